"""Results of a calibration as immutable data, and the pose of the DVL in the body frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, by_severity
from ..filters.cross_validation import HeldOutError
from ..filters.observability import Convergence, Observability, observability, scale_std_ahead
from ..models import MODELS, Model
from ..models.parameters import FROM_REFERENCE, TOLD, UNKNOWN, Parameters
from ..numerics.error_model import correct, corrected_mounting
from ..numerics.frames import FLU_FROM_FRD, Array, near_angles, rpy_from_rotation
from ..numerics.kalman import GaussianState
from ..numerics.samples import Mask
from .bias_covariance import BiasCovariance
from .velocity_correction import NOT_ESTIMATED, lever_arm


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
    of_bias: BiasCovariance
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
    doubts: live, what the data say against the calibration, as bad as that is to the verdict of a replay. iac_model:
    the model that the paper's own selection ends with.
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
    iac_model: str = ""

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


class Segment(NamedTuple):
    """From this stamp on (until the next segment's) this model was selected."""

    from_ns: int
    model: str


@dataclass(frozen=True)
class Verification:
    """The verdict on one model's calibration, with reasons, the decisive ones first.

    verdict: reject, marginal or accept. mounting: what there is to inspect about the mounting, None for nothing: a good
    calibration may be of a bad one.
    """

    model: str
    held_out: HeldOutError | None
    verdict: Severity
    reasons: tuple[Reason, ...]
    mounting: Reason | None = None

    def with_objections(self, objections: Sequence[Reason]) -> Verification:
        """With what else is known of it; the verdict is the worst of all."""
        reasons = tuple(by_severity((*objections, *self.reasons)))
        return replace(self, verdict=reasons[0].severity, reasons=reasons)


_ARM = ("lever_arm_x", "lever_arm_y", "lever_arm_z")


class MountingPose(NamedTuple):
    """A DVL's frame in the body.

    position: (3,) m in the body, nan where it is not known. rotation_body_from_dvl: (3, 3), of the frame that the
    driver's data are in. covariance: (6, 6) of position (m²) and of a small turn about the body's axes (rad²), as in
    geometry_msgs/PoseWithCovariance; NOT_ESTIMATED on the diagonal of what the model does not estimate.
    """

    position: tuple[float, float, float]
    rotation_body_from_dvl: Array
    covariance: Array


def position_in_body(model: Model, state: GaussianState, parameters: Parameters) -> tuple[float, float, float] | None:
    """Where the DVL is in the body (3,) m, by one model's state x (n,), P (n, n); None where that is not known.

    The lever arm is from the reference point, of which `dvl_position` says what is known. On an axis that the data do
    not show it is as it was given, and where they contradict it or know it worse. If it was not given, nothing is
    known.
    """
    if parameters.dvl_position == UNKNOWN:
        return None
    given = np.array(parameters.lever_arm)
    arm = given
    if parameters.dvl_position == FROM_REFERENCE:
        seen = {each.name for each in observability(model, state.p, parameters) if each.observed}
        shown: Mask = np.array([name in seen for name in _ARM])
        if not given.any() and not shown.all():
            return None
        shown = shown & ~keeps_configured_arm(model, state, parameters)
        arm = np.where(shown, lever_arm(model, state, given.tolist()), given)
    x, y, z = (arm + parameters.reference_position).tolist()
    return x, y, z


def mounting_pose(model: Model, state: GaussianState, parameters: Parameters, turned: bool = False) -> MountingPose:
    """Pose of the DVL by one model's state, to first order in its misalignment.

    Parameters
    ----------
    model: Whose state it is.
    state: x (n,), P (n, n).
    parameters: Nominal mounting and lever arm.
    turned: Whether the driver's data are forward-right-down, and were turned.

    """
    t = parameters.rotation_dvl_from_body
    misalignment = (model.error_terms_from_state @ state.x)[:3]
    rotation = corrected_mounting(misalignment, t)
    # R = Tᵀ (I + [φ×])ᵀ, so φ turns the DVL by -Tᵀφ about the body's axes
    terms = np.zeros((6, model.n_state))
    names = model.state_names
    for row, name in enumerate(_ARM):
        if name in names:
            terms[row, names.index(name)] = 1.0
    terms[3:] = -t.T @ model.error_terms_from_state[:3]
    covariance = terms @ state.p @ terms.T
    missing = ~terms.any(axis=1)
    covariance[missing, missing] = NOT_ESTIMATED
    position = position_in_body(model, state, parameters)
    if position is None or parameters.dvl_position == TOLD:
        covariance[:3] = covariance[:, :3] = 0.0
        covariance[[0, 1, 2], [0, 1, 2]] = NOT_ESTIMATED
    return MountingPose(
        (math.nan,) * 3 if position is None else position, rotation @ FLU_FROM_FRD if turned else rotation, covariance
    )


# Turn (rad) over which the angles of a URDF are differentiated: their second derivatives are of order one.
_SMALL_TURN = 1e-5


def corrected_rpy(misalignment: Array, parameters: Parameters) -> Array:
    """Return roll, pitch, yaw (3,) rad of the corrected mounting, within half a turn of the configured ones.

    misalignment: φ (3,) rad, DVL frame.
    """
    corrected = corrected_mounting(misalignment, parameters.rotation_dvl_from_body)
    return near_angles(rpy_from_rotation(corrected), parameters.mounting_rpy)


def rpy_jacobian(misalignment: Array, parameters: Parameters) -> Array:
    """Differentiate roll, pitch, yaw of the corrected mounting by the misalignment φ (3,): (3, 3)."""
    up, down = (
        np.array([corrected_rpy(misalignment + way * each, parameters) for each in _SMALL_TURN * np.eye(3)])
        for way in (1.0, -1.0)
    )
    return near_angles(up - down, 0.0).T / (2.0 * _SMALL_TURN)


def rpy_std(misalignment: Array, covariance: Array, parameters: Parameters) -> Array:
    """Return standard deviations (3,) rad of roll, pitch, yaw of the corrected mounting, as a URDF's origin has them.

    Not those of turns about the body's axes: of a DVL at 45 degrees, a roll of the body that the motion does not show
    is as much pitch as roll. covariance: (n, n) of a model's state, which begins with φ.
    """
    jacobian = rpy_jacobian(misalignment, parameters)
    return np.sqrt(np.diag(jacobian @ covariance[:3, :3] @ jacobian.T))


class ScaleAndDelay(NamedTuple):
    """What a pose does not hold. scale: of motion ahead, dimensionless. time_offset: of the DVL's stamps, s, positive
    late, as the parameters say and what was found. Each with its σ, None where the model does not estimate it."""

    scale: float
    scale_std: float | None
    time_offset: float
    time_offset_std: float | None


def scale_and_delay(model: Model, state: GaussianState, parameters: Parameters) -> ScaleAndDelay:
    """Scale ahead and delay by one model's state, x (n,), P (n, n)."""
    ahead = parameters.rotation_dvl_from_body[:, 0] ** 2 @ model.error_terms_from_state[3:]
    std = scale_std_ahead(model, state.p, parameters)
    delay, delay_std = parameters.dvl_time_offset, None
    if "time_offset" in model.state_names:
        index = model.state_names.index("time_offset")
        delay, delay_std = delay + float(state.x[index]), float(np.sqrt(state.p[index, index]))
    return ScaleAndDelay(float(ahead @ state.x), float(std[0]) if len(std) else None, delay, delay_std)


OFFSETS = "reference_east", "reference_north"
ARM = ("lever_arm_x", "lever_arm_y", "lever_arm_z")
# So many σ are no chance, and so many metres no tape measure's error.
SIGMAS, MEASURED_TO = 5.0, 0.05
# Data that know an arm so many times worse than a tape measure do not improve on it.
WORSE_THAN_TOLD = 2.0


def estimates_lever_arm(model: Model) -> bool:
    """Whether its states have the lever arm."""
    return set(ARM) <= set(model.state_names)


def keeps_configured_arm(model: Model, state: GaussianState, parameters: Parameters) -> Mask:
    """(3,) whether it is where it was told to be, by axis: contradicted, or known less well than by a tape measure."""
    if not any(parameters.lever_arm) or not estimates_lever_arm(model):
        return np.zeros(3, dtype=bool)
    std = np.sqrt(np.diag(state.p)[[model.state_names.index(name) for name in ARM]])
    return contradicts_configured_arm(model, state, parameters) | np.asarray(std > WORSE_THAN_TOLD * MEASURED_TO)


def contradicts_configured_arm(model: Model, state: GaussianState, parameters: Parameters) -> Mask:
    """(3,) whether the data show the DVL elsewhere than it was told to be, by axis of the body."""
    if not any(parameters.lever_arm) or not estimates_lever_arm(model):
        return np.zeros(3, dtype=bool)
    at = [model.state_names.index(name) for name in ARM]
    away, std = np.abs(state.x[at]), np.sqrt(np.diag(state.p)[at])
    return np.asarray(away > np.maximum(SIGMAS * std, MEASURED_TO))
