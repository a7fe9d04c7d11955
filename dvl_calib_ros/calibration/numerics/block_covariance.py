"""How certain an estimate is, by the scatter of blocks of time: the σ that the data show beside the filter's own.

A filter's covariance holds what R claims of white noise. Noise that is larger or lasts longer, and what the model does
not know, make the estimates of different stretches differ by more. With Λ_b, y_b what block b told (Λ = Λ₀ + Σ Λ_b),
the score s_b = y_b - Λ_b x of a block at the common estimate x has covariance Λ_b if all is as claimed; what it really
scatters by is Σ s_b s_bᵀ, and P (Λ₀ + Σ s_b s_bᵀ) P what x then is worth (the "sandwich"; White, "Maximum likelihood
estimation of misspecified models", 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .frames import Array
from .tests import chi2_isf

# Blocks kept; when they are full, neighbours are joined and blocks are twice as long. So memory is bounded, and effects
# that last for minutes show in the end.
MOST = 64
# With fewer, the scatter says little: of 8 its own standard deviation is a quarter.
FEWEST = 8
# By chance a scatter may exceed the filter's σ up to this quantile without being taken for more. What is beyond the
# other is made by no chance, and how much it is is known by as many blocks as there are: 3 σ are to be what they are.
CHANCE, RARELY = 0.1, 0.02
# No fewer blocks that tell alike are taken to tell a quantity: the scatter of fewer is none.
FEWEST_ALIKE = 5.0
# Neighbours of so many blocks are correlated if their coefficient is more than so many times its σ, 1/√m: of noise that
# lasts as long as blocks do more would show in half of the runs of four minutes. No more than this is believed of it.
LASTING_FROM, LASTS, MOST_LASTING = 16, 1.5, 0.85


class TimeBlocks:
    """Information of consecutive blocks of time, for K hypotheses or models at once.

    count: number of blocks. weight: number of samples that all count for. total: Λ (K, n, n) and y (K, n) of all of
    them; not to be written to.
    """

    def __init__(self) -> None:
        # with room for MOST of them
        self._information = np.zeros((0, 0, 0, 0))
        self._vector = np.zeros((0, 0, 0))
        self.total: tuple[Array, Array] = np.zeros((0, 0, 0)), np.zeros((0, 0))
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
        self.total = (self.total[0] + information, self.total[1] + vector) if self.count else (information, vector)
        if self.count and self._in_last < self._each:
            self._information[self.count - 1] += information
            self._vector[self.count - 1] += vector
            self._in_last += 1
            return
        if not self.count:
            # written to, so that memory does not grow with the blocks for ten minutes
            self._information = np.full((MOST, *information.shape), np.nan)
            self._vector = np.full((MOST, *vector.shape), np.nan)
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
            told[:] = onto @ told @ onto.swapaxes(1, 2)
            y[:] = (onto @ rest[..., None])[..., 0]
        self.choose(source)

    def choose(self, source: NDArray[np.intp]) -> None:
        """Let each of K have its past from others. source: (K,) from which of those there are."""
        if self.count:
            self._information, self._vector = self._information[:, source], self._vector[:, source]
            self.total = self.kept[0].sum(axis=0), self.kept[1].sum(axis=0)

    def of(self, index: int) -> BlocksOfOne:
        """What the blocks so far say of one of the K."""
        if not self.count:
            return BlocksOfOne(np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0)))
        information, vector = (each[:, index].copy() for each in self.kept)
        return BlocksOfOne(information, vector, self.total[0][index])

    def inflation(self, index: int, x: Array, p: Array, lasts: float = LASTS, rarely: float | None = RARELY) -> Array:
        """`inflations` of one of the K, x (n,), P (n, n)."""
        return inflations([self.of(index)], x[None], p[None], lasts=lasts, rarely=rarely)[0]


class BlocksOfOne(NamedTuple):
    """Of one hypothesis or model what each block told, Λ_b (B, n, n) and y_b (B, n), and the sum of all Λ_b (n, n)."""

    information: Array
    vector: Array
    total: Array


def inflations(
    blocks: Sequence[BlocksOfOne],
    x: Array,
    p: Array,
    variance: Array | None = None,
    lasts: float = LASTS,
    rarely: float | None = RARELY,
) -> Array:
    """By how much σ of each state has to grow, at least 1, by S times blocks (S, n). x (S, n), P (S, n, n).

    The largest over blocks as they are, and over two and four of them together. variance: (S, r) of r quantities that
    are judged instead, whose covariance with the states p (S, r, n) then is. lasts, rarely: as
    `LASTS` and `RARELY`; None where σ is compared with more than 3 of it.
    """
    variance = np.diagonal(p, axis1=1, axis2=2) if variance is None else variance
    factor = np.ones(variance.shape)
    counts = np.array([len(each.vector) for each in blocks])
    for count in sorted(set(counts[counts >= FEWEST].tolist())):
        at = np.flatnonzero(counts == count)
        scores = np.stack([blocks[number].vector - blocks[number].information @ x[number] for number in at.tolist()])
        information = np.stack([blocks[number].information for number in at.tolist()])
        # of the variance that blocks claim of each quantity the part of each (S, m, r)
        parts = np.einsum("srn,smnk,srk->smr", p[at], information, p[at], optimize=True)
        factor[at] = _inflations(scores, parts, p[at], variance[at], lasts, rarely)
    return factor


def _inflations(scores: Array, parts: Array, p: Array, variance: Array, lasts: float, rarely: float | None) -> Array:
    """(S, r), by scores (S, m, n) and the parts (S, m, r) of the variance that they claim."""
    factor = np.ones(variance.shape)
    claimed = parts.sum(axis=1)
    while scores.shape[1] >= FEWEST:
        m = scores.shape[1]
        scatter = p @ scores.swapaxes(1, 2)
        longer = _lasting(scatter, lasts)
        alike = alike_of(parts)
        found = (scatter**2).sum(axis=2) * (alike / (alike - 1.0)) * longer
        by_chance = claimed * (chi2_isf(CHANCE, m - 1) / (m - 1))
        beyond = found - claimed
        if rarely is not None:
            surely = np.maximum(found - claimed * (chi2_isf(rarely, m - 1) / (m - 1)), 0.0)
            beyond = beyond + surely * (of_few(alike - 1.0) ** 2 - 1.0)
        # the prior's part of P is not the data's to judge
        more = 1.0 + beyond / np.maximum(variance, 1e-300)
        factor = np.maximum(factor, np.where(found > by_chance, np.sqrt(np.maximum(more, 1.0)), 1.0))
        scores, parts = (_paired(each) for each in (scores, parts))
    return factor


def _paired(values: Array) -> Array:
    """Neighbours of (S, m, ...) as one; an odd one goes to the last."""
    m = values.shape[1]
    pairs = values[:, 0 : m - m % 2 : 2] + values[:, 1::2]
    if m % 2:
        pairs[:, -1] += values[:, -1]
    return pairs


def alike_of(parts: Array) -> Array:
    """Of how many alike blocks a sum (S, r) of parts (S, m, r) is: those that tell most of it may be few."""
    number = parts.sum(axis=1) ** 2 / np.maximum((parts**2).sum(axis=1), 1e-300)
    return np.clip(number, FEWEST_ALIKE, parts.shape[1])


def of_few(dof: Array) -> Array:
    """By how much 3 σ has to be more where σ is of so few: Student's t (Cornish and Fisher)."""
    return np.asarray(1.0 + 2.5 / dof + 5.75 / dof**2)


def _lasting(scatter: Array, lasts: float) -> Array:
    """By how much the variance of the sum of each of series (S, n, m) is more than that of their terms.

    What lasts longer than a block is in neighbours alike, and where few blocks are left it is not seen otherwise.
    As of a process of first order, by the correlation of neighbours, which a mean that was taken off makes smaller by
    (1 + 4 ρ) / m (Kendall, 1954).
    """
    m = scatter.shape[-1]
    if m < LASTING_FROM:
        return np.ones(scatter.shape[:-1])
    beside = (scatter[..., 1:] * scatter[..., :-1]).sum(axis=-1) / np.maximum((scatter**2).sum(axis=-1), 1e-300)
    rho = np.clip((beside + 1.0 / m) / (1.0 - 4.0 / m), 0.0, MOST_LASTING)
    more = (1.0 + rho) / (1.0 - rho)
    return np.asarray(np.where(beside > lasts / np.sqrt(m), more / np.maximum(1.0 - more / m, 0.5), 1.0))
