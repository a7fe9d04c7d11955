"""What the running node says of itself, for a terminal: estimates with σ, how far each is, what to fly next.

Everything comes from one status of /diagnostics, so the view works beside the node as well as far from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import printable

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

    from ..node.status import Status

# /diagnostics comes at 1 Hz; without it for so long, the node or the network is gone, s.
SILENCE_S = 5.0
# How often the view is drawn on a terminal, s, and a line written where there is none.
REDRAW_S = 0.5
LINE_S = 10.0
COLOURS = {0: "green", 1: "yellow", 2: "red"}
LOG_LINES = 5
# The table without its last column, which is broken between words, and the longest word in that
TABLE_WIDTH = 72


def rendered(status: Status | None, now_s: float, log: Sequence[str] = ()) -> RenderableType:
    """The view. now_s: monotonic time. log: last lines that the node has written."""
    from rich.console import Group
    from rich.text import Text

    tail = [Text(printable(line), style="dim", no_wrap=True, overflow="ellipsis") for line in log[-LOG_LINES:]]
    if status is None:
        return Group("[yellow]waiting for the node's /diagnostics[/] ... (same ROS_DOMAIN_ID?)", *tail)
    colour = COLOURS.get(status.level, "red")
    why = status.get("why") if status.get("gnss") in status.get("why") else f"{status.get('why')}; {status.get('gnss')}"
    head = [
        f"[bold]{_shown(status.get('model'))}[/]: {_shown(why)}",
        f"[bold {colour}]{_shown(status.get('convergence'))}[/]   {_shown(_counts(status))}",
    ]
    if status.level:
        head.append(f"[{colour}]{_shown(status.message)}[/]")
    silent = now_s - status.received_s
    if silent > SILENCE_S:
        head.insert(0, f"[bold red]nothing heard of the node for {silent:.0f} s[/]")
    return Group(*head, _Estimates(status), *tail)


def _shown(text: str) -> str:
    """A text of another process as rich takes it: it can neither style nor move the cursor."""
    from rich.markup import escape

    return escape(printable(text))


def _counts(status: Status) -> str:
    words = [f"{status.get('samples used')} used", f"{status.get('samples gated')} gated"]
    words += [f"{count} invalid" for count in [status.get("dvl invalid")] if count not in ("-", "0")]
    words += [f"NIS {status.get('mean NIS')}"] if status.get("samples used") != "0" else []
    return ", ".join(words)


class _Estimates:
    """A table, on a terminal that is too narrow for it a list."""

    def __init__(self, status: Status) -> None:
        self._status = status

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield _table(self._status) if options.max_width >= TABLE_WIDTH else _list(self._status)


def _list(status: Status) -> RenderableType:
    """What `_table` says, without its bars: numbers that are cut off or below the screen's end help nobody."""
    lines = []
    for name, unit in status.parameters:
        key = f"{name} [{unit}]"
        progress = status.values.get(f"progress {name} [%]")
        done = "" if progress is None else f", {float(progress):.0f} % to fine"
        missing = status.get(f"observed {name}").partition("needs ")[2]
        fly = f"; fly {missing}" if missing else ""
        lines.append(_shown(f"{name} {status.get(key)} ± {status.get(f'std {key}')} {unit}{done}{fly}"))
    return "\n".join(lines)


def _table(status: Status) -> RenderableType:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE, pad_edge=False)
    for column in ("", "estimate", "± 1σ", "to fine", "still to drive"):
        table.add_column(
            column, justify="right" if column in ("estimate", "± 1σ") else "left", no_wrap=column != "still to drive"
        )
    for name, unit in status.parameters:
        key = f"{name} [{unit}]"
        observed = status.get(f"observed {name}")
        progress = status.values.get(f"progress {name} [%]")
        bar: Any = "" if progress is None else _bar(float(progress))
        missing = observed.partition("needs ")[2]
        value, std = _shown(status.get(key)), _shown(status.get(f"std {key}"))
        table.add_row(_shown(f"{name} {unit}"), value, std, bar, _shown(missing))
    return table


def _bar(percent: float) -> RenderableType:
    from rich.progress_bar import ProgressBar

    # colours that terminals with eight of them have, too
    return ProgressBar(100.0, percent, width=20, style="bright_black", complete_style="yellow", finished_style="green")


def line(status: Status) -> str:
    """The view in one line, for a log."""
    estimates = ", ".join(
        f"{name} {status.get(f'{name} [{unit}]')} ± {status.get(f'std {name} [{unit}]')} {unit}".rstrip()
        for name, unit in status.parameters
    )
    fault = f"; {status.message}" if status.level else ""
    return f"{status.get('model')} {status.get('convergence')}: {estimates}; {_counts(status)}{fault}"


def show(
    console: Console,
    statuses: Callable[[float], Status | None],
    is_running: Callable[[], bool] = lambda: True,
    log: Sequence[str] = (),
) -> None:
    """Draw while it is running. statuses: waits so many s and returns the latest status.

    On a terminal the view is drawn in place; elsewhere a line is written when something has changed, or now and then.
    """
    if console.is_terminal and not console.is_dumb_terminal:
        _draw(console, statuses, is_running, log)
    else:
        for text in _lines(statuses, is_running):
            console.print(text, markup=False, soft_wrap=True)


def _draw(
    console: Console, statuses: Callable[[float], Status | None], is_running: Callable[[], bool], log: Sequence[str]
) -> None:
    from rich.live import Live

    with Live(rendered(None, 0.0, log), console=console, auto_refresh=False) as live:
        while is_running():
            live.update(rendered(statuses(REDRAW_S), time.monotonic(), log), refresh=True)


def _lines(statuses: Callable[[float], Status | None], is_running: Callable[[], bool]) -> Iterable[str]:
    said, said_s = ("", "", ""), 0.0
    while is_running():
        status, now_s = statuses(REDRAW_S), time.monotonic()
        if status is None:
            continue
        what = (status.get("model"), status.get("convergence"), str(status.level))
        if what != said or now_s - said_s > LINE_S:
            said, said_s = what, now_s
            yield printable(line(status))
