"""A spread that outliers do not change, without SciPy, whose import takes longer than a short recording does."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from .frames import Array

# Median of a normal variable's distance from its median, in standard deviations.
_MEDIAN_DISTANCE = NormalDist().inv_cdf(0.75)


def robust_std(values: Array) -> Array:
    """(...) standard deviation of normal values (N, ...), by the median distance from the median; nan of none."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    return np.asarray(np.median(np.abs(values - np.median(values, axis=0)), axis=0) / _MEDIAN_DISTANCE)
