"""A document on a terminal: an answer in its colour, sentences, tables without lines."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ..errors import printable
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason
from .document import Cell, Commands, Document, Facts, FindingLine, Map, Numbers, Sentence, Table, Where

if TYPE_CHECKING:
    from rich.padding import Padding
    from rich.text import Text

    from .folding import Folding

COLOURS = {
    Severity.ACCEPT: "green",
    Severity.MARGINAL: "yellow",
    Severity.WARNING: "yellow",
    Severity.REJECT: "red",
    Severity.ERROR: "red",
}
# Of a cell by its class on a page
_STYLES = {"good": "green", "off": "yellow", "far": "yellow", "bad": "red"}


def shown(document: Document, width: int | None = None) -> Iterator[Any]:
    """What rich prints of a document, but for its warnings, one after the other.

    width: of a terminal that people look at, characters.
    """
    from rich.text import Text

    from .terminal_map import terminal_map

    if document.lead:
        yield from _found(document.lead)
    answer = document.answer
    if answer is not None:
        sentences = list(map(printable, answer.sentences))
        if answer.advice:  # what to do and why, as one
            sentences = [" ".join([answer.advice, *sentences])]
        yield Text.assemble((answer.word, f"bold {COLOURS[answer.severity]}"), ": ", sentences[0])
        yield from map(Text, sentences[1:])
    for section in document.sections:
        if section.where is Where.PAGE or not section.items:
            continue
        if section.title or not isinstance(section.items[0], Sentence):
            yield ""
        if section.title:
            yield Text(printable(section.title), "bold")
        for item in section.items:
            if isinstance(item, Table):
                yield rich_table(item)
            elif isinstance(item, Sentence):
                yield Text(printable(item.text), "dim" if item.soft else "")
            elif isinstance(item, FindingLine):
                yield from _found(item.reason)
            elif isinstance(item, Commands):
                for name, line in item.lines:  # to be copied: never broken
                    yield Text(f"{name:5} {line}", no_wrap=True)
            elif isinstance(item, Facts):
                yield from (Text(printable(f"{name}: {value}")) for name, value in item.facts.items() if value)
            elif isinstance(item, Numbers):
                yield rich_table(item.table)
            elif isinstance(item, Map) and width is not None:
                yield terminal_map(item.navigation, width)


def _found(reason: Reason) -> Iterator[Padding]:
    from rich.padding import Padding
    from rich.text import Text

    yield Padding(Text(printable(reason.says), COLOURS[reason.severity]), (0, 0, 0, 2))
    yield Padding(Text.assemble(printable(reason.remedy), " ", (f"[{reason.code}]", "dim")), (0, 0, 0, 4))


def rich_table(table: Table) -> Folding:
    """A table as rich prints it, folded where the terminal is too narrow."""
    from rich import box
    from rich.table import Table as RichTable

    from .folding import Folding

    made = RichTable(
        show_header=any(_cell(name).plain for name in table.head),
        title=table.title or None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        caption=" ".join(table.notes) or None,
        caption_justify="left",
    )
    for index, name in enumerate(table.head):
        is_word = index < table.words
        made.add_column(_cell(name), justify="left" if is_word else "right", no_wrap=not is_word, overflow="fold")
    for index, row in enumerate(table.rows):
        made.add_row(*map(_cell, row), style="bold" if index == table.marked else None)
    return Folding(made)


def _cell(cell: str | Cell) -> Text:
    from rich.text import Text

    if isinstance(cell, str):
        return Text(printable(cell))
    text = Text(printable(cell.text), _STYLES.get(cell.kind.removeprefix("bar "), ""))
    return text.append(f" {printable(cell.below)}", "dim") if cell.below else text
