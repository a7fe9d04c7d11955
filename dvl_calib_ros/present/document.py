"""A result as it is said: an answer, sentences, tables and figures, whoever shows them.

What a result says is laid out once, by the module of this room that is called as the result is. Terminal
(`terminal.py`), page (`page.py`) and data frame (`Table.frame`) are made of that; JSON is the result's own plain data.
Names in it are of recordings, files and instruments: each text is made `printable` as it is put into a document.
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


# Characters of a bar
BAR = 20
# Errors of a held-out verification, in the order in which they are drawn
HELD_OUT_KINDS = ("uncorrected", "corrected", "predicted")
# Class of a cell that holds a verdict
CELL_KINDS = {Severity.ACCEPT: "good", Severity.MARGINAL: "off", Severity.REJECT: "bad"}


class Where(Enum):
    """Which of the two shows a section."""

    BOTH = "both"
    TERMINAL = "terminal"
    PAGE = "page"


class _Printable:
    """A part of a document, with texts that neither steer a terminal nor turn a line around."""

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]  # those who inherit are dataclasses
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
    """Text of a table. kind: a class of the style sheet, such as good, off, far, bad.

    below: small, on a second line.
    """

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

    def frame(self) -> pandas.DataFrame:
        """The table as a DataFrame: a column of numbers holds these, with their σ and whether they are shown (no ?) in
        columns beside it; others hold texts.

        Raises ImportError without pandas.
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


# A number, perhaps with its σ and a mark where it is not shown, or a dash for none
_NUMBER = re.compile(r"(?P<value>[+-]?\d+(\.\d+)?)( ± (?P<std>\d+(\.\d+)?))?(?P<unseen> \?)?|–")
T = TypeVar("T")
# Heading -> what a column holds of a row's object.
Columns = Mapping[str, Callable[[T], str | Cell]]


def table_by(columns: Columns[T], of: Iterable[T], notes: Sequence[str] = (), words: int = 1) -> Table:
    """A row for each object, by what each column holds of it; headings of texts are aligned as these are."""
    rows = [[column(each) for column in columns.values()] for each in of]
    texts = [isinstance(cell, Cell) and cell.kind.startswith("text") for cell in rows[0]] if rows else ()
    head = [Cell(name, "text") if is_text else name for name, is_text in zip(columns, texts, strict=False)]
    return Table(head, rows, notes=notes, words=words)


Key = TypeVar("Key")


def columns_for(keys: Mapping[str, Key], cell: Callable[[T, Key], str | Cell]) -> Columns[T]:
    """A column for each key, under its heading: what of it a row's object holds."""

    def column(key: Key) -> Callable[[T], str | Cell]:
        return lambda each: cell(each, key)

    return {heading: column(key) for heading, key in keys.items()}


@dataclass(frozen=True)
class Sentence(_Printable):
    """A sentence. soft: less than the others."""

    text: str
    soft: bool = False


@dataclass(frozen=True)
class Figures(_Printable):
    """Pictures, which only a page has drawn: by a function of a module of this room, from what it is given.

    title, alt, caption: of the one picture whose figure the function draws; none where it makes pictures itself.
    """

    module: str
    name: str
    given: tuple[Any, ...]
    title: str = ""
    alt: str = ""
    caption: str = ""

    def draw(self) -> Sequence[Picture]:
        """Make them, which imports matplotlib."""
        function = getattr(import_module(f"{__package__}.{self.module}"), self.name)
        if self.title:
            from .figure_style import picture

            return [picture(self.title, self.alt, function, *self.given, caption=self.caption)]
        found = function(*self.given)
        return found if isinstance(found, Sequence) else list(found) if isinstance(found, Iterable) else [found]


@dataclass(frozen=True)
class SideBySide:
    """Figures that stand beside each other, where there is room."""

    figures: Sequence[Figures]

    def draw(self) -> Sequence[Picture]:
        """Make them."""
        return [each for of in self.figures for each in of.draw()]


def figures(function: str, *given: Any) -> Figures:
    """Those that a function draws, such as ``diagnosis_pictures.twin_pictures``."""
    module, _, name = function.partition(".")
    return Figures(module, name, given)


def figure(function: str, title: str, alt: str, *given: Any, caption: str = "") -> Figures:
    """The one that a function draws, such as ``diagnosis_figures.closure_bars``; see `Picture`."""
    return replace(figures(function, *given), title=title, alt=alt, caption=caption)


@dataclass(frozen=True)
class FindingLine(_Printable):
    """Something that was found, with its remedy."""

    reason: Reason


@dataclass(frozen=True)
class Commands(_Printable):
    """What to type, or to paste: a line each, with what it is called. on_page: further ones, for a page alone."""

    lines: Sequence[tuple[str, str]]
    on_page: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class Facts(_Printable):
    """Short texts by name; an empty one is left out."""

    facts: Mapping[str, str]


def facts_by(facts: Mapping[str, Callable[[T], str]], of: T) -> Facts:
    """What each says of an object."""
    return Facts({name: fact(of) for name, fact in facts.items()})


@dataclass(frozen=True)
class Number(_Printable):
    """A quantity that was found, in its unit. std: its σ. nominal: as configured. change: from that. note: what is to
    be known of it.

    is_shown: whether the data show it.
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
    """The quantities that a result is about: large on a page, a table on a terminal."""

    numbers: Sequence[Number]

    @property
    def table(self) -> Table:
        """They as rows."""
        if any(each.std for each in self.numbers):
            stds = (each.std if each.is_shown else f"{each.std} ?" for each in self.numbers)
            rows = [(n.name, n.nominal, n.value, n.change, std) for n, std in zip(self.numbers, stds, strict=True)]
            return Table(("", "configured", "corrected", "change", "±1σ"), rows)
        return Table(("", "", ""), [(each.name, each.value, each.note) for each in self.numbers])


@dataclass(frozen=True)
class Worth(_Printable):
    """Drift of dead reckoning on a straight kilometre, m, without and with what was found: the largest on a page."""

    before: str
    after: str


@dataclass(frozen=True)
class Legend:
    """Lines of models in the figures that follow."""

    models: Sequence[str]
    selected: str


@dataclass(frozen=True)
class Warned:
    """Where a page has the document's warnings: before all sections, where none says so."""

    warned: bool = True


Item = Warned | Sentence | Table | Figures | SideBySide | FindingLine | Commands | Facts | Numbers | Worth | Legend


@dataclass(frozen=True)
class Section(_Printable):
    """What stands under one heading."""

    title: str
    items: Sequence[Item]
    where: Where = Where.BOTH


def section(title: str, *items: Item | None, where: Where = Where.BOTH) -> Section:
    """What there is of the items, under a heading: no None, and no table without rows."""
    return Section(title, [each for each in items if each is not None and getattr(each, "rows", True)], where)


@dataclass(frozen=True)
class Answer(_Printable):
    """What a result says first: a word, how good or bad that is, and sentences. advice: what to do."""

    word: str
    severity: Severity
    sentences: Sequence[str]
    advice: str = ""


@dataclass(frozen=True)
class Document(_Printable):
    """A result as it is said.

    warnings: what to know beside it. sections: in order; those without items are left out. parameters: what it was made
    with, by name; for the page. lead: what is found before all else. folded: warnings that a page folds away.
    """

    title: str
    subtitle: str
    answer: Answer | None
    warnings: Sequence[str]
    sections: Sequence[Section]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    lead: Reason | None = None
    folded: Sequence[str] = ()

    @property
    def tables(self) -> dict[str, Table]:
        """All of them in order, by the heading that each stands below; of further ones below it with their number."""
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
        """Its tables as data frames. Raises ImportError without pandas."""
        return {heading: table.frame() for heading, table in self.tables.items()}


def bar(full: float, kind: str) -> Cell:
    """A share as a bar. kind: a class of the style sheet."""
    blocks = round(BAR * full)
    return Cell("█" * blocks + "░" * (BAR - blocks), f"bar {kind}")
