"""Velocity error of `full` on held-out references, and its prediction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..filters.cross_validation import HeldOutError, held_out_from_sums
from ..models.own import BIAS, HEADING, REFERENCE_ERROR
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from .full_forward_model import FitBlock, PredictedRows

# States that are instrument errors, which velocity corrections leave in.
NOT_TAKEN_OFF = np.r_[BIAS, HEADING, REFERENCE_ERROR]


class HeldOutSums:
    """Sums of squares (m/s)² over held-out references: errors, white and slow noise, state uncertainty."""

    def __init__(self) -> None:
        self._n = 0
        self._before = self._after = self._white = self._slow = self._uncertainty = self._instrument = 0.0
        self._references, self._claimed = 0, 0.0

    def add(
        self, before: PredictedRows, after: PredictedRows, fold: int, state: GaussianState, white: Array, slow: Array
    ) -> None:
        """Add a block's rows of one fold that exist both uncorrected (`before`) and corrected (`after`).

        state: fitted without the fold. white: (3,), slow: (6,) variances, see `PredictedRows`.
        """
        in_fold = np.flatnonzero(after.fold == fold)
        at = in_fold[np.isin(after.times[in_fold], before.times, assume_unique=True)]
        same = np.searchsorted(before.times, after.times[at])
        weight, columns = after.weight[at], after.columns[at]
        self._n += len(at)
        self._before += float((weight * before.residual[same] ** 2).sum())
        self._after += float((weight * after.residual[at] ** 2).sum())
        self._white += float((weight * white).sum())
        self._slow += float((weight * (after.slow[at] ** 2 * slow).sum(axis=2)).sum())
        self._uncertainty += float((weight * ((columns @ state.p) * columns).sum(axis=2)).sum())
        self._instrument += float((weight * (columns[:, :, NOT_TAKEN_OFF] @ state.x[NOT_TAKEN_OFF]) ** 2).sum())

    def claims(self, block: FitBlock) -> None:
        """Add the noise that a block's references claim."""
        variance = np.diagonal(block.reference.noise, axis1=1, axis2=2)
        self._references += len(variance)
        self._claimed += float((block.measured * variance).sum())

    def error(self, seconds: float, memory_s: float) -> HeldOutError | None:
        """Return the error over all rows. seconds: their duration. memory_s: of the slow noise, s."""
        noise = self._white + self._slow
        predicted = noise + self._uncertainty + self._instrument
        found = held_out_from_sums(self._n, [self._before, self._after, predicted, self._uncertainty, 0.0])
        if found is None or noise <= 0.0:
            return found
        spread = self._white**2 / self._n + self._slow**2 * memory_s / max(seconds, memory_s)
        claimed = math.sqrt(self._claimed / max(self._references, 1))
        return replace(found, independent=noise**2 / spread, claimed=claimed)
