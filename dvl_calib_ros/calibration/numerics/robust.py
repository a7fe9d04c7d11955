"""A spread that outliers do not change, without SciPy, whose import takes longer than a short recording does."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from .frames import Array

# Median of a normal variable's distance from its median, in standard deviations.
_MEDIAN_DISTANCE = NormalDist().inv_cdf(0.75)


def median(values: Array) -> Array:
    """(...) of finite values (N, ...), N > 0: `numpy.median` without its checks, which cost more than a few values."""
    ordered = np.sort(values, axis=0)
    return np.asarray(0.5 * (ordered[(len(values) - 1) // 2] + ordered[len(values) // 2]))


def steps(values: Array) -> Array:
    """(N - 1, ...) from each of (N, ...) to the next: `numpy.diff` without what it asks first, as of `median`."""
    return np.asarray(values[1:] - values[:-1])


def robust_std(values: Array) -> Array:
    """(...) standard deviation of normal values (N, ...), by the median distance from the median; nan of none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    return median(np.abs(values - median(values))) / _MEDIAN_DISTANCE
