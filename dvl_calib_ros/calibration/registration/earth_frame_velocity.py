"""Whether the direction of a velocity turns with the heading, as that of one in the earth's frame does.

A vehicle goes much the same way in its own axes whatever its heading. Velocities that a driver has turned into the
earth's frame agree with a reference there, as if both were in the body: only the heading tells, and no residual.
"""

from __future__ import annotations

import math

import numpy as np

from ..numerics.frames import Array

# So many samples, and a speed (m/s), tell a direction.
ENOUGH, SLOW = 60, 0.2
# Mean resultant lengths: of directions that are one, and of headings that are several (some 25° about their mean).
ONE, SEVERAL = 0.9, 0.9
# Directions are the earth's if their spread is this much smaller in the earth.
CLEARLY = 0.25


class Directions:
    """Sums of horizontal directions, unit complex numbers; constant memory."""

    def __init__(self) -> None:
        self._n = 0
        self._body = self._enu = self._ned = self._heading = 0.0 + 0.0j

    def add(self, velocity: Array, rotation_enu_from_body: Array) -> None:
        """Take velocities (N, 3) m/s, said to be in the body, and the attitudes (N, 3, 3) at their times."""
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
        """Whether the velocities look like the earth's, ENU or NED.

        Over one heading a vehicle that yaws in waves, and goes straight on, looks like NED.
        """
        of_body, of_enu, of_ned = (1.0 - self._length(each) for each in (self._body, self._enu, self._ned))
        if of_enu < 1.0 - ONE and of_enu < CLEARLY * of_body:
            return True
        return self._headings_are_several and of_ned < 1.0 - ONE and of_ned < CLEARLY * of_body

    @property
    def stay_in_the_body(self) -> bool:
        """Whether several headings show that the velocities do not turn with them."""
        return self._headings_are_several and self._length(self._body) > ONE

    @property
    def _headings_are_several(self) -> bool:
        return self._length(self._heading) < SEVERAL
