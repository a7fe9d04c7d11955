"""Estimates of all models with their covariance, and their assessment on held-out data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ..verdict.reasons import Reason
from .assessment.dead_reckoning import Navigation, SlowNoise, dead_reckoned, doubts, objections
from .assessment.manoeuvre_planner import drift_left_open
from .checks.beam_faults import BeamFault
from .estimators.estimator import NEVER, Estimator, Residuals
from .filters.cross_validation import HeldOutError, Moments, calibration_error, folds_of
from .filters.filter_setup import nis_bounds
from .filters.observability import MEASURES_TURNS, MEASURES_VERTICAL, convergence, observability
from .models import MODELS, Model
from .models.parameters import Parameters
from .numerics.error_model import correction_matrix
from .numerics.frames import Array
from .numerics.kalman import GaussianState
from .numerics.samples import Index, Stamps
from .registration.registration import Registration
from .results import results
from .results.extrinsics import day_covariance
from .results.held_out_verification import MAX_ERROR_RATIO, verify
from .results.results import Estimate, Verification, estimates_lever_arm
from .results.thinned_recording import NO_TERMS, Compared, Terms, ThinnedRecording, typical_error, without_outliers

# Reason codes of a verdict that a live calibration reports; its diagnostics cover the others.
JUDGED_LIVE = {
    "HELD_OUT_WORSE", "HELD_OUT_SEVERAL_TIMES", "HELD_OUT_IMPLAUSIBLE", "HELD_OUT_OUTLIERS", "MISALIGNMENT_LARGE",
    "SCALE_LARGE", "LEVER_ARM_TURNS_ANGLE",
}  # fmt: skip


class Assessor:
    """Assessment of the estimates of one calibrator."""

    def __init__(self, estimates: Estimates) -> None:
        self._estimates, self._further = estimates, estimates.further
        self._compared: tuple[ThinnedRecording, Compared] | None = None  # comparison without corrections

    def verification(self, name: str, moments: Moments) -> Verification:
        """Return the hold-out verdict on one model's calibration. moments: sums over the samples, by fold."""
        estimate = self._estimates.without_tilt(self._estimates.estimate(name))
        model, state = MODELS[name], GaussianState(estimate.state, estimate.covariance)
        held_out = self._held_out(name, moments)
        is_suspect = held_out is not None and held_out.corrected > min(
            MAX_ERROR_RATIO * held_out.predicted, held_out.uncorrected
        )
        typical = self.typical_error(model, state) if is_suspect else None
        sums = moments.in_fold(None)
        return self._judged(estimate, held_out, typical, (float(sums.samples), sums.vv), self._further.suggestion)

    def so_far(self, name: str, *, fresh: bool) -> Verification:
        """Return the verdict of a running calibration, by the worker's latest evaluation unless `fresh`."""
        estimate, further = self._estimate(name, fresh=fresh), self._further
        errors, suggestion = further.residuals(fresh=fresh), further.suggestion if fresh else further.suggestion_so_far
        if MODELS[name].from_positions:
            held_out = self._held_out(name, Moments()) if fresh else None
            return self._judged(estimate, held_out, None, (0.0, np.zeros((3, 3, 3))), suggestion)
        if errors is None or not MODELS[name].aided:
            return self._judged(estimate, None, None, (0.0, np.zeros((3, 3, 3))), suggestion)
        return self._judged(estimate, errors.held_out, errors.typical, errors.judged, suggestion)

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
        """Return the verdict on an estimate, see `verify`.

        typical: held-out velocity error without outliers, m/s; None if not needed. judged: number of samples and sum of
        v vᵀ (3, 3), (m/s)², of the samples judged.
        """
        name, p = estimate.model, self._estimates.parameters
        model, estimator = MODELS[name], self._estimates.estimators[name]
        of_velocity = self._estimates.of_recording(name).p - estimator.of_bias.covariance
        return verify(
            model, GaussianState(estimate.state, estimate.covariance), estimate.convergence, held_out, p,
            (estimate.used, estimate.gated), suggestion if model.aided else None, self._further.reference_claims,
            self._further.doubt if model.aided else None, bool(model.estimator) and estimator.claims, typical,
            calibration_error(model, of_velocity, judged, p.rotation_dvl_from_body), drift_left_open(estimate, p),
        )  # fmt: skip

    def doubts(self, name: str, of_clocks: Sequence[Reason], *, fresh: bool) -> list[Reason]:
        """Return the reasons against one model's running calibration, weighed by their effect on the verdict.

        of_clocks: reasons of the clocks against any calibration. fresh: evaluate all data now, else use the worker's
        latest evaluation.
        """
        further, p = self._further, self._estimates.parameters
        suggested, errors = further.suggestion if fresh else further.suggestion_so_far, further.residuals(fresh=fresh)
        navigation = None if errors is None else errors.navigation
        if MODELS[name].from_positions:
            navigation = self._estimates.estimators[name].navigation() if fresh else None
        found = doubts(
            self._estimate(name, fresh=fresh),
            (self._estimate(arm_finder.name, fresh=fresh) for arm_finder in self._estimates.arm_finders),
            navigation,
            p,
            suggested=suggested is not None,
            in_earth=errors is not None and errors.in_earth,
            is_level=fresh and further.is_level,
        )
        found += of_clocks
        if navigation is None:
            return found
        held_out = self.so_far(name, fresh=fresh).reasons
        known_to = drift_left_open(self._estimate(name, fresh=fresh), p)
        return [*found, *objections(navigation, known_to), *(error for error in held_out if error.code in JUDGED_LIVE)]

    def navigation(self, name: str, deviation: GaussianState | None) -> Navigation | None:
        """Return one model's dead-reckoning drift on held-out data; None without reference or motion.

        deviation: heading deviation, as `Estimate.heading_deviation`.
        """
        with self._further.settled():
            of_estimator = self._estimates.estimators[name].navigation()
        if of_estimator is not None:
            return of_estimator
        if self._further.recording is None:
            return None
        recording, epoch_ns = self._further.recording
        try:
            terms = self.held_out_terms(name)
        except np.linalg.LinAlgError:
            return None
        stamps_ns = np.round(recording.dvl.times * 1e9).astype(np.int64) + epoch_ns
        # one correction per fold and day, by its index in the flat list
        n_days, p = len(terms[0]), self._estimates.parameters
        indices = folds_of(stamps_ns, p) * n_days + self._further.day_of(stamps_ns)
        corrections = [day_terms for fold_terms in terms for day_terms in fold_terms]
        further = self._further
        return dead_reckoned(
            recording, indices, corrections, p, epoch_ns, deviation, further.slow_noise, further.dvl_bias,
            further.beam_fault,
        )  # fmt: skip

    def held_out_terms(self, name: str) -> list[list[Terms]]:
        """Return, per fold and day, one model's corrections estimated without that fold.

        Raises numpy.linalg.LinAlgError if a grossly wrong configuration leaves no estimate without a fold.
        """
        return self._estimates.estimators[name].held_out_terms(self._further.n_days)

    def typical_error(self, model: Model, state: GaussianState) -> float | None:
        """Return a state's velocity error (m/s rms) on the kept streams without outliers; None if none were kept."""
        kept, p = self._further.recording, self._estimates.parameters
        if kept is None:
            return None
        x, recording = state.x, kept[0]
        if estimates_lever_arm(model):
            return typical_error(recording, Terms.of_state(x), p)
        if self._compared is None or self._compared[0] is not recording:
            every = np.arange(len(recording.dvl.times))
            self._compared = recording, recording.compared(every, NO_TERMS, p)
        seen, errors, t = self._compared[1], model.error_terms_from_state @ x, p.rotation_dvl_from_body
        change = recording.dvl.velocity @ (t.T - correction_matrix(errors[:3], errors[3:], t)).T
        return without_outliers(seen.error + np.matmul(seen.measured, change[..., None])[..., 0])


class Estimates:
    """Estimates of a calibrator's models.

    estimators: by model name.
    further: the estimators beyond the linear filter.
    models: names of the models in use.
    parameters: replaced by the calibrator when parameters change at run time.
    """

    def __init__(
        self,
        estimators: Mapping[str, Estimator],
        further: NonlinearEstimators,
        models: Sequence[str],
        parameters: Parameters,
    ) -> None:
        """Start without estimates; the arguments are those of the class."""
        self.estimators, self.further, self.parameters = estimators, further, parameters
        self._models = models
        self._day_covariances: dict[str, Array] = {}

    def estimate(self, name: str) -> Estimate:
        """Return the complete estimate of one model."""
        model, estimator = MODELS[name], self.estimators[name]
        state, covariance = self.of_recording(name)
        of_bias = estimator.of_bias
        of_velocity = covariance - of_bias.covariance  # repeating the same motion does not reduce the bias
        counts = estimator.counts
        return Estimate(
            model=name, state=state, covariance=covariance + self._day_covariance(name),
            recording_covariance=covariance, filter_covariance=estimator.filter_covariance,
            left_open=estimator.left_open, of_bias=of_bias, used=counts.used, gated=counts.gated,
            mean_nis=counts.mean_nis, nis_bounds=nis_bounds(counts.mean_rows, self.parameters, counts.used),
            convergence=convergence(model, of_velocity, self.parameters),
            observability=observability(model, of_velocity, self.parameters),
            heading_deviation=estimator.heading_deviation,
        )  # fmt: skip

    def of_recording(self, name: str) -> GaussianState:
        """Return the state with σ for this recording: the larger of the filter's and of the scatter of time blocks."""
        return self.estimators[name].of_recording()

    def next_recording(self, name: str) -> GaussianState:
        """Return `of_recording` with day-to-day variation added, as σ for the next recording."""
        state = self.of_recording(name)
        return GaussianState(state.x, state.p + self._day_covariance(name))

    def _day_covariance(self, name: str) -> Array:
        if name not in self._day_covariances:
            self._day_covariances[name] = day_covariance(MODELS[name], self.parameters)
        return self._day_covariances[name]

    @property
    def arm_finders(self) -> Iterator[Model]:
        """Models in use that estimate the lever arm, the best first."""
        return (MODELS[name] for name in self._models if results.estimates_lever_arm(MODELS[name]))

    def without_tilt(self, estimate: Estimate) -> Estimate:
        """Return the estimate with prior uncertainty on tilt that the data cannot show.

        Roll and pitch need an IMU that measures them and a reference with vertical velocity, which the lever arm's
        height needs too. Roll alone is uncertain if the configured lever arm is contradicted: attitude of another time
        causes both. Without turn rates the lever arm is in the velocities, as roll, yaw and scale.
        """
        model, p = MODELS[estimate.model], self.parameters
        needs = ""
        if self.further.is_level:
            needs = "an IMU that measures roll and pitch"
        elif self.further.is_horizontal:
            needs = MEASURES_VERTICAL
        arm_effect = self.further.arm_effect
        unknown_axes = 2 if needs else int(arm_effect is not None or self._finds_another_arm)
        if not model.aided or not unknown_axes:
            return estimate
        level = p.rotation_dvl_from_body[:, :unknown_axes]
        unknown = np.zeros((model.n_state, model.n_state))
        unknown[:3, :3] = p.initial_std_misalignment**2 * (level @ level.T)
        if needs == MEASURES_VERTICAL and results.estimates_lever_arm(model):  # the height is not observable either
            height = model.state_names.index("lever_arm_z")
            unknown[height, height] = p.initial_std_lever_arm**2
        if arm_effect:
            ahead, up = p.rotation_dvl_from_body[:, 0], p.rotation_dvl_from_body[:, 2]
            by_arm = arm_effect * np.column_stack([[*up, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, *ahead**2]])
            of_state = np.linalg.pinv(model.error_terms_from_state) @ by_arm
            unknown += of_state @ of_state.T
        own = estimate.velocity_covariance + unknown
        return replace(
            estimate,
            covariance=estimate.covariance + unknown,
            recording_covariance=estimate.recording_covariance + unknown,
            convergence=convergence(model, own, p),
            observability=observability(model, own, p, needs or ("" if arm_effect is None else MEASURES_TURNS)),
        )

    @property
    def _finds_another_arm(self) -> bool:
        """Return whether the data contradict the configured lever arm."""
        model = next(self.arm_finders, None)
        if model is None:
            return False
        estimator = self.estimators[model.name]
        x, p = estimator.of_recording()
        shown = GaussianState(x, p - estimator.left_open)
        return bool(results.contradicts_configured_arm(model, shown, self.parameters).any())


_Answer = TypeVar("_Answer")


class NonlinearEstimators:
    """Estimators beyond the linear filter, in the order of their models, with the interface of `Estimator`."""

    def __init__(self, estimators: Sequence[Estimator]) -> None:
        self._all = tuple(estimators)

    def __iter__(self) -> Iterator[Estimator]:
        return iter(self._all)

    def _first(self, ask: Callable[[Estimator], _Answer | None]) -> _Answer | None:
        return next((answer for estimator in self._all if (answer := ask(estimator)) is not None), None)

    @property
    def n_taken(self) -> int:
        """Smallest number of the first aligned row that an estimator has not copied."""
        return min((estimator.n_taken for estimator in self._all), default=NEVER)

    @property
    def n_results(self) -> tuple[int, ...]:
        """Counters, by estimator, that grow when it may have new results."""
        return tuple(estimator.n_results for estimator in self._all)

    @property
    def affected_from_ns(self) -> int | None:
        """Stamp of the first DVL sample that gathered blocks may still affect; None without any."""
        return min((until for model in self._all if (until := model.affected_from_ns) is not None), default=None)

    @property
    def reference_claims(self) -> bool:
        """Return whether the reference's noise comes from its messages instead of a parameter."""
        return any(estimator.reference_claims for estimator in self._all)

    @property
    def is_level(self) -> bool:
        """Return whether the IMU gives a heading only, so that roll and pitch hold the vehicle's trim."""
        return any(estimator.is_level for estimator in self._all)

    @property
    def arm_effect(self) -> float | None:
        """Velocity error by an unknown arm without turn rates, σ as a share of the speed; None if rates are known."""
        return self._first(lambda estimator: estimator.arm_effect)

    @property
    def is_horizontal(self) -> bool:
        """Return whether no reference measures the vertical."""
        return any(estimator.is_horizontal for estimator in self._all)

    @property
    def are_clocks_known(self) -> bool:
        """Return whether the data determine the clock offsets, zero or not."""
        return any(estimator.registration is not None and estimator.registration.are_known for estimator in self._all)

    @property
    def doubt(self) -> Reason | None:
        """Reason against models that assume what these estimators estimate."""
        return self._first(lambda estimator: estimator.doubt)

    @property
    def suggestion(self) -> Reason | None:
        """Configuration that fits the data, if the given one is grossly wrong."""
        return self._first(lambda estimator: estimator.suggestion)

    @property
    def suggestion_so_far(self) -> Reason | None:
        """`suggestion` by the latest evaluation, without waiting."""
        return self._first(lambda estimator: estimator.suggestion_so_far)

    @property
    def registration_so_far(self) -> Registration | None:
        """Registration of clocks and frames by the latest evaluation; None if not known."""
        return self._first(lambda estimator: estimator.registration_so_far)

    def residuals(self, *, fresh: bool) -> Residuals | None:
        """Return the calibration's residuals, evaluated now if `fresh`, else the latest; None if not available."""
        return self._first(lambda estimator: estimator.residuals(fresh=fresh))

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """Streams kept for verification, and the stamp (ns) of their time 0; None if nothing was kept."""
        return self._first(lambda estimator: estimator.recording)

    @property
    def slow_noise(self) -> SlowNoise | None:
        """Slow errors of reference and attitude as estimated; None if not estimated."""
        return self._first(lambda estimator: estimator.slow_noise)

    @property
    def dvl_bias(self) -> GaussianState | None:
        """DVL's bias by the data alone, of the first estimator that has one."""
        return self._first(lambda estimator: estimator.dvl_bias)

    @property
    def beam_fault(self) -> BeamFault | None:
        """Most significant fault of one beam of the DVL; None if not tested."""
        return self._first(lambda estimator: estimator.beam_fault)

    @property
    def n_days(self) -> int:
        """Number of days so far."""
        return max((estimator.n_days for estimator in self._all), default=1)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Return the day (N,), from 0, of each stamp (ns), for stamps within `recording`."""
        days = [estimator.day_of(stamps_ns) for estimator in self._all]
        return np.max(days, axis=0) if days else np.zeros(len(stamps_ns), dtype=np.intp)

    @contextmanager
    def settled(self) -> Iterator[None]:
        """Let all complete blocks take effect inside this context."""
        with ExitStack() as each_settled:
            for estimator in self._all:
                each_settled.enter_context(estimator.settled())
            yield
