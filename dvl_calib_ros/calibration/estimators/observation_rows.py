"""What G2 compares: every reference velocity with the DVL's at each of a row of delays.

The DVL measures, at the true time s, v(s) + ω(s) × l of the body, and stamps it s + τ. Of a reference sample at s, body
velocity and angular velocity are those of s whatever τ is, with its noise in it once; only the DVL's velocity is read
at s + τ, where it is 20 times less noisy than GNSS. So hypotheses of τ are told apart by the same reference noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..models.own import DELAY, G2, LEVER_ARM, N_STATE, g1_errors, g1_heave_errors
from ..numerics.frames import Array, Vector, cross, skew, squared
from ..numerics.kalman import whitening
from ..numerics.samples import Index, Mask
from ..streams.interpolation import (
    LEAST_REACH_S,
    LEAST_SLOPE_REACH_S,
    MOST_REACH_S,
    DvlColumns,
    InBody,
    Parts,
    ReferenceColumns,
    TurnRates,
    angular_velocity_at,
    local_fit,
    places,
    reach_at,
    spacing_at,
)

# Delays are tried this far apart: a vehicle's velocity is straight enough over half of it for the rest to be a state
# (0.1 m/s² changing by 0.3 m/s³ bends by 1.5 mm/s).
STEP_S = 0.2
STEPS: Index = np.arange(-16, 17)
DELAYS_S: Array = STEPS * STEP_S
# What rows say of the DVL's errors and of the delay is another thing for every delay; of the reference's constant error
# and of the lever arm it is the same; of a constant heave they say nothing.
OF_DELAY: Index = np.array([0, 1, 2, 3, 4, DELAY])
OF_NONE: Index = np.array([6, 7, 8, 9, 10])
# What belongs to the day, not to the vehicle: the constant error of the reference, and the delay.
OF_DAY: Index = G2.of_day


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
        """Sum over those used (J,) of (H, z) (K, 13) of what holds of heave in the mean, see vertical_motion.py."""
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
