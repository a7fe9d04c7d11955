"""Whether a vehicle heaves in waves, by its DVL alone: G1 and G2 then are too sure of roll.

They take heave to be nearly none, with `motion_std`. In waves sway and heave come from the same motion of the water, so
what is assumed to be noise goes with what shows the roll, and no scatter of blocks tells it from a roll that is there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .frames import Array

# Heave of so many times motion_std is not what G1 assumes. At three times (0.3 m of waves, 6 s) its 95 % interval of
# roll holds 92 %, at seven (1 m, 8 s) 80 %.
BEYOND_ASSUMED = 3.0
# Swell and wind sea have such periods, s; what is slower is a dive.
PERIODS_S = 2.0, 20.0
# Fewer samples, or heave about its line for a shorter time, s, say nothing.
ENOUGH_S, ENOUGH_SAMPLES = 60.0, 50


class HeaveWaves:
    """Sums over stretches of time: of the heave about a straight line, and of how often it crosses it."""

    def __init__(self, rotation_dvl_from_body: Array) -> None:
        self._heave_from_dvl = rotation_dvl_from_body[:, 2]
        self._seconds = self._square = 0.0
        self._samples = self._crossings = 0

    def add(self, times: Array, velocity: Array, noise: Array) -> None:
        """Add a stretch that is longer than a wave: times (N,) s, velocity (N, 3) m/s in the DVL's frame.

        noise: (3, 3) (m/s)² of the DVL, in its frame, which is no heave.
        """
        if len(times) < 6:
            return
        heave, since = velocity @ self._heave_from_dvl, times - times.mean()
        heave = heave - heave.mean()
        heave -= since * (since @ heave) / (since @ since)
        self._seconds += float(times[-1] - times[0])
        self._square += float(heave @ heave) - len(heave) * float(self._heave_from_dvl @ noise @ self._heave_from_dvl)
        self._samples += len(heave)
        self._crossings += int(np.count_nonzero(np.diff(np.signbit(heave))))

    def found(self, motion_std: float) -> Heave | None:
        """The heave, if it is that of waves and more than is assumed; else None. motion_std: m/s."""
        if self._seconds < ENOUGH_S or self._samples < ENOUGH_SAMPLES or not self._crossings or self._square <= 0.0:
            return None
        std, period = math.sqrt(self._square / self._samples), 2.0 * self._seconds / self._crossings
        in_waves = std > BEYOND_ASSUMED * motion_std and PERIODS_S[0] <= period <= PERIODS_S[1]
        return Heave(std, period) if in_waves else None


class Heave(NamedTuple):
    """std: m/s. period: mean time between crossings upwards, s."""

    std: float
    period: float
