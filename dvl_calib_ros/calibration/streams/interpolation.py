"""Interpolation of streams: value and slope at any time, and the streams as columns.

Delayed streams are compared at times between their samples. Linear interpolation would bias the delay: its noise is
halved midway between samples, and it ignores curvature. Local regression (Cleveland, "Robust locally weighted
regression", 1979), a weighted quadratic through five or six samples, filters alike everywhere and has a slope.

Shapes: N samples, interpolated at J points of time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..numerics.frames import Array, rotation_from_quaternion, slerps
from ..numerics.robust import median, steps
from ..numerics.samples import Index, Mask

LONGEST_DELAY_S = 3.2
# Interval to which streams are averaged or sampled, s: same accuracy, bounded work. Samples at intervals above
# FASTER_THAN_S (s) are kept.
BIN_S = 0.1
FASTER_THAN_S = 0.07
# Longest gap between attitudes or rates that is interpolated, and between velocities that are integrated, s.
GAP_S = 2.0
# Smallest reach of the fit for value and slope, s. The slope needs more, because its noise biases the delay: 0.01 m/s
# at 5 Hz is 0.006 m/s² over 1 s, an eighth of the acceleration of a turning vehicle.
LEAST_REACH_S, LEAST_SLOPE_REACH_S = 0.6, 1.0
# Largest reach, s: DVL samples more than 1.3 s apart do not determine the velocity of a turning vehicle.
MOST_REACH_S = 3.4
# Margin around a block of references in which the other streams are needed, s.
MARGIN_S = 7.0


class DvlColumns(NamedTuple):
    """DVL times (N,) s and velocity (N, 3) m/s, DVL frame."""

    times: Array
    velocity: Array


class ReferenceColumns(NamedTuple):
    """Reference times (J,) s, velocity (J, 3) m/s and noise (J, 3, 3) (m/s)²; body frame where in_body (J,), else ENU.

    claimed: (J,) True if the noise is from the message and excludes the DVL, False if it includes the DVL.
    """

    times: Array
    velocity: Array
    noise: Array
    in_body: Mask
    claimed: Mask

    def part(self, at: Index) -> ReferenceColumns:
        """Return the rows at these indices."""
        return ReferenceColumns(self.times[at], self.velocity[at], self.noise[at], self.in_body[at], self.claimed[at])


class ImuColumns(NamedTuple):
    """IMU times (M,) s, orientation (M, 4) x, y, z, w enu from body, angular_velocity (M, 3) rad/s, body."""

    times: Array
    orientation: Array
    angular_velocity: Array


class TurnRates(NamedTuple):
    """Known angular velocity, averaged over bins: times (M,) s, rates (M, 3) rad/s, body."""

    times: Array
    rates: Array

    @staticmethod
    def of(imu: ImuColumns) -> TurnRates:
        """Return the turn rates of an IMU."""
        known = ~np.isnan(imu.angular_velocity).any(axis=1)
        return TurnRates(*binned(imu.times[known], imu.angular_velocity[known]))


def linear_at(times: Array, values: Array, at: Array) -> Array:
    """Interpolate values (N, k) at times (N,) linearly at other times (M,); at both ends they are constant."""
    return np.column_stack([np.interp(at, times, column) for column in values.T])


def shortened(pauses: Array, max_sum: float) -> Array:
    """Clip the longest pauses (N,), s, to a common length so that their sum is at most `max_sum`, s."""
    if pauses.sum() <= max_sum:
        return pauses
    ascending = np.sort(pauses)
    sum_before = np.cumsum(ascending) - ascending
    limits = (max_sum - sum_before) / np.arange(len(pauses), 0, -1)
    return np.minimum(pauses, limits[np.argmax(ascending > limits)])


def binned(times: Array, *columns: Array) -> tuple[Array, ...]:
    """Return means of times (N,) s and columns (N, ...) over non-empty bins of BIN_S.

    Columns with intervals of FASTER_THAN_S and more are returned unchanged.
    """
    if len(times) < 2 or median(steps(times)) >= FASTER_THAN_S:
        return times, *columns
    bins = np.floor(times / BIN_S)
    starts = np.append(0, np.flatnonzero(steps(bins)) + 1)
    count = steps(np.append(starts, len(times)))
    return tuple(
        np.add.reduceat(column, starts, axis=0) / count.reshape(-1, *[1] * (column.ndim - 1))
        for column in (times, *columns)
    )


def angular_velocity_at(turns: TurnRates, times: Array, gap_s: float) -> Array:
    """Return rates (J, 3) rad/s at these times, smoothed like the DVL velocity; nan where unknown."""
    stamps, rates = turns
    if len(stamps) < 2:
        return np.full((len(times), 3), np.nan)
    fit = local_fit(stamps, rates, times, reach_at(spacing_at(stamps, times), LEAST_REACH_S, MOST_REACH_S))
    after, before, outside = _neighbours(stamps, times)
    outside |= stamps[after] - stamps[before] > gap_s
    value = fit.value
    if not fit.found.all():
        gap = np.maximum(stamps[after] - stamps[before], 1e-12)
        share = np.clip((times - stamps[before]) / gap, 0.0, 1.0)[:, None]
        value = np.where(fit.found[:, None], value, rates[before] + (rates[after] - rates[before]) * share)
    value[outside] = np.nan
    return value


def _neighbours(stamps: Array, times: Array) -> tuple[Index, Index, Mask]:
    """Return indices of the samples after and before J times, and a mask (J,) of times outside. stamps: (N > 1,) s."""
    after = np.minimum(np.maximum(np.searchsorted(stamps, times), 1), len(stamps) - 1)
    return after, after - 1, (times < stamps[0]) | (times > stamps[-1])


class InBody(NamedTuple):
    """References in the body frame: velocity (J, 3), noise (J, 3, 3), mask known (J,), `Observations.earth_in_body`."""

    velocity: Array
    noise: Array
    known: Mask
    earth_in_body: Array


def in_body(reference: ReferenceColumns, rotation: Array, known: Mask) -> InBody:
    """Rotate references to the body by attitudes ``rotation_enu_from_body`` (J, 3, 3) where known (J,)."""
    is_in_body = reference.in_body
    if is_in_body.all():
        n = len(is_in_body)
        return InBody(reference.velocity, reference.noise, np.ones(n, dtype=bool), np.zeros((n, 3, 2)))
    body_from_reference = np.where(is_in_body[:, None, None], np.eye(3), rotation.swapaxes(1, 2))
    velocity = np.matmul(body_from_reference, reference.velocity[..., None])[..., 0]
    noise = body_from_reference @ reference.noise @ body_from_reference.swapaxes(1, 2)
    earth_in_body = body_from_reference[:, :, :2] * ~is_in_body[:, None, None]
    return InBody(velocity, noise, known | is_in_body, earth_in_body)


def attitude_at(imu: ImuColumns, times: Array, gap_s: float) -> tuple[Array, Mask]:
    """Return ``rotation_enu_from_body`` (J, 3, 3), and a validity mask (J,), see `quaternion_at`."""
    quaternion, known = quaternion_at(imu, times, gap_s)
    return rotation_from_quaternion(quaternion), known


def quaternion_at(imu: ImuColumns, times: Array, gap_s: float) -> tuple[Array, Mask]:
    """Return attitudes (J, 4) by spherical interpolation, and a validity mask (J,).

    gap_s: longest interpolated gap.
    """
    is_given = ~np.isnan(imu.orientation[:, 0])
    stamps, quaternions = imu.times, imu.orientation
    if not is_given.all():
        stamps, quaternions = stamps[is_given], quaternions[is_given]
    if len(stamps) < 2:
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)), np.zeros(len(times), dtype=bool)
    after, before, outside = _neighbours(stamps, times)
    gap = np.maximum(stamps[after] - stamps[before], 1e-12)
    fraction = np.minimum(np.maximum((times - stamps[before]) / gap, 0.0), 1.0)
    start, end = (np.asfortranarray(quaternions.take(index, axis=0)) for index in (before, after))
    return slerps(start, end, fraction), ~outside & (gap <= gap_s)


# Fewest samples on each side of a fit: with fewer it extrapolates.
ON_EACH_SIDE = 2
# Reach to each side, in sample intervals: five or six samples, whose weights vanish at the ends.
REACH_INTERVALS = 2.6


class LocalFit(NamedTuple):
    """Fit at M times: value (M, c), slope (M, c) per s, mask found (M,).

    slope_gain: (M,) variance of the slope for white noise of variance 1.
    """

    value: Array
    slope: Array
    slope_gain: Array
    found: NDArray[np.bool_]


def spacing_at(times: Array, at: Array) -> Array:
    """Return the mean interval of the six samples of times (N,) s around each time (...); nan near an end."""
    if len(times) < 6:
        return np.full(at.shape, np.nan)
    after = np.searchsorted(times, at)
    inside = (after >= 3) & (after + 2 < len(times))
    last, first = np.minimum(after + 2, len(times) - 1), np.maximum(after - 3, 0)
    return np.where(inside, (times[last] - times[first]) / 5.0, np.nan)


def reach_at(spacing: Array, least: float, most: float) -> Array:
    """Return the reach (s) of a fit for a sample spacing (s): at least `least`, nan beyond `most`."""
    reach = np.maximum(spacing * REACH_INTERVALS, least)
    return np.where(reach <= most, reach, np.nan)  # nan stays nan


def local_fit(times: Array, values: Array, at: Array, reach: Array) -> LocalFit:
    """Fit a quadratic to the samples within `reach` of each time, weighted by (1 - |u|³)³ with u = distance / reach.

    times: (N,) s, increasing.
    values: (N, c).
    at, reach: (M,) s, nan for no fit.
    """
    found = ~np.isnan(reach)
    if not found.any():
        no_fit = np.full((len(at), values.shape[1]), np.nan)
        return LocalFit(no_fit, no_fit, no_fit[:, 0], found)
    after = np.searchsorted(times, at)
    half_width = _most_within(times, float(np.nanmax(reach)))
    # window along the first axis, so that sums run over whole rows
    index = after + np.arange(-half_width, half_width)[:, None]
    exists = (index >= 0) & (index < len(times))
    index = np.clip(index, 0, len(times) - 1)
    u = (times.take(index) - at) / np.where(found, reach, 1.0)
    distance = np.abs(u)
    taper = 1.0 - distance * distance * distance
    weight = np.where(exists & (distance < 1.0), taper * taper * taper, 0.0)
    used = weight > 0.0
    n_before, n_after = (np.add.reduce(used & side, 0, dtype=np.intp) for side in (u <= 0.0, u >= 0.0))
    found &= np.minimum(n_before, n_after) >= ON_EACH_SIDE
    weight_u = weight * u
    weight_u2 = weight_u * u
    # normal equations of a + b u + c u², and the first two rows of their inverse by cofactors
    weight_u3 = weight_u2 * u
    s0, s1, s2, s3, s4 = (np.add.reduce(moment) for moment in (weight, weight_u, weight_u2, weight_u3, weight_u3 * u))
    c00, c01, c02 = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    c11, c12 = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    found &= determinant > 1e-12 * s0**3
    scale = 1.0 / np.where(found, determinant, 1.0)
    unit_s = np.where(found, reach, 1.0)
    value_weights = (c00 * scale) * weight + (c01 * scale) * weight_u + (c02 * scale) * weight_u2
    scale = scale / unit_s
    slope_weights = (c01 * scale) * weight + (c11 * scale) * weight_u + (c12 * scale) * weight_u2
    samples = values.take(index, axis=0)
    value, slope = np.einsum("wm,wmc->mc", value_weights, samples), np.einsum("wm,wmc->mc", slope_weights, samples)
    return LocalFit(value, slope, np.einsum("wm,wm->m", slope_weights, slope_weights), found)


def _most_within(times: Array, seconds: float) -> int:
    """Return the largest number of consecutive samples within a time, at least one.

    times: (N,) s, increasing.
    """

    def is_reached(n: int) -> bool:
        duration = times[n:] - times[:-n]
        return bool(((duration < seconds) & (duration >= 0.0)).any())

    low, high = 0, 1
    while is_reached(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if is_reached(middle) else (low, middle)
    return high
