"""Series of any length as a figure shows them."""

from __future__ import annotations

import numpy as np

from ..calibration.frames import Array

# Points of a line: more cannot be seen at this width
LINE_POINTS = 600


def thin(n: int) -> slice:
    """Every so many-th of n points, and so that the last one is among them."""
    step = max(1, -(-n // LINE_POINTS))
    return slice((n - 1) % step if n else 0, None, step)


def running_mean(t: Array, values: Array, points: int = 31) -> tuple[Array, Array]:
    """Positions and mean of so many neighbours; of fewer where there are not enough, nan across a gap."""
    width = max(1, min(points, len(values) // 5))
    window = np.ones(width) / width
    mean = np.convolve(values, window, "valid")
    duration = t[width - 1 :] - t[: len(t) - width + 1]
    mean[duration > 2.0 * np.median(duration)] = np.nan
    return np.convolve(t, window, "valid"), mean
