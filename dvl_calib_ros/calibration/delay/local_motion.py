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

from ..numerics.frames import Array
from .parts import Near, places

# Samples on each side that a fit needs: with fewer it extrapolates.
ON_EACH_SIDE = 2
# A fit reaches this far to each side, in intervals of the samples: five or six of them, so that none comes or goes
# with much weight.
REACH_INTERVALS = 2.6


class LocalFit(NamedTuple):
    """At M times: value (M, c), slope (M, c) per s, and whether there is one (M,).

    value_gain, slope_gain: (M,) variance of value and slope for samples with white noise of variance 1.
    """

    value: Array
    slope: Array
    value_gain: Array
    slope_gain: Array
    found: NDArray[np.bool_]

    def part(self, at: slice) -> LocalFit:
        """Those at some of the times."""
        return LocalFit(self.value[at], self.slope[at], self.value_gain[at], self.slope_gain[at], self.found[at])


def spacing_at(times: Array, at: Array, place: Near | None = None) -> Array:
    """Mean interval of the six samples of times (N,) s around each time (...); nan near an end.

    place: of these times, where it is known, or where not all samples may be looked at.
    """
    if len(times) < 6:
        return np.full(at.shape, np.nan)
    after, begin, end = places(times, at) if place is None else place
    inside = (after - begin >= 3) & (after + 2 < end)
    last, first = np.minimum(after + 2, len(times) - 1), np.maximum(after - 3, 0)
    return np.where(inside, (times[last] - times[first]) / 5.0, np.nan)


def reach_at(spacing: Array, least: float, most: float) -> Array:
    """How far (s) a fit has to reach where samples are so far apart: at least `least`, nan beyond `most`."""
    reach = np.maximum(spacing * REACH_INTERVALS, least)
    return np.where(reach <= most, reach, np.nan)  # nan stays nan


def local_fit(times: Array, values: Array, at: Array, reach: Array, place: Near | None = None) -> LocalFit:
    """Fit a quadratic to the samples within `reach` of each time, weighted by (1 - |u|³)³ with u = distance / reach.

    times: (N,) s, increasing. values: (N, c). at, reach: (M,) s, nan for no fit. place: as for `spacing_at`.
    """
    found = ~np.isnan(reach)
    if not found.any():
        nothing = np.full((len(at), values.shape[1]), np.nan)
        return LocalFit(nothing, nothing, nothing[:, 0], nothing[:, 0], found)
    after, begin, end = places(times, at) if place is None else place
    around = _within(times, float(np.nanmax(reach)))
    # samples of a window first: sums over them are then those of whole rows
    index = after + np.arange(-around, around)[:, None]
    there = (index >= begin) & (index < end)
    index = np.clip(index, 0, len(times) - 1)
    u = (times.take(index) - at) / np.where(found, reach, 1.0)
    near = np.abs(u)
    falling = 1.0 - near * near * near
    weight = np.where(there & (near < 1.0), falling * falling * falling, 0.0)
    used = weight > 0.0
    before, after = used & (u <= 0.0), used & (u >= 0.0)
    found &= np.minimum(np.add.reduce(before, 0, dtype=np.intp), np.add.reduce(after, 0, dtype=np.intp)) >= ON_EACH_SIDE
    first = weight * u
    second = first * u
    # the normal equations of a + b u + c u² and, by cofactors, the first two rows of their inverse
    third = second * u
    s0, s1, s2, s3, s4 = (np.add.reduce(each) for each in (weight, first, second, third, third * u))
    c00, c01, c02 = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    c11, c12 = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    found &= determinant > 1e-12 * s0**3
    scale = 1.0 / np.where(found, determinant, 1.0)
    unit = np.where(found, reach, 1.0)
    for_value = (c00 * scale) * weight + (c01 * scale) * first + (c02 * scale) * second
    scale = scale / unit
    for_slope = (c01 * scale) * weight + (c11 * scale) * first + (c12 * scale) * second
    near_by = values.take(index, axis=0)
    value, slope = np.einsum("wm,wmc->mc", for_value, near_by), np.einsum("wm,wmc->mc", for_slope, near_by)
    value_gain, slope_gain = (np.einsum("wm,wm->m", each, each) for each in (for_value, for_slope))
    return LocalFit(value, slope, value_gain, slope_gain, found)


def _within(times: Array, seconds: float) -> int:
    """How many samples follow each other within so many seconds at most, and no fewer than one.

    times: (N,) s, which increase but where another block begins.
    """

    def some(n: int) -> bool:
        apart = times[n:] - times[:-n]
        return bool(((apart < seconds) & (apart >= 0.0)).any())

    low, high = 0, 1
    while some(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if some(middle) else (low, middle)
    return high
