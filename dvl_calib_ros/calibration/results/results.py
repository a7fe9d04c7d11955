"""Immutable results of a calibration, and the pose of the DVL in the body frame."""

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
from ..numerics.error_model import correct, corrected_mounting, correction_jacobian, correction_matrix
from ..numerics.frames import FLU_FROM_FRD, Array, near_angles, rpy_from_rotation
from ..numerics.kalman import GaussianState
from ..numerics.samples import Mask
from ..numerics.tests import Z_REPEATED_TEST

_SCALE_FIRST = [3, 4, 5, 0, 1, 2]
NOT_ESTIMATED = -1.0  # variance of a component that the model does not estimate


def twist_terms(model: Model, state: GaussianState) -> tuple[Array, Array]:
    """Return δk per axis, then φ (6,) with their joint covariance (6, 6).

    A component that the model does not estimate is 0 with variance NOT_ESTIMATED.
    """
    terms = model.error_terms_from_state[_SCALE_FIRST]
    covariance = terms @ state.p @ terms.T
    missing = ~terms.any(axis=1)
    covariance[missing, missing] = NOT_ESTIMATED
    return terms @ state.x, covariance


def lever_arm(model: Model, state: GaussianState, nominal: Sequence[float]) -> tuple[float, float, float]:
    """Return the DVL position, m from the reference point, body frame: configured plus estimated."""
    found = dict(zip(model.state_names, state.x.tolist(), strict=True))
    x, y, z = (known + found.get(f"lever_arm_{axis}", 0.0) for axis, known in zip("xyz", nominal, strict=True))
    return x, y, z


class Correction:
    """Correction of DVL velocities by a model state."""

    def __init__(self, model: Model, state: GaussianState, rotation_dvl_from_body: Array) -> None:
        terms = model.error_terms_from_state
        errors = terms @ state.x
        self._rotation_dvl_from_body = rotation_dvl_from_body
        self._matrix = correction_matrix(errors[:3], errors[3:], rotation_dvl_from_body)
        self._error_covariance = terms @ state.p @ terms.T

    def apply(self, velocity_dvl: Array, noise_dvl: Array) -> tuple[Array, Array]:
        """Return the body velocity (3,) m/s and its covariance (3, 3), including that of the calibration.

        noise_dvl: (3, 3) (m/s)², DVL frame.
        """
        jacobian = correction_jacobian(velocity_dvl, self._rotation_dvl_from_body)
        noise = self._matrix @ noise_dvl @ self._matrix.T
        return self._matrix @ velocity_dvl, noise + jacobian @ self._error_covariance @ jacobian.T


class BiasCovariance(NamedTuple):
    """Effect of the DVL bias on states (n,).

    columns: (n, 3), change of the states per σ of the bias along each DVL axis: its prior σ (`dvl_bias_std`) at one
    speed, its estimated σ if several speeds make it observable.
    """

    columns: Array

    @property
    def covariance(self) -> Array:
        """Contribution (n, n) of the bias to P."""
        return np.asarray(self.columns @ self.columns.swapaxes(-1, -2))

    @staticmethod
    def none(n: int) -> BiasCovariance:
        """Return the effect on states (n,) that are independent of the bias."""
        return BiasCovariance(np.zeros((n, 3)))

    def where(self, known: Mask) -> BiasCovariance:
        """Return the effect on the states (n,) that are known from data."""
        return BiasCovariance(np.where(known[:, None], self.columns, 0.0))


@dataclass(frozen=True)
class Estimate:
    """State of one model.

    state: (n,), misalignment in rad in the DVL frame, then scale-factor errors, then nuisance states.
    covariance: (n, n), for the next recording.
    recording_covariance: (n, n), for this one, inflated by the scatter of time blocks.
    filter_covariance: (n, n), of the filter alone.
    left_open: (n, n), contribution of the reference clock to covariance and recording_covariance; at one speed a delay
      looks like a lever arm.
    of_bias: effect of the DVL bias on the state and these covariances, for the mounting, not for velocities at the
      speeds driven.
    used, gated: samples.
    mean_nis: mean of νᵀS⁻¹ν over the used samples, with the two-sided 99 % bounds of a consistent filter.
    heading_deviation: x (4,), P (4, 4): coefficients of sine and cosine of the yaw and of twice the yaw, rad; None for
      models with exact heading.
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
        """Standard deviations (n,) for the next recording."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def recording_std(self) -> Array:
        """Standard deviations (n,) for this recording."""
        return np.sqrt(np.diag(self.recording_covariance))

    @property
    def of_recording(self) -> GaussianState:
        """State with its covariance for this recording."""
        return GaussianState(self.state, self.recording_covariance)

    @property
    def velocity_covariance(self) -> Array:
        """State covariance (n, n) for corrected velocities of this recording: without bias, at the speeds driven."""
        return self.recording_covariance - self.of_bias.covariance

    @property
    def filter_std(self) -> Array:
        """Standard deviations (n,) of the filter alone."""
        return np.sqrt(np.diag(self.filter_covariance))

    @property
    def misalignment(self) -> Array:
        """Misalignment φ (3,) rad, DVL frame."""
        return self.state[:3]

    @property
    def scale(self) -> Array:
        """Scale-factor errors δk (3,) per DVL axis, zero where not estimated."""
        return (MODELS[self.model].error_terms_from_state @ self.state)[3:]

    def lever_arm(self, nominal: Sequence[float]) -> Array:
        """Return the DVL position (3,) m from the reference point, body frame: configured plus estimated."""
        return np.asarray(nominal, dtype=float) + self._beyond("lever_arm_x", "lever_arm_y", "lever_arm_z")

    def dvl_time_offset(self, nominal: float) -> float:
        """Return the DVL delay, s: configured plus estimated."""
        return nominal + float(self._beyond("time_offset")[0])

    def _beyond(self, *names: str) -> Array:
        """Return states by name, zero where the model has none."""
        return np.array([self.state_of(name) for name in names])

    def state_of(self, name: str) -> float:
        """Return a state by name, zero if the model has none."""
        own = self.state_names
        return float(self.state[own.index(name)]) if name in own else 0.0

    def std_of(self, *names: str) -> Array | None:
        """Return the standard deviations of states by name; None if the model lacks one of them."""
        own = self.state_names
        return self.std[[own.index(name) for name in names]] if set(names) <= set(own) else None

    def corrected_velocity(self, velocity_dvl: Array, rotation_dvl_from_body: Array) -> Array:
        """Return corrected body velocities (..., 3) m/s of measured DVL velocities (..., 3) m/s."""
        return correct(velocity_dvl, self.misalignment, self.scale, rotation_dvl_from_body)

    def rotation_body_from_dvl(self, rotation_dvl_from_body: Array) -> Array:
        """Return the corrected mounting (3, 3)."""
        return corrected_mounting(self.misalignment, rotation_dvl_from_body)


@dataclass(frozen=True)
class Day:
    """States of one of several recordings, estimated from all data.

    Parameters
    ----------
    first_ns
        Stamp of its first DVL sample.
    dvl_time_offset, dvl_time_offset_std
        DVL delay, s, configured plus estimated; its σ.
    shown
        True if the delay is observable.
    reference_offset, reference_offset_std
        (2,) constant error of the reference, east and north, m/s; its σ.
    name
        Name of the recording, or ''.
    """

    first_ns: int
    dvl_time_offset: float
    dvl_time_offset_std: float
    shown: bool
    reference_offset: tuple[float, float]
    reference_offset_std: tuple[float, float]
    name: str = ""


class Delay(NamedTuple):
    """DVL delay against the IMU, s, configured plus estimated; its σ; whether it is observable (shown).

    day: recording of the delay, None if there is only one.
    """

    day: Day | None
    seconds: float
    std: float
    shown: bool


@dataclass(frozen=True)
class Result:
    """Estimates of all models, the selected one, and counts of the data.

    first_ns, last_ns: stamps of the DVL samples received in order, None before the first.
    counts: see `Calibrator.counts`.
    segments: selected model over time.
    parameters: as used, plain values.
    verifications: by model, empty without verification.
    suggestion: configuration that fits, if the configured one is grossly wrong.
    days: recordings in order, empty for a single one.
    days_of: the model of their states.
    doubts: live warnings with the severity of a replay's verdict.
    iac_model: final model by the selection of the paper.
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
        """Estimate of the selected model."""
        return self.estimates[self.selected]

    @property
    def position_in_body(self) -> tuple[float, float, float] | None:
        """DVL position (3,) m in the body by the selected model; None if unknown."""
        estimate = self.estimate
        state = GaussianState(estimate.state, estimate.covariance)
        return position_in_body(MODELS[estimate.model], state, Parameters.from_mapping(self.parameters))

    @property
    def own_days(self) -> tuple[Day, ...]:
        """Recordings with states of the selected model; empty for a single one."""
        return self.days if self.selected == self.days_of else ()

    @property
    def delays(self) -> tuple[Delay, ...]:
        """DVL delays by the selected model: one per recording, or none."""
        estimate = self.estimate
        if self.own_days:
            return tuple(Delay(day, day.dvl_time_offset, day.dvl_time_offset_std, day.shown) for day in self.own_days)
        std = estimate.std_of("time_offset")
        if std is None:
            return ()
        shown = all(entry.observed for entry in estimate.observability if entry.axis == "time offset")
        return (Delay(None, estimate.dvl_time_offset(self.parameters["dvl_time_offset"]), float(std[0]), shown),)


class Segment(NamedTuple):
    """Model selected from this stamp to the next segment."""

    from_ns: int
    model: str


@dataclass(frozen=True)
class Verification:
    """Verdict on the calibration of one model, with reasons, the decisive ones first.

    verdict: reject, marginal or accept. mounting: reason to inspect the mounting, or None; a good calibration can have
    one.
    """

    model: str
    held_out: HeldOutError | None
    verdict: Severity
    reasons: tuple[Reason, ...]
    mounting: Reason | None = None

    def with_objections(self, objections: Sequence[Reason]) -> Verification:
        """Return the verification with further reasons; the verdict is the worst of all."""
        reasons = tuple(by_severity((*objections, *self.reasons)))
        return replace(self, verdict=reasons[0].severity, reasons=reasons)


_ARM = ("lever_arm_x", "lever_arm_y", "lever_arm_z")


class MountingPose(NamedTuple):
    """Pose of the DVL frame in the body.

    position: (3,) m in the body, nan if unknown.
    rotation_body_from_dvl: (3, 3), of the frame of the driver data.
    covariance: (6, 6) of position (m²) and of small rotations about body axes (rad²), as in
      geometry_msgs/PoseWithCovariance; NOT_ESTIMATED on the diagonal of components that the model does not estimate.
    """

    position: tuple[float, float, float]
    rotation_body_from_dvl: Array
    covariance: Array


def position_in_body(model: Model, state: GaussianState, parameters: Parameters) -> tuple[float, float, float] | None:
    """Return the DVL position (3,) m in the body by a model state x (n,), P (n, n); None if unknown.

    `dvl_position` selects its source. The configured lever arm is kept on axes that are not observable, where the data
    contradict it, and where a tape measure is better. If none is configured, all axes must be observable.
    """
    if parameters.dvl_position == UNKNOWN:
        return None
    given = np.array(parameters.lever_arm)
    arm = given
    if parameters.dvl_position == FROM_REFERENCE:
        seen = {entry.name for entry in observability(model, state.p, parameters) if entry.observed}
        shown: Mask = np.array([name in seen for name in _ARM])
        if not given.any() and not shown.all():
            return None
        shown = shown & ~keeps_configured_arm(model, state, parameters)
        arm = np.where(shown, lever_arm(model, state, given.tolist()), given)
    x, y, z = (arm + parameters.reference_position).tolist()
    return x, y, z


def mounting_pose(model: Model, state: GaussianState, parameters: Parameters, turned: bool = False) -> MountingPose:
    """Return the pose of the DVL by a model state, to first order in the misalignment.

    Parameters
    ----------
    model: Model of the state.
    state: x (n,), P (n, n).
    parameters: Nominal mounting and lever arm.
    turned: True if the driver data are forward-right-down and were rotated.
    """
    t = parameters.rotation_dvl_from_body
    misalignment = (model.error_terms_from_state @ state.x)[:3]
    rotation = corrected_mounting(misalignment, t)
    # R = Tᵀ (I + [φ×])ᵀ, so φ rotates the DVL by -Tᵀφ about body axes
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


# Step (rad) of the numerical derivative of URDF angles: their second derivatives are of order one.
_SMALL_TURN = 1e-5


def corrected_rpy(misalignment: Array, parameters: Parameters) -> Array:
    """Return roll, pitch, yaw (3,) rad of the corrected mounting, within half a turn of the configured ones.

    misalignment: φ (3,) rad, DVL frame.
    """
    corrected = corrected_mounting(misalignment, parameters.rotation_dvl_from_body)
    return near_angles(rpy_from_rotation(corrected), parameters.mounting_rpy)


def rpy_jacobian(misalignment: Array, parameters: Parameters) -> Array:
    """Return the derivative (3, 3) of roll, pitch, yaw of the corrected mounting with respect to φ (3,)."""
    up, down = (
        np.array([corrected_rpy(misalignment + sign * turn, parameters) for turn in _SMALL_TURN * np.eye(3)])
        for sign in (1.0, -1.0)
    )
    return near_angles(up - down, 0.0).T / (2.0 * _SMALL_TURN)


def rpy_std(misalignment: Array, covariance: Array, parameters: Parameters) -> Array:
    """Return the σ (3,) rad of roll, pitch, yaw of the corrected mounting, as in a URDF origin.

    They differ from σ about body axes: with a DVL at 45 degrees, unobservable body roll affects pitch and roll alike.
    covariance: (n, n) of a state that begins with φ.
    """
    jacobian = rpy_jacobian(misalignment, parameters)
    return np.sqrt(np.diag(jacobian @ covariance[:3, :3] @ jacobian.T))


class ScaleAndDelay(NamedTuple):
    """Scale of motion ahead (dimensionless) and DVL delay (s, positive late), configured plus estimated.

    Each with its σ, None if the model does not estimate it.
    """

    scale: float
    scale_std: float | None
    time_offset: float
    time_offset_std: float | None


def scale_and_delay(model: Model, state: GaussianState, parameters: Parameters) -> ScaleAndDelay:
    """Return scale ahead and delay by a model state, x (n,), P (n, n)."""
    ahead = parameters.rotation_dvl_from_body[:, 0] ** 2 @ model.error_terms_from_state[3:]
    std = scale_std_ahead(model, state.p, parameters)
    delay, delay_std = parameters.dvl_time_offset, None
    if "time_offset" in model.state_names:
        index = model.state_names.index("time_offset")
        delay, delay_std = delay + float(state.x[index]), float(np.sqrt(state.p[index, index]))
    return ScaleAndDelay(float(ahead @ state.x), float(std[0]) if len(std) else None, delay, delay_std)


OFFSETS = "reference_east", "reference_north"
ARM = ("lever_arm_x", "lever_arm_y", "lever_arm_z")
# σ of a configured lever arm, m: the error of a tape measure. Smaller differences do not contradict it.
TAPE_STD_M = 0.05
# σ of the estimate, in errors of a tape measure, above which the configured lever arm is kept.
WORSE_THAN_TOLD = 2.0


def estimates_lever_arm(model: Model) -> bool:
    """Return whether a model estimates the lever arm."""
    return set(ARM) <= set(model.state_names)


def keeps_configured_arm(model: Model, state: GaussianState, parameters: Parameters) -> Mask:
    """Return, per body axis (3,), whether to keep the configured lever arm."""
    if not any(parameters.lever_arm) or not estimates_lever_arm(model):
        return np.zeros(3, dtype=bool)
    std = np.sqrt(np.diag(state.p)[[model.state_names.index(name) for name in ARM]])
    return contradicts_configured_arm(model, state, parameters) | np.asarray(std > WORSE_THAN_TOLD * TAPE_STD_M)


def contradicts_configured_arm(model: Model, state: GaussianState, parameters: Parameters) -> Mask:
    """Return, per body axis (3,), whether the data contradict the configured lever arm."""
    if not any(parameters.lever_arm) or not estimates_lever_arm(model):
        return np.zeros(3, dtype=bool)
    at = [model.state_names.index(name) for name in ARM]
    away, std = np.abs(state.x[at]), np.sqrt(np.diag(state.p)[at])
    return np.asarray(away > np.maximum(Z_REPEATED_TEST * std, TAPE_STD_M))
