"""What each model's estimator says, with σ worth believing: of this recording, and of the next on another day."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from .estimator import Estimator
from .filters.day_to_day_covariance import day_covariance, offset_covariance
from .filters.filter_setup import nis_bounds
from .filters.observability import MEASURES_VERTICAL, convergence, observability
from .further import FurtherEstimators
from .models import EXTENDED_BY, MODELS, Model
from .models.parameters import Parameters
from .numerics.frames import Array
from .numerics.kalman import GaussianState
from .results import results
from .results.results import Estimate

# Of an angle too little is claimed, where it is known to so many times the variance with the lever arm as unknown.
OPEN_FROM = 4.0
# So many σ of the difference between the two are no chance, and as many of its own are too little claimed.
NO_CHANCE = 3.0


class Estimates:
    """The estimates of a calibrator's models.

    estimators: by model. further: those of them that are more than the linear filter. models: names of those that are
    wanted. parameters: those that can change at run time are set here.
    """

    def __init__(
        self,
        estimators: Mapping[str, Estimator],
        further: FurtherEstimators,
        models: Sequence[str],
        parameters: Parameters,
    ) -> None:
        self.estimators, self.further, self.parameters = estimators, further, parameters
        self._models = models
        self._day_covariances: dict[str, Array] = {}

    def estimate(self, name: str) -> Estimate:
        """Estimate of one model, with all that is known about it."""
        model, estimator = MODELS[name], self.estimators[name]
        state, covariance = self.of_recording(name)
        of_bias = estimator.of_bias
        of_velocity = covariance - of_bias.covariance  # more of the same motion tells no more of a bias
        used, gated, mean_nis, rows, _ = estimator.counts
        return Estimate(
            model=name,
            state=state,
            covariance=covariance + self._day_covariance(name),
            recording_covariance=covariance,
            filter_covariance=estimator.filter_covariance,
            left_open=estimator.left_open + self._by_clock(name),
            of_bias=of_bias,
            used=used,
            gated=gated,
            mean_nis=mean_nis,
            nis_bounds=nis_bounds(rows, self.parameters, used),
            convergence=convergence(model, of_velocity, self.parameters),
            observability=observability(model, of_velocity, self.parameters),
            heading_deviation=estimator.heading_deviation,
        )

    def of_recording(self, name: str) -> GaussianState:
        """State and covariance, σ as of the same day: the larger of what the filter claims and what blocks of time
        show."""
        estimator = self.estimators[name]
        state, covariance = estimator.of_recording()
        worse = offset_covariance(MODELS[name], state, estimator.filter_covariance, self.parameters)
        unknown = self._by_unknown_arm(name, state, covariance) + self._by_clock(name)
        return GaussianState(state, covariance + worse + unknown)

    def next_recording(self, name: str) -> GaussianState:
        """As `of_recording`, with σ worth believing of the next recording: with what another day makes of it."""
        state = self.of_recording(name)
        return GaussianState(state.x, state.p + self._day_covariance(name))

    def _day_covariance(self, name: str) -> Array:
        if name not in self._day_covariances:
            self._day_covariances[name] = day_covariance(MODELS[name], self.parameters)
        return self._day_covariances[name]

    def _by_clock(self, name: str) -> Array:
        """(n, n) of a model that takes clocks as known: what one in a steady turn makes of the angles, with an arm that
        was told."""
        n, estimator = MODELS[name].n_state, self.estimators.get(EXTENDED_BY.get(name, ""))
        found = np.zeros((n, n))
        if estimator is not None and any(self.parameters.lever_arm):
            found[:3, :3] = estimator.turn_open
        return found

    def _by_unknown_arm(self, name: str, state: Array, covariance: Array) -> Array:
        """(n, n) that a model claims too little of angles, for it takes a lever arm that nobody told as known.

        Its angles are off by what the model that finds the arm has otherwise, and by what that one is off.
        """
        found = np.zeros_like(covariance)
        estimator = self.estimators.get(EXTENDED_BY.get(name, ""))
        if estimator is None or not estimator.claims or any(self.parameters.lever_arm):
            return found
        other = estimator.of_recording()
        # a bias of the DVL is there with an arm as without
        own = np.diag(covariance - self.estimators[name].of_bias.covariance)[:3]
        open_arm = np.diag(other.p - estimator.of_bias.covariance)[:3]
        by_arm = open_arm - own
        away = (state - other.x[: len(state)])[:3] ** 2
        is_open = (open_arm > OPEN_FROM * own) | (away > NO_CHANCE**2 * np.minimum(own, np.maximum(by_arm, 0.0)))
        np.fill_diagonal(found[:3, :3], np.where(is_open & (by_arm > 0.0), by_arm + away, 0.0))
        return found

    @property
    def arm_finders(self) -> Iterator[Model]:
        """Wanted models that find the lever arm, the best first."""
        return (MODELS[name] for name in self._models if results.finds_arm(MODELS[name]))

    def without_tilt(self, estimate: Estimate) -> Estimate:
        """An estimate that claims no roll and pitch where those of the vehicle are not known, or no reference measures
        the vertical, which leaves the arm's height open too; and no roll where another lever arm is found than was
        told: an attitude of another time makes one, and in waves a roll."""
        model, p = MODELS[estimate.model], self.parameters
        needs = ""
        if self.further.is_level:
            needs = "an IMU that measures roll and pitch"
        elif self.further.is_horizontal:
            needs = MEASURES_VERTICAL
        unknown_axes = 0 if not model.aided else 2 if needs else int(self._finds_another_arm)
        if not unknown_axes:
            return estimate
        level = p.rotation_dvl_from_body[:, :unknown_axes]
        unknown = np.zeros((model.n_state, model.n_state))
        unknown[:3, :3] = p.initial_std_misalignment**2 * (level @ level.T)
        if needs == MEASURES_VERTICAL and results.finds_arm(model):  # nor does anything show its height
            height = model.state_names.index("lever_arm_z")
            unknown[height, height] = p.initial_std_lever_arm**2
        own = estimate.velocity_covariance + unknown
        return replace(
            estimate,
            covariance=estimate.covariance + unknown,
            recording_covariance=estimate.recording_covariance + unknown,
            convergence=convergence(model, own, p),
            observability=observability(model, own, p, needs),
        )

    @property
    def _finds_another_arm(self) -> bool:
        """Whether the lever arm that was told is contradicted."""
        model = next(self.arm_finders, None)
        if model is None:
            return False
        estimator = self.estimators[model.name]
        x, p = estimator.of_recording()
        shown = GaussianState(x, p - estimator.left_open)
        return bool(results.contradicted(model, shown, self.parameters).any())
