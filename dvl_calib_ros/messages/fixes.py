"""Velocity from satellite positions alone: their difference over a window, in east, north, up.

A position's errors from one second to the next are far more alike than its covariance says, except of RTK, whose
covariance is honest: so the noise here is never claimed too small. The velocity is that of the middle of the window,
which in a turn at ω is short of the true one by (ω T)² / 24: 0.2 per cent at 12 degrees per second and a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..calibration.frames import Array, Vector

# WGS 84: semi-major axis (m) and first eccentricity squared
SEMI_MAJOR_M, ECCENTRICITY_SQUARED = 6_378_137.0, 6.694_379_990_141e-3
# Two positions further apart than so many windows are on two sides of an outage.
LONGEST_WINDOWS = 3.0
# A receiver above so many fixes per window is thinned by the window alone.
MOST_FIXES = 2000


class FixedVelocity(NamedTuple):
    """A velocity (m/s, ENU) at the middle of its window, with its covariance (3, 3) if the positions have one."""

    stamp_ns: int
    velocity: Vector
    covariance: Array | None


class _Fix(NamedTuple):
    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance: Array | None


class FixDifference:
    """Takes fixes in order of time and gives velocities. window_s: over which positions are differenced."""

    def __init__(self, window_s: float = 1.0) -> None:
        self._window_ns = round(window_s * 1e9)
        self._fixes: deque[_Fix] = deque(maxlen=MOST_FIXES)

    def __call__(
        self,
        stamp_ns: int,
        latitude_deg: float,
        longitude_deg: float,
        altitude_m: float,
        covariance: Sequence[float] | Array | None,
    ) -> FixedVelocity | None:
        """The velocity of the window that ends with this fix; None while there is no position a window before it.

        covariance: (9,) m², ENU, None where not given.
        """
        matrix = None if covariance is None else np.asarray(covariance, dtype=float).reshape(3, 3)
        fix = _Fix(stamp_ns, latitude_deg, longitude_deg, altitude_m, matrix)
        fixes = self._fixes
        if fixes and stamp_ns <= fixes[-1].stamp_ns:
            fixes.clear()  # a clock set back, or a loop
        if not math.isfinite(latitude_deg + longitude_deg + altitude_m):
            return None
        fixes.append(fix)
        # the latest that is a window old, give or take half the interval of a jittery receiver
        while len(fixes) > 2 and stamp_ns - fixes[1].stamp_ns >= 0.95 * self._window_ns:
            fixes.popleft()
        before = fixes[0]
        passed_ns = stamp_ns - before.stamp_ns
        if passed_ns > LONGEST_WINDOWS * self._window_ns:
            fixes.clear()
            fixes.append(fix)
            return None
        if passed_ns < 0.95 * self._window_ns:
            return None
        seconds = 1e-9 * passed_ns
        east, north, up = east_north_up(before, fix)
        noise = None
        if before.covariance is not None and fix.covariance is not None:
            noise = (before.covariance + fix.covariance) / seconds**2
        middle_ns = before.stamp_ns + passed_ns // 2
        return FixedVelocity(middle_ns, (east / seconds, north / seconds, up / seconds), noise)


def east_north_up(start: _Fix, end: _Fix) -> Vector:
    """From one position to another nearby, m, on the ellipsoid's tangent plane between them."""
    latitude = math.radians(0.5 * (start.latitude_deg + end.latitude_deg))
    height = 0.5 * (start.altitude_m + end.altitude_m)
    curved = 1.0 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    meridian = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / curved**1.5
    normal = SEMI_MAJOR_M / math.sqrt(curved)
    longitude_deg = math.remainder(end.longitude_deg - start.longitude_deg, 360.0)
    return (
        math.radians(longitude_deg) * (normal + height) * math.cos(latitude),
        math.radians(end.latitude_deg - start.latitude_deg) * (meridian + height),
        end.altitude_m - start.altitude_m,
    )
