"""Tables of columns that grow at the end and shrink at the start, with bounded memory."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

SMALLEST = 128
# Largest filled share of the capacity, so that rows are seldom moved.
FULL = 0.75


class _Column(NamedTuple):
    """A column of a table: its dtype, and the shape of one element."""

    dtype: Any
    shape: tuple[int, ...]


def column(dtype: Any, *shape: int) -> Any:
    """Declare an attribute of a `RowTable` as one of its columns. shape: of one element."""
    return _Column(dtype, shape)


class RowTable:
    """Rows with an array per attribute that is declared as a `column`.

    Rows are in the slots begin .. size - 1 of longer arrays. The number of a row since the start is slot + base, and
    constant. If memory `IS_REUSED`, discarded rows may be overwritten, so no views of them may be kept.
    """

    LAYOUT: ClassVar[Mapping[str, _Column]]
    IS_REUSED: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        own = {name: value for name, value in vars(cls).items() if isinstance(value, _Column)}
        cls.LAYOUT = {**getattr(cls, "LAYOUT", {}), **own}

    def __init__(self) -> None:
        self.begin = self.size = self.base = 0
        for name, (dtype, shape) in self.LAYOUT.items():
            setattr(self, name, np.empty((SMALLEST, *shape), dtype))
        self._capacity = SMALLEST

    @property
    def end(self) -> int:
        """Number of the next row."""
        return self.base + self.size

    def extend(self, n: int) -> slice:
        """Return the slots of n new rows, to be filled by the caller."""
        if self.size + n > self._capacity:
            self._make_room(n)
        first = self.size
        self.size += n
        return slice(first, self.size)

    def reserve(self, n: int) -> None:
        """Reserve and touch memory for n rows, so that it does not grow while it is filled."""
        held = self.size - self.begin
        if n > FULL * self._capacity:
            self._move(math.ceil(n / FULL))
            for name in self.LAYOUT:
                getattr(self, name)[held:] = 0

    def _make_room(self, n: int) -> None:
        """Double the capacity until n more rows fit."""
        capacity = self._capacity
        while self.size - self.begin + n > FULL * capacity:
            capacity *= 2
        self._move(capacity)

    def _move(self, capacity: int) -> None:
        """Move the rows to the start of an array of this capacity; the present one if it `IS_REUSED`."""
        held = self.size - self.begin
        for name, (dtype, shape) in self.LAYOUT.items():
            before = getattr(self, name)
            grown = before if self.IS_REUSED and capacity == self._capacity else np.empty((capacity, *shape), dtype)
            grown[:held] = before[self.begin : self.size]
            setattr(self, name, grown)
        self.base += self.begin
        self.begin, self.size, self._capacity = 0, held, capacity

    def forget_before(self, slot: int) -> None:
        """Discard the rows before a slot."""
        self.begin = max(self.begin, slot)

    def between(self, column: NDArray[np.int64], first: int, end: int) -> slice:
        """Return the slots of rows with an increasing column from `first` to below `end`."""
        held = column[self.begin : self.size]
        start, stop = (np.searchsorted(held, (first, end)) + self.begin).tolist()
        return slice(start, stop)

    def clear(self) -> None:
        """Discard all rows; numbers continue."""
        self.base += self.size
        self.begin = self.size = 0


def return_memory() -> None:
    """Return unused memory to the system; glibc would keep some megabytes."""
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
