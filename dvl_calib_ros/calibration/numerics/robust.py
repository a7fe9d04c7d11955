"""Robust median and standard deviation without SciPy, whose import takes longer than a short recording."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from .frames import Array

# Median absolute deviation of a normal variable, in standard deviations.
MEDIAN_DISTANCE = NormalDist().inv_cdf(0.75)
MEDIAN_SQUARE = MEDIAN_DISTANCE**2
# Noise below this is rounding, and the smallest noise of a real instrument, m/s.
ROUNDING_MPS, QUIETEST_MPS = 1e-4, 1e-3
# Fewest independent values (stretches, fixes, slow samples) of a scatter: σ from 12 values is known to a fifth.
FEWEST_VALUES = 12
# Passes of a robust fit, each with the weights or outliers of the last one.
ROBUST_PASSES = 3
# Fewest samples of one motion, which are partly correlated: of a fit or of a share, and of a direction or a rate.
FEWEST_SAMPLES, FEWEST_OF_MOTION = 20, 60


def median(values: Array) -> Array:
    """Return the median (...) of finite values (N, ...), N > 0; faster than `numpy.median`, without its checks."""
    lower, upper = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (lower, upper), axis=0)
    return np.asarray(0.5 * (ordered[lower] + ordered[upper]))


def steps(values: Array) -> Array:
    """Return the differences (N - 1, ...) of values (N, ...); faster than `numpy.diff`, without its checks."""
    return np.asarray(values[1:] - values[:-1])


def robust_std(values: Array) -> Array:
    """Return the standard deviation (...) of normal values (N, ...) by the median absolute deviation; nan for none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    return median(np.abs(values - median(values))) / MEDIAN_DISTANCE
