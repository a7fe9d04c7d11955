"""Results that print as their answer, and give their tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


class Answering:
    """Base of results that print as their answer, also in a notebook.

    `api` sets the functions that lay a result out, because this room must not import them.
    """

    laid_out: Callable[[Answering, bool], str] | None = None
    """Formatter: result and whether HTML is wanted -> text."""
    framed: Callable[[Answering], dict[str, pandas.DataFrame]] | None = None
    """Function from a result to its tables by heading."""

    def __repr__(self) -> str:
        show = Answering.laid_out
        return object.__repr__(self) if show is None else show(self, False)

    def _repr_html_(self) -> str | None:
        show = Answering.laid_out
        return None if show is None else show(self, True)

    def tables(self) -> dict[str, pandas.DataFrame]:
        """Return the tables of the report and the terminal as data frames.

        Returns
        -------
        dict of str to pandas.DataFrame
            By heading. Numeric columns are in the unit of their heading, with their σ as ``... ±1σ`` and whether they
            are observable as ``... shown`` next to them; other columns are texts.

        Raises
        ------
        InputError
            Without pandas.
        """
        make = Answering.framed
        return {} if make is None else make(self)
