"""Results that print as their answer, and give their tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


class Answering:
    """A result: printed it is its answer, in a notebook as well.

    How a result is laid out is known further up, by whoever hands results to people (`api`), and told here.
    """

    laid_out: Callable[[Answering, bool], str] | None = None
    """Result and whether HTML is wanted -> text."""
    framed: Callable[[Answering], dict[str, pandas.DataFrame]] | None = None
    """Result -> its tables by heading."""

    def __repr__(self) -> str:
        show = Answering.laid_out
        return object.__repr__(self) if show is None else show(self, False)

    def _repr_html_(self) -> str | None:
        show = Answering.laid_out
        return None if show is None else show(self, True)

    def tables(self) -> dict[str, pandas.DataFrame]:
        """Give the tables of its page and of the terminal as data frames.

        Returns
        -------
        dict of str to pandas.DataFrame
            By the heading that each stands below. Columns of numbers hold these, in the unit of their heading, with
            their σ as ``... ±1σ`` and whether they are shown as ``... shown`` beside them; others hold texts.

        Raises
        ------
        InputError
            Without pandas.
        """
        make = Answering.framed
        return {} if make is None else make(self)
