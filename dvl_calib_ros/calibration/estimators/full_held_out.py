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

# States that are errors of the instruments. A published calibration does not correct velocities for them.
INSTRUMENT_ERRORS = np.r_[BIAS, HEADING, REFERENCE_ERROR]


class HeldOutSums:
    """Sums of squares (m/s)² over held-out references: errors, white and slow noise, state uncertainty."""

    def __init__(self) -> None:
        self._n = 0
        self._before = self._after = self._white = self._slow = self._uncertainty = self._instrument = 0.0
        self._references, self._claimed = 0, 0.0

    def add(
        self, before: PredictedRows, after: PredictedRows, fold: int, state: GaussianState, white: Array, slow: Array
    ) -> None:
        """Add a block's references of one fold that are predicted both uncorrected and corrected.

        before, after: rows of the block about the nominal and the corrected state.
        state: x, P of the states, fitted without the fold.
        white: (3,) (m/s)², variance of the white noise per axis.
        slow: (6,) variances of the slow errors that change, as the first columns of `PredictedRows.slow`.
        """
        in_fold = np.flatnonzero(after.fold == fold)
        at = in_fold[np.isin(after.times[in_fold], before.times, assume_unique=True)]
        same = np.searchsorted(before.times, after.times[at])
        weight, columns = after.weight[at], after.columns[at]
        self._n += len(at)
        self._before += float((weight * before.residual[same] ** 2).sum())
        self._after += float((weight * after.residual[at] ** 2).sum())
        self._white += float((weight * white).sum())
        self._slow += float((weight * (after.slow[at, :, : len(slow)] ** 2 * slow).sum(axis=2)).sum())
        self._uncertainty += float((weight * ((columns @ state.p) * columns).sum(axis=2)).sum())
        self._instrument += float((weight * (columns[:, :, INSTRUMENT_ERRORS] @ state.x[INSTRUMENT_ERRORS]) ** 2).sum())

    def add_claimed(self, block: FitBlock) -> None:
        """Add the noise variances that a block's references report."""
        variance = np.diagonal(block.reference.noise, axis1=1, axis2=2)
        self._references += len(variance)
        self._claimed += float((block.measured * variance).sum())

    def error(self, seconds: float, memory_s: float) -> HeldOutError | None:
        """Return the error over all rows; None if they are too few.

        seconds: duration of the rows. memory_s: time constant of the slow noise.
        """
        noise = self._white + self._slow
        predicted = noise + self._uncertainty + self._instrument
        error = held_out_from_sums(self._n, [self._before, self._after, predicted, self._uncertainty, 0.0])
        if error is None or noise <= 0.0:
            return error
        spread = self._white**2 / self._n + self._slow**2 * memory_s / max(seconds, memory_s)
        claimed = math.sqrt(self._claimed / max(self._references, 1))
        return replace(error, independent=noise**2 / spread, claimed=claimed)
