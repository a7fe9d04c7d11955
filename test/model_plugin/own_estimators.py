"""Y1's estimator: the mean of what the reference says beside the DVL in the vertical, found by no filter at all."""

from __future__ import annotations

import numpy as np
from own_models import PRIOR_STD

from dvl_calib_ros.calibration.estimators.estimator import Estimator, EstimatorSetup
from dvl_calib_ros.calibration.filters.cross_validation import FOLDS
from dvl_calib_ros.calibration.filters.filter_bank import ModelCounts
from dvl_calib_ros.calibration.filters.filter_setup import prior
from dvl_calib_ros.calibration.filters.state_history import PastStates
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.results.thinned_recording import NO_TERMS, Terms


class MeanRise(Estimator):
    """Of the mounting it knows what is known before."""

    def __init__(self, given: EstimatorSetup) -> None:
        self._given, self._taken = given, 0
        self._sum = self._count = 0.0

    @property
    def n_taken(self) -> int:
        return self._taken

    def advance(self) -> None:
        partners = self._given.aligner.partners
        block = self._given.aligner.rows.block(self._taken, partners.n_paired)
        self._taken = partners.n_paired
        rise = block.reference[:, 2] - (block.velocity_dvl @ self._given.parameters.rotation_dvl_from_body)[:, 2]
        self._sum += float(rise[block.paired].sum())
        self._count += float(np.count_nonzero(block.paired))

    def state(self) -> GaussianState:
        x, p = prior(self._given.model, self._given.parameters)
        x[-1], p[-1, -1] = self._sum / max(self._count, 1.0), PRIOR_STD**2 / (1.0 + self._count)
        return GaussianState(x, p)

    def of_recording(self) -> GaussianState:
        return self.state()

    @property
    def counts(self) -> ModelCounts:
        return ModelCounts(int(self._count), 0, 3.0, 3.0, 0)

    def states_at(self, trace, numbers, stamps_ns):
        n, (x, p) = len(stamps_ns), self.state()
        used = np.full(n, self.counts.used)
        return PastStates(GaussianState(np.stack([x] * n), np.stack([p] * n)), used, 3.0 * used)

    def held_out_error(self, judge, rotation_dvl_from_body):
        return None

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        return [[NO_TERMS] * n_days] * FOLDS
