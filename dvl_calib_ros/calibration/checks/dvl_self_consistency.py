"""Test of whether DVL messages are one DVL's measurements, without other sensors.

Measured velocities have noise on each axis, and each is nearest to the one before. Two DVLs on one topic, coarse
rounding, or axes that a driver fills with zeros leave residuals like noise, and a wrong mounting.
"""

from __future__ import annotations

import math

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..numerics.robust import FEWEST_VALUES, QUIETEST_MPS, median, steps

# Blocks needed.
MIN_BLOCKS = 6
# Two streams share a topic if squared changes over one sample exceed CHANGE_RATIO times those over two, plus
# CHANGE_MPS2, (m/s)², for motion. MIN_BLOCK_SHARE: share of the blocks in which they must.
CHANGE_RATIO, CHANGE_MPS2, MIN_BLOCK_SHARE = 6.0, 0.02**2, 0.6
# Rounding step, as a share of the speed, that changes the mounting by half a degree. Share of repeated values that
# shows it: noise does not average it out.
ROUNDED_FROM, REPEATED_FROM = 0.03, 0.4
_AXES = "xyz"


class DvlStream:
    """Sums over blocks of DVL velocities; constant memory."""

    def __init__(self) -> None:
        self._blocks = self._alternating = self._n = 0
        self._step = np.full(3, math.inf)  # smallest nonzero change, m/s
        self._repeated: Array = np.zeros(3)
        self._is_dead = np.ones(3, dtype=bool)
        self._square = self._noise = 0.0

    def add(self, velocity: Array) -> None:
        """Add a block of consecutive DVL velocities (N, 3) m/s."""
        if len(velocity) < FEWEST_VALUES:
            return
        change, change_of_two = steps(velocity), velocity[2:] - velocity[:-2]
        square_of_two, square_of_one = (float(median((step**2).sum(axis=1))) for step in (change_of_two, change))
        self._blocks += 1
        self._alternating += square_of_one > CHANGE_RATIO * square_of_two + CHANGE_MPS2
        self._n += len(change)
        magnitude = np.abs(change)
        self._repeated += (magnitude < 1e-6).sum(axis=0)
        self._step = np.minimum(self._step, np.where(magnitude < 1e-6, math.inf, magnitude).min(axis=0))
        self._is_dead &= (velocity == 0.0).all(axis=0)
        self._square += float((velocity**2).sum())
        self._noise = max(self._noise, math.sqrt(float(median(steps(steps(change)) ** 2).max()) / 20.0))

    def contradiction(self) -> Reason | None:
        """Return the reason if the data are not one DVL's measurements."""
        if self._blocks < MIN_BLOCKS:
            return None
        if self._alternating > MIN_BLOCK_SHARE * self._blocks:
            return finding("DVL_TWO_ON_TOPIC")
        rounded = np.where(self._repeated > REPEATED_FROM * self._n, self._step, 0.0)
        step = float(np.where(np.isfinite(rounded), rounded, 0.0).max())
        if step > ROUNDED_FROM * math.sqrt(self._square / self._n):
            return finding("DVL_ROUNDED", step=step)
        dead = [axis for axis, is_dead in zip(_AXES, self._is_dead, strict=True) if is_dead]
        if dead and len(dead) < 3 and self._noise > QUIETEST_MPS:
            return finding("DVL_AXIS_DEAD", axes=" and ".join(dead))
        return None
