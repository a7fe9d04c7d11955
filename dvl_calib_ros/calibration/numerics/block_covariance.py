"""Uncertainty of an estimate from the scatter of time blocks, in addition to the covariance of the filter.

The covariance of a filter assumes white noise R. Larger or correlated noise and model errors make stretches differ
more. With Λ_b, y_b the information of block b (Λ = Λ₀ + Σ Λ_b), its score s_b = y_b - Λ_b x at the common estimate x
has covariance Λ_b under the model. The actual scatter Σ s_b s_bᵀ gives the "sandwich" covariance P (Λ₀ + Σ s_b s_bᵀ) P
(White, "Maximum likelihood estimation of misspecified models", 1982).

Shapes: K models, B blocks of time, S estimates, n states.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .frames import Array
from .tests import chi2_isf

# Length of a block of time: motion and the errors of waves are correlated over less.
BLOCK_S, BLOCK_NS = 10.0, 10_000_000_000
# Most blocks. When full, neighbours are joined and the block length doubles: memory is bounded, and the scatter covers
# effects of minutes.
MAX_BLOCKS = 64
# Fewest blocks of a scatter: with 8 its relative σ is a quarter.
MIN_BLOCKS = 8
# Upper-tail probabilities of the scatter: beyond CHANCE σ is inflated, and the excess beyond RARE is scaled by
# Student's t, so that 3 σ keep their probability with few blocks.
CHANCE, RARE = 0.1, 0.02
# Smallest equivalent number of blocks with equal information.
FEWEST_ALIKE = 5.0
# Fewest blocks for a correlation of neighbours, significant coefficient in σ (1/√m), and largest coefficient used. A
# higher threshold would miss noise as long as a block in half of the four-minute recordings.
MIN_LASTING_BLOCKS, LASTING_Z, MAX_CORRELATION = 16, 1.5, 0.85


class TimeBlocks:
    """Information of consecutive time blocks, for K hypotheses or models.

    count: number of blocks.
    weight: equivalent number of samples.
    total: sums Λ (K, n, n) and y (K, n), read-only.
    """

    def __init__(self) -> None:
        # capacity: MAX_BLOCKS blocks
        self._information = np.zeros((0, 0, 0, 0))
        self._vector = np.zeros((0, 0, 0))
        self.total: tuple[Array, Array] = np.zeros((0, 0, 0)), np.zeros((0, 0))
        self.count = 0
        self._per_block = 1  # additions in a full block
        self._in_last = 0
        self.weight = 0.0

    @property
    def kept(self) -> tuple[Array, Array]:
        """Λ_b (B, K, n, n) and y_b (B, K, n) of each block, in order."""
        return self._information[: self.count], self._vector[: self.count]

    def add(self, information: Array, vector: Array, weight: float) -> None:
        """Add the information of a stretch to the newest block, or to a new one if that is full.

        At MAX_BLOCKS blocks, neighbours are joined and a full block holds twice as many stretches.

        information, vector: Λ_b (K, n, n) and y_b (K, n). weight: equivalent number of samples.
        """
        self.weight += weight
        self.total = (self.total[0] + information, self.total[1] + vector) if self.count else (information, vector)
        if self.count and self._in_last < self._per_block:
            self._information[self.count - 1] += information
            self._vector[self.count - 1] += vector
            self._in_last += 1
            return
        if not self.count:
            # filled, so that the memory is allocated now and not over ten minutes
            self._information = np.full((MAX_BLOCKS, *information.shape), np.nan)
            self._vector = np.full((MAX_BLOCKS, *vector.shape), np.nan)
        if self.count == MAX_BLOCKS:
            self.count = MAX_BLOCKS // 2
            for sums in (self._information, self._vector):
                sums[: self.count] = sums[0::2] + sums[1::2]
            self._per_block *= 2
        self._information[self.count], self._vector[self.count] = information, vector
        self.count += 1
        self._in_last = 1

    def end_day(self, of_day: NDArray[np.intp], information: Array, vector: Array, source: NDArray[np.intp]) -> None:
        """Reduce the blocks to the states that continue in the next recording.

        of_day: indices (u,) of the other states.
        information (K, n, n), vector (K, n): total.
        source: (K,) index of the hypothesis whose past each one takes.
        """
        if not len(of_day):
            return
        n, k = information.shape[-1], len(information)
        inverse = np.linalg.inv(information[np.ix_(np.arange(k), of_day, of_day)])
        # eliminate the per-recording states: their scores vanish at the estimate
        projection = np.broadcast_to(np.eye(n), (k, n, n)).copy()
        projection[:, :, of_day] -= information[:, :, of_day] @ inverse
        projection[:, of_day] = 0.0
        estimate = (inverse @ vector[:, of_day, None])[..., 0]
        for block_information, block_vector in zip(*self.kept, strict=True):
            residual = block_vector - (block_information[:, :, of_day] @ estimate[..., None])[..., 0]
            block_information[:] = projection @ block_information @ projection.swapaxes(1, 2)
            block_vector[:] = (projection @ residual[..., None])[..., 0]
        self.choose(source)

    def choose(self, source: NDArray[np.intp]) -> None:
        """Give each hypothesis the past of another. source: (K,) indices of the present ones."""
        if self.count:
            self._information, self._vector = self._information[:, source], self._vector[:, source]
            self.total = self.kept[0].sum(axis=0), self.kept[1].sum(axis=0)

    def of(self, index: int) -> BlocksOfOne:
        """Return the blocks of one of the K."""
        if not self.count:
            return BlocksOfOne(np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0)))
        information, vector = (sums[:, index].copy() for sums in self.kept)
        return BlocksOfOne(information, vector, self.total[0][index])

    def inflation(self, index: int, x: Array, p: Array, lasts: float = LASTING_Z, rarely: float | None = RARE) -> Array:
        """Return `inflations` for one of the K, x (n,), P (n, n)."""
        return inflations([self.of(index)], x[None], p[None], lasts=lasts, rarely=rarely)[0]


class BlocksOfOne(NamedTuple):
    """Blocks of one hypothesis or model: Λ_b (B, n, n), y_b (B, n), and Σ Λ_b (n, n)."""

    information: Array
    vector: Array
    total: Array

    def part(self, at: NDArray[np.intp]) -> BlocksOfOne:
        """Return the blocks of some of the states."""
        return BlocksOfOne(self.information[:, at[:, None], at], self.vector[:, at], self.total[at[:, None], at])


def inflations(
    blocks: Sequence[BlocksOfOne], x: Array, p: Array, lasts: float = LASTING_Z, rarely: float | None = RARE
) -> Array:
    """Return the σ inflation factors (S, n), at least 1, of estimates x (S, n), P (S, n, n).

    A factor is the largest over single blocks and over blocks joined by two and four. lasts, rarely: see `LASTING_Z`
    and `RARE`; None: without the factor of Student's t, for thresholds above 3 σ.
    """
    variance = np.diagonal(p, axis1=1, axis2=2)
    factor = np.ones(variance.shape)
    counts = np.array([len(block.vector) for block in blocks])
    for count in sorted(set(counts[counts >= MIN_BLOCKS].tolist())):
        chosen = np.flatnonzero(counts == count)
        own = [(blocks[number], x[number]) for number in chosen.tolist()]
        scores = np.stack([blocks.vector - blocks.information @ estimate for blocks, estimate in own])
        information = np.stack([blocks.information for blocks, _ in own])
        # share of each block in the claimed variance of each quantity (S, m, r)
        shares = np.einsum("srn,smnk,srk->smr", p[chosen], information, p[chosen], optimize=True)
        factor[chosen] = _inflations(scores, shares, p[chosen], variance[chosen], lasts, rarely)
    return factor


def _inflations(scores: Array, parts: Array, p: Array, variance: Array, lasts: float, rarely: float | None) -> Array:
    """Return factors (S, r) from scores (S, m, n) and the shares (S, m, r) of the variance that they claim."""
    factor = np.ones(variance.shape)
    claimed = parts.sum(axis=1)
    while scores.shape[1] >= MIN_BLOCKS:
        m = scores.shape[1]
        scatter = p @ scores.swapaxes(1, 2)
        lasting = _lasting(scatter, lasts)
        n_effective = effective_blocks(parts)
        observed = (scatter**2).sum(axis=2) * (n_effective / (n_effective - 1.0)) * lasting
        by_chance = claimed * (chi2_isf(CHANCE, m - 1) / (m - 1))
        excess = observed - claimed
        if rarely is not None:
            rare_excess = np.maximum(observed - claimed * (chi2_isf(rarely, m - 1) / (m - 1)), 0.0)
            excess = excess + rare_excess * (student_factor(n_effective - 1.0) ** 2 - 1.0)
        # the prior part of P is not judged by the data
        ratio = 1.0 + excess / np.maximum(variance, 1e-300)
        factor = np.maximum(factor, np.where(observed > by_chance, np.sqrt(np.maximum(ratio, 1.0)), 1.0))
        scores, parts = (_paired(values) for values in (scores, parts))
    return factor


def _paired(values: Array) -> Array:
    """Join neighbours of (S, m, ...); an odd last one is added to the last pair."""
    m = values.shape[1]
    pairs = values[:, 0 : m - m % 2 : 2] + values[:, 1::2]
    if m % 2:
        pairs[:, -1] += values[:, -1]
    return pairs


def effective_blocks(parts: Array) -> Array:
    """Return the equivalent number (S, r) of blocks with equal shares, from shares (S, m, r)."""
    number = parts.sum(axis=1) ** 2 / np.maximum((parts**2).sum(axis=1), 1e-300)
    return np.clip(number, FEWEST_ALIKE, parts.shape[1])


def student_factor(dof: Array) -> Array:
    """Return the factor of 3 σ if σ has few degrees of freedom: Student's t (Cornish and Fisher)."""
    return np.asarray(1.0 + 2.5 / dof + 5.75 / dof**2)


def _lasting(scatter: Array, lasts: float) -> Array:
    """Return the variance of the sum of series (S, n, m) over the sum of their variances.

    First-order process with the correlation of neighbouring blocks, corrected for the bias (1 + 4 ρ) / m due to the
    subtracted mean (Kendall, 1954). It covers noise that lasts longer than a block.
    """
    m = scatter.shape[-1]
    if m < MIN_LASTING_BLOCKS:
        return np.ones(scatter.shape[:-1])
    correlation = (scatter[..., 1:] * scatter[..., :-1]).sum(axis=-1) / np.maximum((scatter**2).sum(axis=-1), 1e-300)
    rho = np.clip((correlation + 1.0 / m) / (1.0 - 4.0 / m), 0.0, MAX_CORRELATION)
    growth = (1.0 + rho) / (1.0 - rho)
    return np.asarray(np.where(correlation > lasts / np.sqrt(m), growth / np.maximum(1.0 - growth / m, 0.5), 1.0))
