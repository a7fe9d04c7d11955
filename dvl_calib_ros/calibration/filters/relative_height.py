"""Height since the last dropout, integrated from the DVL's vertical velocity, for the shear of a current."""

from __future__ import annotations

import math

import numpy as np

from ..numerics.frames import Array
from ..numerics.samples import Stamps

# Memory of the integral, s: a pitch error of 3 degrees adds 10 m at 2 m/s, which looks like a constant current.
MEMORY_S = 100.0
# Longest gap that is integrated, s.
LONGEST_STEP_S = 5.0


class RelativeHeight:
    """Integrator of the vertical velocity, per sample, independent of the block size."""

    def __init__(self) -> None:
        self._height = 0.0
        self._last_ns: int | None = None

    def add(self, stamps_ns: Stamps, rising: Array) -> Array:
        """Add vertical velocities (N,) m/s, positive up. Return heights (N,) m."""
        height, last_ns = self._height, self._last_ns
        heights = np.empty(len(rising))
        for row, (stamp_ns, speed) in enumerate(zip(stamps_ns.tolist(), rising.tolist(), strict=True)):
            step_s = 0.0 if last_ns is None else 1e-9 * (stamp_ns - last_ns)
            left = math.exp(-step_s / MEMORY_S)
            height *= left
            if step_s <= LONGEST_STEP_S:
                height += speed * MEMORY_S * (1.0 - left)
            heights[row] = height
            last_ns = stamp_ns
        self._height, self._last_ns = height, last_ns
        return heights

    def end_day(self) -> None:
        """Reset the height."""
        self._height, self._last_ns = 0.0, None
