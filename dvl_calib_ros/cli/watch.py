"""Watch a calibration node that runs somewhere on the ROS domain: mounting, what it is worth, what to drive next.

Ctrl-C or q ends the view, not the node; s saves, r twice forgets all. ``dvl-calib run --watch`` starts a node and
watches it; there they end both.
"""

from __future__ import annotations

import argparse
import math
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING

from ..errors import printable
from ..node.main import ENDS_WITH_STDIN
from ..standard_streams import say
from . import common

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from ..node.listener import Listener
    from ..node.shutdown import Ending
    from ..node.status import Status

# How long a node may take to save, s.
PATIENCE_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--node", metavar="NAME", help="full name of the node, if it was given another")


def run(arguments: argparse.Namespace) -> None:
    """Watch until Ctrl-C."""
    from ..files.parameter_files import NODE_NAME
    from ..node.shutdown import Ending

    with Ending() as ending, _listener(arguments.node or NODE_NAME) as listener:
        show(common.console(), listener, lambda: not ending.requested)


def _listener(node: str) -> Listener:
    from ..errors import needing_ros

    with needing_ros("watch"):
        import rich  # noqa: F401

        from ..node.listener import Listener
    return Listener(node)


def run_and_watch(ros_arguments: Sequence[str], ending: Ending) -> int:
    """Start the node in a process of its own and watch it; its exit code.

    Ctrl-C, SIGTERM and SIGHUP end the node as they would without the view: it saves. It is in a session of its own, so
    that they reach it through here only, by the pipe that closes with this process, however that ends.
    """

    with _listener(_node_name(ros_arguments)) as listener:
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(
            node_command(ros_arguments), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=environment, start_new_session=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None  # a pipe
            log = _Log(process.stdout)
            show(common.console(), listener, lambda: process.poll() is None and not ending.requested, log.lines)
            said = len(log.lines) if process.poll() is None else 0  # lines that are on the screen already
        finally:
            code = _ended(process)
        for text in log.finished()[said:]:
            say(text)
    return code


def _node_name(ros_arguments: Sequence[str]) -> str:
    """Full name of the node that is started with these: __ns and __node remap it."""
    from ..files.parameter_files import NODE_NAME

    rules = dict(word.split(":=", 1) for word in ros_arguments if ":=" in word)
    return f"{rules.get('__ns', '')}/{rules.get('__node', NODE_NAME)}"


def node_command(ros_arguments: Sequence[str]) -> list[str]:
    """What runs a node that ends with this process, or when its standard input is closed before."""
    return [sys.executable, "-m", "dvl_calib_ros.node.main", ENDS_WITH_STDIN, *ros_arguments]


def _ended(process: subprocess.Popen[bytes]) -> int:
    assert process.stdin is not None  # a pipe
    process.stdin.close()
    try:
        return process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        say(f"the node did not end within {PATIENCE_S:.0f} s and is killed; it may not have saved")
        process.kill()
        return process.wait()


class _Log:
    """Collects what the node writes, so that it neither garbles the view nor is lost."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self.lines: list[str] = []
        self._pipe = pipe
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for raw in self._pipe:
            self.lines.append(raw.decode(errors="replace").rstrip())

    def finished(self) -> list[str]:
        """All lines of a node that has ended."""
        self._thread.join()
        return self.lines


# /diagnostics comes at 1 Hz; without it for so long, the node or the network is gone, s.
SILENCE_S = 5.0
# How often the view is drawn on a terminal, s, and a line written where there is none.
REDRAW_S = 0.5
LINE_S = 10.0
# A second r within this forgets all that was learnt, s.
SURE_S = 3.0
COLOURS = {0: "green", 1: "yellow", 2: "red"}
LOG_LINES = 3
BAR = 24
STREAMS = (("dvl", "DVL"), ("gnss", "reference"), ("imu", "IMU"))
MOUNTING = (
    (("roll", "deg", "°"), ("pitch", "deg", "°"), ("yaw", "deg", "°")),
    (("arm x", "m", " m"), ("arm y", "m", " m"), ("arm z", "m", " m")),
    (("scale", "%", " %"), ("delay", "s", " s")),
)
SECTORS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
HEIGHTS = " ▁▂▃▄▅▆▇█"
GOALS = (("worth", "dead reckoning"), ("side", "  by yaw"), ("ahead", "  by scale"))
KEYS = "s save   r r forget all   q quit"


def rendered(status: Status | None, now_s: float, log: Sequence[str] = (), said: str = "") -> RenderableType:
    """The view. now_s: monotonic time. log: last lines that the node has written. said: in answer to a key."""
    from rich.console import Group
    from rich.text import Text

    def text(line: str, style: str = "") -> Text:
        return Text(printable(line), style=style, overflow="ellipsis", no_wrap=True)

    tail = [text(line, "dim") for line in log[-LOG_LINES:]]
    if status is None:
        return Group(text("waiting for the node's /diagnostics ... (same ROS_DOMAIN_ID?)", "yellow"), *tail)
    colour = COLOURS.get(status.level, "red")
    lines: list[RenderableType] = [text(_head(status), "bold")]
    silent = now_s - status.received_s
    if silent > SILENCE_S:
        lines.insert(0, text(f"nothing heard of the node for {silent:.0f} s", "bold red"))
    if status.level:
        lines.append(Text(printable(status.message), style=colour))
    lines += [text("   ".join(_stream(status, *each) for each in STREAMS)), text("")]
    is_usable, code = status.get("usable") != "no", status.get("next code")
    unusable = "see above" if code == "NEXT_REJECTED" else "the data do not show it yet"
    lines.append(text("mounting now") if is_usable else text(f"mounting: not to be used, {unusable}", colour))
    lines += [text("  ".join(_quantity(status, *each) for each in row), "" if is_usable else "dim") for row in MOUNTING]
    if is_usable and (sound := status.values.get("speed of sound", "")):
        lines.append(text(f"speed of sound  {sound}"))
    lines.append(text(""))
    lines += [_goal(status, *each) for each in GOALS if f"goal {each[0]} [%]" in status.values]
    lines.append(text(_rose(status)))
    if is_usable or not ("REJECTED" in code or "GOOD" in code):
        if taken_back := status.values.get("taken back", ""):
            lines.append(text(taken_back, "yellow"))
        seconds = status.get("seconds")
        about = "" if seconds == "-" else f", about {_duration(seconds)} until good enough"
        style = "bold green" if "GOOD" in code else "bold"
        lines.append(text(f"next: {status.get('next')}{about}", style))
    lines += [text(""), text(f"{KEYS}   {said}".rstrip(), "dim")]
    return Group(*lines, *tail)


def _head(status: Status) -> str:
    return f"model {status.get('model')}   {_duration(status.get('elapsed [s]'))}"


def _duration(text: str) -> str:
    """Seconds of another process, as people tell them."""
    try:
        seconds = float(text)
    except ValueError:
        return text
    if not math.isfinite(seconds):
        return text
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"


def _number(text: str) -> float:
    """A number of another process; 0 where it is none."""
    try:
        number = float(text)
    except ValueError:
        return 0.0
    return number if 0.0 < number < 1e9 else 0.0


def _stream(status: Status, name: str, shown: str) -> str:
    age = status.get(f"{name} age [s]")
    return f"{shown} none yet" if age == "-" else f"{shown} {status.get(f'{name} rate [Hz]')} Hz, {age} s ago"


def _quantity(status: Status, name: str, unit: str, shown: str) -> str:
    value, std = status.get(f"mounting {name} [{unit}]"), status.get(f"sigma mounting {name} [{unit}]")
    return f"{name:5} {value:>7}" + (f" ±{std}{shown}" if std[:1].isdigit() else f"{shown}, as set").ljust(11)


def _goal(status: Status, key: str, shown: str) -> RenderableType:
    from rich.text import Text

    percent = min(_number(status.get(f"goal {key} [%]")), 100.0)
    full = round(BAR * percent / 100.0)
    names = {"worth": "worth", "side": "worth to the side", "ahead": "worth ahead"}
    goal = f", goal {status.get('target')}" if key == "worth" else ""
    return Text.assemble(
        f"{shown:15} ",
        ("█" * full, "green" if percent >= 100.0 else "yellow"),
        ("░" * (BAR - full), "dim"),
        printable(f" {percent:3.0f} %  {status.get(names[key])} m per km{goal}"),
        overflow="ellipsis",
        no_wrap=True,
    )


def _rose(status: Status) -> str:
    driven = [_number(status.get(f"driven {sector} [s]")) for sector in SECTORS]
    most = max(max(driven), 1.0)
    heights = (HEIGHTS[round((len(HEIGHTS) - 1) * seconds / most)] for seconds in driven)
    return "headings        " + "  ".join(f"{sector}{height}" for sector, height in zip(SECTORS, heights, strict=True))


def line(status: Status) -> str:
    """The view in one line, for a log."""
    found = ", ".join(" ".join(_quantity(status, *each).split()) for each in MOUNTING[0])
    fault = f"; {status.message}" if status.level else ""
    worth = f"{status.get('worth')} m per km; next: {status.get('next')}"
    return f"{status.get('model')} {status.get('convergence')}: {found}; {worth}{fault}"


class Keys:
    """What single keys ask of a node; what came of it is in `said`."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self._asked_s = -SURE_S
        self._own = ""

    @property
    def said(self) -> str:
        """The last answer."""
        return self._own or self._listener.answer

    def press(self, key: str, now_s: float) -> bool:
        """Do what it asks for; False to leave the view."""
        is_sure = key == "r" and now_s - self._asked_s < SURE_S
        self._asked_s = now_s if key == "r" and not is_sure else -SURE_S
        self._own = "press r again to forget all that was learnt" if key == "r" and not is_sure else ""
        if key == "s":
            self._listener.call("save")
        elif is_sure:
            self._listener.call("reset")
        return key != "q"


@contextmanager
def _single_keys() -> Iterator[Callable[[], str]]:
    """Read keys of the terminal as they are pressed: a function that gives the next one, '' for none."""
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
) -> None:
    """Draw while it is running, or until q. listener: whose latest status is drawn, and who is told of keys.

    On a terminal the view is drawn in place; elsewhere a line is written when something has changed, or now and then.
    """
    if not console.is_terminal or console.is_dumb_terminal:
        for text in _lines(listener.latest, is_running):
            console.print(text, markup=False, soft_wrap=True)
        return
    from rich.live import Live

    keys = Keys(listener)
    with _single_keys() as pressed, Live(rendered(None, 0.0, log), console=console, auto_refresh=False) as live:
        while is_running():
            status, now_s = listener.latest(REDRAW_S), time.monotonic()
            while key := pressed():
                if not keys.press(key, now_s):
                    return
            live.update(rendered(status, now_s, log, keys.said), refresh=True)


def _lines(statuses: Callable[[float], Status | None], is_running: Callable[[], bool]) -> Iterable[str]:
    said, said_s = ("", "", ""), 0.0
    while is_running():
        status, now_s = statuses(REDRAW_S), time.monotonic()
        if status is None:
            continue
        what = (status.get("model"), status.get("convergence"), str(status.level))
        if what != said or now_s - said_s > LINE_S:
            said, said_s = what, now_s
            yield line(status)
