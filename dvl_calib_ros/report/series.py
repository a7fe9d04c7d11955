"""Series of any length as a figure shows them."""

from __future__ import annotations

import numpy as np

from ..calibration.frames import Array

# Points of a line: more cannot be seen at this width
LINE_POINTS = 300
# Points over which a residual is averaged
AVERAGED_POINTS = 31


def thin(n: int) -> slice:
    """Every so many-th of n points, and so that the last one is among them."""
    step = max(1, -(-n // LINE_POINTS))
    return slice((n - 1) % step if n else 0, None, step)


def running_mean(t: Array, values: Array) -> tuple[Array, Array]:
    """Positions and mean of AVERAGED_POINTS neighbours; of fewer where there are not so many, nan across a gap."""
    width = min(AVERAGED_POINTS, len(values))
    window = np.ones(width) / width
    mean = np.convolve(values, window, "valid")
    duration = t[width - 1 :] - t[: len(t) - width + 1]
    mean[duration > 2.0 * np.median(duration)] = np.nan
    return np.convolve(t, window, "valid"), mean
