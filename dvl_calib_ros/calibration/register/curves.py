"""Velocity and slope of the DVL, and turn rates, at any time: smoothed once, for all places of the clocks."""

from __future__ import annotations

from copy import copy

import numpy as np

from ..numerics.frames import Array
from ..numerics.robust import median
from ..numerics.samples import Index, Mask
from ..streams.interpolation import (
    LEAST_SLOPE_REACH_S,
    MOST_REACH_S,
    REACH_INTERVALS,
    angular_velocity_at,
    local_fit,
    reach_at,
    spacing_at,
)
from .motion import MotionStreams

# Curves are smoothed on a grid of this step, s, and of a long recording of so many times; of so many at once.
GRID_S, MOST_GRID, AT_ONCE = 0.1, 18_000, 1000
# Attitudes and rates further apart than this tell nothing between, s.
GAP_S = 2.0


# A left-handed driver's axes.
MIRRORED: Array = np.array([1.0, -1.0, 1.0])


class Curves:
    """Velocity and slope of the DVL, and turn rates, on a fine grid of time, each smoothed once for all places."""

    def __init__(self, motion: MotionStreams) -> None:
        """Of all streams of a motion."""
        times = motion.dvl.times
        length = float(times[-1] - times[0])
        self._step, self._start = max(GRID_S, length / MOST_GRID), float(times[0])
        self._grid = self._start + self._step * np.arange(int(length / self._step) + 2)
        typical = float(median(np.diff(times)))
        reach = reach_at(spacing_at(times, self._grid), LEAST_SLOPE_REACH_S, MOST_REACH_S)
        reach = np.clip(reach, LEAST_SLOPE_REACH_S, None)
        reach[np.isnan(reach)] = max(LEAST_SLOPE_REACH_S, min(REACH_INTERVALS * typical, MOST_REACH_S))
        fits = [local_fit(times, motion.dvl.velocity, self._grid[at], reach[at]) for at in _parts(len(self._grid))]
        self._velocity = np.concatenate([np.hstack([fit.value, fit.slope, fit.slope_gain[:, None]]) for fit in fits])
        self._found = np.concatenate([fit.found for fit in fits])
        self._turns, self._turns_start = np.zeros((2, 3)), 0.0
        if len(motion.turns.times) > 1:
            grid = np.arange(motion.turns.times[0], motion.turns.times[-1] + self._step, self._step)
            self._turns_start = float(grid[0])
            rates = [angular_velocity_at(motion.turns, grid[at], GAP_S)[0] for at in _parts(len(grid))]
            self._turns = np.nan_to_num(np.concatenate(rates))

    def mirrored(self) -> Curves:
        """The same of a DVL whose y points the other way."""
        made = copy(self)
        made._velocity = self._velocity * MIRRORED[[0, 1, 2, 0, 1, 2, 0]]
        return made

    def velocity(self, at: Array) -> tuple[Array, Array, Array, Mask]:
        """At times (J,) s: velocity (J, 3), slope (J, 3), noise gain of the slope (J,), and whether there is one."""
        before, share, inside = self._places(at, self._start, len(self._grid))
        both = _between(self._velocity, before, share)
        return both[:, :3], both[:, 3:6], both[:, 6], inside & self._found[before] & self._found[before + 1]

    def rates(self, at: Array) -> Array:
        """(J, 3) rad/s, zero where they are not known."""
        before, share, inside = self._places(at, self._turns_start, len(self._turns))
        return np.where(inside[:, None], _between(self._turns, before, share), 0.0)

    def _places(self, at: Array, start: float, n: int) -> tuple[Index, Array, Mask]:
        place = (at - start) / self._step
        before = np.clip(place, 0, n - 2).astype(np.intp)
        return before, (place - before)[:, None], (place >= 0.0) & (place <= n - 1)


def _parts(n: int) -> list[slice]:
    """N places in parts: windows about all of them at once would take more memory than a node should."""
    return [slice(first, first + AT_ONCE) for first in range(0, n, AT_ONCE)]


def _between(values: Array, before: Index, share: Array) -> Array:
    left = values.take(before, axis=0)
    found: Array = values.take(before + 1, axis=0)
    found -= left
    found *= share
    found += left
    return found
