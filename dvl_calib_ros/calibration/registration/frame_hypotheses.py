"""Frame hypotheses: in which axes velocities and attitudes are, by how well DVL and reference agree.

Under each reading of the data (frame of the reference, axes and world of the IMU, axes of the DVL) velocities of one
time are compared: with the mounting, where it is known, else after the best rotation. A DVL that sits ahead, or is
stamped late, can look as if it were turned; so the readings that compare well are registered, with lever arm and delay.
The posterior of a reading is its prior, which the caller states, times a tempered likelihood of the residual.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..numerics.frames import (
    ENU_FROM_NED,
    ENU_FROM_NWU,
    FLU_FROM_FRD,
    Array,
    cross,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_of,
    rpy_from_rotation,
    squared,
    whole_degrees,
)
from ..numerics.samples import VelocityFrame
from ..streams.imu_frame import ENU_FROM, quaternion_product
from ..streams.interpolation import ImuColumns, TurnRates, angular_velocity_at, attitude_at
from .configuration_check import DRAWN, angle_between, misfit, nearest
from .earth_frame_velocity import Directions
from .gauss_newton import ARM, FEW_ROWS, REFERENCE, SLOW_MPS, MotionFit, white_noise
from .motion_streams import GAP_S, Curves, MotionStreams
from .unregistrable_clocks import covered, velocity_at

# Fewer samples say nothing about frames.
ENOUGH_SAMPLES = 12
# Weight of "as it is" in the rotation's fit, as a share of the mean squared speed: it decides the turns that the motion
# does not show (roll of a vehicle that only goes ahead), and moves one that is shown by less than 0.1 degrees.
AS_IT_IS = 1e-3
# The worst tenth of the samples (outliers, lags in turns) does not take part.
KEPT_SHARE = 0.9
# What is declared is doubted if another reading leaves less than this share of the difference ...
CLEARLY = 0.5
# ... and fits in itself: what it leaves is below this share of the speed (17 degrees of misalignment).
FITS = 0.3
# Data need a turn about the direction of travel if it leaves less than this share.
ROLLED = 0.8
# Independent samples of three axes that a comparison counts for. A residual below this share of the speed is none.
INDEPENDENT, LEAST_LEFT = 4.0, 0.005
# A mean velocity to the side below this share of the speed is none that a vehicle travels by.
SIDEWAYS = 0.5
# Turn rates below this (rad/s) do not say which way a body's axes point.
TURNS = 0.01
# A mounting nearer than this (rad) to one that is drawn is that one.
MEANT_WITHIN = math.radians(8.0)


# Frames of a reference: in the body, and by which matrix it is read.
IN_BODY = (VelocityFrame.BODY.value, "frd")
READ_BY: Mapping[str, Array] = {
    "body": np.eye(3), "frd": FLU_FROM_FRD, "enu": np.eye(3), "ned": ENU_FROM_NED, "nwu": ENU_FROM_NWU,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ImuFrame:
    """How an IMU's data may be meant. rotation_body_from_imu (3, 3); world: as parameter imu_frame."""

    rotation_body_from_imu: Array
    world: str
    says: str

    def read(self, imu: ImuColumns) -> ImuColumns:
        """An IMU's attitudes and rates, as they are meant."""
        quaternions = quaternion_product(
            imu.orientation, np.array(quaternion_from_rotation(self.rotation_body_from_imu.T))
        )
        quaternions = quaternion_product(np.array(quaternion_from_rotation(ENU_FROM[self.world])), quaternions)
        return ImuColumns(imu.times, quaternions, imu.angular_velocity @ self.rotation_body_from_imu.T)


@dataclass(frozen=True)
class Reading:
    """One reading of the data.

    reference: frame of the reference, as parameter gnss_frame. turned: whether the DVL's data are turned about x by
    180°, to the axes of the body.
    """

    reference: str
    imu: ImuFrame | None
    turned: bool

    @property
    def in_body(self) -> bool:
        """Whether the reference is in the body."""
        return self.reference in IN_BODY


@dataclass(frozen=True)
class Agreement:
    """How well one reading of the data fits.

    left: root mean square of what is left of the difference of DVL and reference, as a share of the speed, at the
    mounting that is given or, without one, at the best. rotation_dvl_from_body: (3, 3) the best; best_left: what that
    leaves. is_ahead: whether the vehicle mostly goes ahead or astern under this reading, rather than sideways.
    """

    reading: Reading
    left: float
    rotation_dvl_from_body: Array
    best_left: float
    is_ahead: bool

    @property
    def angle(self) -> float:
        """Angle of the best rotation, rad."""
        return angle_between(self.rotation_dvl_from_body, np.eye(3))


class Registered(NamedTuple):
    """A reading that is registered.

    left: residual, as a share of the speed. rotation_dvl_from_body: (3, 3). arm, arm_std: (3,) m, the lever arm less
    the one that is known, and its σ.
    """

    left: float
    rotation_dvl_from_body: Array
    arm: Array
    arm_std: Array


NOT_REGISTERED = Registered(math.inf, np.eye(3), np.zeros(3), np.full(3, math.inf))


class Readings:
    """What a motion is, read in several ways.

    motion: velocities and attitudes as messages have them. position: (3,) m of the DVL in the body, from the point
    whose velocity the reference is.
    """

    def __init__(self, motion: MotionStreams, position: Array) -> None:
        self._motion, self._position = motion, position
        self._motions: dict[Reading, MotionStreams] = {}
        self._fits: dict[Reading, MotionFit] = {}
        times, dvl = motion.dvl
        use = covered(motion.reference_times, times) & (squared(dvl) > SLOW_MPS**2)
        if motion.has_attitude:
            use &= attitude_at(motion.imu, times, GAP_S)[1]
        self._at, self._dvl = times[use], dvl[use]
        self._reference = velocity_at(motion.reference_times, motion.reference, self._at)

    def __len__(self) -> int:
        """How many velocities of one time there are."""
        return len(self._at)

    def beside_noise(self, left: float) -> float:
        """Of a share of the speed that is left what is not the reference's own noise."""
        square = float(squared(self._dvl).mean())
        return math.sqrt(max(left**2 - 3.0 * white_noise(self._motion.reference) / max(square, 1e-9), 0.0))

    def log_likelihood(self, left: float) -> float:
        """Return the tempered log likelihood of a residual, as a share of the speed, beside the reference's noise.

        What a comparison misses of arms, delays and waves is alike from sample to sample, so few of them count.
        """
        return self.log_likelihood_registered(self.beside_noise(left))

    @staticmethod
    def log_likelihood_registered(left: float) -> float:
        """Return the same of a registration, which is compared with its noise."""
        return -3.0 * INDEPENDENT * math.log(max(left, LEAST_LEFT))

    def agreements(self, readings: Sequence[Reading], rotation_dvl_from_body: Array | None) -> list[Agreement]:
        """All readings that can be tried, the best first, with clocks in time and no other lever arm.

        rotation_dvl_from_body: the mounting (3, 3), None if it is not known.
        """
        if len(self) < ENOUGH_SAMPLES:
            return []
        known = rotation_dvl_from_body
        likely = np.eye(3) if known is None else known
        found = []
        for reading in readings:
            motion = self._read(reading)
            if motion is None:
                continue
            body = velocity_at(motion.reference_times, motion.reference, self._at)
            if motion.in_earth:
                body = np.einsum("nji,nj->ni", attitude_at(motion.imu, self._at, GAP_S)[0], body)
            if self._position.any():
                body = body + np.nan_to_num(cross(angular_velocity_at(motion.turns, self._at, GAP_S), self._position))
            dvl = self._dvl @ FLU_FROM_FRD if reading.turned else self._dvl
            speed = _rms(dvl)
            best = best_rotation(dvl, body, likely)
            # a second time without the worst
            errors = squared(dvl - body @ best.T)
            kept = errors <= np.sort(errors)[int(KEPT_SHARE * (len(errors) - 1))]
            best = best_rotation(dvl[kept], body[kept], likely)
            best_left = _rms(dvl - body @ best.T) / speed
            left = best_left if known is None else _rms(dvl - body @ known.T) / speed
            travel = np.abs(body.mean(axis=0) if known is None else (dvl @ known).mean(axis=0))
            is_ahead = bool(travel[1] < max(travel[0], SIDEWAYS * speed))
            found.append(Agreement(reading, left, best, best_left, is_ahead))
        # of two that fit alike the one that asks for the smaller turn; rounding decides nothing: worlds that are both
        # turned over fit the same
        return sorted(found, key=lambda each: round(each.left + (0.02 * each.angle if known is None else 0.0), 9))

    def registered(self, reading: Reading, rotation_dvl_from_body: Array | None) -> Registered:
        """Register a reading with the lever arm and the DVL's delay that suit it best.

        The reference is in time: late on a circle it is any yaw at all.

        rotation_dvl_from_body: the mounting, which is kept but for a small misalignment; None to find it. Of a rotation
        that is found and the same turned about the direction of travel, which a lever arm makes alike, the upright one
        is taken unless the other leaves clearly less.
        """
        turn = FLU_FROM_FRD if reading.turned else np.eye(3)
        motion = self._read(reading)
        if motion is None:
            return NOT_REGISTERED
        if reading not in self._fits:
            self._fits[reading] = MotionFit(motion, self._position, Curves(motion), FEW_ROWS)
        fit = self._fits[reading]

        def of(rotation: Array | None) -> Registered:
            nominal = None if rotation is None else rotation.T @ turn
            found = nearest(fit, nominal, (REFERENCE,))
            if found is None:
                return NOT_REGISTERED
            left = math.sqrt(float(_better(found.squares).mean())) / max(found.speed, 1e-9)
            given = found.rotation_body_from_dvl if nominal is None else nominal
            rotation_found = turn @ found.rotation_body_from_dvl.T
            return Registered(misfit(found, given, left), rotation_found, found.x[ARM], found.std[ARM])

        if rotation_dvl_from_body is not None:
            return of(rotation_dvl_from_body)
        best = of(None)
        turned = of(best.rotation_dvl_from_body @ FLU_FROM_FRD)
        upright, other = sorted((best, turned), key=lambda each: -float(each.rotation_dvl_from_body[2, 2]))
        return other if other.left < CLEARLY * upright.left else upright

    def without_roll(self, found: Agreement, rotation_dvl_from_body: Array) -> Array:
        """A rotation (3, 3) without what it turns about the direction of travel, unless the data need that."""
        travel = (self._dvl @ FLU_FROM_FRD if found.reading.turned else self._dvl).mean(axis=0)
        least = _least_turn(rotation_dvl_from_body.T @ travel, travel)
        is_needed = ROLLED * self.agreements([found.reading], least)[0].left > found.best_left
        return rotation_dvl_from_body if is_needed else least

    def is_in_body(self, found: Agreement) -> bool:
        """Whether DVL and reference that agree as in the body are not both in the earth's frame."""
        motion = self._read(replace(found.reading, reference=VelocityFrame.ENU.value))
        if motion is None:
            return True
        directions = Directions()
        dvl = self._dvl @ FLU_FROM_FRD if found.reading.turned else self._dvl
        directions.add(dvl @ found.rotation_dvl_from_body, attitude_at(motion.imu, self._at, GAP_S)[0])
        return directions.stay_in_the_body

    def _read(self, reading: Reading) -> MotionStreams | None:
        """The motion as a reading has it but for the DVL; None if that needs an attitude that is not there."""
        key = replace(reading, turned=False)
        if key not in self._motions:
            m = self._motion
            imu = m.imu if reading.imu is None else reading.imu.read(m.imu)
            in_earth = not reading.in_body
            if in_earth and (reading.imu is None or not m.has_attitude):
                return None
            reference = m.reference @ READ_BY[reading.reference].T
            turned = replace(m, reference=reference, in_earth=in_earth, imu=imu, turns=TurnRates.of(imu))
            self._motions[key] = turned
        return self._motions[key]


def turns_right(times: Array, own: Array, imu: ImuColumns, frame: ImuFrame) -> bool | None:
    """Whether a velocity's own turn rates are forward-right-down, by those of an IMU; None if that does not show.

    A vehicle that turns left has a positive rate about an axis up, and a negative one about an axis down.

    times, own: (N,) s, (N, 3) rad/s.
    """
    rates = angular_velocity_at(TurnRates.of(frame.read(imu)), times, GAP_S)
    use = np.isfinite(rates).all(axis=1) & np.isfinite(own).all(axis=1)
    rates, own = rates[use], own[use]
    if len(own) < ENOUGH_SAMPLES or _rms(own) < TURNS or _rms(rates) < TURNS:
        return None
    left, right = _rms(own - rates), _rms(own @ FLU_FROM_FRD - rates)
    return None if min(left, right) > CLEARLY * max(left, right) else right < left


def best_rotation(a: Array, b: Array, as_it_is: Array) -> Array:
    """The rotation M (3, 3) that minimises mean |a - M b|² + AS_IT_IS |b|² |M - as_it_is|²; a, b: (N, 3)."""
    square = float(squared(b).mean())
    return nearest_rotation(a.T @ b / len(a) + AS_IT_IS * square * as_it_is)


def _least_turn(a: Array, b: Array) -> Array:
    """The rotation (3, 3) by the smallest angle that turns one direction (3,) into another."""
    axis = cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9 * max(float(a @ a), 1e-300):
        return np.eye(3) if float(a @ b) >= 0.0 else np.diag([-1.0, -1.0, 1.0])
    return rotation_of(axis / sine * math.atan2(sine, float(a @ b)))


def nominal_rpy(rotation_body_from_dvl: Array) -> tuple[float, float, float]:
    """The mounting that somebody may have meant (rad): as mountings are drawn where it is close, else whole degrees."""
    rpy = rpy_from_rotation(rotation_body_from_dvl)
    near = DRAWN * np.round(rpy / DRAWN)
    meant = np.where(np.abs(rpy - near) < MEANT_WITHIN, near, whole_degrees(rotation_body_from_dvl))
    roll, pitch, yaw = (meant + 0.0).tolist()
    return roll, pitch, yaw


def _rms(difference: Array) -> float:
    return math.sqrt(float(_better(squared(difference)).mean()))


def _better(squares: Array) -> Array:
    """Those of the better samples."""
    return np.sort(squares)[: max(1, int(KEPT_SHARE * len(squares)))]
