"""Detection of velocities in an earth frame: their direction rotates with the heading.

In its own axes a vehicle moves in much the same direction on every heading. DVL velocities that a driver rotated into
the earth frame agree with an earth-frame reference without residual, so only the heading reveals them.
"""

from __future__ import annotations

import math

import numpy as np

from ..numerics.frames import Array

# Fewest samples, and lowest speed (m/s), that determine a direction.
ENOUGH, SLOW = 60, 0.2
# Mean resultant lengths: above ONE directions agree; below SEVERAL headings differ (25° about their mean).
ONE, SEVERAL = 0.9, 0.9
# Largest ratio of the spread in the earth frame to the spread in the body frame for earth-frame velocities.
CLEARLY = 0.25


class Directions:
    """Sums of horizontal directions as unit complex numbers, in constant memory."""

    def __init__(self) -> None:
        self._n = 0
        self._body = self._enu = self._ned = self._heading = 0.0 + 0.0j

    def add(self, velocity: Array, rotation_enu_from_body: Array) -> None:
        """Add velocities (N, 3) m/s, nominally in the body frame, and their attitudes (N, 3, 3)."""
        along = velocity[:, 0] + 1j * velocity[:, 1]
        ahead = rotation_enu_from_body[:, 0, 0] + 1j * rotation_enu_from_body[:, 1, 0]
        use = (np.abs(along) > SLOW) & (np.abs(ahead) > 0.5)
        along, ahead = along[use] / np.abs(along[use]), ahead[use] / np.abs(ahead[use])
        self._n += len(along)
        self._body += complex(along.sum())
        self._enu += complex((along * ahead.conj()).sum())
        self._ned += complex((along * ahead).sum())
        self._heading += complex(ahead.sum())

    def _length(self, total: complex) -> float:
        return abs(total) / self._n if self._n >= ENOUGH else math.nan

    @property
    def turn_with_heading(self) -> bool:
        """True if the velocities are in an earth frame, ENU or NED.

        NED needs several headings: a vehicle that yaws in waves on a straight course looks like NED.
        """
        of_body, of_enu, of_ned = (1.0 - self._length(each) for each in (self._body, self._enu, self._ned))
        if of_enu < 1.0 - ONE and of_enu < CLEARLY * of_body:
            return True
        return self._headings_are_several and of_ned < 1.0 - ONE and of_ned < CLEARLY * of_body

    @property
    def stay_in_the_body(self) -> bool:
        """True if the velocity direction is constant in the body over several headings."""
        return self._headings_are_several and self._length(self._body) > ONE

    @property
    def _headings_are_several(self) -> bool:
        return self._length(self._heading) < SEVERAL
