"""Watch a calibration node on the ROS domain: mounting, predicted drift, next manoeuvre.

Ctrl-C or q ends the view, not the node; s saves, r twice resets the calibration, w shows all warnings. After
``dvl-calib run --watch``, which starts a node and watches it, they end both.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, NamedTuple

from ..errors import needing_ros, printable
from ..node.main import ENDS_WITH_STDIN
from ..standard_streams import say
from . import common

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.text import Text

    from ..node.listener import Listener
    from ..node.shutdown import Ending
    from ..node.status import Status

# time limit for the node to save, s
PATIENCE_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--node", metavar="NAME", help="full name of the node, if it was given another")


def run(arguments: argparse.Namespace) -> None:
    """Watch until Ctrl-C."""
    from ..files.parameter_files import NODE_NAME
    from ..node.shutdown import Ending

    with Ending() as ending, _listener(arguments.node or NODE_NAME) as listener:
        show(common.console(), listener, lambda: not ending.requested)


def _listener(node: str) -> Listener:
    """Return a listener to a node's diagnostics. Raises InputError without ROS."""
    with needing_ros("watch"):
        import rich  # noqa: F401

        from ..node.listener import Listener
    return Listener(node)


def run_and_watch(ros_arguments: Sequence[str], ending: Ending) -> int:
    """Start the node in its own process and watch it. Return its exit code.

    Ctrl-C, SIGTERM and SIGHUP end the node as without the view: it saves. The node has its own session, so these
    signals reach only this process; the node ends when the pipe from this process closes.
    """

    with _listener(_node_name(ros_arguments)) as listener:
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(
            node_command(ros_arguments), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=environment, start_new_session=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None  # a pipe
            log: list[str] = []
            collecting = threading.Thread(target=_collect, args=(process.stdout, log), daemon=True)
            collecting.start()
            show(common.console(), listener, lambda: process.poll() is None and not ending.requested, log, True)
            n_shown = len(log) if process.poll() is None else 0  # number of lines already on the screen
        finally:
            code = _end_process(process)
        collecting.join()
        for text in log[n_shown:]:
            say(text)
    return code


def _node_name(ros_arguments: Sequence[str]) -> str:
    """Return the full name of the node started with these arguments, which may remap it by __ns and __node."""
    from ..files.parameter_files import NODE_NAME

    rules = dict(word.split(":=", 1) for word in ros_arguments if ":=" in word)
    return f"{rules.get('__ns', '')}/{rules.get('__node', NODE_NAME)}"


def node_command(ros_arguments: Sequence[str]) -> list[str]:
    """Return the command of a node that ends when its standard input closes."""
    return [sys.executable, "-m", "dvl_calib_ros.node.main", ENDS_WITH_STDIN, *ros_arguments]


def _end_process(process: subprocess.Popen[bytes]) -> int:
    """Ask the node to end by closing its standard input; kill it after `PATIENCE_S`. Return its exit code."""
    assert process.stdin is not None  # a pipe
    process.stdin.close()
    try:
        return process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        say(f"the node did not end within {PATIENCE_S:.0f} s and is killed; it may not have saved")
        process.kill()
        return process.wait()


def _collect(pipe: IO[bytes], lines: list[str]) -> None:
    """Collect the lines of the node's log, so that it neither garbles the view nor is lost."""
    for raw in pipe:
        lines.append(raw.decode(errors="replace").rstrip())


# Age of the last /diagnostics, published at 1 Hz, after which the node or the network counts as gone, s.
SILENCE_S = 5.0
# interval of redrawing on a terminal, and of a line elsewhere, s
REDRAW_S = 0.5
LINE_S = 10.0
# time for the second r, which resets the calibration, s
SURE_S = 3.0
COLOURS = {0: "green", 1: "yellow", 2: "red"}
LOG_LINES = 3
BAR = 24
STREAMS = (("dvl", "DVL"), ("gnss", "reference"), ("imu", "IMU"))
MOUNTING = (
    (("roll", "deg", "°"), ("pitch", "deg", "°"), ("yaw", "deg", "°")),
    (("arm x", "m", " m"), ("arm y", "m", " m"), ("arm z", "m", " m")),
    (("scale", "%", " %"), ("delay", "s", " s against the IMU")),
)
SECTORS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
HEIGHTS = " ▁▂▃▄▅▆▇█"
GOALS = (("worth", "drift"), ("side", " yaw"), ("ahead", " scale"))
WORSE = "[RESULT_WORSE]"
WAITING = "waiting for the node's /diagnostics ... (same ROS_DOMAIN_ID?)"
KEYS = "s save  r r forget  w warnings  q quit"
# width in columns from which a row has three quantities of the mounting and the next manoeuvre fits on one line
WIDE = 76


class Row(NamedTuple):
    """Row of the view, wrapped to the terminal's width. most, least: limits of its number of lines."""

    text: str
    style: str = ""
    most: int = 3
    least: int = 1

    def lines(self, console: Console, width: int) -> list[Text]:
        """Return its lines; longer text ends in an ellipsis."""
        from rich.text import Text

        lines = list(Text(printable(self.text), self.style).wrap(console, width, overflow="fold"))
        if len(lines) > self.most:
            lines = lines[: self.most]
            lines[-1].truncate(width - 1)
            lines[-1].append("…")
        return lines + [Text()] * (self.least - len(lines))


@dataclass(frozen=True)
class View:
    """Live view, fitted to the terminal: rows with fixed places first, optional rows last.

    now_s: monotonic time.
    log: lines of the node's log.
    event: the last answer or log line.
    page: presses of w.
    """

    status: Status | None
    now_s: float
    log: Sequence[str] = ()
    event: str = ""
    page: int = 0

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield lines, at most the terminal's height."""
        width, height = options.max_width, options.size.height
        tail = [Row(_message(line), "dim", most=1) for line in self.log[-LOG_LINES:]]
        fixed, body, warnings = [Row(WAITING, "yellow")], tail, list[str]()
        if self.status is not None:
            warnings = _warnings(self.status)
            fixed = self._fixed(self.status, warnings, width)
            body = [*_body(self.status, warnings, width), *tail]

        def folded(rows: Iterable[Row]) -> list[Text]:
            return [line for row in rows for line in row.lines(console, width)]

        lines = folded(fixed)
        room = max(height - len(lines) - 1, 1)
        warning_rows = folded(Row(f"{number}. {each}", most=height) for number, each in enumerate(warnings, start=1))
        pages = [warning_rows[at : at + room] for at in range(0, len(warning_rows), room)]
        page = self.page % (len(pages) + 1)
        if page:
            lines += [*pages[page - 1], *folded([Row(f"page {page} of {len(pages)} (w goes on)", "dim", most=1)])]
        else:
            lines += folded(body)
        yield from lines[:height]

    def _fixed(self, status: Status, warnings: Sequence[str], width: int) -> list[Row]:
        """Return the rows that are always shown: model, goal, next step, keys, last event."""
        silent, code = self.now_s - status.received_s, status.get("next code")
        state = Row(f"model {status.get('model')}   {_duration(status.get('elapsed [s]'))}", "bold", most=1)
        if silent > SILENCE_S:
            state = Row(f"nothing heard of the node for {silent:.0f} s", "bold red", most=1)
        following = ""
        if _is_usable(status) or not ("REJECTED" in code or "GOOD" in code):
            seconds = status.get("seconds")
            spread = status.values.get("seconds spread", "-")
            remaining = " ± ".join(_duration(each, rough=True) for each in (seconds, spread))
            about = "" if seconds == "-" else f", about {remaining} until good enough"
            following = f"next: {status.get('next')}{about}"
        lines = 1 if width >= WIDE else 2
        return [
            state,
            _goal_row(status, *GOALS[0], width),
            Row(following, "bold green" if "GOOD" in code else "bold", most=lines, least=lines),
            Row(KEYS, "dim", most=lines),
            Row("" if self.event in warnings else self.event, "cyan", most=4 if "(y/n)" in self.event else 2),
        ]


def _is_usable(status: Status) -> bool:
    return status.get("usable") != "no"


def _warnings(status: Status) -> list[str]:
    """Return errors first, then a withdrawn result, warnings, and why the calibration takes longer."""
    found = [each for n in range(1, 100) if (each := status.values.get(f"finding {n}"))]
    found = found or [status.message] * bool(status.level)
    urgent = found[:1] if status.level > 1 else []  # an error, which comes first
    taken_back, longer = (status.values.get(n, "") if _is_usable(status) else "" for n in ("taken back", "longer"))
    # a finding is often why it takes longer
    return list(filter(None, [*urgent, taken_back, *found[len(urgent) :], longer]))


def _body(status: Status, warnings: Sequence[str], width: int) -> Iterator[Row]:
    """Yield mounting and first warning, streams, drift by axis and headings. A narrow view begins with the warning."""
    is_usable, colour = _is_usable(status), COLOURS.get(status.level, "red")
    why = "see the warning" if status.get("next code") == "NEXT_REJECTED" else "not observable yet"
    between = [Row("")] if width >= WIDE else []
    first = [Row(each, colour if status.level else "yellow", most=2) for each in warnings[:1]]
    if len(warnings) > 1:
        first.append(Row(f"+{len(warnings) - 1} more (w)", colour))
    if width < WIDE:
        yield from first
    yield from between
    yield Row("mounting now") if is_usable else Row(f"mounting: not to be used, {why}", colour, most=2)
    for each in MOUNTING:
        found = [_quantity(status, *quantity) for quantity in each]
        for text in ["  ".join(found)] if width >= WIDE else found:
            yield Row(text, "" if is_usable else "dim")
    if is_usable and (sound := status.values.get("speed of sound", "")):
        yield Row(f"speed of sound  {sound}", most=2)
    if width >= WIDE:
        yield from first
    yield from between
    yield Row("   ".join(_stream(status, *each) for each in STREAMS))
    yield from (_goal_row(status, *each, width) for each in GOALS[1:] if f"goal {each[0]} [%]" in status.values)
    yield Row(_heading_bars(status))


def _parsed(text: str) -> float:
    """Parse a number of another process; nan if invalid."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _duration(text: str, rough: bool = False) -> str:
    """Format seconds of another process. rough: without seconds from two minutes on."""
    seconds = _parsed(text)
    if not math.isfinite(seconds):
        return text
    if rough and seconds >= 120.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"


def _number(text: str) -> float:
    """Parse a positive number of another process; 0 if invalid."""
    number = _parsed(text)
    return number if 0.0 < number < 1e9 else 0.0


def _stream(status: Status, name: str, label: str) -> str:
    age = status.get(f"{name} age [s]")
    return f"{label} none yet" if age == "-" else f"{label} {status.get(f'{name} rate [Hz]')} Hz, {age} s ago"


def _quantity(status: Status, name: str, unit: str, label: str) -> str:
    value, std = status.get(f"mounting {name} [{unit}]"), status.get(f"sigma mounting {name} [{unit}]")
    is_estimated = std[:1].isdigit() and status.values.get("samples used") != "0"  # without a sample σ is the prior's
    return f"{name:5} {value:>7}" + (f" ±{std}{label}" if is_estimated else f"{label}, as set").ljust(11)


def _goal_row(status: Status, key: str, label: str, width: int) -> Row:
    """Return one row with a value, its progress bar, and the predicted drift."""
    percent = min(_number(status.get(f"goal {key} [%]")), 100.0)
    names = {"worth": "worth", "side": "worth to the side", "ahead": "worth ahead"}
    goal = f", goal {status.get('target')}" if key == "worth" else ""
    bar = max(0, min(BAR, width - 34))
    full = round(bar * percent / 100.0)
    text = f"{label:7}{'█' * full}{'░' * (bar - full)} {percent:3.0f} %  {status.get(names[key])} m/km{goal}"
    return Row(text, "green" if percent >= 100.0 else "yellow")


def _heading_bars(status: Status) -> str:
    """Return the time driven on each sector of headings as a row of bars."""
    driven = [_number(status.get(f"driven {sector} [s]")) for sector in SECTORS]
    longest = max(max(driven), 1.0)
    heights = (HEIGHTS[round((len(HEIGHTS) - 1) * seconds / longest)] for seconds in driven)
    return "headings  " + "  ".join(f"{sector}{height}" for sector, height in zip(SECTORS, heights, strict=True))


def line(status: Status) -> str:
    """Return the view in one line, for a log."""
    found = ", ".join(" ".join(_quantity(status, *each).split()) for each in MOUNTING[0])
    fault = f"; {status.message}" if status.level else ""
    worth = f"{status.get('worth')} m per km; next: {status.get('next')}"
    return f"{status.get('model')} {status.get('convergence')}: {found}; {worth}{fault}"


class Keys:
    """Keyboard commands to a node. `last_answer` is the answer of the last service, `page` the number of presses of w.

    ends_node: whether the node ends with the view. Then q saves first, and asks before a better result is replaced.
    """

    def __init__(self, listener: Listener, ends_node: bool = False) -> None:
        self._listener = listener
        self._ends_node = ends_node
        self._asked_s = -SURE_S
        self._question = ""
        self._is_leaving = False
        self.page = 0

    @property
    def last_answer(self) -> str:
        """Last answer."""
        return self._question or self._listener.answer

    def press(self, key: str, now_s: float) -> bool:
        """Execute a key. Return False to leave the view."""
        is_sure = key == "r" and now_s - self._asked_s < SURE_S
        self._asked_s = now_s if key == "r" and not is_sure else -SURE_S
        self.page += key == "w"
        if self._is_leaving:
            if key == "y" and self._question:
                self._question = ""
                self._listener.call("save_anyway")
            return key not in ("n", "q")
        self._question = "press r again to forget all that was learnt" if key == "r" and not is_sure else ""
        if key == "s" or (key == "q" and self._ends_node):
            self._listener.call("save")
        elif is_sure:
            self._listener.call("reset")
        self._is_leaving = key == "q"
        return key != "q" or self._ends_node

    def has_left(self) -> bool:
        """Return whether the program may end after q: the node has answered, and no question is open.

        Asks the question whether to replace a better saved result, so call it repeatedly.
        """
        if not self._is_leaving or self._listener.is_waiting or self._question:
            return False
        if WORSE not in self._listener.answer:
            return True
        self._question = f"replace the better result? (y/n)  {self._listener.answer}"
        return False


@contextmanager
def _single_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the next key of the terminal without waiting, '' for none."""
    if not sys.stdin.isatty():
        yield lambda: ""
        return
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    tty.setcbreak(number)  # Ctrl-C stays a signal
    try:
        yield lambda: os.read(number, 1).decode(errors="replace") if select.select([number], [], [], 0.0)[0] else ""
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def show(
    console: Console,
    listener: Listener,
    is_running: Callable[[], bool] = lambda: True,
    log: Sequence[str] = (),
    ends_node: bool = False,
) -> None:
    """Draw the view while `is_running`, or until q.

    listener: source of the latest status, and receiver of keys. ends_node: whether the node ends with the view. On a
    terminal the view is drawn in place; elsewhere a line is written after a change, or periodically.
    """
    if not console.is_terminal or console.is_dumb_terminal:
        for text in _log_lines(listener.latest, is_running):
            console.print(text, markup=False, soft_wrap=True)
        return
    from rich.live import Live

    keys, event, before = Keys(listener, ends_node), "", ("", "")
    with _single_keys() as pressed, Live(View(None, 0.0, log), console=console, auto_refresh=False) as live:
        while is_running():
            status, now_s = listener.latest(REDRAW_S), time.monotonic()
            while key := pressed():
                if not keys.press(key, now_s):
                    return
            if keys.has_left():
                return
            news = (_message(log[-1]) if log else "", keys.last_answer)
            event = next((new for new, old in zip(news, before, strict=True) if new != old), event)
            before = news
            live.update(View(status, now_s, log, event, keys.page), refresh=True)


def _message(logged: str) -> str:
    """Return a line of the node's log without time and name of the node."""
    return re.sub(r"^\[(\w+)\] \[[\d.]+\] \[[^\]]*\]: ", "", logged)


def _log_lines(statuses: Callable[[float], Status | None], is_running: Callable[[], bool]) -> Iterable[str]:
    """Yield a line when model, convergence or severity change, and at least every `LINE_S`."""
    printed, printed_s = ("", "", ""), 0.0
    told_s = time.monotonic()
    while is_running():
        status, now_s = statuses(REDRAW_S), time.monotonic()
        if status is None:
            if now_s - told_s > SILENCE_S:
                told_s = now_s
                yield WAITING
            continue
        what = (status.get("model"), status.get("convergence"), str(status.level))
        if what != printed or now_s - printed_s > LINE_S:
            printed, printed_s = what, now_s
            yield line(status)
