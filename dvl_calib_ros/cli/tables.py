"""Tables of the terminal that are of no result."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

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
