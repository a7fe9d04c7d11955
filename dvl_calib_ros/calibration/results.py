"""What a calibration says: immutable data that outlives the code that made it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..verdict.reasons import Reason
from .dvl_bias import OfBias
from .models import MODELS
from .models.parameters import Parameters
from .mounting_pose import position_in_body
from .numerics.error_model import correct, corrected_mounting
from .numerics.frames import Array
from .numerics.kalman import GaussianState
from .observability import Convergence, Observability
from .selection import Segment
from .verification import Verification


@dataclass(frozen=True)
class Estimate:
    """State of one model.

    state: (n,), misalignment in rad in the DVL frame, then scale-factor errors. covariance: (n, n), of the next
    recording, on another day (`days`). recording_covariance: (n, n), of this one: as blocks of time show, where that is
    more than the filter claims. filter_covariance: (n, n), what the filter alone claims. left_open: (n, n), the part of
    both covariances that the clock of the reference leaves open, which at one speed looks like a lever arm. of_bias:
    what a bias of the DVL makes of state and both: of the mounting, not of velocities at the speeds driven.
    used, gated: samples. mean_nis: mean of νᵀS⁻¹ν over the used samples, with the two-sided 99 % bounds of a consistent
    filter. heading_deviation: x (5,), P (5, 5) of how the heading deviates: coefficients of sine and cosine of the yaw
    and of twice the yaw, rad, and of time, rad/s; None for models that take the heading as it is.
    """

    model: str
    state: Array
    covariance: Array
    recording_covariance: Array
    filter_covariance: Array
    left_open: Array
    of_bias: OfBias
    used: int
    gated: int
    mean_nis: float
    nis_bounds: tuple[float, float]
    convergence: Convergence
    observability: tuple[Observability, ...]
    heading_deviation: GaussianState | None = None

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return MODELS[self.model].state_names

    @property
    def std(self) -> Array:
        """Standard deviations (n,), of the next recording."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def recording_std(self) -> Array:
        """Standard deviations (n,) of this recording."""
        return np.sqrt(np.diag(self.recording_covariance))

    @property
    def of_recording(self) -> GaussianState:
        """State with its covariance of this recording."""
        return GaussianState(self.state, self.recording_covariance)

    @property
    def velocity_covariance(self) -> Array:
        """(n, n) of this recording, for what velocities are worth that it corrects, at the speeds driven."""
        return self.recording_covariance - self.of_bias.covariance

    @property
    def filter_std(self) -> Array:
        """Standard deviations (n,) that the filter alone claims."""
        return np.sqrt(np.diag(self.filter_covariance))

    @property
    def misalignment(self) -> Array:
        """φ (3,) rad, DVL frame."""
        return self.state[:3]

    @property
    def scale(self) -> Array:
        """δk (3,) per DVL axis, zero where not estimated."""
        return (MODELS[self.model].error_terms_from_state @ self.state)[3:]

    def lever_arm(self, nominal: Sequence[float]) -> Array:
        """Where the DVL is (3,) m from the reference point, body frame: as the parameters say, and what was found."""
        return np.asarray(nominal, dtype=float) + self._beyond("lever_arm_x", "lever_arm_y", "lever_arm_z")

    def dvl_time_offset(self, nominal: float) -> float:
        """By how much the DVL's stamps are late, s: as the parameters say, and what was found."""
        return nominal + float(self._beyond("time_offset")[0])

    def _beyond(self, *names: str) -> Array:
        """States of these names, zero where the model has none."""
        return np.array([self.state_of(name) for name in names])

    def state_of(self, name: str) -> float:
        """State of this name, zero where the model has none."""
        own = self.state_names
        return float(self.state[own.index(name)]) if name in own else 0.0

    def std_of(self, *names: str) -> Array | None:
        """Standard deviations of states of these names; None if the model has none of them."""
        own = self.state_names
        return self.std[[own.index(name) for name in names]] if set(names) <= set(own) else None

    def corrected_velocity(self, velocity_dvl: Array, rotation_dvl_from_body: Array) -> Array:
        """Measured DVL velocities (..., 3) m/s -> corrected body velocities (..., 3) m/s."""
        return correct(velocity_dvl, self.misalignment, self.scale, rotation_dvl_from_body)

    def rotation_body_from_dvl(self, rotation_dvl_from_body: Array) -> Array:
        """Corrected mounting (3, 3)."""
        return corrected_mounting(self.misalignment, rotation_dvl_from_body)


@dataclass(frozen=True)
class Day:
    """What belongs to one of several days, by the data of all.

    Parameters
    ----------
    first_ns
        Stamp of its first DVL sample.
    dvl_time_offset, dvl_time_offset_std
        By how much the DVL's stamps are late, s: as the parameters say, and what was found; its σ.
    shown
        Whether the data showed it.
    reference_offset, reference_offset_std
        (2,) constant error of the reference, east and north, m/s; its σ.
    name
        Of the recording, '' for none.
    """

    first_ns: int
    dvl_time_offset: float
    dvl_time_offset_std: float
    shown: bool
    reference_offset: tuple[float, float]
    reference_offset_std: tuple[float, float]
    name: str = ""


class Delay(NamedTuple):
    """By how much the DVL's stamps are late, s: as the parameters say, and what was found; σ; whether it was shown.

    day: whose it is, None where there is one only.
    """

    day: Day | None
    seconds: float
    std: float
    shown: bool


@dataclass(frozen=True)
class Result:
    """All models' estimates, which one is selected, and what the data went through.

    first_ns, last_ns: stamps of the DVL samples received in order, None before the first. counts: see
    `Calibrator.counts`. segments: which model was selected from when. parameters: as used, plain values. verifications:
    by model, empty if the calibrator was not to verify. suggestion: what configuration the data fit, where the one
    given is grossly wrong, else ''. days: in order, none where there is one; days_of: the model whose states they are.
    doubts: live, what the data say against the calibration, as bad as that is to the verdict of a replay.
    """

    selected: str
    selected_because: Reason
    estimates: Mapping[str, Estimate]
    segments: tuple[Segment, ...]
    counts: Mapping[str, Mapping[str, int]]
    first_ns: int | None
    last_ns: int | None
    parameters: Mapping[str, Any]
    verifications: Mapping[str, Verification]
    suggestion: Reason | None = None
    days: tuple[Day, ...] = ()
    days_of: str = ""
    doubts: tuple[Reason, ...] = ()

    @property
    def estimate(self) -> Estimate:
        """The selected model's estimate."""
        return self.estimates[self.selected]

    @property
    def position_in_body(self) -> tuple[float, float, float] | None:
        """Where the DVL is in the body (3,) m, by the selected model; None where that is not known."""
        estimate = self.estimate
        state = GaussianState(estimate.state, estimate.covariance)
        return position_in_body(MODELS[estimate.model], state, Parameters.from_mapping(self.parameters))

    @property
    def own_days(self) -> tuple[Day, ...]:
        """Days that the selected model found something of; none where there is one."""
        return self.days if self.selected == self.days_of else ()

    @property
    def delays(self) -> tuple[Delay, ...]:
        """What the selected model found of the DVL's clock: one of each day, one if there is one, none without."""
        estimate = self.estimate
        if self.own_days:
            return tuple(Delay(day, day.dvl_time_offset, day.dvl_time_offset_std, day.shown) for day in self.own_days)
        std = estimate.std_of("time_offset")
        if std is None:
            return ()
        shown = all(each.observed for each in estimate.observability if each.axis == "time offset")
        return (Delay(None, estimate.dvl_time_offset(self.parameters["dvl_time_offset"]), float(std[0]), shown),)
