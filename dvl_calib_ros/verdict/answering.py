"""Results that print as their answer."""

from __future__ import annotations

from collections.abc import Callable


class Answering:
    """A result: printed it is its answer, in a notebook as well.

    How a result is laid out is known further up, by whoever hands results to people (`api`), and told here.
    """

    laid_out: Callable[[Answering, bool], str] | None = None
    """Result and whether HTML is wanted -> text."""

    def __repr__(self) -> str:
        show = Answering.laid_out
        return object.__repr__(self) if show is None else show(self, False)

    def _repr_html_(self) -> str | None:
        show = Answering.laid_out
        return None if show is None else show(self, True)
