"""Whether the headings so far tell a current from a misalignment, for a model that needs attitude and no reference.

Sway over ground is that of a misalignment, u φ_z with speed u ahead, plus that of a current c, which turns with the
heading: (Rᵀc)_y. On one heading the two are the same to the data; over several, least squares on (φ_z, c) alone says
by its covariance whether they come apart. It is A1's without all else that A1 estimates, and with a current ten times
as strong as expected, so that no prior stands in for a heading.

And whether the vehicle is trimmed: a model without attitude takes the heave in the body of one that holds its depth
with its bow up for none, and makes a pitch of it.
"""

from __future__ import annotations

import numpy as np

from ..models.base import Observations
from ..models.own import UPRIGHT
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.samples import Mask, Stamps
from ..streams.stream_order import LONG_AGO_NS

# Judged once in so long, by stamps: whoever feeds samples in blocks comes to the same answer.
EVERY_NS = 10_000_000_000
# Of what is expected of a current, so that it is headings and not the prior that show the mounting.
STRONGER = 10.0
# The angle is told from the current once its σ is below this share of the prior's, as for what is observed.
SHOWN_SHARE = 0.5
# So much mean heave of a level path, of its prior, over so many periods, is a trim.
TRIMMED_FROM, TRIMMED_PERIODS = 2.0, 6
# Sway that a turn leaves, s: m/s per (rad/s of turn times m/s of speed); a turning sample says little of a current.
TURN_SWAY_STD_S = 1.0


class Headings:
    """Sums over samples with attitude."""

    def __init__(self, parameters: Parameters) -> None:
        angle, current = parameters.initial_std_misalignment, STRONGER * parameters.current_std
        self._prior_std, self._current_std = angle, current
        self._information = np.diag([angle**-2, current**-2, current**-2])
        self._motion_std = parameters.motion_std
        self._least_heave = TRIMMED_FROM * parameters.heave_offset_std
        self._heave, self._periods, self._n = 0.0, 0, 0
        self.shown = self.trimmed = False
        self._next_ns = LONG_AGO_NS  # from here on they are judged again

    def waits_for(self, stamp_ns: int) -> bool:
        """Whether a row of this stamp is one at which the samples before it are to be judged."""
        return stamp_ns >= self._next_ns

    def add(self, stamps_ns: Stamps, oriented: Mask, seen: Observations | None) -> int | None:
        """Take rows that are decided (N,), of which M are oriented (N,) and are those of `seen` (M), None if none.

        Returns the stamp of the row by which the current, or the trim, was shown, the first time; else None.
        """
        if self.shown:
            return None
        part, heave = np.zeros((len(stamps_ns), 3, 3)), np.zeros(len(stamps_ns))
        if seen is not None:
            part[oriented], heave[oriented] = self._told(seen), self._level_heave(seen)
        periods = stamps_ns // EVERY_NS
        starts = [0, *(np.flatnonzero(np.diff(periods)) + 1).tolist()]
        for start, end in zip(starts, [*starts[1:], len(stamps_ns)], strict=True):
            stamp_ns = int(stamps_ns[start])
            if stamp_ns >= self._next_ns:
                self._next_ns = (stamp_ns // EVERY_NS + 1) * EVERY_NS
                self._periods += self._n > 0
                told = np.sqrt(np.linalg.inv(self._information)[0, 0]) < SHOWN_SHARE * self._prior_std
                self.trimmed = self._periods >= TRIMMED_PERIODS and abs(self._heave) > self._least_heave * self._n
                if told or self.trimmed:
                    self.shown = True
                    return stamp_ns
            self._information = self._information + part[start:end].sum(axis=0)
            self._heave += float(heave[start:end].sum())
            self._n += int(np.count_nonzero(oriented[start:end]))
        return None

    def end_day(self) -> None:
        """Go on with what is known of the angle; the current is another one."""
        angle_std = np.sqrt(np.linalg.inv(self._information)[0, 0])
        self._information = np.diag([angle_std**-2, self._current_std**-2, self._current_std**-2])

    def _told(self, seen: Observations) -> Array:
        """Information (M, 3, 3) on φ_z (rad) and the current east and north (m/s)."""
        rotation, rates, ahead = seen.rotation_enu_from_body, seen.angular_velocity, seen.velocity_in_body[:, 0]
        assert rotation is not None and rates is not None
        h = np.column_stack([ahead, rotation[:, 0, 1], rotation[:, 1, 1]])
        variance = self._motion_std**2 + (TURN_SWAY_STD_S * rates[:, 2] * ahead) ** 2
        told: Array = h[:, :, None] * h[:, None, :] * (seen.motion_weight / variance)[:, None, None]
        return told

    def _level_heave(self, seen: Observations) -> Array:
        """Heave in the body (M,) m/s of a vehicle that holds its depth with the pitch that it has."""
        assert seen.rotation_enu_from_body is not None
        up = seen.rotation_enu_from_body[:, 2]
        upright, ahead = np.abs(up[:, 2]) > UPRIGHT, seen.velocity_in_body[:, 0]
        heave: Array = np.where(upright, -up[:, 0] * ahead / np.where(upright, up[:, 2], 1.0), 0.0)
        return heave
