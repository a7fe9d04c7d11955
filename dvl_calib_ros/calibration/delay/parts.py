"""Columns of several blocks of time, one after the other, of which each is looked at by itself.

A block is a copy of a stretch with margins, so neighbours hold the same samples twice: one call of numpy for many
blocks must not let one see what another one holds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Sized
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..numerics.frames import Array
from ..numerics.samples import Index, Mask


@dataclass(frozen=True)
class Parts:
    """Of N samples those of each of B blocks. bounds: (B+1,) where each begins, and where the last one ends."""

    bounds: Index

    @staticmethod
    def of(columns: Sequence[Sized]) -> Parts:
        """Of columns that are joined in this order."""
        return Parts(np.cumsum([0, *map(len, columns)]))

    def __iter__(self) -> Iterator[slice]:
        bounds = self.bounds.tolist()
        return map(slice, bounds[:-1], bounds[1:])

    def __len__(self) -> int:
        return len(self.bounds) - 1

    @property
    def number(self) -> Index:
        """(N,) of which block each sample is."""
        return np.repeat(np.arange(len(self)), np.diff(self.bounds))

    def where(self, kept: Mask) -> Parts:
        """Those of the samples that are kept (N,)."""
        return Parts(np.concatenate([[0], np.cumsum(kept)])[self.bounds])

    def at(self, index: Index) -> Parts:
        """Those of samples taken from them, by ascending numbers (M,)."""
        return Parts(np.searchsorted(index, self.bounds))


class Near(NamedTuple):
    """Of M times the place of the first sample that is not before each, and of the first and the last but one sample
    that may be looked at: (M,) each, or for all the same."""

    after: Index
    first: Index | int
    end: Index | int

    def twice(self) -> Near:
        """Of the same times, one after the other twice."""
        after, first, end = self
        if isinstance(first, int) or isinstance(end, int):
            return Near(np.tile(after, 2), first, end)
        return Near(np.tile(after, 2), np.tile(first, 2), np.tile(end, 2))


def places(times: Array, at: Array, parts: Parts | None = None, at_parts: Parts | None = None) -> Near:
    """Places of times `at` (M,) among times (N,) s that increase in every one of some parts, by default in all of it.

    at_parts: which of `at` are looked for in which part.
    """
    if parts is None or at_parts is None or len(parts) == 1:
        return Near(np.searchsorted(times, at), 0, len(times))
    found = [np.searchsorted(times[own], at[of]) for own, of in zip(parts, at_parts, strict=True)]
    first, end = (np.repeat(bound, np.diff(at_parts.bounds)) for bound in (parts.bounds[:-1], parts.bounds[1:]))
    return Near(np.concatenate(found) + first, first, end)
