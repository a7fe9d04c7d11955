"""What G2 compares: every reference velocity with the DVL's at each of a row of delays.

The DVL measures, at the true time s, v(s) + ω(s) × l of the body, and stamps it s + τ. Of a reference sample at s, body
velocity and angular velocity are those of s whatever τ is, with its noise in it once; only the DVL's velocity is read
at s + τ, where it is 20 times less noisy than GNSS. So hypotheses of τ are told apart by the same reference noise.
(Long, because each stream is read between its samples in a way of its own.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from ..models.own import DELAY, G2, LEVER_ARM, N_STATE, g1_errors, g1_heave_errors
from ..numerics.frames import Array, Vector, cross, rotation_from_quaternion, skew, slerps, squared
from ..numerics.kalman import whitening
from ..numerics.robust import median, steps
from ..numerics.samples import Index, Mask
from .local_motion import local_fit, reach_at, spacing_at
from .parts import Near, Parts, places

# Delays are tried this far apart: a vehicle's velocity is straight enough over half of it for the rest to be a state
# (0.1 m/s² changing by 0.3 m/s³ bends by 1.5 mm/s).
STEP_S = 0.2
STEPS: Index = np.arange(-16, 17)
DELAYS_S: Array = STEPS * STEP_S
LONGEST_DELAY_S = 3.2
# Samples at least as dense as this tell their noise apart from the vehicle's motion, s.
NOISE_FROM_S = 0.15
# Samples faster than this are averaged over bins of so long: none the worse for it, and the work stays the same.
BIN_S = 0.1
FASTER_THAN_S = 0.07
# A quadratic that averages the DVL's noise reaches at least so far; the slope further, for its noise pulls the delay
# that it shows: 0.01 m/s at 5 Hz is 0.006 m/s² over 1 s, an eighth of what a turning vehicle has.
LEAST_REACH_S, LEAST_SLOPE_REACH_S = 0.6, 1.0
# ... and at most: DVL samples more than 1.3 s apart do not tell a turning vehicle's velocity between them.
MOST_REACH_S = 3.4
# How far beyond a block of references the other streams have to be known.
MARGIN_S = 7.0
# What rows say of the DVL's errors and of the delay is another thing for every delay; of the reference's constant error
# and of the lever arm it is the same; of a constant heave they say nothing.
OF_DELAY: Index = np.array([0, 1, 2, 3, 4, DELAY])
OF_NONE: Index = np.array([6, 7, 8, 9, 10])
# What belongs to the day, not to the vehicle: the constant error of the reference, and the delay.
OF_DAY: Index = G2.of_day


class DvlColumns(NamedTuple):
    """times (N,) s, velocity (N, 3) m/s in the DVL's frame."""

    times: Array
    velocity: Array


class ReferenceColumns(NamedTuple):
    """times (J,) s, velocity (J, 3) m/s and noise (J, 3, 3) (m/s)²; ENU, or body where in_body (J,).

    claimed: (J,) where the noise is the message's, to which the DVL's is added; else it is that of both.
    """

    times: Array
    velocity: Array
    noise: Array
    in_body: Mask
    claimed: Mask

    def part(self, at: Index) -> ReferenceColumns:
        """Some of them."""
        return ReferenceColumns(self.times[at], self.velocity[at], self.noise[at], self.in_body[at], self.claimed[at])


class ImuColumns(NamedTuple):
    """times (M,) s, orientation (M, 4) quaternion (x, y, z, w) enu from body, angular_velocity (M, 3) rad/s, body."""

    times: Array
    orientation: Array
    angular_velocity: Array


C = TypeVar("C", DvlColumns, ImuColumns, ReferenceColumns)


def joined(columns: Sequence[C]) -> C:
    """Columns of several blocks, one after the other."""
    return columns[0] if len(columns) == 1 else type(columns[0])(*map(np.concatenate, zip(*columns, strict=True)))


class TurnRates(NamedTuple):
    """Angular velocity where it is known, averaged over bins: times (M,) s, rates (M, 3) rad/s, body; variance (B, 3)
    of its noise in each of the parts that they are of."""

    times: Array
    rates: Array
    variance: Array
    parts: Parts

    @staticmethod
    def of(imu: ImuColumns) -> TurnRates:
        """Those of an IMU, all of one part."""
        known = ~np.isnan(imu.angular_velocity).any(axis=1)
        times, rates = binned(imu.times[known], imu.angular_velocity[known])
        return TurnRates(times, rates, _noise_of(times, rates)[None], Parts.of([times]))

    @staticmethod
    def joined(each: Sequence[TurnRates]) -> TurnRates:
        """Of several blocks."""
        if len(each) == 1:
            return each[0]
        times, rates, variance, _ = zip(*each, strict=True)
        return TurnRates(np.concatenate(times), np.concatenate(rates), np.concatenate(variance), Parts.of(times))


@dataclass(frozen=True)
class DelayedRows:
    """J reference samples, each compared at K delays: rows of (H, z), turned and scaled so that their noise is 1.

    index: (J,) of the reference. moving: (K, 7, 3, J), columns of `OF_DELAY` and z. standing: (5, 3, J), columns of
    `OF_NONE`. weight: (J,) share of its own information that a sample adds. regressor_noise: (J, 4) how much of the
    information on lever arm (3) and delay is that of noise: angular velocity and slope that only seem to change.
    """

    index: Index
    moving: Array
    standing: Array
    weight: Array
    regressor_noise: Array
    motion: MotionAtReferences
    body_from_dvl: Array

    def __len__(self) -> int:
        return len(self.index)

    def part(self, at: Mask) -> DelayedRows:
        """Those of some references."""
        return DelayedRows(
            self.index[at],
            self.moving[..., at],
            self.standing[..., at],
            self.weight[at],
            self.regressor_noise[at],
            self.motion.part(at),
            self.body_from_dvl,
        )

    def heave(self, used: Mask) -> Array:
        """Sum over those used (J,) of (H, z) (K, 13) of what holds of heave in the mean, see heave.py."""
        velocity, slope, _, turning, lever, _ = self.motion
        k, n = velocity.shape[1:]
        share = used.astype(float)
        row = np.zeros((k, N_STATE + 1))
        of_errors = g1_heave_errors(self.body_from_dvl, velocity.reshape(3, k * n)).reshape(5, k, n)
        row[:, :5] = (of_errors @ share).T
        row[:, 5] = -share.sum()
        row[:, LEVER_ARM] = -(share @ skew(turning)[:, 2])
        row[:, DELAY] = self.body_from_dvl[2] @ (slope @ share)
        row[:, N_STATE] = -(self.body_from_dvl[2] @ (velocity @ share))
        if lever is not None:
            row[:, N_STATE] += share @ lever[:, 2]
        return row


class MotionAtReferences(NamedTuple):
    """What J references are compared with.

    velocity, slope: (3, K, J) of the DVL at every delay, m/s and m/s², in its own frame. body: (J, 3) m/s, the
    reference's. turning: (J, 3) rad/s. lever: (J, 3) m/s that a known lever arm makes of it, None without one. earth:
    (J, 3, 2) as in `Observations.earth_in_body`.
    """

    velocity: Array
    slope: Array
    body: Array
    turning: Array
    lever: Array | None
    earth: Array

    def velocities(self, body_from_dvl: Array) -> tuple[Array, Array]:
        """Of the DVL, and of the reference less that, (K, J, 3) m/s in the DVL's frame."""
        velocity = self.velocity.transpose(1, 2, 0)
        beside = self.body if self.lever is None else self.body + self.lever
        return velocity, beside @ body_from_dvl - velocity

    def part(self, at: Mask | slice) -> MotionAtReferences:
        """Of some references."""
        lever = None if self.lever is None else self.lever[at]
        return MotionAtReferences(
            self.velocity[..., at], self.slope[..., at], self.body[at], self.turning[at], lever, self.earth[at]
        )


@dataclass(frozen=True)
class Matched:
    """The references (J,) of several blocks that have all that rows need.

    index: (J,) of the reference among those of its block. parts: of which block. motion, weight, regressor_noise: as
    in `DelayedRows`. white: (J, 3, 3).
    """

    index: Index
    parts: Parts
    motion: MotionAtReferences
    white: Array
    weight: Array
    regressor_noise: Array
    body_from_dvl: Array

    def rows(self, block: int) -> DelayedRows:
        """The rows of one block, which few enough to stay in the processor's caches."""
        at = slice(*self.parts.bounds[block : block + 2].tolist())
        motion, white = self.motion.part(at), self.white[at]
        moving = _moving(motion, white, self.body_from_dvl)
        standing = np.concatenate([motion.earth, -skew(motion.turning)], axis=2)
        return DelayedRows(
            self.index[at],
            moving,
            np.ascontiguousarray((white @ standing).transpose(2, 1, 0)),
            self.weight[at],
            self.regressor_noise[at],
            motion,
            self.body_from_dvl,
        )


def matched(
    dvl: DvlColumns,
    dvl_parts: Parts,
    reference: ReferenceColumns,
    reference_parts: Parts,
    seen: InBody,
    turns: TurnRates,
    *,
    noise_dvl: Array,
    body_from_dvl: Array,
    lever_arm: Vector,
    min_speed: float,
    max_turn_rate: float,
    imu_gap_s: float,
    steps: Index = STEPS,
) -> Matched:
    """References of some blocks that lie within what these know of the other streams.

    dvl_parts, reference_parts: of which block samples are. seen: the references as in the body. noise_dvl: (B, 3, 3)
    (m/s)², DVL frame. body_from_dvl: (3, 3), nominal mounting. lever_arm: (3,) m, body, as far as it is known already.
    min_speed (m/s), max_turn_rate (rad/s, 0 for none): as the parameters. imu_gap_s: longest gap that is interpolated
    across. steps: (K,) of `STEPS`, the delays that are compared; which references are is decided by all.
    """
    times, block = reference.times, reference_parts.number
    turning, turning_noise = angular_velocity_at(turns, times, imu_gap_s, reference_parts)
    body, noise = seen.velocity, seen.noise
    moving = squared(body) >= min_speed**2
    if max_turn_rate > 0.0:
        moving &= squared(turning) <= max_turn_rate**2
    read = _read(dvl, dvl_parts, times, reference_parts, steps)
    use = seen.known & ~np.isnan(turning[:, 0]) & moving & read.known
    white = whitening(noise + np.where(reference.claimed[:, None, None], noise_dvl[block], 0.0))
    use &= np.isfinite(white).all(axis=(1, 2))
    index = np.flatnonzero(use)
    white, turning, spacing, block = white[index], turning[index], read.spacing[index], block[index]
    uncertain = _Uncertain(turning_noise[block], noise_dvl[block], read.slope_gain[index])
    interval = np.minimum(np.diff(times, prepend=times[:1] - 1.0), 10.0)
    begins = reference_parts.bounds[:-1]
    interval[begins[begins < len(times)]] = 1.0
    # references closer together than the DVL's samples share these
    weight = np.clip(interval[index] / spacing, 0.0, 1.0)
    lever = cross(turning, np.array(lever_arm)) if any(lever_arm) else None
    motion = MotionAtReferences(
        read.velocity[..., index], read.slope[..., index], body[index], turning, lever, seen.earth_in_body[index]
    )
    told = uncertain.information(white.swapaxes(1, 2) @ white)
    in_block = index - reference_parts.bounds[block]
    return Matched(in_block, reference_parts.at(index), motion, white, weight, told, body_from_dvl)


class _Uncertain(NamedTuple):
    """Noise of J regressors: variance of the angular velocity (J, 3) (rad/s)² as it is used, covariance (J, 3, 3)
    (m/s)² of the DVL's velocity, and by what (J,) that is multiplied to be its slope's."""

    turning: Array
    velocity_dvl: Array
    slope_gain: Array

    def information(self, told: Array) -> Array:
        """What such noise alone would tell of lever arm and delay (J, 4), where a velocity tells (J, 3, 3)."""
        x, y, z = told[:, 0, 0], told[:, 1, 1], told[:, 2, 2]
        nx, ny, nz = self.turning.T
        delay = (told * self.velocity_dvl.swapaxes(1, 2)).sum(axis=(1, 2)) * self.slope_gain
        return np.column_stack([nz * y + ny * z, nz * x + nx * z, ny * x + nx * y, delay])


class _Reading(NamedTuple):
    """The DVL at J times and every delay: velocity, slope (3, K, J), and at J times whether all of it is known, how far
    the DVL's samples are apart, s, and the slope's noise for samples with noise of variance 1."""

    velocity: Array
    slope: Array
    known: Mask
    spacing: Array
    slope_gain: Array


def _read(dvl: DvlColumns, dvl_parts: Parts, times: Array, parts: Parts, compared: Index) -> _Reading:
    """Fits are made every STEP_S, and cubics read between them: on so short a step no worse, a tenth of the work.

    times: (J,) s. parts: of which block they are. compared: (K,) of `STEPS`.
    """
    steps = times / STEP_S
    middle = np.floor(steps).astype(np.intp)
    part = steps - middle  # at every delay, as they are whole steps
    grids: list[Array] = []
    shift: Index = np.zeros(len(times), dtype=np.intp)
    n = 0
    for own in parts:
        first, last = (middle[own.start], middle[own.stop - 1]) if own.stop > own.start else (0, -2 - STEPS.size)
        grids.append(STEP_S * np.arange(first + STEPS[0], last + STEPS[-1] + 2))
        shift[own] = n - (first + STEPS[0])
        n += len(grids[-1])
    grid = np.concatenate(grids)
    place = places(dvl.times, grid, dvl_parts, Parts.of(grids))
    spacing = spacing_at(dvl.times, grid, place)
    reach = reach_at(spacing, LEAST_REACH_S, MOST_REACH_S)
    # both in one call: so few numbers take as long as twice as many
    reaches = np.concatenate([reach, np.maximum(reach, LEAST_SLOPE_REACH_S)])
    both = local_fit(dvl.times, dvl.velocity, np.concatenate([grid, grid]), reaches, place.twice())
    fit, wide = both.part(slice(len(grid))), both.part(slice(len(grid), None))
    middle += shift
    before = middle + compared[:, None]
    after = before + 1
    rest = 1.0 - part
    (v0, b0, s0), (v1, b1, s1) = (
        [column.T.take(at, axis=1) for column in (fit.value, fit.slope, wide.slope)] for at in (before, after)
    )
    velocity = (
        v0 * (rest * rest * (1.0 + 2.0 * part))
        + v1 * (part * part * (1.0 + 2.0 * rest))
        + (b0 * rest - b1 * part) * (STEP_S * part * rest)
    )
    slope = s0 * rest + s1 * part
    found = fit.found & wide.found
    # by all delays, whichever are compared: none is judged by other samples than another was
    known: Mask = np.logical_and.reduce([found.take(middle + step) for step in range(STEPS[0], STEPS[-1] + 2)])
    return _Reading(velocity, slope, known, spacing[middle], wide.slope_gain[middle])


def _moving(motion: MotionAtReferences, white: Array, body_from_dvl: Array) -> Array:
    """`DelayedRows.moving`. white: (J, 3, 3) lower triangles."""
    k, n = motion.velocity.shape[1:]
    v = motion.velocity.reshape(3, k * n)
    plain = np.empty((3, 7, k, n))
    plain[:, :5] = g1_errors(body_from_dvl, v).reshape(3, 5, k, n)
    plain[:, 5] = (body_from_dvl @ motion.slope.reshape(3, k * n)).reshape(3, k, n)
    beside = motion.body if motion.lever is None else motion.body + motion.lever
    np.subtract(beside.T[:, None], (body_from_dvl @ v).reshape(3, k, n), out=plain[:, 6])
    moving = np.empty((k, 7, 3, n))
    part = np.empty((7, k, n))
    for i in range(3):
        row = plain[i] * white[:, i, i]
        for j in range(i):
            row += np.multiply(white[:, i, j], plain[j], out=part)
        moving[:, :, i] = row.swapaxes(0, 1)
    return moving


def binned(times: Array, *columns: Array) -> tuple[Array, ...]:
    """Means of times (N,) s and columns (N, ...) over bins of BIN_S, of those bins that hold any;
    as they are if they come no faster than FASTER_THAN_S."""
    if len(times) < 2 or median(steps(times)) >= FASTER_THAN_S:
        return times, *columns
    bins = np.floor(times / BIN_S)
    starts = np.append(0, np.flatnonzero(steps(bins)) + 1)
    count = steps(np.append(starts, len(times)))
    return tuple(
        np.add.reduceat(column, starts, axis=0) / count.reshape(-1, *[1] * (column.ndim - 1))
        for column in (times, *columns)
    )


def angular_velocity_at(
    turns: TurnRates, times: Array, gap_s: float, parts: Parts | None = None
) -> tuple[Array, Array]:
    """(J, 3) rad/s at these times, averaged as the DVL's velocity is; nan where not known. And its variance (B, 3).

    parts: by which block's rates each is to be known; None where all are of one.
    """
    stamps, rates, variance, turn_parts = turns
    if len(stamps) < 2:
        return np.full((len(times), 3), np.nan), np.zeros_like(variance)
    parts = Parts.of([times]) if parts is None else parts
    place = places(stamps, times, turn_parts, parts)
    reach = reach_at(spacing_at(stamps, times, place), LEAST_REACH_S, MOST_REACH_S)
    smooth = local_fit(stamps, rates, times, reach, place)
    after, before, outside = _beside(stamps, times, place)
    outside |= stamps[after] - stamps[before] > gap_s
    value = smooth.value
    if not smooth.found.all():
        gap = np.maximum(stamps[after] - stamps[before], 1e-12)
        share = np.clip((times - stamps[before]) / gap, 0.0, 1.0)[:, None]
        value = np.where(smooth.found[:, None], value, rates[before] + (rates[after] - rates[before]) * share)
    value[outside] = np.nan
    noise = [
        own * gain[found].mean() if found.any() else np.zeros(3)
        for own, gain, found in (
            (own, smooth.value_gain[at], smooth.found[at]) for own, at in zip(variance, parts, strict=True)
        )
    ]
    return value, np.array(noise)


def _beside(stamps: Array, times: Array, place: Near) -> tuple[Index, Index, Mask]:
    """Places of the samples after and before each of J times, and where there are none (J,). stamps: (N > 1,) s."""
    after, first, end = place
    after = np.minimum(np.maximum(np.minimum(np.maximum(after, first + 1), end - 1), 1), len(stamps) - 1)
    last = np.maximum(end - 1, 0)
    outside = (end - first < 2) | (times < stamps[np.minimum(first, len(stamps) - 1)]) | (times > stamps[last])
    return after, after - 1, outside


def _noise_of(times: Array, values: Array) -> Array:
    """Variance (c,) of white noise on samples at times (N,) s, by their second differences; zero for slow ones.

    A vehicle that rolls in waves has second differences of its own if it is looked at once a second.
    """
    if len(times) < 8 or median(steps(times)) > NOISE_FROM_S:
        return np.zeros(values.shape[1])
    bent = values[2:] - 2.0 * values[1:-1] + values[:-2]
    return median(bent**2) / (6.0 * 0.455)  # 0.455: median of chi-square


class InBody(NamedTuple):
    """Velocity (J, 3), noise (J, 3, 3) in the body frame, where that is known (J,), `Observations.earth_in_body`."""

    velocity: Array
    noise: Array
    known: Mask
    earth_in_body: Array

    def part(self, at: Index | slice) -> InBody:
        """Some of them."""
        return InBody(self.velocity[at], self.noise[at], self.known[at], self.earth_in_body[at])


def in_body(reference: ReferenceColumns, rotation: Array, known: Mask) -> InBody:
    """References as in the body, by attitudes ``rotation_enu_from_body`` (J, 3, 3) where they are known (J,)."""
    in_body = reference.in_body
    if in_body.all():
        n = len(in_body)
        return InBody(reference.velocity, reference.noise, np.ones(n, dtype=bool), np.zeros((n, 3, 2)))
    body_from_enu = np.where(in_body[:, None, None], np.eye(3), rotation.swapaxes(1, 2))
    velocity = np.matmul(body_from_enu, reference.velocity[..., None])[..., 0]
    noise = body_from_enu @ reference.noise @ body_from_enu.swapaxes(1, 2)
    earth = body_from_enu[:, :, :2] * ~in_body[:, None, None]
    return InBody(velocity, noise, known | in_body, earth)


def attitude_at(
    imu: ImuColumns, times: Array, gap_s: float, imu_parts: Parts | None = None, parts: Parts | None = None
) -> tuple[Array, Mask]:
    """``rotation_enu_from_body`` (J, 3, 3) by spherical interpolation, and where that is possible (J,).

    gap_s: longest gap that is interpolated across. imu_parts, parts: of which block samples and times are.
    """
    given = ~np.isnan(imu.orientation[:, 0])
    stamps, quaternions = imu.times, imu.orientation
    if not given.all():
        stamps, quaternions = stamps[given], quaternions[given]
        imu_parts = None if imu_parts is None else imu_parts.where(given)
    if len(stamps) < 2:
        return np.broadcast_to(np.eye(3), (len(times), 3, 3)), np.zeros(len(times), dtype=bool)
    after, before, outside = _beside(stamps, times, places(stamps, times, imu_parts, parts))
    gap = np.maximum(stamps[after] - stamps[before], 1e-12)
    fraction = np.minimum(np.maximum((times - stamps[before]) / gap, 0.0), 1.0)
    between = slerps(quaternions.take(before, axis=0), quaternions.take(after, axis=0), fraction)
    return rotation_from_quaternion(between), ~outside & (gap <= gap_s)
