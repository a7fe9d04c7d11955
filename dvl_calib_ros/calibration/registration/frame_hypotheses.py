"""Frame hypotheses: axes of velocities and attitudes, judged by the agreement of DVL and reference.

A reading fixes the frame of the reference, the axes and world of the IMU, and the axes of the DVL. Simultaneous
velocities are compared with the known mounting, or after the best rotation. A lever arm or a delay can look like a
rotation, so the readings that agree well are registered. The posterior of a reading is its prior, set by the caller,
times a tempered likelihood of the residual.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..models.parameters import FROM_MESSAGE
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
from ..numerics.robust import FEWEST_VALUES
from ..numerics.samples import VelocityFrame
from ..streams.imu_frame import enu_from, quaternion_product
from ..streams.interpolation import GAP_S, ImuColumns, TurnRates, angular_velocity_at, attitude_at, linear_at
from .configuration_check import BETTER_BY, DRAWN, Directions, angle_between, misfit, nearest, wrong_axes
from .gauss_newton import ARM, MIN_SPEED_MPS, QUICK_ROWS, REFERENCE, MotionFit, white_noise
from .motion_streams import MotionStreams
from .unregistrable_clocks import covered

# Weight of the prior rotation, as a share of the mean squared speed: it decides unobservable rotations (roll of a
# vehicle that only moves ahead) and changes observable ones by less than 0.1 degrees.
PRIOR_WEIGHT = 1e-3
# Share of samples kept; the rest are outliers or lags in turns.
KEPT_SHARE = 0.9
# Largest residual of a reading that is preferred to the declared one, as a share of the speed (17 degrees of
# misalignment); its largest ratio is `BETTER_BY`.
MAX_RESIDUAL = 0.3
# Largest residual ratio that justifies a rotation about the direction of travel.
ROLL_RATIO = 0.8
# Equivalent number of independent samples of a comparison, and smallest residual, as a share of the speed.
N_INDEPENDENT, MIN_RESIDUAL = 4.0, 0.005
# Smallest mean sideways velocity of a vehicle that travels sideways, as a share of the speed.
MIN_SIDEWAYS = 0.5
# Smallest RMS turn rate that determines the axes, rad/s.
MIN_TURN_RADPS = 0.01
# Distance of roll, pitch, yaw (rad) from a drawn mounting (multiples of `DRAWN`) below which that mounting is meant.
# The yaw is shown best, and 5 degrees off a mounting is rejected.
NOMINAL_TOL_RAD = np.radians([8.0, 8.0, 4.0])


# Body frames of a reference, and the matrix from each frame to body or ENU axes.
IN_BODY = (VelocityFrame.BODY.value, "flu", "frd")
READ_BY: Mapping[str, Array] = {
    "body": np.eye(3), "flu": FLU_FROM_FRD, "frd": FLU_FROM_FRD,
    "enu": np.eye(3), "ned": ENU_FROM_NED, "nwu": ENU_FROM_NWU,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ImuFrame:
    """Hypothesis about the IMU's axes and world.

    rotation_body_from_imu (3, 3); world: as parameter imu_frame;
    says: description.
    heading_offset: rad, as parameter.
    """

    rotation_body_from_imu: Array
    world: str
    says: str
    heading_offset: float = 0.0

    def read(self, imu: ImuColumns) -> ImuColumns:
        """Return attitudes and rates converted to body axes and ENU."""
        quaternions = quaternion_product(
            imu.orientation, np.array(quaternion_from_rotation(self.rotation_body_from_imu.T))
        )
        enu_from_world = np.array(quaternion_from_rotation(enu_from(self.world, self.heading_offset)))
        quaternions = quaternion_product(enu_from_world, quaternions)
        return ImuColumns(imu.times, quaternions, imu.angular_velocity @ self.rotation_body_from_imu.T)


@dataclass(frozen=True)
class Reading:
    """One hypothesis about the frames of all data.

    reference: frame of the reference, as parameter gnss_frame. turned: the DVL data are rotated about x by 180° to body
    axes.
    """

    reference: str
    imu: ImuFrame | None
    turned: bool

    @property
    def in_body(self) -> bool:
        """True if the reference is in a body frame."""
        return self.reference in IN_BODY


@dataclass(frozen=True)
class Agreement:
    """Agreement of DVL and reference under one reading.

    residual: RMS as a share of the speed, with the given mounting or else the best one.
    rotation_dvl_from_body: (3, 3) best rotation.
    best_residual: its residual.
    is_ahead: the vehicle mostly moves ahead or astern, not sideways.
    """

    reading: Reading
    residual: float
    rotation_dvl_from_body: Array
    best_residual: float
    is_ahead: bool

    @property
    def angle(self) -> float:
        """Angle of the best rotation, rad."""
        return angle_between(self.rotation_dvl_from_body, np.eye(3))


class Registered(NamedTuple):
    """Registration of a reading.

    residual: as a share of the speed.
    rotation_dvl_from_body: (3, 3).
    arm, arm_std: (3,) m, lever arm beyond the configured one, and its σ.
    """

    residual: float
    rotation_dvl_from_body: Array
    arm: Array
    arm_std: Array


NOT_REGISTERED = Registered(math.inf, np.eye(3), np.zeros(3), np.full(3, math.inf))


class _ImuAsRead(NamedTuple):
    """IMU under a hypothesis of its axes and world.

    rotation: (N, 3, 3) rotation_enu_from_body at the N compared DVL samples.
    by_arm: (N, 3) m/s, velocity of the DVL relative to the reference point; (3,) zeros without a lever arm.
    """

    columns: ImuColumns
    turns: TurnRates
    rotation: Array
    by_arm: Array


class _MotionAsRead(NamedTuple):
    """Motion under a reading, except the DVL. body: (N, 3) m/s, the reference at the DVL's place and samples."""

    motion: MotionStreams
    imu: _ImuAsRead
    body: Array


class Readings:
    """Comparison of one motion under several readings.

    motion: velocities and attitudes as in the messages. position: (3,) m DVL position from the reference point, body
    frame.
    """

    def __init__(self, motion: MotionStreams, position: Array) -> None:
        """Select the moving DVL samples that have reference and attitude, with the reference at their times."""
        self._motion, self._position = motion, position
        self._imus: dict[ImuFrame | None, _ImuAsRead] = {}
        self._motions: dict[Reading, _MotionAsRead] = {}
        self._fits: dict[Reading, MotionFit] = {}
        times, dvl = motion.dvl
        use = covered(motion.reference_times, times) & (squared(dvl) > MIN_SPEED_MPS**2)
        if motion.has_attitude:
            use &= attitude_at(motion.imu, times, GAP_S)[1]
        self._at, self._dvl = times[use], dvl[use]
        self._reference = linear_at(motion.reference_times, motion.reference, self._at)

    def __len__(self) -> int:
        """Return the number of simultaneous velocities."""
        return len(self._at)

    def without_noise(self, residual: float) -> float:
        """Return a residual share without the white noise of the reference."""
        square = float(squared(self._dvl).mean())
        return math.sqrt(max(residual**2 - 3.0 * white_noise(self._motion.reference) / max(square, 1e-9), 0.0))

    def log_likelihood(self, residual: float) -> float:
        """Return the tempered log likelihood of a residual share, corrected for the reference noise.

        Errors by lever arms, delays and waves are correlated, so few samples count (`N_INDEPENDENT`).
        """
        return self.log_likelihood_registered(self.without_noise(residual))

    @staticmethod
    def log_likelihood_registered(residual: float) -> float:
        """Return the tempered log likelihood of a registration residual, noise included."""
        return -3.0 * N_INDEPENDENT * math.log(max(residual, MIN_RESIDUAL))

    def agreements(self, readings: Sequence[Reading], rotation_dvl_from_body: Array | None) -> list[Agreement]:
        """Compare all possible readings with synchronised clocks. Return the best first.

        rotation_dvl_from_body: (3, 3) mounting, None if unknown.
        """
        if len(self) < FEWEST_VALUES:
            return []
        found = [self._agreement(reading, rotation_dvl_from_body) for reading in readings]
        possible = [agreement for agreement in found if agreement is not None]
        # a small penalty prefers the smaller rotation; rounding makes ties stable (two inverted worlds fit equally)
        penalty = 0.02 if rotation_dvl_from_body is None else 0.0
        return sorted(possible, key=lambda agreement: round(agreement.residual + penalty * agreement.angle, 9))

    def _agreement(self, reading: Reading, mounting: Array | None) -> Agreement | None:
        """Compare velocities under a reading; None without its attitude. mounting: rotation_dvl_from_body, if known."""
        read = self._read(reading)
        if read is None:
            return None
        body, prior = read.body, np.eye(3) if mounting is None else mounting
        dvl = self._dvl @ FLU_FROM_FRD if reading.turned else self._dvl
        speed = _rms(dvl)
        best = best_rotation(dvl, body, prior)
        # second pass without outliers
        errors = squared(dvl - body @ best.T)
        kept = errors <= np.sort(errors)[int(KEPT_SHARE * (len(errors) - 1))]
        best = best_rotation(dvl[kept], body[kept], prior)
        best_residual = _rms(dvl - body @ best.T) / speed
        residual = best_residual if mounting is None else _rms(dvl - body @ mounting.T) / speed
        travel = np.abs(body.mean(axis=0) if mounting is None else (dvl @ mounting).mean(axis=0))
        is_ahead = bool(travel[1] < max(travel[0], MIN_SIDEWAYS * speed))
        return Agreement(reading, residual, best, best_residual, is_ahead)

    def registered(self, reading: Reading, rotation_dvl_from_body: Array | None) -> Registered:
        """Register a reading with free lever arm and DVL delay.

        The reference is held synchronised: on a circle its delay looks like yaw.

        rotation_dvl_from_body: prior mounting, None to estimate it. A lever arm makes a rotation and its inverted twin
        (rotated about the direction of travel) look alike: the upright one is returned unless the other fits clearly
        better.
        """
        if rotation_dvl_from_body is not None:
            return self._registered_with(reading, rotation_dvl_from_body)
        best = self._registered_with(reading, None)
        rolled = self._registered_with(reading, best.rotation_dvl_from_body @ FLU_FROM_FRD)
        upright, other = sorted((best, rolled), key=lambda fit: -float(fit.rotation_dvl_from_body[2, 2]))
        return other if other.residual < BETTER_BY * upright.residual else upright

    def _registered_with(self, reading: Reading, rotation_dvl_from_body: Array | None) -> Registered:
        """Register a reading from one mounting (3, 3); None to estimate it."""
        flu_from_dvl = FLU_FROM_FRD if reading.turned else np.eye(3)
        nominal = None if rotation_dvl_from_body is None else rotation_dvl_from_body.T @ flu_from_dvl
        fit = self._fit(reading)
        fitted = nearest(fit, nominal, (REFERENCE,)) if fit else None
        if fitted is None:
            return NOT_REGISTERED
        residual = math.sqrt(float(_smallest_share(fitted.squares).mean())) / max(fitted.speed, 1e-9)
        compared_with = fitted.rotation_body_from_dvl if nominal is None else nominal
        rotation_found = flu_from_dvl @ fitted.rotation_body_from_dvl.T
        return Registered(misfit(fitted, compared_with, residual), rotation_found, fitted.x[ARM], fitted.std[ARM])

    def are_axes_mirrored(self, reading: Reading, rotation_found: Array, rotation_dvl_from_body: Array) -> bool:
        """Return whether mirrored axes of the DVL with a mounting (3, 3) fit better than the rotation found (3, 3)."""
        flu_from_dvl = FLU_FROM_FRD if reading.turned else np.eye(3)
        read, fit = self._read(reading), self._fit(reading)
        rotated = nearest(fit, rotation_found.T @ flu_from_dvl, (REFERENCE,)) if fit else None
        if read is None or rotated is None:
            return False
        mounting = rotation_dvl_from_body.T @ flu_from_dvl
        wrong = wrong_axes(read.motion, mounting, self._position, rotated.level, FROM_MESSAGE)
        return wrong is not None and wrong.code == "DVL_LEFT_HANDED"

    def without_roll(self, agreement: Agreement, rotation_dvl_from_body: Array) -> Array:
        """Return a rotation (3, 3) without roll about the direction of travel, unless the data need it."""
        travel = (self._dvl @ FLU_FROM_FRD if agreement.reading.turned else self._dvl).mean(axis=0)
        unrolled = least_turn(rotation_dvl_from_body.T @ travel, travel)
        is_needed = ROLL_RATIO * self.agreements([agreement.reading], unrolled)[0].residual > agreement.best_residual
        return rotation_dvl_from_body if is_needed else unrolled

    def is_in_body(self, agreement: Agreement) -> bool:
        """Return whether DVL and reference are in the body: they also agree if both are in the earth frame."""
        read = self._read(replace(agreement.reading, reference=VelocityFrame.ENU.value))
        if read is None:
            return True
        directions = Directions()
        dvl = self._dvl @ FLU_FROM_FRD if agreement.reading.turned else self._dvl
        directions.add(dvl @ agreement.rotation_dvl_from_body, read.imu.rotation)
        return directions.stay_in_the_body

    def _fit(self, reading: Reading) -> MotionFit | None:
        """Return the least squares of a reading; None if a required attitude is missing."""
        read = self._read(reading)
        if read is not None and reading not in self._fits:
            self._fits[reading] = MotionFit(read.motion, self._position, read.motion.curves, QUICK_ROWS)
        return self._fits.get(reading)

    def _read(self, reading: Reading) -> _MotionAsRead | None:
        """Return the motion under a reading, except the DVL; None if a required attitude is missing."""
        key = replace(reading, turned=False)
        if key not in self._motions:
            m, in_earth = self._motion, not reading.in_body
            if in_earth and (reading.imu is None or not m.has_attitude):
                return None
            imu = self._read_imu(reading.imu)
            reference, body = (velocity @ READ_BY[reading.reference].T for velocity in (m.reference, self._reference))
            if in_earth:
                body = np.einsum("nji,nj->ni", imu.rotation, body)
            motion = replace(m, reference=reference, in_earth=in_earth, imu=imu.columns, turns=imu.turns)
            self._motions[key] = _MotionAsRead(motion, imu, body + imu.by_arm)
        return self._motions[key]

    def _read_imu(self, frame: ImuFrame | None) -> _ImuAsRead:
        """Return the IMU under a hypothesis; None for its messages' own axes."""
        if frame not in self._imus:
            columns = self._motion.imu if frame is None else frame.read(self._motion.imu)
            turns, by_arm = TurnRates.of(columns), np.zeros(3)
            if self._position.any():
                by_arm = np.nan_to_num(cross(angular_velocity_at(turns, self._at, GAP_S), self._position))
            self._imus[frame] = _ImuAsRead(columns, turns, attitude_at(columns, self._at, GAP_S)[0], by_arm)
        return self._imus[frame]


def are_rates_frd(reference_rates: Array, rates: Array) -> bool | None:
    """Return whether turn rates of the reference agree with the IMU as forward-right-down; None if unclear.

    reference_rates, rates: (N, 3) rad/s. A left turn is positive about an axis up, negative about one down.
    """
    known = np.isfinite(rates).all(axis=1) & np.isfinite(reference_rates).all(axis=1)
    rates, reference_rates = rates[known], reference_rates[known]
    if len(reference_rates) < FEWEST_VALUES or _rms(reference_rates) < MIN_TURN_RADPS or _rms(rates) < MIN_TURN_RADPS:
        return None
    misfit_flu, misfit_frd = _rms(reference_rates - rates), _rms(reference_rates @ FLU_FROM_FRD - rates)
    is_unclear = min(misfit_flu, misfit_frd) > BETTER_BY * max(misfit_flu, misfit_frd)
    return None if is_unclear else misfit_frd < misfit_flu


def best_rotation(a: Array, b: Array, prior: Array) -> Array:
    """Return the rotation M (3, 3) from b (N, 3) to a (N, 3), with weight PRIOR_WEIGHT on the rotation `prior`."""
    square = float(squared(b).mean())
    return nearest_rotation(a.T @ b / len(a) + PRIOR_WEIGHT * square * prior)


def least_turn(a: Array, b: Array) -> Array:
    """Return the rotation (3, 3) by the smallest angle from direction a (3,) to b."""
    axis = cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9 * max(float(a @ a), 1e-300):
        return np.eye(3) if float(a @ b) >= 0.0 else np.diag([-1.0, -1.0, 1.0])
    return rotation_of(axis / sine * math.atan2(sine, float(a @ b)))


def nominal_rpy(rotation_body_from_dvl: Array) -> tuple[float, float, float]:
    """Return the likely intended mounting (rad): the drawn angle if near (multiples of `DRAWN`), else whole degrees."""
    rpy = rpy_from_rotation(rotation_body_from_dvl)
    near = DRAWN * np.round(rpy / DRAWN)
    meant = np.where(np.abs(rpy - near) < NOMINAL_TOL_RAD, near, whole_degrees(rotation_body_from_dvl))
    roll, pitch, yaw = (meant + 0.0).tolist()
    return roll, pitch, yaw


def _rms(difference: Array) -> float:
    """Return the RMS of the kept share of differences (N, 3)."""
    return math.sqrt(float(_smallest_share(squared(difference)).mean()))


def _smallest_share(squares: Array) -> Array:
    """Return the smallest squares (M,), outliers removed."""
    return np.sort(squares)[: max(1, int(KEPT_SHARE * len(squares)))]
