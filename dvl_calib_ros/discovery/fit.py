"""Which frames a recording's velocities and attitudes are in: the hypothesis under which DVL and reference agree best.

For every hypothesis (reference in the body, ENU or NED; IMU as its transform says or as marine instruments give it;
DVL forward-left-up or forward-right-down) the reference is turned into the body and compared with the DVL. Where the
mounting is known, by what is left of the difference; where it is not, by what is left after the best rotation (Wahba's
problem, solved by singular values). A DVL that sits ahead, or is stamped late, can look as if it were turned; so before
anything else than what is declared is taken, both are looked at with the lever arm and the delay that suit them best.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..calibration.frames import (
    ENU_FROM_NED,
    FLU_FROM_FRD,
    Array,
    cross,
    nearest_rotation,
    rotation_from_quaternion,
    rpy_from_rotation,
    skew,
)
from ..calibration.register.configuration import MISALIGNED, SCALED
from ..calibration.samples import VelocityFrame
from ..recordings.look import Look, comparable

# Fewer samples, or a slower vehicle (m/s), say nothing about frames.
ENOUGH_SAMPLES, SLOW = 12, 0.1
# Weight of "as it is" in the rotation's fit, as a share of the mean squared speed: it decides the turns that the motion
# does not show (roll of a vehicle that only goes ahead), and moves one that is shown by less than 0.1 degrees.
AS_IT_IS = 1e-3
# The worst tenth of the samples (outliers, lags in turns) does not take part.
KEPT_SHARE = 0.9
# What is declared is doubted if another hypothesis leaves less than this share of the difference ...
CLEARLY = 0.5
# ... and fits in itself: what it leaves is below this share of the speed (17 degrees of misalignment).
FITS = 0.3
# Turn rates below this (rad/s) do not say which way a body's axes point.
TURNS = 0.01
# Rounds in which rotation and lever arm are found in turns.
ROUNDS = 3
# What is likely of a misalignment (rad), a scale and a lever arm (m). It decides what the motion does not: on a circle
# at one speed a lever arm looks like a turned DVL. It counts by 0.005 of the speed in every sample, which moves what is
# shown by a hundredth.
LIKELY: Array = np.array([0.05] * 3 + [0.02] + [1.0] * 3) / 0.005
# By how much the DVL's stamps may be late, s, at a step that is short beside turns and waves.
DELAYS_S = np.linspace(-3.0, 3.0, 13)


@dataclass(frozen=True, eq=False)
class ImuFrame:
    """How an IMU's data may be meant. rotation_body_from_imu (3, 3); world: "enu" or "ned"."""

    rotation_body_from_imu: Array
    world: str
    says: str


@dataclass(frozen=True)
class Hypothesis:
    """One reading of the data. turned: the DVL's data are forward-right-down; reference_turned: the reference's."""

    reference: VelocityFrame
    imu: ImuFrame | None
    turned: bool
    reference_turned: bool = False


@dataclass(frozen=True)
class Fit:
    """How well one reading of the data fits.

    left: root mean square of what is left of the difference of DVL and reference, as a share of the speed, at the
    mounting that is given or, without one, at the best. rotation_dvl_from_body: (3, 3) the best; best_left: what that
    leaves.
    """

    hypothesis: Hypothesis
    left: float
    rotation_dvl_from_body: Array
    best_left: float

    @property
    def angle(self) -> float:
        """Angle of the best rotation, rad."""
        return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(self.rotation_dvl_from_body)) - 1.0))))


@dataclass(frozen=True)
class Together:
    """DVL and reference at the same times, N of them, as their messages have them.

    dvl, reference: (N, 3) m/s. orientation: (N, 4), rates: (N, 3) rad/s, as the IMU has them, or None.
    """

    dvl: Array
    reference: Array
    orientation: Array | None
    rates: Array | None


def together(dvl: Look, reference: Look, imu: Look | None) -> Together | None:
    """Put the looks side by side at the DVL's times; None if they have too little in common."""
    velocity, near = comparable(reference, dvl.stamps_s)
    orientation = rates = None
    if imu is not None:
        columns, imu_near = comparable(imu, dvl.stamps_s)
        if imu.has_orientation:
            near = near & imu_near & np.isfinite(columns[:, :4]).all(axis=1)
            orientation, rates = columns[:, :4], columns[:, 4:7]
    speed = np.linalg.norm(dvl.values, axis=1)
    near = near & (speed > SLOW)
    if np.count_nonzero(near) < ENOUGH_SAMPLES:
        return None
    return Together(
        dvl.values[near],
        velocity[near],
        None if orientation is None else orientation[near],
        None if rates is None else rates[near],
    )


def body_velocity(data: Together, hypothesis: Hypothesis) -> Array | None:
    """The reference (N, 3) m/s in the body, under a hypothesis; None if that needs an attitude that is not there."""
    if hypothesis.reference is VelocityFrame.BODY:
        return data.reference @ FLU_FROM_FRD if hypothesis.reference_turned else data.reference
    if data.orientation is None or hypothesis.imu is None:
        return None
    enu = data.reference @ ENU_FROM_NED.T if hypothesis.reference is VelocityFrame.NED else data.reference
    return np.einsum("nij,ni->nj", rotation_enu_from_body(data.orientation, hypothesis.imu), enu)


def rotation_enu_from_body(orientation: Array, imu: ImuFrame) -> Array:
    """(N, 3, 3) of an IMU's quaternions (N, 4), as they are meant."""
    world_from_imu = rotation_from_quaternion(orientation)
    if imu.world == "ned":
        world_from_imu = ENU_FROM_NED @ world_from_imu
    rotation: Array = world_from_imu @ imu.rotation_body_from_imu.T
    return rotation


def turns_right(reference: Look, imu: Look, frame: ImuFrame) -> bool | None:
    """Whether a velocity's own turn rates are forward-right-down, by those of an IMU; None if that does not show.

    A vehicle that turns left has a positive rate about an axis up, and a negative one about an axis down.
    """
    if reference.rates is None:
        return None
    columns, near = comparable(imu, reference.stamps_s)
    near = near & np.isfinite(columns[:, 4:7]).all(axis=1) & np.isfinite(reference.rates).all(axis=1)
    rates = columns[near, 4:7] @ frame.rotation_body_from_imu.T
    own = reference.rates[near]
    if len(own) < ENOUGH_SAMPLES or _rms(own) < TURNS or _rms(rates) < TURNS:
        return None
    left, right = _rms(own - rates), _rms(own @ FLU_FROM_FRD - rates)
    return None if min(left, right) > CLEARLY * max(left, right) else right < left


def best_rotation(a: Array, b: Array, as_it_is: Array) -> Array:
    """The rotation M (3, 3) that minimises mean |a - M b|² + AS_IT_IS |b|² |M - as_it_is|²; a, b: (N, 3)."""
    square = float((b**2).sum(axis=1).mean())
    return nearest_rotation(a.T @ b / len(a) + AS_IT_IS * square * as_it_is)


def _rms(difference: Array) -> float:
    """Root mean square over the better samples."""
    squares = np.sort((difference**2).sum(axis=1))
    return float(np.sqrt(squares[: max(1, int(KEPT_SHARE * len(squares)))].mean()))


def fit(
    data: Together,
    hypotheses: Sequence[Hypothesis],
    rotation_dvl_from_body: Array | None,
    position: Array | None = None,
) -> list[Fit]:
    """All hypotheses that can be tried, the best first.

    rotation_dvl_from_body: the mounting (3, 3), None if it is not known. position: (3,) m of the DVL in the body, from
    the point whose velocity the reference is.
    """
    fits = []
    for hypothesis in hypotheses:
        body = body_velocity(data, hypothesis)
        if body is None:
            continue
        if position is not None and data.rates is not None and hypothesis.imu is not None:
            rates = data.rates @ hypothesis.imu.rotation_body_from_imu.T
            body = body + np.where(np.isfinite(rates), cross(rates, np.asarray(position)), 0.0)
        dvl = data.dvl @ FLU_FROM_FRD if hypothesis.turned else data.dvl
        speed = _rms(dvl)
        known = rotation_dvl_from_body
        best = best_rotation(dvl, body, np.eye(3) if known is None else known)
        # a second time without the worst
        errors = ((dvl - body @ best.T) ** 2).sum(axis=1)
        kept = _better(errors)
        best = best_rotation(dvl[kept], body[kept], np.eye(3) if known is None else known)
        best_left = _rms(dvl - body @ best.T) / speed
        left = best_left if known is None else _rms(dvl - body @ known.T) / speed
        fits.append(Fit(hypothesis, left, best, best_left))
    # of two that fit alike the one that asks for the smaller turn
    return sorted(fits, key=lambda each: each.left + (0.0 if rotation_dvl_from_body is not None else 0.02 * each.angle))


@dataclass(frozen=True)
class Explained:
    """What is left with the lever arm and the delay that suit a reading of the data best, as a share of the speed, and
    its rotation_dvl_from_body (3, 3)."""

    left: float
    rotation_dvl_from_body: Array


NOT_EXPLAINED = Explained(math.inf, np.eye(3))


def at_delays(dvl: Look, reference: Look, imu: Look | None) -> list[Together]:
    """The looks side by side at each delay of the DVL at which they have enough in common."""
    each = (together(replace(dvl, stamps_s=dvl.stamps_s - late_s), reference, imu) for late_s in DELAYS_S.tolist())
    return [data for data in each if data is not None]


def explained(delayed: Sequence[Together], hypothesis: Hypothesis, rotation_dvl_from_body: Array | None) -> Explained:
    """What is left under a hypothesis with any lever arm, any delay, and a small misalignment and scale.

    delayed: of `at_delays`. rotation_dvl_from_body: the mounting (3, 3), which stands if it is not None; else the best
    is found.
    """
    found = [_explained(data, hypothesis, rotation_dvl_from_body) for data in delayed]
    return min(found, key=lambda each: each.left, default=NOT_EXPLAINED)


def _explained(data: Together, hypothesis: Hypothesis, known: Array | None) -> Explained:
    """As `explained`, at one delay.

    Of a rotation that is found and the same turned about the direction of travel, which a lever arm makes alike, that
    with the smaller angle is taken unless the other leaves clearly less.
    """
    if known is None:
        best = _with_lever_arm(data, hypothesis, None)
        turned = _with_lever_arm(data, hypothesis, best.rotation_dvl_from_body @ FLU_FROM_FRD)
        upright, other = sorted((best, turned), key=lambda each: -float(np.trace(each.rotation_dvl_from_body)))
        return other if other.left < CLEARLY * upright.left else upright
    return _with_lever_arm(data, hypothesis, known)


def _with_lever_arm(data: Together, hypothesis: Hypothesis, known: Array | None) -> Explained:
    body = body_velocity(data, hypothesis)
    if body is None:
        return NOT_EXPLAINED
    rates = np.zeros_like(body)
    if data.rates is not None and hypothesis.imu is not None:
        rates = np.nan_to_num(data.rates @ hypothesis.imu.rotation_body_from_imu.T)
    dvl = data.dvl @ FLU_FROM_FRD if hypothesis.turned else data.dvl
    likely = np.diag((_rms(dvl) / LIKELY) ** 2)
    rotation = best_rotation(dvl, body, np.eye(3)) if known is None else known
    for last in range(ROUNDS if known is None else 1, 0, -1):
        own = dvl @ rotation
        columns = np.concatenate([skew(own), own[:, :, None], skew(rates)], axis=2)
        kept = np.arange(len(own))
        for _ in range(2):  # a second time without the worst
            h, z = columns[kept].reshape(-1, 7), (own - body)[kept].reshape(-1)
            x = np.linalg.solve(h.T @ h + len(kept) * likely, h.T @ z)
            rest = own - body - columns @ x
            kept = np.flatnonzero(_better((rest**2).sum(axis=1)))
        if last > 1:
            rotation = best_rotation(dvl[kept], (body + cross(rates, x[4:]))[kept], np.eye(3))
    if np.linalg.norm(x[:3]) > MISALIGNED or abs(x[3]) > SCALED:
        return NOT_EXPLAINED
    return Explained(_rms(rest) / _rms(dvl), rotation)


def _better(errors: Array) -> Array:
    """(N,) whether a sample is not among the worst."""
    return np.asarray(errors <= np.sort(errors)[int(KEPT_SHARE * (len(errors) - 1))])


def nominal_rpy(rotation_body_from_dvl: Array) -> tuple[float, float, float]:
    """The mounting that somebody may have meant (rad): whole 45 degrees where the data is close, else whole degrees."""
    rpy = np.degrees(rpy_from_rotation(rotation_body_from_dvl))
    near = 45.0 * np.round(rpy / 45.0)
    meant = np.where(np.abs(rpy - near) < 8.0, near, np.round(rpy))
    roll, pitch, yaw = np.radians(meant + 0.0).tolist()
    return roll, pitch, yaw
