"""Whether a DVL's messages are what one DVL measures, by themselves: no other sensor is asked.

A measured velocity has noise along each axis, finer than a mounting is wanted, and each sample is nearest to the one
before. Two instruments on one topic, velocities rounded to a decimetre per second and axes that a driver fills with
zeros give residuals that look like noise, and a mounting that is that of none.
"""

from __future__ import annotations

import math

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..numerics.robust import median, steps

# Blocks of so many samples are looked at; so many of them tell anything.
FEWEST, ENOUGH = 12, 6
# Two streams are one if a sample is so many times further from the one before than from the one before that (squares),
# by more than a vehicle moves meanwhile, (m/s)², in so large a share of the blocks.
FURTHER, FURTHER_MPS2, MOST = 6.0, 0.02**2, 0.6
# Rounding to this share of the speed turns a mounting by half a degree, unless noise moves most to another step.
ROUNDED_FROM, REPEATED_FROM = 0.03, 0.4
# An axis without any velocity, where another one has noise of so much, m/s.
NOISE_MPS = 1e-3
_AXES = "xyz"


class DvlStream:
    """Sums over blocks of a DVL's velocities; constant memory."""

    def __init__(self) -> None:
        self._blocks = self._alternating = self._n = 0
        self._step = np.full(3, math.inf)  # the smallest that is no repetition, m/s
        self._repeated: Array = np.zeros(3)
        self._is_dead = np.ones(3, dtype=bool)
        self._square = self._noise = 0.0

    def add(self, velocity: Array) -> None:
        """Take a block of a DVL's velocities (N, 3) m/s, in order, none left out."""
        if len(velocity) < FEWEST:
            return
        one, two = steps(velocity), velocity[2:] - velocity[:-2]
        near, far = (float(median((each**2).sum(axis=1))) for each in (two, one))
        self._blocks += 1
        self._alternating += far > FURTHER * near + FURTHER_MPS2
        self._n += len(one)
        size = np.abs(one)
        self._repeated += (size < 1e-6).sum(axis=0)
        self._step = np.minimum(self._step, np.where(size < 1e-6, math.inf, size).min(axis=0))
        self._is_dead &= (velocity == 0.0).all(axis=0)
        self._square += float((velocity**2).sum())
        self._noise = max(self._noise, math.sqrt(float(median(steps(steps(one)) ** 2).max()) / 20.0))

    def contradiction(self) -> Reason | None:
        """What the data fit, where they are not what one DVL measures."""
        if self._blocks < ENOUGH:
            return None
        if self._alternating > MOST * self._blocks:
            return finding("DVL_TWO_ON_TOPIC")
        rounded = np.where(self._repeated > REPEATED_FROM * self._n, self._step, 0.0)
        step = float(np.where(np.isfinite(rounded), rounded, 0.0).max())
        if step > ROUNDED_FROM * math.sqrt(self._square / self._n):
            return finding("DVL_ROUNDED", step=step)
        dead = [axis for axis, is_dead in zip(_AXES, self._is_dead, strict=True) if is_dead]
        if dead and len(dead) < 3 and self._noise > NOISE_MPS:
            return finding("DVL_AXIS_DEAD", axes=" and ".join(dead))
        return None
