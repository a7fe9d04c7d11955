"""Dead reckoning at the times of position fixes, linear in what is to be found of the DVL.

The way between two times is ∫ R M v dt, with R the attitude (ENU from body), v the DVL's velocity and M the matrix that
corrects it. It is linear in M, whatever the angles are: so W = ∫ R ⊗ v dt is summed up once, and serves any M.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..filters.heading_bias import N_HEADING
from ..numerics.frames import Array, rotation_from_quaternion
from ..numerics.samples import Index, Stamps

# No vehicle is so far from where it began, m.
FARTHEST_M = 1e6
# Between DVL samples that are further apart, s, the way is not known.
LONGEST_STEP_S = 3.0
# So much later than the DVL's samples of its time, s, a fix may come at least.
LATEST_FIX_S = 60.0
# Fixes that come faster say no more: their errors are alike.
SHORTEST_FIX_NS = 950_000_000


class Fixes(NamedTuple):
    """N positions in order of stamps.

    stamps_ns (N,). position (N, 3): east, north, up, m, from any origin. variance (N, 3) m², nan where not given.
    """

    stamps_ns: Stamps
    position: Array
    variance: Array

    @staticmethod
    def none() -> Fixes:
        """No fix."""
        return Fixes(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    def part(self, at: slice | Index) -> Fixes:
        """The rows of a slice or of indices."""
        columns: list[Any] = [column[at] for column in self]
        return Fixes(*columns)

    def joined(self, others: Fixes) -> Fixes:
        """These and then others."""
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self, others, strict=True)]
        return Fixes(*columns)


class Legs(NamedTuple):
    """N fixes, and the way to each since its stretch began, in which the DVL had no gap.

    seconds (N,) since the first DVL sample. stretch (N,): number of it. way (N, 3, 3, 3): W, of axes of ENU, body and
    DVL, m. drifted (N, 3, 5): by what the way turns with the coefficients of the heading's deviation as `HeadingStates`
    has them, of time per second, m/rad. rotation (N, 3, 3): ENU from body. position, variance (N, 3): of the fixes.
    velocity (N, 3) m/s in ENU, as mounted.
    """

    seconds: Array
    stretch: Index
    way: Array
    drifted: Array
    rotation: Array
    velocity: Array
    position: Array
    variance: Array

    def part(self, at: slice | Index) -> Legs:
        """The rows of a slice or of indices."""
        columns: list[Any] = [column[at] for column in self]
        return Legs(*columns)


# Columns of what is summed up: way, and what a deviation of the heading turns it by.
N_SUMS = 27 + 3 * N_HEADING
_WAY, _DRIFTED = slice(0, 27), slice(27, N_SUMS)


class _Passed(NamedTuple):
    """DVL samples since the last fix that is done. sums: up to each; rates: of them, per second."""

    seconds: Array
    stretch: Index
    sums: Array
    rates: Array
    quaternion: Array


_NO_ROWS = _Passed(
    np.zeros(0), np.zeros(0, dtype=np.intp), np.zeros((0, N_SUMS)), np.zeros((0, N_SUMS)), np.zeros((0, 4))
)


class DeadReckoning:
    """Sums up the way as DVL samples come, and says where fixes found it."""

    def __init__(self, rotation_dvl_from_body: Array, latest_fix_s: float = 0.0) -> None:
        """latest_fix_s: so much later than the DVL's samples of its time a fix may come."""
        self._latest_s = max(LATEST_FIX_S, latest_fix_s)
        self._body_from_dvl = rotation_dvl_from_body.T
        self._epoch_ns: int | None = None
        self._stretch = 0
        self._rows: _Passed = _NO_ROWS
        self._new: list[tuple[Stamps, Array, Array]] = []
        self._waiting = Fixes.none()
        self._done: list[Legs] = []
        self._newest_fix_ns = -(2**62)

    def add_fixes(self, fixes: Fixes) -> None:
        """Take fixes; those out of order are left out, and of faster ones so many as say something."""
        kept = []
        sound = np.asarray((np.abs(fixes.position[:, :2]) < FARTHEST_M).all(axis=1))
        for row, stamp_ns in enumerate(fixes.stamps_ns.tolist()):
            if sound[row] and stamp_ns >= self._newest_fix_ns + SHORTEST_FIX_NS:
                self._newest_fix_ns = stamp_ns
                kept.append(row)
        if kept:
            self._waiting = self._waiting.joined(fixes.part(np.array(kept)))

    def add_rows(self, stamps_ns: Stamps, velocity_dvl: Array, quaternion: Array) -> None:
        """Take DVL samples that follow those before: velocity (N, 3) m/s, its axes; quaternion (N, 4) ENU from body."""
        known = np.isfinite(velocity_dvl).all(axis=1) & np.isfinite(quaternion).all(axis=1)
        if not known.any():
            return
        self._new.append((stamps_ns[known], velocity_dvl[known], quaternion[known]))

    def _sum_up(self) -> None:
        """Take what is new into the sums."""
        if not self._new:
            return
        stamps_ns, velocity_dvl, quaternion = (np.concatenate(column) for column in zip(*self._new, strict=True))
        self._new = []
        if self._epoch_ns is None:
            self._epoch_ns = int(stamps_ns[0])
        seconds = 1e-9 * (stamps_ns - self._epoch_ns)
        rates = self._rates(seconds, velocity_dvl, quaternion)
        before_s, _, before_sum, before_rate, _ = self._rows
        if not len(before_s):  # the first of all
            before_s, before_rate, before_sum = seconds[:1], rates[:1], np.zeros((1, N_SUMS))
        step = np.diff(np.concatenate([before_s[-1:], seconds]))
        breaks = step > LONGEST_STEP_S
        rate_before = np.concatenate([before_rate[-1:], rates[:-1]])
        moved = np.where(breaks[:, None], 0.0, 0.5 * step[:, None] * (rate_before + rates))
        sums = before_sum[-1] + np.cumsum(moved, axis=0)
        stretch = self._stretch + np.cumsum(breaks)
        self._stretch = int(stretch[-1])
        new = (seconds, stretch, sums, rates, quaternion)
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self._rows, new, strict=True)]
        self._rows = _Passed(*columns)

    def _rates(self, seconds: Array, velocity: Array, quaternion: Array) -> Array:
        """What is summed up, per second (N, 42)."""
        rotation = rotation_from_quaternion(quaternion)
        n = len(seconds)
        way = rotation[:, :, :, None] * velocity[:, None, None, :]
        east, north, _ = (rotation @ (velocity @ self._body_from_dvl.T)[..., None])[..., 0].T
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        terms = np.column_stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw), seconds])
        turned = np.column_stack([-north, east, np.zeros(n)])
        return np.concatenate(
            [way.reshape(n, 27), (turned[:, :, None] * terms[:, None, :]).reshape(n, 3 * N_HEADING)], axis=1
        )

    def legs(self) -> Legs:
        """Of all fixes so far that DVL samples have passed."""
        self._sum_up()
        self._pass_fixes()
        newest_s = self._rows.seconds[-1] if len(self._rows.seconds) else 0.0
        # a fix that is later than this is not waited for
        kept = max(int(np.searchsorted(self._rows.seconds, newest_s - self._latest_s)) - 1, 0)
        columns: list[Any] = [column[kept:] for column in self._rows]
        self._rows = _Passed(*columns)
        if len(self._done) > 1:
            columns = [np.concatenate(column) for column in zip(*self._done, strict=True)]
            self._done = [Legs(*columns)]
        return self._done[0] if self._done else _no_legs()

    def _pass_fixes(self) -> None:
        seconds, stretch, sums, rates, quaternion = self._rows
        if len(seconds) < 2 or not len(self._waiting.stamps_ns):
            return
        at_s = 1e-9 * (self._waiting.stamps_ns - (self._epoch_ns or 0))
        passed = int(np.searchsorted(at_s, seconds[-1], side="right"))
        if not passed:
            return
        fixes, at_s = self._waiting.part(slice(passed)), at_s[:passed]
        self._waiting = self._waiting.part(slice(passed, None))
        after = np.clip(np.searchsorted(seconds, at_s), 1, len(seconds) - 1)
        known = (at_s >= seconds[0]) & (stretch[after] == stretch[after - 1])
        fixes, at_s, after = fixes.part(np.flatnonzero(known)), at_s[known], after[known]
        share = ((at_s - seconds[after - 1]) / (seconds[after] - seconds[after - 1]))[:, None]
        found = sums[after - 1] + share * (sums[after] - sums[after - 1])
        near = np.where(share < 0.5, after[:, None] - 1, after[:, None])[:, 0]
        n = len(at_s)
        rotation = rotation_from_quaternion(quaternion[near])
        rate = (rates[after - 1] + share * (rates[after] - rates[after - 1]))[:, _WAY].reshape(n, 3, 3, 3)
        velocity = np.einsum("nabc,bc->na", rate, self._body_from_dvl)
        way, drifted = found[:, _WAY].reshape(n, 3, 3, 3), found[:, _DRIFTED].reshape(n, 3, N_HEADING)
        self._done.append(Legs(at_s, stretch[after], way, drifted, rotation, velocity, fixes.position, fixes.variance))


def _no_legs() -> Legs:
    nothing = np.zeros((0, 3))
    turned = np.zeros((0, 3, N_HEADING))
    none = np.zeros(0, dtype=np.intp)
    return Legs(np.zeros(0), none, np.zeros((0, 3, 3, 3)), turned, np.zeros((0, 3, 3)), nothing, nothing, nothing)
