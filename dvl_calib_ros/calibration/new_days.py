"""Where a new day begins: what belongs to the day (`Nuisance.of_the_day`, the delay of the DVL) is then found anew.

Clocks are set, and an inertial navigation aligned, between one dive and the next. Live, a pause says so; of recordings
that are replayed together it is known.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

# What follows sooner is another part of the same recording. Longer than a block of G2's samples and the longest delay,
# so that none holds those of two days.
SHORTEST_PAUSE_NS = 15_000_000_000


class NewDays:
    """Says of a DVL sample whether it is the first of a day, by stamps alone."""

    def __init__(self, pause_ns: int, recordings_ns: Sequence[int] = ()) -> None:
        """pause_ns: of the DVL, after which it is another day. recordings_ns: stamps between one recording and the next
        of those that are taken together, each of a day of its own."""
        self._pause_ns = pause_ns
        self._recordings_ns = sorted(recordings_ns)

    def begins(self, stamp_ns: int, interval_ns: int) -> bool:
        """Whether a day begins with this stamp, which came so long after the one before."""
        if interval_ns <= SHORTEST_PAUSE_NS:
            return False
        if interval_ns > self._pause_ns:
            return True
        before = bisect_right(self._recordings_ns, stamp_ns - interval_ns)
        return bisect_right(self._recordings_ns, stamp_ns) > before
