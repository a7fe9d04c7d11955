"""A result as it is said: an answer, sentences, tables and figures, whoever shows them.

What a result says is laid out once, by the module of this room that is called as the result is. Terminal
(`terminal.py`), page (`page.py`) and data frame (`Table.frame`) are made of that; JSON is the result's own plain data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

from ..verdict.kinds import Severity

if TYPE_CHECKING:
    from .style import Picture


class Where(Enum):
    """Which of the two shows a section."""

    BOTH = "both"
    TERMINAL = "terminal"
    PAGE = "page"


@dataclass(frozen=True)
class Cell:
    """Text of a table. kind: a class of the style sheet, such as good, off, far, bad.

    below: small, on a second line.
    """

    text: str
    kind: str = ""
    below: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of cells under a head; the first column names the row.

    Parameters
    ----------
    head
        Names of the columns.
    rows
        Cells, each a text or a `Cell`.
    title
        Above it.
    marked
        Index of the row that stands out.
    notes
        Below it.
    dense
        Whether it has many columns.
    words
        How many columns at the left are words; the others are numbers.

    """

    head: Sequence[str | Cell]
    rows: Sequence[Sequence[str | Cell]]
    title: str = ""
    marked: int | None = None
    notes: Sequence[str] = ()
    dense: bool = False
    words: int = 1

    def frame(self) -> Any:
        """The table as a pandas DataFrame of texts. Raises ImportError without pandas."""
        import pandas

        return pandas.DataFrame(
            [[_text(cell) for cell in row] for row in self.rows], columns=[_text(cell) for cell in self.head]
        )


def _text(cell: str | Cell) -> str:
    return cell if isinstance(cell, str) else cell.text


@dataclass(frozen=True)
class Sentence:
    """A sentence. soft: less than the others."""

    text: str
    soft: bool = False


@dataclass(frozen=True)
class Figures:
    """Pictures, which only a page has drawn: ``draw()`` makes them."""

    draw: Callable[[], Sequence[Picture]]


@dataclass(frozen=True)
class Section:
    """What stands under one heading."""

    title: str
    items: Sequence[Sentence | Table | Figures]
    where: Where = Where.BOTH


@dataclass(frozen=True)
class Answer:
    """What a result says first: a word, how good or bad that is, and sentences."""

    word: str
    severity: Severity
    sentences: Sequence[str]


@dataclass(frozen=True)
class Document:
    """A result as it is said. warnings: what to know beside it. sections: in order; those without items are left out.

    parameters: what it was made with, by name; for the page.
    """

    title: str
    subtitle: str
    answer: Answer | None
    warnings: Sequence[str]
    sections: Sequence[Section]
    parameters: Sequence[tuple[str, str]] = ()

    @property
    def tables(self) -> list[Table]:
        """All of them, in order."""
        return [item for section in self.sections for item in section.items if isinstance(item, Table)]


def number(value: float, digits: int = 2, *, signed: bool = False) -> str:
    """A number with so many digits, the minus as wide as the plus; – for none."""
    if value != value:
        return "–"
    rounded = round(value, digits) + 0.0  # no minus before zero
    return f"{rounded:{'+' if signed else ''}.{digits}f}".replace("-", "−")


def signed(value: float, digits: int = 2) -> str:
    """A number with its sign."""
    return number(value, digits, signed=True)


def with_std(value: float, std: float, digits: int = 2, *, signed: bool = False) -> str:
    """A number with its standard deviation; – where that is not known."""
    return f"{number(value, digits, signed=signed)} ± {std:.{digits}f}" if std == std else "–"
