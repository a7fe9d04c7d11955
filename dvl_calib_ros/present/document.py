"""Presentation of a result as a document: answer, sentences, tables and figures.

Each result is laid out once, by its own module of this room. Terminal (`terminal.py`), page (`page.py`) and data frame
(`Table.frame`) are made from the document; JSON is the result's own plain data. Texts may include names of recordings,
files and instruments, so each text is made `printable` when it enters a document.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from ..errors import printable
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason

if TYPE_CHECKING:
    import pandas

    from .figure_style import Picture


# columns that a page is too narrow for, and rows that become columns instead
WIDE = 8
FEW = 5
# characters of a bar
BAR = 20
# errors of a held-out verification, in the order of drawing
HELD_OUT_KINDS = ("uncorrected", "corrected", "predicted")
# style class of a cell with a verdict
CELL_KINDS = {Severity.ACCEPT: "good", Severity.MARGINAL: "off", Severity.REJECT: "bad"}


class Where(Enum):
    """Outputs that show a section: page, terminal or both."""

    BOTH = "both"
    TERMINAL = "terminal"
    PAGE = "page"


class _Printable:
    """Part of a document whose texts contain no control characters for a terminal or text direction."""

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]  # subclasses are dataclasses
            object.__setattr__(self, each.name, _printable(getattr(self, each.name)))


def _printable(value: Any) -> Any:
    """Return a value with every text in it, also in lists, mappings and reasons, made printable."""
    if type(value) is str:
        return printable(value)
    if type(value) in (list, tuple):
        return type(value)(map(_printable, value))
    if isinstance(value, Mapping):
        return {_printable(name): _printable(each) for name, each in value.items()}
    return replace(value, numbers=_printable(value.numbers)) if isinstance(value, Reason) else value


@dataclass(frozen=True)
class Cell(_Printable):
    """Text of a table. kind: class of the style sheet (good, off, far, bad). below: small second line."""

    text: str
    kind: str = ""
    below: str = ""


@dataclass(frozen=True)
class Table(_Printable):
    """Rows of cells under a head; the first column names the row.

    Parameters
    ----------
    head
        Names of the columns.
    rows
        Cells, each a text or a `Cell`.
    title
        Title above the table.
    marked
        Index of the highlighted row.
    notes
        Notes below the table.
    dense
        Whether the table has many columns.
    words
        Number of text columns at the left; the others are numbers.
    """

    head: Sequence[str | Cell]
    rows: Sequence[Sequence[str | Cell]]
    title: str = ""
    marked: int | None = None
    notes: Sequence[str] = ()
    dense: bool = False
    words: int = 1

    @property
    def transposed(self) -> Table | None:
        """The table with rows and columns exchanged; None if cells are sentences, which need the width of a row."""
        if not self.rows or any(isinstance(cell, Cell) for row in self.rows for cell in row):
            return None
        names, *columns = zip(self.head, *self.rows, strict=True)
        return replace(self, head=names, rows=columns, marked=None, words=1)

    @property
    def on_page(self) -> Table:
        """The table for a page, transposed if it has many columns and few rows."""
        is_wide = len(self.head) > WIDE and len(self.rows) <= FEW
        return (self.transposed if is_wide else None) or self

    def frame(self) -> pandas.DataFrame:
        """Return a DataFrame with the values as numbers.

        A column whose texts are all numbers becomes one numeric column, followed by columns of σ (texts with ±) and of
        observability (texts with ?). Other columns stay texts. Raises ImportError without pandas.
        """
        import pandas

        head, *rows = ([getattr(cell, "text", cell) for cell in row] for row in (self.head, *self.rows))
        columns: list[pandas.Series[Any]] = []
        for name, texts in zip(head, zip(*rows, strict=True), strict=False):
            read = [found for text in texts if (found := _NUMBER.fullmatch(text.replace("−", "-")))]
            if len(read) < len(texts) or not any(each["value"] for each in read):
                columns.append(pandas.Series(texts, name=name))
                continue
            columns.append(pandas.to_numeric(pandas.Series([each["value"] for each in read], name=name)))
            if any(each["std"] for each in read):
                columns.append(pandas.to_numeric(pandas.Series([each["std"] for each in read], name=f"{name} ±1σ")))
            if any(each["unseen"] for each in read):
                columns.append(pandas.Series([not each["unseen"] for each in read], name=f"{name} shown"))
        return pandas.concat(columns, axis=1)


# number, optionally with σ and with ? if it is not observable, or a dash for none
_NUMBER = re.compile(r"(?P<value>[+-]?\d+(\.\d+)?)( ± (?P<std>\d+(\.\d+)?))?(?P<unseen> \?)?|–")
T = TypeVar("T")
# heading -> function from a row's object to its cell
Columns = Mapping[str, Callable[[T], str | Cell]]


def table_by(
    columns: Columns[T], objects: Iterable[T], notes: Sequence[str] = (), words: int = 1, dense: bool = False
) -> Table:
    """Return a table with a row per object. Headings of text columns are aligned like their texts."""
    rows = [[column(each) for column in columns.values()] for each in objects]
    texts = [isinstance(cell, Cell) and cell.kind.startswith("text") for cell in rows[0]] if rows else ()
    head = [Cell(name, "text") if is_text else name for name, is_text in zip(columns, texts, strict=False)]
    return Table(head, rows, notes=notes, words=words, dense=dense)


Key = TypeVar("Key")


def columns_for(keys: Mapping[str, Key], cell: Callable[[T, Key], str | Cell]) -> Columns[T]:
    """Return one column per key, under its heading, whose cell depends on the row's object and the key."""

    def column(key: Key) -> Callable[[T], str | Cell]:
        return lambda each: cell(each, key)

    return {heading: column(key) for heading, key in keys.items()}


@dataclass(frozen=True)
class Sentence(_Printable):
    """A sentence. soft: less prominent."""

    text: str
    soft: bool = False


@dataclass(frozen=True)
class Figures(_Printable):
    """Pictures drawn by a function of this room from given data; only a page shows them.

    title, alt, caption: of the single figure; empty if the function makes `Picture` objects itself.
    """

    module: str
    name: str
    given: tuple[Any, ...]
    title: str = ""
    alt: str = ""
    caption: str = ""

    def draw(self) -> Sequence[Picture]:
        """Draw the pictures, which imports matplotlib."""
        function = getattr(import_module(f"{__package__}.{self.module}"), self.name)
        if self.title:
            from .figure_style import picture

            return [picture(self.title, self.alt, function, *self.given, caption=self.caption)]
        found = function(*self.given)
        return found if isinstance(found, Sequence) else list(found) if isinstance(found, Iterable) else [found]


@dataclass(frozen=True)
class SideBySide:
    """Figures next to each other, if there is room."""

    figures: Sequence[Figures]

    def draw(self) -> Sequence[Picture]:
        """Draw the pictures."""
        return [each for each_figures in self.figures for each in each_figures.draw()]


def figures(function: str, *given: Any) -> Figures:
    """Return the figures drawn by a function, such as ``diagnosis_pictures.twin_pictures``."""
    module, _, name = function.partition(".")
    return Figures(module, name, given)


def figure(function: str, title: str, alt: str, *given: Any, caption: str = "") -> Figures:
    """Return the figure drawn by a function, such as ``diagnosis_pictures.closure_bars``; see `Picture`."""
    return replace(figures(function, *given), title=title, alt=alt, caption=caption)


@dataclass(frozen=True)
class FindingLine(_Printable):
    """A finding with its remedy."""

    reason: Reason


@dataclass(frozen=True)
class Commands(_Printable):
    """Commands or text to copy, one line each, with a label. on_page: further ones for a page only."""

    lines: Sequence[tuple[str, str]]
    on_page: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class Facts(_Printable):
    """Short texts by name; empty ones are omitted."""

    facts: Mapping[str, str]


def facts_by(facts: Mapping[str, Callable[[T], str]], described: T) -> Facts:
    """Return the facts of an object, each from its function."""
    return Facts({name: fact(described) for name, fact in facts.items()})


@dataclass(frozen=True)
class Number(_Printable):
    """Estimated quantity. std: its σ. nominal: configured value. change: from nominal. note: a remark.

    is_shown: whether the data make it observable.
    """

    name: str
    value: str
    std: str = ""
    nominal: str = ""
    change: str = ""
    note: str = ""
    is_shown: bool = True


@dataclass(frozen=True)
class Numbers:
    """Main quantities of a result: large on a page, a table on a terminal."""

    numbers: Sequence[Number]

    @property
    def table(self) -> Table:
        """The quantities as rows."""
        if any(each.std for each in self.numbers):
            stds = (each.std if each.is_shown else f"{each.std} ?" for each in self.numbers)
            rows = [(n.name, n.nominal, n.value, n.change, std) for n, std in zip(self.numbers, stds, strict=True)]
            return Table(("", "configured", "corrected", "change", "±1σ"), rows)
        return Table(("", "", ""), [(each.name, each.value, each.note) for each in self.numbers])


@dataclass(frozen=True)
class Worth(_Printable):
    """Drift of dead reckoning on a straight kilometre, m, without and with the correction: largest number of a page."""

    before: str
    after: str


@dataclass(frozen=True)
class Legend:
    """Legend of the models in the following figures."""

    models: Sequence[str]
    selected: str


@dataclass(frozen=True)
class Warned:
    """Position of the document's warnings on a page; by default before all sections."""

    warned: bool = True


Item = Warned | Sentence | Table | Figures | SideBySide | FindingLine | Commands | Facts | Numbers | Worth | Legend


@dataclass(frozen=True)
class Section(_Printable):
    """Heading and the items below it."""

    title: str
    items: Sequence[Item]
    where: Where = Where.BOTH


def section(title: str, *items: Item | None, where: Where = Where.BOTH) -> Section:
    """Return a section of the given items, without None and empty tables."""
    return Section(title, [each for each in items if each is not None and getattr(each, "rows", True)], where)


@dataclass(frozen=True)
class Answer(_Printable):
    """First part of a result: a word, its severity, and sentences. advice: what to do."""

    word: str
    severity: Severity
    sentences: Sequence[str]
    advice: str = ""


@dataclass(frozen=True)
class Document(_Printable):
    """Presentation of a result.

    sections: in order; empty ones are omitted.
    parameters: parameters of the run by name, for the page.
    folded: warnings that a page folds away.
    """

    title: str
    subtitle: str
    answer: Answer | None
    warnings: Sequence[str]
    sections: Sequence[Section]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    folded: Sequence[str] = ()

    @property
    def tables(self) -> dict[str, Table]:
        """All tables in order, by their heading; further tables under a heading get a number."""
        found: dict[str, Table] = {}
        heading, below = self.title, 0
        for each in self.sections:
            if each.title and each.title != heading:
                heading, below = each.title, 0
            for item in each.items:
                table = item.table if isinstance(item, Numbers) else item
                if isinstance(table, Table) and table.rows and table not in found.values():
                    below += 1
                    found[heading if below == 1 else f"{heading} ({below})"] = table
        return found

    def frames(self) -> dict[str, pandas.DataFrame]:
        """Return the tables as data frames. Raises ImportError without pandas."""
        return {heading: table.frame() for heading, table in self.tables.items()}


def bar(full: float, kind: str) -> Cell:
    """Return a share (0..1) as a bar. kind: a class of the style sheet."""
    blocks = round(BAR * full)
    return Cell("█" * blocks + "░" * (BAR - blocks), f"bar {kind}")
