"""History of the model states, thinned to constant memory.

Shapes: K models, E rows of samples, n states.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..numerics.frames import Array
from ..numerics.kalman import GaussianState

Numbers = NDArray[np.int64]
Counts = NDArray[np.int64]


class PastStates(NamedTuple):
    """One model after each of E rows: x (E, n), P (E, n, n). used, nis_sum: (E,) samples used, and their Σ νᵀS⁻¹ν."""

    state: GaussianState
    used: Counts
    nis_sum: Array


class Snapshot(NamedTuple):
    """K models after E rows: x (E, K, n), P (E, K, n, n) of the filter; used, nis_sum (E, K) so far."""

    x: Array
    p: Array
    used: Counts
    nis_sum: Array

    def row(self, index: int) -> Snapshot:
        """Return one row, as E = 1."""
        at = slice(index, index + 1)
        return Snapshot(self.x[at], self.p[at], self.used[at], self.nis_sum[at])

    @staticmethod
    def joined(rows: Sequence[Snapshot]) -> Snapshot:
        """Return concatenated rows."""
        x, p, used, nis_sum = zip(*rows, strict=True)
        return Snapshot(np.concatenate(x), np.concatenate(p), np.concatenate(used), np.concatenate(nis_sum))


class StateTrace:
    """States after every stride-th DVL sample in order; the stride doubles when the limit is exceeded.

    limit: largest number of stored rows. expected: number of DVL samples in the recording, 0 if unknown.
    """

    def __init__(self, limit: int, expected: int = 0) -> None:
        self._limit = limit
        self._expected = expected
        self.start(())

    def start(self, groups: Iterable[Hashable]) -> None:
        """Restart with these groups of models."""
        self._stride = max(1, -(-self._expected // self._limit))
        self._kept: dict[Hashable, dict[int, Snapshot]] = {group: {} for group in groups}

    def wanted(self, first: int, end: int) -> Numbers:
        """Return the rows among first .. end - 1 after which states are stored."""
        return np.arange(-(-first // self._stride) * self._stride, end, self._stride)

    def add(self, numbers: Numbers, group: Hashable, after: Snapshot) -> None:
        """Add the states of a group after rows (E)."""
        kept = self._kept[group]
        for index, number in enumerate(numbers.tolist()):
            kept[number] = after.row(index)
        while max(map(len, self._kept.values())) > self._limit:
            self._stride *= 2
            for snapshots in self._kept.values():
                for number in [number for number in snapshots if number % self._stride]:
                    del snapshots[number]

    def numbers(self) -> Numbers:
        """Return the rows (E) with states of all models."""
        common = set.intersection(*(set(snapshots) for snapshots in self._kept.values()))
        return np.array(sorted(number for number in common if number % self._stride == 0), dtype=np.int64)

    def snapshot(self, group: Hashable, numbers: Numbers) -> Snapshot:
        """Return the states of a group after these rows."""
        return Snapshot.joined([self._kept[group][number] for number in numbers.tolist()])
