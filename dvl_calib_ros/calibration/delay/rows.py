"""What G2 compares: every reference velocity with the DVL's at each of a row of delays.

The DVL measures, at the true time s, v(s) + ω(s) × l of the body, and stamps it s + τ. Of a reference sample at s, body
velocity and angular velocity are those of s whatever τ is, with its noise in it once; only the DVL's velocity is read
at s + τ, where it is 20 times less noisy than GNSS. So hypotheses of τ are told apart by the same reference noise.
(Long, because each stream is read between its samples in a way of its own.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..frames import Array, Vector, cross, rotation_from_quaternion, skew
from ..kalman import whitening
from ..models import MODELS
from ..models.own import g1_heave, linearise_g1
from ..observations import Observations
from ..robust import median
from ..samples import Index, Mask
from .local_motion import local_fit, reach_at, spacing_at

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
N_G1, N_STATE = 8, 12
LEVER_ARM, DELAY = slice(8, 11), 11
BEYOND = slice(N_G1, N_STATE)  # what G1 has not
# What belongs to the day, not to the vehicle: the constant error of the reference, and the delay.
OF_DAY: Index = MODELS["G2"].of_day


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


class TurnRates(NamedTuple):
    """Angular velocity where it is known, averaged over bins: times (M,) s, rates (M, 3) rad/s, body; variance (3,) of
    its noise."""

    times: Array
    rates: Array
    variance: Array

    @staticmethod
    def of(imu: ImuColumns) -> TurnRates:
        """Those of an IMU."""
        known = ~np.isnan(imu.angular_velocity).any(axis=1)
        times, rates = binned(imu.times[known], imu.angular_velocity[known])
        return TurnRates(times, rates, _noise_of(times, rates))


@dataclass(frozen=True)
class DelayedRows:
    """J reference samples, each compared at K delays.

    index: (J,) of the reference. white: (K, 13, 3, J) (H, z) turned and scaled so that their noise is 1, on G1's
    states, lever arm (m, body) and what the delay is more (s) than that of its hypothesis. weight: (J,) share of its
    own information that a sample adds. heave: (J, K, 13) (H, z) of what holds of heave in the mean, see heave.py.
    regressor_noise: (J, 4) how much of the information on lever arm (3) and
    delay is that of noise: angular velocity and slope that only seem to change.
    """

    index: Index
    white: Array
    weight: Array
    heave: Array
    regressor_noise: Array

    def __len__(self) -> int:
        return len(self.index)

    def part(self, at: Mask) -> DelayedRows:
        """Those of some references."""
        return DelayedRows(
            self.index[at], self.white[..., at], self.weight[at], self.heave[at], self.regressor_noise[at]
        )


def delayed_rows(
    dvl: DvlColumns,
    reference: ReferenceColumns,
    seen: InBody,
    turns: TurnRates,
    *,
    noise_dvl: Array,
    template: Observations,
    lever_arm: Vector,
    min_speed: float,
    max_turn_rate: float,
    imu_gap_s: float,
) -> DelayedRows:
    """Rows of the references that lie within what is known of the other streams.

    seen: the references as in the body. noise_dvl: (3, 3) (m/s)², DVL frame. template: whose mounting and assumptions
    hold; its samples are not looked at. lever_arm: (3,) m, body, as far as it is known already. min_speed (m/s),
    max_turn_rate (rad/s, 0 for none): as the parameters. imu_gap_s: longest gap that is interpolated across.
    """
    times = reference.times
    turning, turning_noise = angular_velocity_at(turns, times, imu_gap_s)
    body, noise, earth = seen.velocity, seen.noise, seen.earth_in_body
    moving = (body**2).sum(axis=1) >= min_speed**2
    if max_turn_rate > 0.0:
        moving &= (turning**2).sum(axis=1) <= max_turn_rate**2
    read = _read(dvl, times)
    use = seen.known & ~np.isnan(turning[:, 0]) & moving & read.known
    white = whitening(noise + np.where(reference.claimed[:, None, None], noise_dvl, 0.0))
    use &= np.isfinite(white).all(axis=(1, 2))
    index = np.flatnonzero(use)
    body, white, turning = body[index], white[index], turning[index]
    value, slope, spacing = read.velocity[..., index], read.slope[..., index], read.spacing[index]
    uncertain = _Uncertain(turning_noise, noise_dvl, read.slope_gain[index])
    interval = np.minimum(np.diff(times, prepend=times[:1] - 1.0), 10.0)[index]
    # references closer together than the DVL's samples share these
    weight = np.clip(interval / spacing, 0.0, 1.0)
    earth = earth[index]
    return _rows(index, value, slope, body, earth, turning, uncertain, white, weight, template, lever_arm)


class _Uncertain(NamedTuple):
    """Noise of regressors: variance of the angular velocity (3,) (rad/s)² as it is used, covariance (3, 3) (m/s)² of
    the DVL's velocity, and by what (J,) that is multiplied to be its slope's."""

    turning: Array
    velocity_dvl: Array
    slope_gain: Array

    def information(self, told: Array) -> Array:
        """What such noise alone would tell of lever arm and delay (J, 4), where a velocity tells (J, 3, 3)."""
        x, y, z = told[:, 0, 0], told[:, 1, 1], told[:, 2, 2]
        nx, ny, nz = self.turning
        delay = np.einsum("nij,ji->n", told, self.velocity_dvl) * self.slope_gain
        return np.column_stack([nz * y + ny * z, nz * x + nx * z, ny * x + nx * y, delay])


class _Reading(NamedTuple):
    """The DVL at J times and every delay: velocity, slope (3, K, J), and at J times whether all of it is known, how far
    the DVL's samples are apart, s, and the slope's noise for samples with noise of variance 1."""

    velocity: Array
    slope: Array
    known: Mask
    spacing: Array
    slope_gain: Array


def _read(dvl: DvlColumns, times: Array) -> _Reading:
    """Fits are made every STEP_S, and cubics read between them: on so short a step no worse, a tenth of the work."""
    first, last = (int(np.floor(time / STEP_S)) + step for time, step in ((times[0], STEPS[0]), (times[-1], STEPS[-1])))
    grid = STEP_S * np.arange(first, last + 2)
    spacing = spacing_at(dvl.times, grid)
    reach = reach_at(spacing, LEAST_REACH_S, MOST_REACH_S)
    # both in one call: so few numbers take as long as twice as many
    reaches = np.concatenate([reach, np.maximum(reach, LEAST_SLOPE_REACH_S)])
    both = local_fit(dvl.times, dvl.velocity, np.concatenate([grid, grid]), reaches)
    fit, wide = both.part(slice(len(grid))), both.part(slice(len(grid), None))
    steps = times / STEP_S
    middle = np.floor(steps).astype(np.intp)
    part = steps - middle  # at every delay, as they are whole steps
    middle -= first
    before = middle + STEPS[:, None]
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
    known: Mask = (found.take(before) & found.take(after)).all(axis=0)
    return _Reading(velocity, slope, known, spacing[middle], wide.slope_gain[middle])


def _rows(
    index: Index,
    velocity_dvl: Array,
    slope: Array,
    body: Array,
    earth: Array,
    turning: Array,
    uncertain: _Uncertain,
    white: Array,
    weight: Array,
    template: Observations,
    lever_arm: Vector,
) -> DelayedRows:
    k, n = velocity_dvl.shape[1:]
    body_from_dvl = template.rotation_dvl_from_body.T
    lever = cross(turning, np.array(lever_arm)) if any(lever_arm) else None
    # the same reference beside the DVL at every delay; in memory the samples of each element follow each other
    each = Observations(
        velocity_dvl=velocity_dvl.reshape(3, k * n).T,
        reference_body=np.tile(body.T, k).T,
        lever_velocity=None if lever is None else np.tile(lever.T, k).T,
        rotation_dvl_from_body=template.rotation_dvl_from_body,
        sway_heave=template.sway_heave,
        earth_in_body=np.tile(earth.transpose(1, 2, 0), k).transpose(2, 0, 1),
    )
    z, h_g1 = linearise_g1(each)
    rows = np.empty((k, N_STATE + 1, 3, n))
    rows[:, :N_G1] = h_g1.transpose(2, 1, 0).reshape(N_G1, 3, k, n).transpose(2, 0, 1, 3)
    rows[:, LEVER_ARM] = -skew(turning).transpose(2, 1, 0)
    rows[:, DELAY] = np.tensordot(body_from_dvl, slope, 1).swapaxes(0, 1)
    rows[:, N_STATE] = z.reshape(k, n, 3).swapaxes(1, 2)
    heave = np.empty((n, k, N_STATE + 1))
    of_g1 = g1_heave(each).T.reshape(N_G1 + 1, k, n).transpose(2, 1, 0)
    heave[..., :N_G1], heave[..., N_STATE] = of_g1[..., :N_G1], of_g1[..., N_G1]
    heave[..., BEYOND] = rows[:, BEYOND, 2].transpose(2, 0, 1)
    part = np.empty((k, N_STATE + 1, n))
    for i in (2, 1, 0):  # from the last on, as those before go into it
        rows[:, :, i] *= white[:, i, i]
        for j in range(i):
            rows[:, :, i] += np.multiply(white[:, i, j], rows[:, :, j], out=part)
    told = uncertain.information(white.swapaxes(1, 2) @ white)
    return DelayedRows(index, rows, weight, heave, told)


def binned(times: Array, *columns: Array) -> tuple[Array, ...]:
    """Means of times (N,) s and columns (N, ...) over bins of BIN_S, of those bins that hold any;
    as they are if they come no faster than FASTER_THAN_S."""
    if len(times) < 2 or median(np.diff(times)) >= FASTER_THAN_S:
        return times, *columns
    bins = np.floor(times / BIN_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(bins, prepend=bins[:1] - 1))
    count = np.diff(np.append(starts, len(times)))
    return tuple(
        np.add.reduceat(column, starts, axis=0) / count.reshape(-1, *[1] * (column.ndim - 1))
        for column in (times, *columns)
    )


def angular_velocity_at(turns: TurnRates, times: Array, gap_s: float) -> tuple[Array, Array]:
    """(J, 3) rad/s at these times, averaged as the DVL's velocity is; nan where not known. And its variance (3,)."""
    stamps, rates, variance = turns
    if len(stamps) < 2:
        return np.full((len(times), 3), np.nan), np.zeros(3)
    reach = reach_at(spacing_at(stamps, times), LEAST_REACH_S, MOST_REACH_S)
    smooth = local_fit(stamps, rates, times, reach)
    after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    outside = (times < stamps[0]) | (times > stamps[-1]) | (stamps[after] - stamps[after - 1] > gap_s)
    value = smooth.value
    if not smooth.found.all():
        interpolated = np.column_stack([np.interp(times, stamps, column) for column in rates.T])
        value = np.where(smooth.found[:, None], value, interpolated)
    value[outside] = np.nan
    return value, variance * float(np.nanmean(smooth.value_gain)) if smooth.found.any() else np.zeros(3)


def _noise_of(times: Array, values: Array) -> Array:
    """Variance (c,) of white noise on samples at times (N,) s, by their second differences; zero for slow ones.

    A vehicle that rolls in waves has second differences of its own if it is looked at once a second.
    """
    if len(times) < 8 or median(np.diff(times)) > NOISE_FROM_S:
        return np.zeros(values.shape[1])
    bent: Array = median(np.diff(values, 2, axis=0) ** 2) / (6.0 * 0.455)  # 0.455: median of chi-square
    return bent


class InBody(NamedTuple):
    """Velocity (J, 3), noise (J, 3, 3) in the body frame, where that is known (J,), `Observations.earth_in_body`."""

    velocity: Array
    noise: Array
    known: Mask
    earth_in_body: Array


def in_body(reference: ReferenceColumns, imu: ImuColumns, gap_s: float) -> InBody:
    """References as in the body, by an attitude that is interpolated across gaps of this length (s) at most."""
    in_body = reference.in_body
    if in_body.all():
        n = len(in_body)
        return InBody(reference.velocity, reference.noise, np.ones(n, dtype=bool), np.zeros((n, 3, 2)))
    rotation, known = attitude_at(imu, reference.times, gap_s)
    body_from_enu = np.where(in_body[:, None, None], np.eye(3), rotation.swapaxes(1, 2))
    velocity = np.matmul(body_from_enu, reference.velocity[..., None])[..., 0]
    noise = body_from_enu @ reference.noise @ body_from_enu.swapaxes(1, 2)
    earth = body_from_enu[:, :, :2] * ~in_body[:, None, None]
    return InBody(velocity, noise, known | in_body, earth)


def attitude_at(imu: ImuColumns, times: Array, gap_s: float) -> tuple[Array, Mask]:
    """``rotation_enu_from_body`` (J, 3, 3) by spherical interpolation, and where that is possible (J,)."""
    given = ~np.isnan(imu.orientation[:, 0])
    every = bool(given.all())
    stamps, quaternions = (imu.times, imu.orientation) if every else (imu.times[given], imu.orientation[given])
    if len(stamps) < 2:
        return np.broadcast_to(np.eye(3), (len(times), 3, 3)), np.zeros(len(times), dtype=bool)
    after = np.minimum(np.maximum(np.searchsorted(stamps, times), 1), len(stamps) - 1)
    before = after - 1
    gap = stamps[after] - stamps[before]
    fraction = np.minimum(np.maximum((times - stamps[before]) / gap, 0.0), 1.0)
    a, b = quaternions.take(before, axis=0), quaternions.take(after, axis=0)
    dot = np.einsum("nq,nq->n", a, b)
    angle = np.arccos(np.minimum(np.abs(dot), 1.0))
    sine = np.sin(angle)
    small = sine < 1e-6  # the chord is exact then
    divisor = np.where(small, 1.0, sine)
    left = np.where(small, 1.0 - fraction, np.sin((1.0 - fraction) * angle) / divisor)
    right = np.where(small, fraction, np.sin(fraction * angle) / divisor) * np.where(dot < 0.0, -1.0, 1.0)
    mixed = left[:, None] * a + right[:, None] * b
    mixed /= np.sqrt(np.einsum("nq,nq->n", mixed, mixed))[:, None]
    known = (times >= stamps[0]) & (times <= stamps[-1]) & (gap <= gap_s)
    return rotation_from_quaternion(mixed), known
