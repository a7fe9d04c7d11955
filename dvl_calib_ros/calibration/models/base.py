"""Calibration models and their observations: linear in the state, ``z = H x + noise``.

State order: residual misalignment φ (DVL frame, rad), scale-factor errors, nuisance states (such as a current).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..numerics.frames import Array, skew
from ..numerics.samples import Mask

MISALIGNMENT_STATES = ("phi_x", "phi_y", "phi_z")
N_MEASUREMENT = 3  # rows of the largest measurement; models with fewer are padded in the bank


Linearised = tuple[Array, Array]
"""z (N, m) m/s and H (N, m, n): what one model makes of a block of observations."""


class Needs(Enum):
    """Input that a model requires of each sample in addition to the DVL velocity."""

    __hash__ = object.__hash__  # Enum.__hash__ is slow and runs for every live sample
    NOTHING = "nothing"
    REFERENCE = "reference velocity"
    ATTITUDE = "attitude and angular velocity"
    ATTITUDE_IF_KNOWN = "attitude and angular velocity, if known"


class Nuisance(NamedTuple):
    """State that is estimated only to keep its effect out of misalignment and scale.

    std: prior standard deviation in `unit`, a number or the name of the parameter that holds it.
    per_recording: the value differs per recording.
    handed_on: a result file passes it on as a prior, even if it differs per recording, because a restarted node usually
      continues the same recording.
    """

    name: str
    unit: str
    std: float | str
    per_recording: bool = False
    handed_on: bool = True


@dataclass(frozen=True)
class Model:
    """Calibration model: required input, measurement equation, states and filter options.

    linearise: observations -> z (N, m), H (N, m, n).
    shown_by: for the operator, the motion that makes roll, pitch, yaw and scale observable.
    assumes, wrong_when: for the documentation.
    scale_axes: name of each scale state and the DVL axes that it acts on.
    needs_prior: uses prior sway and heave.

    Filter options.
    noise: observations -> R (N or 1, 3, 3) (m/s)², of which a model with fewer rows uses the first ones; None:
      `Observations.noise`.
    motion_is_noise: vehicle motion is the noise, so samples have the weight `Observations.motion_weight`.
    vertical_from_reference: uses the vertical velocity of the reference as a measurement.
    estimator: "module:class" of its `Estimator`, '' for the linear filter.
    sideslip_std: σ (rad) about the body's yaw axis that P includes because no data of this model reduce it; 0: none.
    uses_height: uses `Observations.height`.
    from_positions: uses positions instead of velocities derived from them; `auto` selects it where the derived
      velocities are too noisy.
    """

    name: str
    needs: Needs
    n_measurement: int
    linearise: Callable[[Observations], Linearised]
    shown_by: Mapping[str, str]
    assumes: str
    wrong_when: str
    scale_axes: tuple[tuple[str, tuple[int, ...]], ...] = ()
    needs_prior: bool = False
    nuisance: tuple[Nuisance, ...] = ()
    noise: Callable[[Observations], Array] | None = None
    motion_is_noise: bool = False
    vertical_from_reference: bool = False
    estimator: str = ""
    sideslip_std: float = 0.0
    uses_height: bool = False
    from_positions: bool = False

    @property
    def aided(self) -> bool:
        """True if the model needs a reference (velocities or positions)."""
        return self.needs is Needs.REFERENCE or self.from_positions

    @property
    def n_errors(self) -> int:
        """Number of DVL error states: misalignment and scale."""
        return 3 + len(self.scale_axes)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states in order: misalignment (rad), scale-factor errors (dimensionless), nuisance states."""
        scales, nuisance = (name for name, _ in self.scale_axes), (spec.name for spec in self.nuisance)
        return (*MISALIGNMENT_STATES, *scales, *nuisance)

    @property
    def n_state(self) -> int:
        """Number of states n."""
        return self.n_errors + len(self.nuisance)

    @cached_property
    def of_day(self) -> NDArray[np.intp]:
        """Indices (u,) of the states that differ per recording (`Nuisance.per_recording`)."""
        return self._nuisance_that(lambda spec: spec.per_recording)

    @cached_property
    def not_handed_on(self) -> NDArray[np.intp]:
        """Indices (u,) of the states that a result file does not pass on (`Nuisance.handed_on`)."""
        return self._nuisance_that(lambda spec: not spec.handed_on)

    def _nuisance_that(self, is_so: Callable[[Nuisance], bool]) -> NDArray[np.intp]:
        return np.array([self.n_errors + i for i, spec in enumerate(self.nuisance) if is_so(spec)], dtype=np.intp)

    @cached_property
    def error_terms_from_state(self) -> Array:
        """Matrix (6, n) from the state to φ (3) and δk per axis (3)."""
        matrix = np.zeros((6, self.n_state))
        matrix[:3, :3] = np.eye(3)
        for column, (_, axes) in enumerate(self.scale_axes, start=3):
            matrix[[3 + axis for axis in axes], column] = 1.0
        return matrix


# For the operator: the motion that makes roll, pitch, yaw and scale observable, with and without GNSS.
SHOWN_WITH_GNSS = {
    "roll": "motion across the bow: turns, a box or a figure eight",
    "pitch": "motion ahead: a straight leg at 1 m/s or more",
    "yaw": "motion ahead: a straight leg at 1 m/s or more",
    "scale": "speed and time: longer legs, faster",
    "scale across": "motion across the bow: turns, a box or a figure eight",
}
SHOWN_WITHOUT = {
    "roll": "a reference velocity (GNSS): without one this cannot be seen",
    "pitch": "motion ahead without heave: a straight, level leg",
    "yaw": "motion ahead without sway: a straight leg, no current across",
    "scale": "a reference velocity (GNSS): without one this cannot be seen",
}


_HORIZONTAL = np.array([1.0, 1.0, 0.0])
_UNIT_NOISE: Array = np.eye(3)[None]


class Assumptions(NamedTuple):
    """Assumed vehicle motion of `unaided`; each field is a parameter.

    motion_std, heave_offset_std, current_std: m/s. motion_correlation_time: s.
    """

    motion_std: float = 0.03
    motion_correlation_time: float = 12.0
    heave_offset_std: float = 0.01
    current_std: float = 0.1


ASSUMPTIONS = Assumptions()


class Unmeasured(NamedTuple):
    """Axes that a reference velocity does not measure.

    axes: (N, 3) in the frame of the reference. rotation_reference_from_body: (N, 3, 3).
    """

    axes: Mask
    rotation_reference_from_body: Array


class Reference(NamedTuple):
    """Reference velocity r = T (g + ω×l) (N, 3) m/s in the DVL frame, and [r×] (N, 3, 3)."""

    r: Array
    skew: Array


@dataclass(frozen=True)
class Observations:
    """Block of N synchronised samples with everything a model may use; derived quantities are computed once.

    velocity_dvl: (N, 3) m/s measured, DVL frame.
    reference_body: (N, 3) m/s reference velocity of the reference point, body frame; None without a reference.
    lever_velocity: (N, 3) m/s, ω×l of the DVL, body frame, zero where unknown; None without a lever arm.
    rotation_dvl_from_body: T (3, 3).
    sway_heave: (2,) m/s prior sway and heave, body frame.
    noise: R (N or 1, 3, 3) (m/s)² of the measurement, DVL frame.
    rotation_enu_from_body: (N, 3, 3), and angular_velocity: (N, 3) rad/s, body frame; None without attitude, identity
      and zero where not oriented (N,).
    interval: (N,) s since the previous DVL sample.
    unmeasured: axes of the reference that hold the DVL's own velocity (nominal mounting) because they are not measured;
      None if all are measured.
    earth_in_body: (N, 3, 2) east and north as columns in the body frame, the axes of a constant error of an earth-frame
      reference; zeros for samples with a body-frame reference, None if all have one.
    height: (N,) m since the last dropout, None unless the model uses it.
    """

    velocity_dvl: Array
    reference_body: Array | None
    lever_velocity: Array | None
    rotation_dvl_from_body: Array
    sway_heave: Array
    noise: Array = field(default_factory=lambda: _UNIT_NOISE)
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None
    interval: Array | None = None
    assumptions: Assumptions = ASSUMPTIONS
    unmeasured: Unmeasured | None = None
    earth_in_body: Array | None = None
    height: Array | None = None
    oriented: Mask | None = None

    @cached_property
    def reference(self) -> Reference:
        """Reference velocity in the DVL frame."""
        assert self.reference_body is not None  # the filter bank passes only paired blocks to aided models
        return self._reference(self.reference_body)

    @cached_property
    def reference_without_heave(self) -> Reference:
        """Reference velocity with zero heave in the body frame.

        For a mounting rotated about z only this is the paper's r_z := 0. For a tilted one r_z := 0 in the DVL frame
        would undo the known tilt.
        """
        assert self.reference_body is not None
        return self._reference(self.reference_body * _HORIZONTAL)

    def _reference(self, velocity_body: Array) -> Reference:
        """Return the reference velocity (N, 3) m/s at the DVL in its frame, and its cross-product matrices."""
        if self.lever_velocity is not None:
            velocity_body = velocity_body + self.lever_velocity
        r = velocity_body @ self.rotation_dvl_from_body.T
        return Reference(r, skew(r))

    @cached_property
    def velocity_at_reference(self) -> Array:
        """Measured velocity (N, 3) m/s at the reference point, DVL frame."""
        if self.lever_velocity is None:
            return self.velocity_dvl
        return self.velocity_dvl - self.lever_velocity @ self.rotation_dvl_from_body.T

    @cached_property
    def velocity_in_body(self) -> Array:
        """Measured velocity Tᵀv (N, 3) m/s at the reference point, body frame by the nominal mounting."""
        return self.velocity_at_reference @ self.rotation_dvl_from_body

    @cached_property
    def rising(self) -> Array:
        """Measured vertical velocity (N,) m/s, positive up; needs attitude."""
        assert self.rotation_enu_from_body is not None
        up: Array = (self.rotation_enu_from_body[:, 2] * self.velocity_in_body).sum(axis=1)
        return up

    @cached_property
    def speed(self) -> Array:
        """Measured speed (N,) m/s at the reference point."""
        v = self.velocity_at_reference
        return np.sqrt((v * v).sum(axis=1))

    @cached_property
    def speed_and_prior(self) -> Array:
        """Expected velocity (‖v‖, s, h) (N, 3) m/s, body frame: measured speed ahead, prior sway and heave."""
        expected = np.empty((len(self.speed), 3))
        expected[:, 0] = self.speed
        expected[:, 1:] = self.sway_heave
        return expected

    @cached_property
    def body_from_measured(self) -> Array:
        """Tᵀ[v×] (N, 3, 3): derivative of the body-frame velocity with respect to φ."""
        return np.matmul(self.rotation_dvl_from_body.T, skew(self.velocity_at_reference))

    @cached_property
    def noise_in_body(self) -> Array:
        """Measurement noise Tᵀ R T (N or 1, 3, 3) (m/s)², body frame."""
        noise: Array = self.rotation_dvl_from_body.T @ self.noise @ self.rotation_dvl_from_body
        return noise

    @cached_property
    def measured_in_body(self) -> Array:
        """Indicator (N or 1, 3): 1 for body axes along which the reference measures, else 0."""
        if self.unmeasured is None:
            return np.ones((1, 3))
        axes, turned = self.unmeasured
        # an earth axis is assigned to the nearest body axis
        along = np.einsum("nai,na->ni", turned**2, axes.astype(float))
        measured: Array = (along < 0.5).astype(float)
        return measured

    @cached_property
    def motion_weight(self) -> Array:
        """Information weight (N,) of samples whose noise is the motion of the vehicle.

        Sway and heave are correlated over τ: samples Δt apart hold Δt / 2τ independent ones (integrated autocorrelation
        of exp(-|t|/τ)), so σ does not shrink with the DVL's rate.
        """
        if self.interval is None:
            return np.ones(len(self.velocity_dvl))
        tau = self.assumptions.motion_correlation_time
        # the first sample has no interval, and weights must be positive
        return np.clip(self.interval, 1e-3, 2.0 * tau) / (2.0 * tau) if tau > 0.0 else np.ones(len(self.interval))
