"""A calibrator's estimates held against data that they had not seen: verdicts, and what is left with each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..verdict.reasons import Reason
from .doubts import doubts
from .estimates import Estimates
from .filters.cross_validation import HeldOutError, Moments, calibration_error, folds_of
from .models import MODELS, Model
from .navigation import Navigation, dead_reckoned, objections
from .numerics.error_model import correction_matrix
from .numerics.frames import Array
from .numerics.kalman import GaussianState
from .results.held_out_verification import SEVERAL, verify
from .results.results import Estimate, Verification, finds_arm
from .results.thinned_recording import NO_TERMS, Compared, Terms, ThinnedRecording, typical_error, without_outliers
from .worth import drift_left_open

# What is said of a running calibration on the way: of the rest its diagnostics say more than a verdict does.
JUDGED_LIVE = {
    "HELD_OUT_WORSE", "HELD_OUT_SEVERAL_TIMES", "HELD_OUT_IMPLAUSIBLE", "HELD_OUT_OUTLIERS", "MISALIGNMENT_LARGE",
    "SCALE_LARGE", "LEVER_ARM_TURNS_ANGLE",
}  # fmt: skip


class Judge:
    """Judges the estimates of one calibrator."""

    def __init__(self, estimates: Estimates) -> None:
        self._estimates, self._further = estimates, estimates.further
        self._compared: tuple[ThinnedRecording, Compared] | None = None  # as mounted

    def verification(self, name: str, moments: Moments) -> Verification:
        """The verdict on one model's calibration, by hold-out. moments: of the samples that it is judged by."""
        estimate = self._estimates.without_tilt(self._estimates.estimate(name))
        model, state = MODELS[name], GaussianState(estimate.state, estimate.covariance)
        held_out = self._held_out(name, moments)
        is_suspect = held_out is not None and held_out.corrected > min(
            SEVERAL * held_out.predicted, held_out.uncorrected
        )
        typical = self.typical_error(model, state) if is_suspect else None
        samples, vv, *_ = moments.total
        return self._judged(estimate, held_out, typical, (float(samples), vv), self._further.suggestion)

    def so_far(self, name: str, *, fresh: bool) -> Verification:
        """The same of a running calibration, by what the worker looked at; nothing is waited for unless fresh."""
        estimate, further = self._estimate(name, fresh=fresh), self._further
        rest, suggestion = further.rest(fresh=fresh), further.suggestion if fresh else further.suggestion_so_far
        if MODELS[name].from_positions:
            held_out = self._held_out(name, Moments()) if fresh else None
            return self._judged(estimate, held_out, None, (0.0, np.zeros((3, 3, 3))), suggestion)
        if rest is None or not MODELS[name].aided:
            return self._judged(estimate, None, None, (0.0, np.zeros((3, 3, 3))), suggestion)
        return self._judged(estimate, rest.held_out, rest.typical, rest.judged, suggestion)

    def _held_out(self, name: str, moments: Moments) -> HeldOutError | None:
        rotation_dvl_from_body = self._estimates.parameters.rotation_dvl_from_body
        return self._estimates.estimators[name].held_out_error(moments, rotation_dvl_from_body)

    def _estimate(self, name: str, *, fresh: bool) -> Estimate:
        estimate = self._estimates.estimate(name)
        return self._estimates.without_tilt(estimate) if fresh else estimate

    def _judged(
        self,
        estimate: Estimate,
        held_out: HeldOutError | None,
        typical: float | None,
        judged: tuple[float, Array],
        suggestion: Reason | None,
    ) -> Verification:
        """As of `verify`. judged: as of `calibration_error`."""
        name, p = estimate.model, self._estimates.parameters
        model, estimator = MODELS[name], self._estimates.estimators[name]
        of_velocity = self._estimates.of_recording(name).p - estimator.of_bias.covariance
        return verify(
            model,
            GaussianState(estimate.state, estimate.covariance),
            estimate.convergence,
            held_out,
            p,
            (estimate.used, estimate.gated),
            suggestion if model.aided else None,
            self._further.reference_claims,
            self._further.doubt if model.aided else None,
            bool(model.estimator) and estimator.claims,
            typical,
            calibration_error(model, of_velocity, judged, p.rotation_dvl_from_body),
        )

    def doubts(self, name: str, of_clocks: Sequence[Reason], *, fresh: bool) -> list[Reason]:
        """What the data say against one model's calibration, as bad as that is to a verdict; of a running one.

        of_clocks: what clocks say against every calibration. fresh: by a look at all there is, else by one that the
        worker took a little ago.
        """
        further, p = self._further, self._estimates.parameters
        suggested, rest = further.suggestion if fresh else further.suggestion_so_far, further.rest(fresh=fresh)
        navigation = None if rest is None else rest.navigation
        if MODELS[name].from_positions:
            navigation = self._estimates.estimators[name].navigation() if fresh else None
        found = doubts(
            self._estimate(name, fresh=fresh),
            (self._estimate(each.name, fresh=fresh) for each in self._estimates.arm_finders),
            navigation,
            p,
            suggested=suggested is not None,
            in_earth=rest is not None and rest.in_earth,
            is_level=fresh and further.is_level,
        )
        found += of_clocks
        if navigation is None:
            return found
        held_out = self.so_far(name, fresh=fresh).reasons
        known_to = drift_left_open(self._estimate(name, fresh=fresh), p)
        return [*found, *objections(navigation, known_to), *(each for each in held_out if each.code in JUDGED_LIVE)]

    def navigation(self, name: str, deviation: GaussianState | None) -> Navigation | None:
        """What one model's calibration is worth to dead reckoning, on data that it had not seen. None without
        reference, or with hardly any motion. deviation: how the heading deviates."""
        with self._further.settled():
            own = self._estimates.estimators[name].navigation()
        if own is not None:
            return own
        kept = self._further.recording
        if kept is None:
            return None
        recording, epoch_ns = kept
        try:
            terms = self.held_out_terms(name)
        except np.linalg.LinAlgError:
            return None
        stamps_ns = np.round(recording.dvl.times * 1e9).astype(np.int64) + epoch_ns
        # of every fold and day what corrects it
        n_days, p = len(terms[0]), self._estimates.parameters
        parts = folds_of(stamps_ns, p) * n_days + self._further.day_of(stamps_ns)
        corrections = [each for of_days in terms for each in of_days]
        return dead_reckoned(recording, parts, corrections, p, epoch_ns, deviation)

    def held_out_terms(self, name: str) -> list[list[Terms]]:
        """For every fold what one model corrects on every day, had it not seen that fold.

        Raises numpy.linalg.LinAlgError for a configuration so wrong that there is no estimate without a fold.
        """
        return self._estimates.estimators[name].held_out_terms(self._further.n_days)

    def typical_error(self, model: Model, state: GaussianState) -> float | None:
        """Velocity error of a state, m/s rms, without outliers; None where nothing was kept."""
        kept, p = self._further.recording, self._estimates.parameters
        if kept is None:
            return None
        x, recording = state.x, kept[0]
        if finds_arm(model):
            return typical_error(recording, Terms.of_state(x), p)
        if self._compared is None or self._compared[0] is not recording:
            every = np.arange(len(recording.dvl.times))
            self._compared = recording, recording.compared(every, NO_TERMS, p)
        seen, errors, t = self._compared[1], model.error_terms_from_state @ x, p.rotation_dvl_from_body
        change = recording.dvl.velocity @ (t.T - correction_matrix(errors[:3], errors[3:], t)).T
        return without_outliers(seen.error + np.matmul(seen.measured, change[..., None])[..., 0])
