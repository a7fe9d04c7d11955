"""How certain an estimate is, by the scatter of blocks of time: the σ that the data show beside the filter's own.

A filter's covariance holds what R claims of white noise. Noise that is larger or lasts longer, and what the model does
not know, make the estimates of different stretches differ by more. With Λ_b, y_b what block b told (Λ = Λ₀ + Σ Λ_b),
the score s_b = y_b - Λ_b x of a block at the common estimate x has covariance Λ_b if all is as claimed; what it really
scatters by is Σ s_b s_bᵀ, and P (Λ₀ + Σ s_b s_bᵀ) P what x then is worth (the "sandwich"; White, "Maximum likelihood
estimation of misspecified models", 1982).
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from .frames import Array

# Blocks kept; when they are full, neighbours are joined and blocks are twice as long. So memory is bounded, and effects
# that last for minutes show in the end.
MOST = 64
# With fewer, the scatter says little: of 8 its own standard deviation is a quarter.
FEWEST = 8
# By chance a scatter may exceed the filter's σ up to this quantile without being taken for more.
CHANCE = 0.1


class TimeBlocks:
    """Information of consecutive blocks of time, for K hypotheses or models at once.

    kept: of each block, in order, Λ_b (K, n, n) and y_b (K, n). weight: number of samples that all count for.
    """

    def __init__(self) -> None:
        self.kept: list[tuple[Array, Array]] = []
        self._each = 1  # additions in a full block
        self._in_last = 0
        self.weight = 0.0

    def add(self, information: Array, vector: Array, weight: float) -> None:
        """Add what a stretch told: Λ_b (K, n, n), y_b (K, n). weight: number of samples that it counts for."""
        self.weight += weight
        if self.kept and self._in_last < self._each:
            last = self.kept[-1]
            self.kept[-1] = last[0] + information, last[1] + vector
            self._in_last += 1
            return
        if len(self.kept) == MOST:
            self.kept = [_joined(pair) for pair in zip(self.kept[::2], self.kept[1::2], strict=True)]
            self._each *= 2
        self.kept.append((information.copy(), vector.copy()))
        self._in_last = 1

    def inflation(self, index: int, x: Array, p: Array) -> Array:
        """By how much σ of each state (n,) has to grow, at least 1. index: which of the K. x (n,), P (n, n) of it.

        The largest over blocks as they are, and over two and four of them together.
        """
        scores = np.array([vector[index] - information[index] @ x for information, vector in self.kept])
        factor = np.ones(len(x))
        if len(scores) < FEWEST:
            return factor
        information = sum(each[0][index] for each in self.kept)
        claimed = np.diag(p @ information @ p)
        while len(scores) >= FEWEST:
            m = len(scores)
            scatter = p @ scores.T
            found = (scatter**2).sum(axis=1) * (m / (m - 1.0))
            ratio = found / np.maximum(claimed, 1e-300)
            beyond_chance = ratio > float(chdtri(m - 1, CHANCE)) / (m - 1)
            # the prior's part of P is not the data's to judge
            total = 1.0 + (found - claimed) / np.diag(p)
            factor = np.maximum(factor, np.where(beyond_chance, np.sqrt(np.maximum(total, 1.0)), 1.0))
            if m % 2:
                scores = np.vstack([scores[:-2], scores[-2:].sum(axis=0)])[: m - 1]
                m -= 1
            scores = scores[0::2][: m // 2] + scores[1::2][: m // 2]
        return factor


def _joined(pair: tuple[tuple[Array, Array], tuple[Array, Array]]) -> tuple[Array, Array]:
    (a, b), (c, d) = pair
    return a + c, b + d
