"""Tables of the terminal, and numbers in them, as every command shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rich.table import Table


def titled(title: str, words: Iterable[str], numbers: Iterable[str] = (), caption: str | None = None) -> Table:
    """An empty table, title and caption on the left, with columns of words and columns of numbers."""
    from rich.table import Table as RichTable

    table = RichTable(title=title, title_justify="left", caption=caption, caption_justify="left")
    for name in words:
        table.add_column(name)
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def cell(value: float, digits: int = 4) -> str:
    """A number; - where there is none."""
    return f"{value:.{digits}f}" if value == value else "-"


def interval(each: tuple[float, float, float]) -> str:
    """A value and its interval."""
    value, low, high = each
    return f"{value:.3g} ({low:.3g} .. {high:.3g})"


def intervals(parameters: Mapping[str, tuple[float, float, float]]) -> str:
    """Values and their intervals, by name; - where there are none."""
    return ", ".join(f"{name} {interval(each)}" for name, each in parameters.items()) or "-"
