"""Columns that grow at their end and are forgotten at their start, so that memory stays flat."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

SMALLEST = 128
# What is held fills no more than this of the room, so that rows are moved a few times in all.
FULL = 0.75


class RowTable:
    """Rows with a column per entry of `LAYOUT` (dtype, shape of one element), which are attributes of these names.

    The arrays are longer than what they hold: rows are in the slots begin .. size - 1. A row's number, counted since
    the start, stays its own: slot + base. Where memory `IS_REUSED`, rows may be overwritten by others once they are
    forgotten: only where nobody keeps a view of them.
    """

    LAYOUT: ClassVar[Mapping[str, tuple[Any, tuple[int, ...]]]]
    IS_REUSED: ClassVar[bool] = False

    def __init__(self) -> None:
        self.begin = self.size = self.base = 0
        for name, (dtype, shape) in self.LAYOUT.items():
            setattr(self, name, np.empty((SMALLEST, *shape), dtype))
        self._capacity = SMALLEST

    @property
    def end(self) -> int:
        """Number of the row that comes next."""
        return self.base + self.size

    def extend(self, n: int) -> slice:
        """The slots of n new rows, to be filled in."""
        if self.size + n > self._capacity:
            self._make_room(n)
        first = self.size
        self.size += n
        return slice(first, self.size)

    def reserve(self, n: int) -> None:
        """Take room for n rows at a time, and write to it: memory that is only taken grows as it is filled."""
        held = self.size - self.begin
        if n > FULL * self._capacity:
            self._move(math.ceil(n / FULL))
            for name in self.LAYOUT:
                getattr(self, name)[held:] = 0

    def _make_room(self, n: int) -> None:
        capacity = self._capacity
        while self.size - self.begin + n > FULL * capacity:
            capacity *= 2
        self._move(capacity)

    def _move(self, capacity: int) -> None:
        """Have what is held at the beginning of so much room, in the memory that there is where that `IS_REUSED`."""
        held = self.size - self.begin
        for name, (dtype, shape) in self.LAYOUT.items():
            before = getattr(self, name)
            grown = before if self.IS_REUSED and capacity == self._capacity else np.empty((capacity, *shape), dtype)
            grown[:held] = before[self.begin : self.size]
            setattr(self, name, grown)
        self.base += self.begin
        self.begin, self.size, self._capacity = 0, held, capacity

    def forget_before(self, slot: int) -> None:
        """Give up the rows before a slot."""
        self.begin = max(self.begin, slot)

    def between(self, column: NDArray[np.int64], first: int, end: int) -> slice:
        """Slots of the rows where one of the columns, increasing, is from `first` on and below `end`."""
        held = column[self.begin : self.size]
        start, stop = (np.searchsorted(held, (first, end)) + self.begin).tolist()
        return slice(start, stop)

    def clear(self) -> None:
        """Give up all rows; numbers go on."""
        self.base += self.size
        self.begin = self.size = 0
