"""Tables for terminals of any width: what is too wide is folded, so that no number is cut off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

# Cells up to this width stay on one line; longer ones are sentences, which may be broken between words.
SHORT = 20
# Beside its widest cell a column takes two blanks and a line.
_BESIDE = 3


class Folding:
    """A table as it is if it fits, else in several tables with the first columns in each, else one line per cell."""

    def __init__(self, table: Table) -> None:
        self._table = table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table, width = self._table, options.max_width
        needed = [_keep_short(console, options, column) for column in table.columns]
        if sum(needed) + 1 <= width:
            yield table
            return
        if table.title:
            yield _shown(console, table.title, "table.title")
        groups = _groups(table.columns, needed, width - 1)
        if groups is None:
            yield from _lines(console, table)
        else:
            yield from (_part(table, group) for group in groups)
        if table.caption:
            yield _shown(console, table.caption, "table.caption")


def _keep_short(console: Console, options: ConsoleOptions, column: Column) -> int:
    """Keep a column of short cells on single lines; its least width, with what is beside it, that cuts nothing off."""
    wide = options.update(width=10_000)
    sizes = [Measurement.get(console, wide, cell) for cell in (column.header, *column.cells)]
    widest = max((size.maximum for size in sizes), default=0)
    broken = max((size.minimum for size in sizes), default=0)
    column.no_wrap = column.no_wrap or widest <= SHORT
    return _BESIDE + (widest if column.no_wrap else max(broken, SHORT))


def _groups(columns: Sequence[Column], needed: Sequence[int], width: int) -> list[list[int]] | None:
    """Places of the columns of each part, which all begin with those that name the rows; None if none is so narrow."""
    n_names = next((at for at, column in enumerate(columns) if at and column.justify == "right"), 1)
    for names in (range(n_names), range(1)):
        rest = range(len(names), len(columns))
        room = width - sum(needed[at] for at in names)
        if max((needed[at] for at in rest), default=0) > room:
            continue
        groups: list[list[int]] = []
        left = 0
        for at in rest:
            if needed[at] > left:
                groups.append([*names])
                left = room
            groups[-1].append(at)
            left -= needed[at]
        return groups
    return None


def _part(table: Table, places: Sequence[int]) -> Table:
    part = Table(box=table.box, show_header=table.show_header, pad_edge=table.pad_edge)
    for at in places:
        column = table.columns[at]
        part.add_column(column.header, justify=column.justify, style=column.style, no_wrap=column.no_wrap)
    cells = [list(table.columns[at].cells) for at in places]
    for row, values in zip(table.rows, zip(*cells, strict=True), strict=True):
        part.add_row(*values, style=row.style, end_section=row.end_section)
    return part


def _lines(console: Console, table: Table) -> RenderResult:
    cells = [list(column.cells) for column in table.columns]
    for values in zip(*cells, strict=True):
        for at, (column, value) in enumerate(zip(table.columns, values, strict=True)):
            if value == "":
                continue
            header = _shown(console, column.header)
            if not isinstance(value, str | Text):
                yield from (header, value)
            elif at == 0 or not header.plain:
                yield _shown(console, value, "bold")
            else:
                yield Text.assemble(" ", header, " ", _shown(console, value))


def _shown(console: Console, text: Any, style: str = "") -> Text:
    """A text, with its markup, as rich shows it within a table."""
    return console.render_str(text, style=style) if isinstance(text, str) else text
