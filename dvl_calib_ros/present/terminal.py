"""Documents on a terminal of any width; wide tables are folded so that no number is cut off."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Column
from rich.table import Table as RichTable
from rich.text import Text

from ..verdict.kinds import Severity
from ..verdict.reasons import Reason
from .document import Cell, Commands, Document, Facts, FindingLine, Numbers, Sentence, Table, Where

# Cells up to this width stay on one line; longer ones are sentences, which may break between words.
SHORT = 20
# Tables of up to this number of columns break their row names before they are split into more than two.
FEW = 6
# two blanks and a line next to a column
_GAP_WIDTH = 3


class Folding:
    """Table that fits: unchanged, transposed, split into tables that repeat the first columns, or one line per cell."""

    def __init__(self, table: RichTable, transposed: RichTable | None = None) -> None:
        self._table = table
        self._transposed = transposed

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the table as it is if it fits; else transposed, in groups of columns, or with one cell per line."""
        table, width = self._table, options.max_width
        needed = [_keep_short(console, options, column) for column in table.columns]
        if sum(needed) + 1 <= width:
            yield table
            return
        if table.title:
            yield _rendered(console, table.title, "table.title")
        turned = self._transposed
        groups = _groups(table.columns, needed, width - 1)
        if groups is not None and len(groups) > 2 and len(needed) <= FEW:
            names = table.columns[0]  # long names may break, so that more columns are next to each other
            names.no_wrap = False
            broken = (Measurement.get(console, options, cell).minimum for cell in (names.header, *names.cells))
            groups = _groups(table.columns, [_GAP_WIDTH + max(broken), *needed[1:]], width - 1)
        if turned is not None and sum(_keep_short(console, options, column) for column in turned.columns) + 1 <= width:
            yield turned
        elif groups is None:
            yield from _one_cell_per_line(console, table)
        else:
            yield from (_selected_columns(table, group) for group in groups)
        if table.caption:
            yield _rendered(console, table.caption, "table.caption")


def _keep_short(console: Console, options: ConsoleOptions, column: Column) -> int:
    """Keep a column of short cells on single lines. Return the smallest width, with borders, that cuts nothing off."""
    wide = options.update(width=10_000)
    sizes = [Measurement.get(console, wide, cell) for cell in (column.header, *column.cells)]
    widest = max((size.maximum for size in sizes), default=0)
    broken = max((size.minimum for size in sizes), default=0)
    column.no_wrap = column.no_wrap or widest <= SHORT
    return _GAP_WIDTH + (widest if column.no_wrap else max(broken, SHORT))


def _groups(columns: Sequence[Column], needed: Sequence[int], width: int) -> list[list[int]] | None:
    """Return the columns of each part, which all begin with the row names; None if one is too wide."""
    n_names = next((at for at, column in enumerate(columns) if at and column.justify == "right"), 1)
    for names in (range(n_names), range(1)):
        rest = range(len(names), len(columns))
        room = width - sum(needed[at] for at in names)
        if max((needed[at] for at in rest), default=0) > room:
            continue
        groups: list[list[int]] = []
        space_left = 0
        for at in rest:
            if needed[at] > space_left:
                groups.append([*names])
                space_left = room
            groups[-1].append(at)
            space_left -= needed[at]
        return groups
    return None


def _selected_columns(table: RichTable, places: Sequence[int]) -> RichTable:
    """Copy some columns of a table, by their indices."""
    part = RichTable(box=table.box, show_header=table.show_header, pad_edge=table.pad_edge)
    for at in places:
        column = table.columns[at]
        part.add_column(column.header, justify=column.justify, style=column.style, no_wrap=column.no_wrap)
    cells = [list(table.columns[at].cells) for at in places]
    for row, values in zip(table.rows, zip(*cells, strict=True), strict=True):
        part.add_row(*values, style=row.style, end_section=row.end_section)
    return part


def _one_cell_per_line(console: Console, table: RichTable) -> RenderResult:
    """Yield the table with each cell on a line of its own, after its column's heading."""
    cells = [list(column.cells) for column in table.columns]
    for values in zip(*cells, strict=True):
        for at, (column, value) in enumerate(zip(table.columns, values, strict=True)):
            if value == "":
                continue
            header = _rendered(console, column.header)
            if not isinstance(value, str | Text):
                yield from (header, value)
            elif at == 0 or not header.plain:
                yield _rendered(console, value, "bold")
            else:
                yield Text.assemble(" ", header, " ", _rendered(console, value))


def _rendered(console: Console, text: Any, style: str = "") -> Text:
    """Render a text with its markup as in a table."""
    return console.render_str(text, style=style) if isinstance(text, str) else text


COLOURS = {
    Severity.ACCEPT: "green",
    Severity.MARGINAL: "yellow",
    Severity.WARNING: "yellow",
    Severity.REJECT: "red",
    Severity.ERROR: "red",
}
# style of a cell by its class on a page
_STYLES = {"good": "green", "off": "yellow", "far": "yellow", "bad": "red"}


def shown(document: Document) -> Iterator[Any]:
    """Yield rich's renderables of a document, without its warnings."""
    yield from answer_shown(document)
    yield from sections_shown(document)


def answer_shown(document: Document) -> Iterator[Any]:
    """Yield rich's renderables of a document's answer."""
    answer = document.answer
    if answer is not None:
        sentences = list(answer.sentences)
        if answer.advice:  # advice and reason on one line
            sentences = [" ".join([answer.advice, *sentences])]
        yield Text.assemble((answer.word, f"bold {COLOURS[answer.severity]}"), ": ", sentences[0])
        yield from map(Text, sentences[1:])


def sections_shown(document: Document) -> Iterator[Any]:
    """Yield rich's renderables of a document's sections."""
    for section in document.sections:
        if section.where is Where.PAGE or not section.items:
            continue
        if section.title or not isinstance(section.items[0], Sentence):
            yield ""
        if section.title:
            yield Text(section.title, "bold")
        for item in section.items:
            if isinstance(item, Table):
                yield rich_table(item)
            elif isinstance(item, Sentence):
                yield Text(item.text, "dim" if item.soft else "")
            elif isinstance(item, FindingLine):
                yield from _finding_lines(item.reason)
            elif isinstance(item, Commands):
                for name, line in item.lines:  # to be copied: never broken
                    yield Text(f"{name:5} {line}", no_wrap=True)
            elif isinstance(item, Facts):
                yield from (Text(f"{name}: {value}") for name, value in item.facts.items() if value)
            elif isinstance(item, Numbers):
                yield rich_table(item.table)


def _finding_lines(reason: Reason) -> Iterator[Padding]:
    """Yield a finding and, indented below it, remedy and code."""
    yield Padding(Text(reason.says, COLOURS[reason.severity]), (0, 0, 0, 2))
    remedy = [reason.remedy, " "] if reason.remedy else []
    yield Padding(Text.assemble(*remedy, (f"[{reason.code}]", "dim")), (0, 0, 0, 4))


def rich_table(table: Table) -> Folding:
    """Return a table for rich, transposed or folded if the terminal is too narrow."""
    turned = table.transposed
    return Folding(_build(table), None if turned is None else _build(replace(turned, title="", notes=())))


def _build(table: Table) -> RichTable:
    """Build the table for rich without fitting it to the terminal."""
    built = RichTable(
        show_header=any(_cell(name).plain for name in table.head),
        title=Text(table.title, "table.title") if table.title else None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        caption=Text(" ".join(table.notes), "table.caption") if table.notes else None,
        caption_justify="left",
    )
    for index, name in enumerate(table.head):
        is_word = index < table.words
        built.add_column(_cell(name), justify="left" if is_word else "right", no_wrap=not is_word, overflow="fold")
    for index, row in enumerate(table.rows):
        built.add_row(*map(_cell, row), style="bold" if index == table.marked else None)
    return built


def _cell(cell: str | Cell) -> Text:
    """Return a cell as styled text, with its small second line appended."""
    if isinstance(cell, str):
        return Text(cell)
    text = Text(cell.text, _STYLES.get(cell.kind.removeprefix("bar "), ""))
    return text.append(f" {cell.below}", "dim") if cell.below else text
