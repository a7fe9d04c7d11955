"""Separability of current and misalignment by the headings so far, for models with attitude and no reference.

Sway is u φ_z + (Rᵀc)_y, with speed u ahead and a current c that rotates with the heading. The covariance of least
squares on (φ_z, c) shows whether several headings separate the two. The prior current is ten times the expected one, so
that headings decide and not the prior.

The trim is tested, too: a model without attitude takes the body heave of a trimmed vehicle at constant depth for pitch.
"""

from __future__ import annotations

import numpy as np

from ..models.base import Observations
from ..models.own import UPRIGHT
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.samples import Mask, Stamps
from ..streams.stream_order import LONG_AGO_NS

# Interval of the test, ns, by stamps, so that it does not depend on the block size.
EVERY_NS = 10_000_000_000
# Prior current as a multiple of `current_std`, so that headings decide and not the prior.
STRONGER = 10.0
# The angle is observable once its σ is below this share of the prior, as in observability.py.
SHOWN_SHARE = 0.5
# A vehicle is trimmed from this mean level-path heave, in prior σ, over this many intervals.
TRIMMED_FROM, TRIMMED_PERIODS = 2.0, 6
# σ of the sway in turns, s: m/s per (rad/s of turn times m/s of speed).
TURN_SWAY_STD_S = 1.0


class Headings:
    """Sums over samples with attitude. shown: the current, or the trim, is observable. trimmed: the trim is."""

    def __init__(self, parameters: Parameters) -> None:
        angle, current = parameters.initial_std_misalignment, STRONGER * parameters.current_std
        self._prior_std, self._current_std = angle, current
        self._information = np.diag([angle**-2, current**-2, current**-2])
        self._motion_std = parameters.motion_std
        self._least_heave = TRIMMED_FROM * parameters.heave_offset_std
        self._heave, self._periods, self._n = 0.0, 0, 0
        self.shown = self.trimmed = False
        self._next_ns = LONG_AGO_NS  # stamp of the next test

    def waits_for(self, stamp_ns: int) -> bool:
        """Return whether a row with this stamp triggers a test of the samples before it."""
        return stamp_ns >= self._next_ns

    def add(self, stamps_ns: Stamps, oriented: Mask, seen: Observations | None) -> int | None:
        """Add decided rows (N,), of which M are oriented (N,) and have observations `seen` (M), None if none.

        Return the stamp of the row at which the current, or the trim, first becomes observable; else None.
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
        """Keep the information on the angle for the next recording, and reset the current."""
        angle_std = np.sqrt(np.linalg.inv(self._information)[0, 0])
        self._information = np.diag([angle_std**-2, self._current_std**-2, self._current_std**-2])

    def _told(self, seen: Observations) -> Array:
        """Return the information (M, 3, 3) on φ_z (rad) and the current east and north (m/s)."""
        rotation, rates, ahead = seen.rotation_enu_from_body, seen.angular_velocity, seen.velocity_in_body[:, 0]
        assert rotation is not None and rates is not None
        h = np.column_stack([ahead, rotation[:, 0, 1], rotation[:, 1, 1]])
        variance = self._motion_std**2 + (TURN_SWAY_STD_S * rates[:, 2] * ahead) ** 2
        told: Array = h[:, :, None] * h[:, None, :] * (seen.motion_weight / variance)[:, None, None]
        return told

    def _level_heave(self, seen: Observations) -> Array:
        """Return the body heave (M,) m/s of a vehicle at constant depth with its pitch."""
        assert seen.rotation_enu_from_body is not None
        up = seen.rotation_enu_from_body[:, 2]
        upright, ahead = np.abs(up[:, 2]) > UPRIGHT, seen.velocity_in_body[:, 0]
        heave: Array = np.where(upright, -up[:, 0] * ahead / np.where(upright, up[:, 2], 1.0), 0.0)
        return heave
