"""Slopes, and first-order recursions with varying decay, along time."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtbtrs

from ..calibration.numerics.frames import Array


def slopes(time: Array, values: Array) -> Array:
    """Return slopes (N, k) per s of values (N, k) at times (N,) s, N > 1, faster than `numpy.gradient`."""
    steps = np.diff(time)
    between = np.diff(values, axis=0)
    between /= steps[:, None]
    found: Array = np.empty_like(between, shape=values.shape)
    found[:-1], found[-1] = between, between[-1]
    found[1:-1] += (steps[1:] / (steps[1:] + steps[:-1]))[:, None] * (between[:-1] - between[1:])
    return found


def recursion(decay: Array, added: Array) -> Array:
    """Return x (N, ...) with x_n = decay_n x_(n-1) + added_n and x_0 = added_0.

    decay: (N,), the first is unused. added: (N, ...). It solves a triangular system with two bands.
    """
    if not added.size:
        return added.copy()
    bands = np.ones((2, len(added)))
    bands[1, :-1] = -decay[1:]
    solved, _ = dtbtrs(bands, added.reshape(len(added), -1), uplo="L", diag="U")
    return np.ascontiguousarray(solved).reshape(added.shape)
