"""The calibration models as data (models.md, "The models").

A model is one entry of `MODELS`; nothing outside its definition branches on its name. Every model is linear in its
state, ``z = H x + noise``, with the residual misalignment φ (DVL frame, rad) first and its scale-factor errors after.

Sources: M1-M7 from Yampolsky and Klein, "Information-Aided DVL Calibration" (M1, M2 baselines, M3, M4 IAC-G, M5-M7
IAC-GF). They hold in any right-handed frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from .frames import Array, skew

MISALIGNMENT_STATES = ("phi_x", "phi_y", "phi_z")
N_MEASUREMENT = 3  # rows of the largest measurement; models with fewer are padded in the bank


@dataclass(frozen=True)
class Observations:
    """A block of N synchronised samples, everything a model may use.

    velocity_dvl: (N, 3) m/s measured, DVL frame. reference_body: (N, 3) m/s GNSS velocity of the reference point in
    the body frame, None where the block has none. lever_velocity: (N, 3) m/s, ω×l of the DVL in the body frame, zero
    where unknown, None without a lever arm. rotation_dvl_from_body: T (3, 3). sway_heave: (2,) m/s prior sway and
    heave, body frame.

    What several models derive from these is computed once.
    """

    velocity_dvl: Array
    reference_body: Array | None
    lever_velocity: Array | None
    rotation_dvl_from_body: Array
    sway_heave: Array

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


class Reference(NamedTuple):
    """r = T (g + ω×l) (N, 3) m/s in the DVL frame, and [r×] (N, 3, 3)."""

    r: Array
    skew: Array


_HORIZONTAL = np.array([1.0, 1.0, 0.0])

Linearised = tuple[Array, Array]
"""z (N, m) m/s and H (N, m, n): what one model makes of a block of observations."""


@dataclass(frozen=True)
class Model:
    """One calibration model.

    scale_axes: for every scale state its name and the DVL axes it acts on. linearise: observations -> z (N, m),
    H (N, m, n) with n = 3 + number of scale states. aided: True if it needs a reference velocity. needs_prior: True if
    it uses prior sway and heave. shown_by: what lets it see roll, pitch, yaw and scale, for the operator. assumes,
    wrong_when: for the documentation.
    """

    name: str
    aided: bool
    n_measurement: int
    linearise: Callable[[Observations], Linearised]
    shown_by: Mapping[str, str]
    assumes: str
    wrong_when: str
    scale_axes: tuple[tuple[str, tuple[int, ...]], ...] = ()
    needs_prior: bool = False

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states in order: misalignment (rad), then scale-factor errors (dimensionless)."""
        return MISALIGNMENT_STATES + tuple(name for name, _ in self.scale_axes)

    @property
    def n_state(self) -> int:
        """Number of states n."""
        return 3 + len(self.scale_axes)

    @cached_property
    def error_terms_from_state(self) -> Array:
        """(6, n) matrix that takes the state to φ (3) and δk per axis (3)."""
        matrix = np.zeros((6, self.n_state))
        matrix[:3, :3] = np.eye(3)
        for column, (_, axes) in enumerate(self.scale_axes, start=3):
            matrix[[3 + axis for axis in axes], column] = 1.0
        return matrix


def _gnss_aided(
    scale_axes: tuple[tuple[str, tuple[int, ...]], ...], heave_is_zero: bool, seen: Observations
) -> Linearised:
    """M1-M4: z = r - v, H = [r×, -r on the scaled axes]."""
    r, r_skew = seen.reference_without_heave if heave_is_zero else seen.reference
    h = np.zeros((len(r), 3, 3 + len(scale_axes)))
    h[:, :, :3] = r_skew
    for column, (_, axes) in enumerate(scale_axes, start=3):
        for axis in axes:
            h[:, axis, column] = -r[:, axis]
    return r - seen.velocity_dvl, h


def _m5(seen: Observations) -> Linearised:
    """z = r - v, H = [r×], r = T (‖v‖, s, h)."""
    r = seen.speed_and_prior @ seen.rotation_dvl_from_body.T
    return r - seen.velocity_at_reference, skew(r)


def _m6(seen: Observations) -> Linearised:
    """z = (‖v‖, s, h) - Tᵀv, H = Tᵀ[v×], body frame."""
    z = seen.speed_and_prior - seen.velocity_at_reference @ seen.rotation_dvl_from_body
    return z, seen.body_from_measured


def _m7(seen: Observations) -> Linearised:
    """z = ‖v‖ - (Tᵀv)_x, H = first row of Tᵀ[v×]."""
    z = seen.speed - seen.velocity_at_reference @ seen.rotation_dvl_from_body[:, 0]
    return z[:, None], seen.body_from_measured[:, :1]


_ONE_SCALE = (("delta_k", (0, 1, 2)),)
_SCALE_X = (("delta_k_x", (0,)),)
_SHOWN_WITH_GNSS = {
    "roll": "motion across the bow: turns, a box or a figure eight",
    "pitch": "motion ahead: a straight leg at 1 m/s or more",
    "yaw": "motion ahead: a straight leg at 1 m/s or more",
    "scale": "speed and time: longer legs, faster",
}
_SHOWN_WITHOUT = {
    "roll": "nothing this model knows: it takes a reference velocity (GNSS)",
    "pitch": "motion ahead without heave: a straight, level leg",
    "yaw": "motion ahead without sway: a straight leg, no current across",
    "scale": "nothing this model knows: it takes a reference velocity (GNSS)",
}
_NOISY_REGRESSOR = "slow, or with a noisy receiver: noise in the reference pulls the scale down by about"


def _aided(
    name: str,
    scale_axes: tuple[tuple[str, tuple[int, ...]], ...],
    heave_is_zero: bool,
    assumes: str,
    wrong_when: str,
) -> Model:
    linearise = partial(_gnss_aided, scale_axes, heave_is_zero)
    return Model(name, True, 3, linearise, _SHOWN_WITH_GNSS, assumes, wrong_when, scale_axes)


_TABLE = (
    _aided(
        "M1", _ONE_SCALE, False,
        assumes="GNSS velocity in three axes; one scale error for all axes (published baseline)",
        wrong_when=f"{_NOISY_REGRESSOR} 3 σ²/‖v‖² (3 % at 2 m/s and 0.2 m/s)",
    ),
    _aided(
        "M2", _SCALE_X, False,
        assumes="GNSS velocity in three axes; scale error along x only (published baseline)",
        wrong_when=f"{_NOISY_REGRESSOR} σ²/‖v‖²; with the DVL's x far from the direction of travel",
    ),
    _aided(
        "M3", _ONE_SCALE, True,
        assumes="horizontal GNSS velocity, no heave; one scale error for all axes",
        wrong_when=f"heaving in waves or diving; {_NOISY_REGRESSOR} 2 σ²/‖v‖²",
    ),
    _aided(
        "M4", _SCALE_X, True,
        assumes="horizontal GNSS velocity, no heave; scale error along x only",
        wrong_when=f"heaving in waves or diving; {_NOISY_REGRESSOR} σ²/‖v‖²; with the DVL's x far from the travel",
    ),
    Model(
        "M5", False, 3, _m5, _SHOWN_WITHOUT, needs_prior=True,
        assumes="no GNSS; the vehicle moves ahead at the measured speed with known, constant sway and heave",
        wrong_when="a current or turns make sway; prior sway and heave from the DVL itself already hold the error",
    ),
    Model(
        "M6", False, 3, _m6, _SHOWN_WITHOUT, needs_prior=True,
        assumes="as M5, compared in the body frame with the measured velocity as regressor",
        wrong_when="as M5",
    ),
    Model(
        "M7", False, 1, _m7, _SHOWN_WITHOUT,
        assumes="no GNSS, nothing else known: all the speed is ahead",
        wrong_when="a current or turns make sway; by construction it finds half the angle, and its σ is too small",
    ),
)  # fmt: skip

MODELS: Mapping[str, Model] = {model.name: model for model in _TABLE}
