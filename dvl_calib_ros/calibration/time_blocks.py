"""How certain an estimate is, by the scatter of blocks of time: the σ that the data show beside the filter's own.

A filter's covariance holds what R claims of white noise. Noise that is larger or lasts longer, and what the model does
not know, make the estimates of different stretches differ by more. With Λ_b, y_b what block b told (Λ = Λ₀ + Σ Λ_b),
the score s_b = y_b - Λ_b x of a block at the common estimate x has covariance Λ_b if all is as claimed; what it really
scatters by is Σ s_b s_bᵀ, and P (Λ₀ + Σ s_b s_bᵀ) P what x then is worth (the "sandwich"; White, "Maximum likelihood
estimation of misspecified models", 1982).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from .chi_square import chi2_isf
from .frames import Array
from .kalman import GaussianState

# Blocks kept; when they are full, neighbours are joined and blocks are twice as long. So memory is bounded, and effects
# that last for minutes show in the end.
MOST = 64
# With fewer, the scatter says little: of 8 its own standard deviation is a quarter.
FEWEST = 8
# By chance a scatter may exceed the filter's σ up to this quantile without being taken for more.
CHANCE = 0.1


class TimeBlocks:
    """Information of consecutive blocks of time, for K hypotheses or models at once.

    count: number of blocks. weight: number of samples that all count for.
    """

    def __init__(self) -> None:
        # with room for MOST of them
        self._information = np.zeros((0, 0, 0, 0))
        self._vector = np.zeros((0, 0, 0))
        self.count = 0
        self._each = 1  # additions in a full block
        self._in_last = 0
        self.weight = 0.0

    @property
    def kept(self) -> tuple[Array, Array]:
        """Of each block, in order, Λ_b (B, K, n, n) and y_b (B, K, n)."""
        return self._information[: self.count], self._vector[: self.count]

    def add(self, information: Array, vector: Array, weight: float) -> None:
        """Add what a stretch told: Λ_b (K, n, n), y_b (K, n). weight: number of samples that it counts for."""
        self.weight += weight
        if self.count and self._in_last < self._each:
            self._information[self.count - 1] += information
            self._vector[self.count - 1] += vector
            self._in_last += 1
            return
        if not self.count:
            self._information, self._vector = np.empty((MOST, *information.shape)), np.empty((MOST, *vector.shape))
        if self.count == MOST:
            self.count = MOST // 2
            for each in (self._information, self._vector):
                each[: self.count] = each[0::2] + each[1::2]
            self._each *= 2
        self._information[self.count], self._vector[self.count] = information, vector
        self.count += 1
        self._in_last = 1

    def end_day(self, of_day: NDArray[np.intp], information: Array, vector: Array, source: NDArray[np.intp]) -> None:
        """Leave to what was told only what it says of the states that go on, the others being found anew.

        of_day: (u,) which states those others are. information (K, n, n), vector (K, n): of all that is known. source:
        (K,) from which of the K each takes its past.
        """
        if not len(of_day):
            return
        n, k = information.shape[-1], len(information)
        within = np.linalg.inv(information[np.ix_(np.arange(k), of_day, of_day)])
        # scores of the day's own states are known to vanish: what they would, were x another, is taken off the others
        onto = np.broadcast_to(np.eye(n), (k, n, n)).copy()
        onto[:, :, of_day] -= information[:, :, of_day] @ within
        onto[:, of_day] = 0.0
        found = (within @ vector[:, of_day, None])[..., 0]
        for told, y in zip(*self.kept, strict=True):
            rest = y - (told[:, :, of_day] @ found[..., None])[..., 0]
            told[:] = (onto @ told @ onto.swapaxes(1, 2))[source]
            y[:] = (onto @ rest[..., None])[source, :, 0]

    def inflation(self, index: int, x: Array, p: Array) -> Array:
        """By how much σ of each state (n,) has to grow, at least 1. index: which of the K. x (n,), P (n, n) of it.

        The largest over blocks as they are, and over two and four of them together.
        """
        factor = np.ones(len(x))
        if self.count < FEWEST:
            return factor
        information, vector = (each[:, index] for each in self.kept)
        scores = vector - information @ x
        claimed = np.diag(p @ information.sum(axis=0) @ p)
        while len(scores) >= FEWEST:
            m = len(scores)
            scatter = p @ scores.T
            found = (scatter**2).sum(axis=1) * (m / (m - 1.0))
            ratio = found / np.maximum(claimed, 1e-300)
            beyond_chance = ratio > chi2_isf(CHANCE, m - 1) / (m - 1)
            # the prior's part of P is not the data's to judge
            total = 1.0 + (found - claimed) / np.diag(p)
            factor = np.maximum(factor, np.where(beyond_chance, np.sqrt(np.maximum(total, 1.0)), 1.0))
            if m % 2:
                scores = np.vstack([scores[:-2], scores[-2:].sum(axis=0)])[: m - 1]
                m -= 1
            scores = scores[0::2][: m // 2] + scores[1::2][: m // 2]
        return factor


_NO_CUTS = np.zeros(0, dtype=np.intp)


class BlockScatter:
    """`TimeBlocks` of K filters without process noise, told by their states where one block ends and the next begins.

    What a block told is the difference of the information after and before it. The factors are those as of the end of
    the last block, so they depend on stamps alone.
    """

    def __init__(self, x: Array, p: Array, seconds: float) -> None:
        """Start from states x (K, n), P (K, n, n). seconds: length of a block."""
        self._blocks = TimeBlocks()
        self._length_ns = round(seconds * 1e9)
        self._last: int | None = None
        self._state = x, p
        self._told = _information(x, p)
        self._factors: dict[int, Array] = {}

    def cuts(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.intp]:
        """Numbers of samples (E) of those with these stamps (N,) after which a new block begins."""
        first, last = int(stamps_ns[0]) // self._length_ns, int(stamps_ns[-1]) // self._length_ns
        if first == last == (first if self._last is None else self._last):  # as nearly always live
            self._last = last
            return _NO_CUTS
        blocks = stamps_ns // self._length_ns
        before = blocks[0] if self._last is None else self._last
        self._last = int(blocks[-1])
        return np.flatnonzero(np.diff(blocks, prepend=before))

    def add(self, x: Array, p: Array, last: tuple[Array, Array]) -> None:
        """Take the states at the cuts, x (E, K, n), P (E, K, n, n).

        last: x (K, n), P (K, n, n) at the last of them with all that is known beside what blocks are judged by.
        """
        for information, vector in _informations(x, p):
            self._blocks.add(information - self._told[0], vector - self._told[1], 1.0)
            self._told = information, vector
        self._state = last
        self._factors.clear()

    def end_day(
        self, before: GaussianState, after: GaussianState, of_day: NDArray[np.intp], last: GaussianState
    ) -> None:
        """Go on with states `after` the end of a day, x (K, n), P (K, n, n), from those `before`. of_day: which (u,) of
        them were of the day. last: those `after`, as in `add`."""
        self.add(before.x[None], before.p[None], last)
        self._blocks.end_day(of_day, *self._told, np.arange(len(before.x)))
        self._state, self._told = last, _information(*after)
        self._last = None
        self._factors.clear()

    def inflation(self, index: int) -> Array:
        """By how much σ of each state (n,) of one filter has to grow, at least 1."""
        if index not in self._factors:
            x, p = self._state
            self._factors[index] = self._blocks.inflation(index, x[index], p[index])
        return self._factors[index]


def _informations(x: Array, p: Array) -> Iterator[tuple[Array, Array]]:
    """Of E states x (K, n), P (K, n, n); without those whose numbers ran away: the filter goes on from before them."""
    try:
        yield from zip(*_information(x, p), strict=True)
        return
    except np.linalg.LinAlgError:
        pass
    for each in zip(x, p, strict=True):
        with suppress(np.linalg.LinAlgError):
            yield _information(*each)


def _information(x: Array, p: Array) -> tuple[Array, Array]:
    information = np.linalg.inv(p)
    return information, (information @ x[..., None])[..., 0]
