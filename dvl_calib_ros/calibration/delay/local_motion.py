"""A stream's value and slope at any time, from a quadratic through the samples around it.

Two streams with a delay between them are compared at times at which neither has a sample. A straight line between
neighbours is a filter that depends on where between them the time lies: half as noisy in the middle as on a sample, and
blind to what curves. Delays would then be told apart by the interpolation, not by the vehicle. A quadratic through the
five or six samples around, weighted by their distance (local regression: Cleveland, "Robust locally weighted
regression", 1979), is the same filter everywhere, and has a slope.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..frames import Array

# Samples on each side that a fit needs: with fewer it extrapolates.
ON_EACH_SIDE = 2
# A fit reaches this far to each side, in intervals of the samples: five or six of them, so that none comes or goes
# with much weight.
REACH_INTERVALS = 2.6


class LocalFit(NamedTuple):
    """At every time (...): value (..., c), slope (..., c) per s, and whether there is one (...).

    value_gain, slope_gain: (...) variance of value and slope for samples with white noise of variance 1.
    """

    value: Array
    slope: Array
    value_gain: Array
    slope_gain: Array
    found: NDArray[np.bool_]


def spacing_at(times: Array, at: Array) -> Array:
    """Mean interval of the six samples of times (N,) s around each time (...); nan near an end."""
    if len(times) < 6:
        return np.full(at.shape, np.nan)
    after = np.searchsorted(times, at)
    inside = (after >= 3) & (after + 2 < len(times))
    last, first = np.minimum(after + 2, len(times) - 1), np.maximum(after - 3, 0)
    return np.where(inside, (times[last] - times[first]) / 5.0, np.nan)


def reach_at(spacing: Array, least: float, most: float) -> Array:
    """How far (s) a fit has to reach where samples are so far apart: at least `least`, nan beyond `most`."""
    reach = np.maximum(spacing * REACH_INTERVALS, least)
    return np.where(reach <= most, reach, np.nan)  # nan stays nan


def local_fit(times: Array, values: Array, at: Array, reach: Array) -> LocalFit:
    """Fit a quadratic to the samples within `reach` of each time, weighted by (1 - |u|³)³ with u = distance / reach.

    times: (N,) s, increasing. values: (N, c). at, reach: (...) s, nan for no fit.
    """
    found = ~np.isnan(reach)
    if not found.any():
        nothing = np.full((*at.shape, values.shape[1]), np.nan)
        return LocalFit(nothing, nothing, nothing[..., 0], nothing[..., 0], found)
    widest = float(np.nanmax(reach))
    around = int((np.searchsorted(times, times + widest) - np.arange(len(times))).max())
    index = np.searchsorted(times, at)[..., None] + np.arange(-around, around)
    there = (index >= 0) & (index < len(times))
    index = np.clip(index, 0, len(times) - 1)
    u = (times[index] - at[..., None]) / np.where(found, reach, 1.0)[..., None]
    near = np.abs(u)
    weight = np.where(there & (near < 1.0), (1.0 - near**3) ** 3, 0.0)
    used = weight > 0.0
    found &= ((used & (u <= 0.0)).sum(axis=-1) >= ON_EACH_SIDE) & ((used & (u >= 0.0)).sum(axis=-1) >= ON_EACH_SIDE)
    first = weight * u
    second = first * u
    # the normal equations of a + b u + c u² and, by cofactors, the first two rows of their inverse
    s0, s1, s2 = weight.sum(axis=-1), first.sum(axis=-1), second.sum(axis=-1)
    s3, s4 = (second * u).sum(axis=-1), (second * u * u).sum(axis=-1)
    c00, c01, c02 = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    c11, c12 = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    found &= determinant > 1e-12 * s0**3
    scale = 1.0 / np.where(found, determinant, 1.0)[..., None]
    for_value = (c00[..., None] * weight + c01[..., None] * first + c02[..., None] * second) * scale
    for_slope = (c01[..., None] * weight + c11[..., None] * first + c12[..., None] * second) * scale
    around_values = values[index]
    value = np.matmul(for_value[..., None, :], around_values)[..., 0, :]
    slope = np.matmul(for_slope[..., None, :], around_values)[..., 0, :]
    unit = np.where(found, reach, 1.0)
    gains = ((for_value**2).sum(axis=-1), (for_slope**2).sum(axis=-1) / unit**2)
    return LocalFit(value, slope / unit[..., None], *gains, found)
