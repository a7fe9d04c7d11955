"""Y1's estimator: the mean of what the reference says beside the DVL in the vertical, found by no filter at all."""

from __future__ import annotations

import numpy as np
from own_models import PRIOR_STD

from dvl_calib_ros.calibration.estimators.estimator import Estimator, EstimatorSetup
from dvl_calib_ros.calibration.filters.filter_bank import ModelCounts
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.results.thinned_recording import Terms


class MeanRise(Estimator):
    """Extends G1's state by one."""

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

    def _with_mean(self, base: GaussianState) -> GaussianState:
        n = len(base.x)
        p = np.zeros((n + 1, n + 1))
        p[:n, :n], p[n, n] = base.p, PRIOR_STD**2 / (1.0 + self._count)
        return GaussianState(np.append(base.x, self._sum / max(self._count, 1.0)), p)

    def state(self) -> GaussianState:
        return self._with_mean(self._given.base.state())

    def of_recording(self) -> GaussianState:
        return self._with_mean(self._given.base.of_recording())

    @property
    def counts(self) -> ModelCounts:
        return self._given.base.counts

    def states_at(self, trace, numbers, stamps_ns):
        base, used, nis_sum = self._given.base.states_at(trace, numbers, stamps_ns)
        extended = [self._with_mean(GaussianState(*each)) for each in zip(*base, strict=True)]
        return GaussianState(np.array([s.x for s in extended]), np.array([s.p for s in extended])), used, nis_sum

    def held_out_error(self, judge, rotation_dvl_from_body):
        return self._given.base.held_out_error(judge, rotation_dvl_from_body)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        return self._given.base.held_out_terms(n_days)
