"""Positions of satellites or acoustics in east, north, up, and velocities over a window.

Errors of successive positions are far more correlated than their covariance suggests, except for RTK, whose covariance
is realistic; so the claimed noise of velocities is never too small. The velocity belongs to the middle of the window.
In a turn at ω it is too small by (ω T)² / 24: 0.2 per cent at 12 degrees per second and a window of one second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from ..calibration.numerics.frames import Array, Vector

# WGS 84: semi-major axis (m) and first eccentricity squared
SEMI_MAJOR_M, ECCENTRICITY_SQUARED = 6_378_137.0, 6.694_379_990_141e-3
# two positions further apart than this number of windows are on two sides of an outage
LONGEST_WINDOWS = 3.0
# positions with a longer interval (s), such as a USBL's, are differenced between neighbours in previews
SELDOM_S = 3.0
# a receiver with more fixes per window is thinned to the window's ends
MOST_FIXES = 2000


class FixedVelocity(NamedTuple):
    """A velocity (m/s, ENU) at the middle of its window, with its covariance (3, 3) if the positions have one."""

    stamp_ns: int
    velocity: Vector
    covariance: Array | None


Place = tuple[float, float, float]


class PositionType(NamedTuple):
    """Properties of the positions of a type.

    between: two places -> vector from one to the other, m.
    has_height: whether the vertical is as accurate as the horizontal.
    """

    between: Callable[[Place, Place], Vector]
    has_height: bool


class _Fix(NamedTuple):
    stamp_ns: int
    place: Place
    covariance: Array | None


class FixDifference:
    """Differentiator of fixes in order of time.

    window_s: time between the differenced positions. between: as in `PositionType`, by default for latitude, longitude
    (degrees) and altitude (m).
    """

    def __init__(self, window_s: float = 1.0, between: Callable[[Place, Place], Vector] | None = None) -> None:
        self._window_ns = round(window_s * 1e9)
        self._between = between or east_north_up
        self._fixes: deque[_Fix] = deque(maxlen=MOST_FIXES)

    def __call__(self, stamp_ns: int, x: float, y: float, z: float, covariance: Array | None) -> FixedVelocity | None:
        """Return the velocity of the window that ends with this fix; None until there is a position one window earlier.

        x, y, z: position. covariance: (3, 3) m², None if not given.
        """
        fix = _Fix(stamp_ns, (x, y, z), covariance)
        fixes = self._fixes
        if fixes and stamp_ns <= fixes[-1].stamp_ns:
            fixes.clear()  # a clock set back, or a loop
        if not math.isfinite(x + y + z):
            return None
        fixes.append(fix)
        # find the latest fix one window old, with a tolerance of half the interval of a jittery receiver
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
        east, north, up = self._between(before.place, fix.place)
        noise = None
        if before.covariance is not None and fix.covariance is not None:
            noise = (before.covariance + fix.covariance) / seconds**2
        middle_ns = before.stamp_ns + passed_ns // 2
        return FixedVelocity(middle_ns, (east / seconds, north / seconds, up / seconds), noise)


def east_north_up(start: Place, end: Place) -> Vector:
    """Return the vector from one position to another nearby, m, on the tangent plane of the ellipsoid between them."""
    (start_deg, start_longitude_deg, start_m), (end_deg, end_longitude_deg, end_m) = start, end
    latitude = math.radians(0.5 * (start_deg + end_deg))
    height = 0.5 * (start_m + end_m)
    curved = 1.0 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    meridian = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / curved**1.5
    normal = SEMI_MAJOR_M / math.sqrt(curved)
    longitude_deg = math.remainder(end_longitude_deg - start_longitude_deg, 360.0)
    return (
        math.radians(longitude_deg) * (normal + height) * math.cos(latitude),
        math.radians(end_deg - start_deg) * (meridian + height),
        end_m - start_m,
    )


def straight(start: Place, end: Place) -> Vector:
    """Return the vector between two points of a plane map, m."""
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


SATELLITES = PositionType(between=east_north_up, has_height=False)
POSE = PositionType(between=straight, has_height=True)
