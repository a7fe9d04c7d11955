"""What is not shown, and what is left, fitted beside a fit: the one place where these are put together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..calibration.numerics.frames import Array
from .composed import Hypothesis, Problem, Seen
from .fitting import Fit, prior_std
from .least_squares import WhitenedLeastSquares
from .noise import Noise


class FittedBeside(NamedTuple):
    """What is fitted beside what is looked for. columns: (M, A, k) d residual / d parameters. std, centre: (k,), of the
    prior of what they explain of a fit's residual.
    """

    columns: Array
    std: Array
    centre: Array

    @staticmethod
    def of(problem: Problem, hypothesis: Hypothesis, seen: Sequence[Seen], columns: Array) -> FittedBeside:
        """Columns (M, A, k) of the first k parameters of a hypothesis, and those of what is not shown (u more)."""
        unshown, sizes = problem.unshown_columns(hypothesis, seen)
        k, none = columns.shape[2], np.zeros(len(sizes))
        std, centre = np.append(prior_std(hypothesis)[:k], sizes), np.append(hypothesis.vector()[:k], none)
        return FittedBeside(np.concatenate([columns, unshown], axis=2), std, centre)

    @staticmethod
    def of_fit(problem: Problem, fit: Fit) -> FittedBeside:
        """All parameters of a fit, and what is not shown."""
        return FittedBeside.of(problem, fit.hypothesis, fit.seen, fit.columns)

    def and_rest(self, raw: Array, residual: Array) -> FittedBeside:
        """And columns raw (M, A, c), of unit size, of what a residual (M, A) follows."""
        size = np.maximum(np.sqrt((raw**2).mean(axis=(0, 1))), 1e-12)
        # all together are no larger than the residual: else stretches without a turn would be told of any size
        std, none = np.full(raw.shape[2], _likely(raw, residual)), np.zeros(raw.shape[2])
        columns = np.concatenate([self.columns, raw / size], axis=2)
        return FittedBeside(columns, np.append(self.std, std), np.append(self.centre, none))

    def step(self, noise: Noise, residual: Array) -> WhitenedLeastSquares:
        """Of the step (k,) of what is fitted that leaves least of a residual (M, A) under a noise."""
        return WhitenedLeastSquares.of(noise.whiten(self.columns), -noise.whiten(residual), self.std, -self.centre)


def _likely(raw: Array, residual: Array) -> float:
    """Size of each of columns (M, A, c) of unit size that all together are no larger than a residual (M, A)."""
    return float(np.sqrt(np.mean(residual**2) / max(raw.shape[2] / raw.shape[1], 1.0)))
