"""Height since the last dropout, by the DVL's own vertical velocity: what a current changes with."""

from __future__ import annotations

import math

import numpy as np

from ..numerics.frames import Array
from ..numerics.samples import Stamps

# What was so long ago is forgotten, s: a pitch that is wrong by 3 degrees adds up to 10 m at 2 m/s, and stays there,
# where a model takes it for a part of its constant current.
MEMORY_S = 100.0
# Between samples further apart than this, s, nobody knows how far it rose or sank.
LONGEST_STEP_S = 5.0


class RelativeHeight:
    """Integrates the vertical velocity sample by sample, so that it does not matter in what blocks they come."""

    def __init__(self) -> None:
        self._height = 0.0
        self._last_ns: int | None = None

    def add(self, stamps_ns: Stamps, rising: Array) -> Array:
        """Heights (N,) m after further samples. rising: (N,) m/s, positive up."""
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
        """Forget all of it."""
        self._height, self._last_ns = 0.0, None
