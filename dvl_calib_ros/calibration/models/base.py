"""A calibration model and its observations: linear in its state, ``z = H x + noise``.

The residual misalignment φ (DVL frame, rad) comes first, its scale-factor errors after, and last what the model must
know to see them (nuisance states, such as a current).
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
    """What a sample must come with, beside the DVL's velocity, for a model to use it."""

    __hash__ = object.__hash__  # Enum's own is slow, and asked for with every live sample
    NOTHING = "nothing"
    REFERENCE = "reference velocity"
    ATTITUDE = "attitude and angular velocity"


class Nuisance(NamedTuple):
    """A state that is estimated only because it would else be taken for misalignment or scale.

    std: prior standard deviation in `unit`, a number or the name of the parameter that holds it. of_the_day: another on
    another day. handed_on: gone on with from a result file all the same, as a node that is started again is on the same
    day more often than not, and has found it by much data.
    """

    name: str
    unit: str
    std: float | str
    of_the_day: bool = False
    handed_on: bool = True


@dataclass(frozen=True)
class Model:
    """One calibration model.

    linearise: observations -> z (N, m), H (N, m, n). shown_by: what lets it see roll, pitch, yaw and scale, for the
    operator. assumes, wrong_when: for the documentation. scale_axes: for every scale state its name and the DVL axes
    it acts on. needs_prior: True if it uses prior sway and heave.

    What a model may change of how it is filtered: noise: observations -> its own R (N or 1, 3, 3) (m/s)², of which a
    model with fewer rows uses the first ones; None: `Observations.noise`. vertical_from_reference: it takes the
    reference's vertical velocity for a measurement, so does without where there is none (M3 and M4 assume their own).
    motion_is_noise: its noise is the
    vehicle's motion, so samples count by `Observations.motion_weight`. estimator: "module:class" of the `Estimator`
    that finds its states, '' for the linear filter.
    sideslip_std: σ (rad) about the body's yaw axis that no data of this model can take away, and that is in its P; 0
    for none. uses_height: it wants `Observations.height`. instead_of: the model that `auto` leaves for this one once
    headings show the current (heading_diversity.py). from_positions: it goes by positions, not by velocities made of
    them; `auto` takes it where these are too noisy.
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
    instead_of: str | None = None
    sideslip_std: float = 0.0
    uses_height: bool = False
    from_positions: bool = False

    @property
    def aided(self) -> bool:
        """Whether it needs a reference: velocities, or positions."""
        return self.needs is Needs.REFERENCE or self.from_positions

    @property
    def n_errors(self) -> int:
        """Number of states that are errors of the DVL: misalignment and scale."""
        return 3 + len(self.scale_axes)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states in order: misalignment (rad), scale-factor errors (dimensionless), nuisance states."""
        scales, nuisance = (name for name, _ in self.scale_axes), (each.name for each in self.nuisance)
        return (*MISALIGNMENT_STATES, *scales, *nuisance)

    @property
    def n_state(self) -> int:
        """Number of states n."""
        return self.n_errors + len(self.nuisance)

    @cached_property
    def of_day(self) -> NDArray[np.intp]:
        """Which states (u,) are of the day (`Nuisance.of_the_day`)."""
        return self._nuisance_that(lambda each: each.of_the_day)

    @cached_property
    def not_handed_on(self) -> NDArray[np.intp]:
        """Which states (u,) are not gone on with from a result file (`Nuisance.handed_on`)."""
        return self._nuisance_that(lambda each: not each.handed_on)

    def _nuisance_that(self, is_so: Callable[[Nuisance], bool]) -> NDArray[np.intp]:
        return np.array([self.n_errors + i for i, each in enumerate(self.nuisance) if is_so(each)], dtype=np.intp)

    @cached_property
    def error_terms_from_state(self) -> Array:
        """(6, n) matrix that takes the state to φ (3) and δk per axis (3)."""
        matrix = np.zeros((6, self.n_state))
        matrix[:3, :3] = np.eye(3)
        for column, (_, axes) in enumerate(self.scale_axes, start=3):
            matrix[[3 + axis for axis in axes], column] = 1.0
        return matrix


# What lets models see roll, pitch, yaw and scale, for the operator: with GNSS, and without.
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
    """What the models beyond the paper take for granted of a vehicle's motion; each is a parameter, see there.

    motion_std, heave_offset_std, current_std: m/s. motion_correlation_time: s.
    """

    motion_std: float = 0.03
    motion_correlation_time: float = 12.0
    heave_offset_std: float = 0.01
    current_std: float = 0.1


ASSUMPTIONS = Assumptions()


class Unmeasured(NamedTuple):
    """Axes that a reference velocity does not measure.

    axes: (N, 3) of the reference's own frame. rotation_reference_from_body: (N, 3, 3) into that frame.
    """

    axes: Mask
    rotation_reference_from_body: Array


class Reference(NamedTuple):
    """r = T (g + ω×l) (N, 3) m/s in the DVL frame, and [r×] (N, 3, 3)."""

    r: Array
    skew: Array


@dataclass(frozen=True)
class Observations:
    """A block of N synchronised samples, everything a model may use.

    velocity_dvl: (N, 3) m/s measured, DVL frame. reference_body: (N, 3) m/s GNSS velocity of the reference point in
    the body frame, None where the block has none. lever_velocity: (N, 3) m/s, ω×l of the DVL in the body frame, zero
    where unknown, None without a lever arm. rotation_dvl_from_body: T (3, 3). sway_heave: (2,) m/s prior sway and
    heave, body frame. noise: R (N or 1, 3, 3) (m/s)² of the measurement, DVL frame. rotation_enu_from_body:
    (N, 3, 3), and angular_velocity: (N, 3) rad/s in the body frame, None where the block has no attitude. interval:
    (N,) s since the DVL sample before. unmeasured: axes of the reference that hold what the DVL measures, by the
    nominal mounting, for want of a measurement; None if it measures all. earth_in_body: (N, 3, 2) east and north as
    columns in the body frame where the reference is in an earth frame, along which it may be wrong constantly; zeros
    where it is in the body frame; None if all are.

    What several models derive from these is computed once.
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

    @cached_property
    def reference(self) -> Reference:
        """The reference velocity as it is."""
        assert self.reference_body is not None  # the bank gives aided models paired blocks only
        return self._reference(self.reference_body)

    @cached_property
    def reference_without_heave(self) -> Reference:
        """The reference velocity with its heave set to zero.

        In the body frame, before T: it is the vehicle, not the instrument, that does not heave. For a mounting turned
        about z only this is the paper's r_z := 0; for a tilted one r_z := 0 would undo the known tilt.
        """
        assert self.reference_body is not None
        return self._reference(self.reference_body * _HORIZONTAL)

    def _reference(self, velocity_body: Array) -> Reference:
        if self.lever_velocity is not None:
            velocity_body = velocity_body + self.lever_velocity
        r = velocity_body @ self.rotation_dvl_from_body.T
        return Reference(r, skew(r))

    @cached_property
    def velocity_at_reference(self) -> Array:
        """Measured velocity moved to the reference point (N, 3) m/s, DVL frame."""
        if self.lever_velocity is None:
            return self.velocity_dvl
        return self.velocity_dvl - self.lever_velocity @ self.rotation_dvl_from_body.T

    @cached_property
    def velocity_in_body(self) -> Array:
        """Tᵀv: measured velocity at the reference point, turned by the nominal mounting (N, 3) m/s, body frame."""
        return self.velocity_at_reference @ self.rotation_dvl_from_body

    @cached_property
    def rising(self) -> Array:
        """Measured vertical velocity (N,) m/s, positive up, of a block with attitude."""
        assert self.rotation_enu_from_body is not None
        up: Array = (self.rotation_enu_from_body[:, 2] * self.velocity_in_body).sum(axis=1)
        return up

    @cached_property
    def speed(self) -> Array:
        """Measured speed at the reference point (N,) m/s."""
        v = self.velocity_at_reference
        return np.sqrt((v * v).sum(axis=1))

    @cached_property
    def speed_and_prior(self) -> Array:
        """(‖v‖, s, h): measured speed ahead, prior sway and heave (N, 3) m/s, body frame."""
        expected = np.empty((len(self.speed), 3))
        expected[:, 0] = self.speed
        expected[:, 1:] = self.sway_heave
        return expected

    @cached_property
    def body_from_measured(self) -> Array:
        """Tᵀ[v×] (N, 3, 3): how the measured velocity turns in the body frame."""
        return np.matmul(self.rotation_dvl_from_body.T, skew(self.velocity_at_reference))

    @cached_property
    def noise_in_body(self) -> Array:
        """Tᵀ R T (N or 1, 3, 3) (m/s)²."""
        noise: Array = self.rotation_dvl_from_body.T @ self.noise @ self.rotation_dvl_from_body
        return noise

    @cached_property
    def measured_in_body(self) -> Array:
        """(N or 1, 3) 1 for the axes of the body along which the reference measures, 0 for the others."""
        if self.unmeasured is None:
            return np.ones((1, 3))
        axes, turned = self.unmeasured
        # an axis of the earth counts for the axis of the body that is nearest to it
        along = np.einsum("nai,na->ni", turned**2, axes.astype(float))
        measured: Array = (along < 0.5).astype(float)
        return measured

    @cached_property
    def motion_weight(self) -> Array:
        """(N,) share of its own information that a sample adds where the vehicle's motion is the noise.

        Sway and heave wander: with a correlation time τ, samples Δt apart hold Δt / 2τ of independent ones (the
        integrated autocorrelation of exp(-|t|/τ)), so σ does not shrink with the DVL's rate.
        """
        if self.interval is None:
            return np.ones(len(self.velocity_dvl))
        tau = self.assumptions.motion_correlation_time
        # the first sample has no interval; nor may a weight be zero
        return np.clip(self.interval, 1e-3, 2.0 * tau) / (2.0 * tau) if tau > 0.0 else np.ones(len(self.interval))
