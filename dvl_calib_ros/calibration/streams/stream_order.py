"""Order of each stream by header stamps alone, its values at other times, new recordings and dropouts.

A live run and a replay agree: results depend neither on wall time nor, within a bounded lag in stamps, on the arrival
order of *different* topics. Rules for one sample and for columns are the same (test_alignment.py).

Between two dives clocks are set and an INS is aligned. Live, a pause marks a new recording; in a joint replay the
recordings are known.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from enum import Enum
from itertools import pairwise
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from ..numerics.frames import Array
from ..numerics.samples import Codes, Index, Mask, Stamps
from ..numerics.tables import RowTable, column
from .clock_correction import SECOND_NS

# Earlier than any stamp; adding a timeout cannot overflow 64 bits.
LONG_AGO_NS = -(2**62)
# Longest history that a track keeps beyond pairing, ns: a silent DVL must not fill the memory.
LONGEST_NS = 600_000_000_000
# Fewest samples to which LONGEST_NS applies: ten minutes at 400 Hz, 26 MB. A forward clock step is no silence, and its
# effect must not depend on the size of columns.
MOST_KEPT = 240_000


# A longer gap separates segments of time: no recording is longer without a break.
SEGMENT_GAP_NS = 7 * 86_400 * SECOND_NS


class Stamped(Protocol):
    """Object with a header stamp."""

    @property
    def stamp_ns(self) -> int:
        """Stamp in integer nanoseconds."""


S = TypeVar("S", bound=Stamped)


class Order(Enum):
    """Relation of a stamp to the earlier ones of its stream."""

    NEXT = "next"
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out_of_order"
    HELD = "held"
    CONFIRMED_GAP = "confirmed_gap"
    CONFIRMED_RESTART = "confirmed_restart"


class Admitted(NamedTuple):
    """Mask (N,) of the admitted rows of a stream, and counts of the others by kind."""

    rows: Mask
    duplicate: int
    out_of_order: int


class Sequencer(Generic[S]):
    """Filter that admits samples of a stream in strictly increasing order of stamps.

    A sample more than `max_jump_ns` away is held until the next one confirms it (a gap or, backward, a restart) or
    contradicts it (stray, dropped). So neither one wrong stamp nor a real jump (dropout, clock set, bag loop) stops the
    stream. The first sample is unconfirmed: if the next ones are more than `SEGMENT_GAP_NS` ahead, it is a restart,
    too.

    is_alone: there was only one sample so far.
    """

    def __init__(self, max_jump_ns: int) -> None:
        self._max_jump_ns = max_jump_ns
        self.last_ns: int | None = None
        self.is_alone = False
        self.held: S | None = None
        self.stray = 0

    def goes_on(self, stamp_ns: int) -> bool:
        """Record a stamp and return True if it is simply the next one; else call `admit`."""
        last = self.last_ns
        if last is None or self.held is not None or not last < stamp_ns <= last + self._max_jump_ns:
            return False
        self.last_ns = stamp_ns
        self.is_alone = False
        return True

    def follow(self, stamps_ns: Stamps) -> None:
        """Record stamps (N > 0,) that `admit_columns` admitted."""
        self.is_alone = self.last_ns is None and len(stamps_ns) == 1
        self.last_ns = int(stamps_ns[-1])

    def admit(self, sample: S) -> tuple[Order, tuple[S, ...]]:
        """Return the order of a sample, and the admitted samples (a confirmed held one first)."""
        stamp, last = sample.stamp_ns, self.last_ns
        if last is None:
            self.last_ns = stamp
            self.is_alone = True
            return Order.NEXT, (sample,)
        if -self._max_jump_ns <= stamp - last <= self._max_jump_ns:
            self._drop_held()
            if stamp > last:
                self.last_ns = stamp
                self.is_alone = False
                return Order.NEXT, (sample,)
            return (Order.DUPLICATE if stamp == last else Order.OUT_OF_ORDER), ()
        held = self.held
        if held is not None and 0 <= stamp - held.stamp_ns <= self._max_jump_ns:
            if stamp == held.stamp_ns:
                return Order.DUPLICATE, ()
            is_gap = last < held.stamp_ns and not (self.is_alone and held.stamp_ns - last > SEGMENT_GAP_NS)
            order = Order.CONFIRMED_GAP if is_gap else Order.CONFIRMED_RESTART
            self.held = None
            self.last_ns = stamp
            self.is_alone = False
            return order, (held, sample)
        self._drop_held()
        self.held = sample
        return Order.HELD, ()

    def _drop_held(self) -> None:
        if self.held is not None:
            self.stray += 1
            self.held = None

    def admit_columns(self, stamps_ns: Stamps) -> Admitted | None:
        """Apply `admit` to stamps (N,) without recording them. Return None if there is a jump among them.

        Columns with jumps, which are rare, must use `admit` per sample.
        """
        if self.held is not None:
            return None
        if not len(stamps_ns):
            return Admitted(np.zeros(0, dtype=bool), 0, 0)
        first_ns = int(stamps_ns[0]) - 1 if self.last_ns is None else self.last_ns
        step = stamps_ns - np.maximum.accumulate(np.concatenate([[first_ns], stamps_ns[:-1]]))
        if step.max() > self._max_jump_ns or step.min() < -self._max_jump_ns:
            return None
        rows = step > 0
        duplicate = int(np.count_nonzero(step == 0))
        return Admitted(rows, duplicate, len(step) - int(np.count_nonzero(rows)) - duplicate)


def strays(stamps_ns: Stamps, max_jump_ns: int) -> Mask:
    """Return a mask of stamps (N,) far from both neighbours on the same side, while these are near each other."""
    stray = np.zeros(len(stamps_ns), dtype=bool)
    if len(stamps_ns) > 2:
        before, after = stamps_ns[1:-1] - stamps_ns[:-2], stamps_ns[2:] - stamps_ns[1:-1]
        is_far = (np.abs(before) > max_jump_ns) & (np.abs(after) > max_jump_ns) & (np.sign(before) != np.sign(after))
        stray[1:-1] = is_far & (np.abs(stamps_ns[2:] - stamps_ns[:-2]) <= max_jump_ns)
    return stray


class Bracket(NamedTuple):
    """Slots of the samples before (-1: none near enough) and at or after a time, and its fraction between them.

    fraction: 0..1; 1 is exactly the later.
    """

    before: int
    after: int
    fraction: float


class Brackets(NamedTuple):
    """`Bracket` for N times. found: (N,); other fields are undefined where it is False."""

    before: Index
    after: Index
    fraction: Array
    found: Mask


class Track(RowTable):
    """Recent samples of one stream, for interpolation without extrapolation.

    values: linearly interpolated quantities or, for an IMU, quaternion and angular velocity (samples.py); for a
      reference velocity (3), covariance (9, nan where not given).
    frames, unmeasured: of a reference, its frame (index in `FRAMES`) and a bit per axis that is not measured.
    late: at its arrival it lagged other streams by more than the limit.
    """

    stamps_ns: Stamps = column(np.int64)
    values: Array = column(np.float64, 12)
    frames: Codes = column(np.uint8)
    unmeasured: Codes = column(np.uint8)
    late: Mask = column(np.bool_)

    def __init__(self, max_gap_ns: int, max_latency_ns: int, retention_ns: int) -> None:
        """Make an empty track.

        max_gap_ns: longest interpolated gap.
        max_latency_ns: lead of other streams at which waiting for this one ends.
        retention_ns: largest age of a time behind the newest sample.
        """
        super().__init__()
        self.max_gap_ns = max_gap_ns
        self.max_latency_ns = max_latency_ns
        self.retention_ns = retention_ns
        # by user: stamp from which samples are kept, up to LONGEST_NS
        self.needed_from: dict[object, int] = {}

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample."""
        return int(self.stamps_ns[self.size - 1]) if self.size > self.begin else None

    def forget_old(self) -> None:
        """Discard samples that no future request needs."""
        if self.size > self.begin:
            oldest_ns = int(self.stamps_ns[self.size - 1]) - self.retention_ns - self.max_gap_ns
            if self.needed_from:
                wanted_ns = min(self.needed_from.values())
                if self.size - self.begin > MOST_KEPT:
                    wanted_ns = max(wanted_ns, int(self.stamps_ns[self.size - 1]) - LONGEST_NS)
                oldest_ns = min(oldest_ns, wanted_ns)
            self.begin += int(np.searchsorted(self.stamps_ns[self.begin : self.size], oldest_ns))

    def in_time(self, from_ns: int, to_ns: int) -> Index:
        """Return slots of samples between two stamps that were not late; live, late ones miss their block."""
        span = self.between(self.stamps_ns, from_ns, to_ns)
        return np.flatnonzero(~self.late[span]) + span.start

    def decided(self, stamp_ns: int, horizon_ns: int) -> bool:
        """Return whether `bracket(stamp_ns)` is final. horizon_ns: newest stamp of any stream.

        It is final once this stream has reached the time, or once every sample that could bracket it is overdue.
        """
        newest = self.newest_ns
        return (newest is not None and newest >= stamp_ns) or horizon_ns >= self.deadline_ns(stamp_ns)

    def deadline_ns(self, stamp_ns: int) -> int:
        """Return the horizon at which a time that this stream has not reached is decided anyway."""
        newest = self.newest_ns
        last_chance_ns = stamp_ns if newest is None else max(stamp_ns, newest + self.max_gap_ns)
        return last_chance_ns + self.max_latency_ns

    def decided_in(
        self, stamps_ns: Stamps, since: Index, new_ns: Stamps, arrived: Index, newest_ns: Stamps, horizon_ns: Stamps
    ) -> Index:
        """Return the event (0..T-1, T: none) at which each of N times is `decided`.

        stamps_ns: (N,) increasing.
        since: (N,) event from which each time is requested.
        new_ns: stamps of the samples that this stream gains, arrived: their events.
        newest_ns, horizon_ns: (T,) after every event.
        """
        n_events = len(horizon_ns)
        before_ns = LONG_AGO_NS if self.newest_ns is None else self.newest_ns
        # once this stream has reached the time
        reached_at = np.append(arrived, n_events)[np.searchsorted(new_ns, stamps_ns)]
        decided = np.where(stamps_ns <= before_ns, since, np.maximum(since, reached_at))
        # or once it is overdue: time up to which it is given up after an event, which grows while it is silent
        overdue = newest_ns + self.max_gap_ns + self.max_latency_ns <= horizon_ns
        if not overdue.any():
            return decided
        given_up_ns = np.where(overdue, horizon_ns - self.max_latency_ns, LONG_AGO_NS)
        # stretches of events without a new sample, of those that end overdue
        bounds = np.concatenate([[0], np.flatnonzero(np.diff(newest_ns)) + 1, [n_events]])
        with_overdue = np.flatnonzero(given_up_ns[bounds[1:] - 1] != LONG_AGO_NS)
        for start, stop in zip(bounds[with_overdue].tolist(), bounds[with_overdue + 1].tolist(), strict=True):
            low = int(np.searchsorted(stamps_ns, newest_ns[start], side="right"))
            high = int(np.searchsorted(stamps_ns, given_up_ns[stop - 1], side="right"))
            given_up = np.searchsorted(given_up_ns[start:stop], stamps_ns[low:high]) + start
            given_up = np.maximum(given_up, since[low:high])
            decided[low:high] = np.where(given_up < stop, np.minimum(decided[low:high], given_up), decided[low:high])
        return decided

    def bracket(self, stamp_ns: int, newest_ns: int | None = None) -> Bracket | None:
        """Return the samples around a time; None beyond the newest sample, across a long gap, or too long ago.

        newest_ns: newest stamp of this stream at the decision; None: now.
        """
        stamps = self.stamps_ns[self.begin : self.size]
        at = int(stamps.searchsorted(stamp_ns))
        if at == len(stamps):
            return None
        newest_ns = int(stamps[-1]) if newest_ns is None else newest_ns
        if not newest_ns - self.retention_ns <= stamp_ns <= newest_ns:
            return None
        after_ns = int(stamps[at])
        before_ns = int(stamps[at - 1]) if at else LONG_AGO_NS
        after = self.begin + at
        before = after - 1 if after_ns - before_ns <= self.max_gap_ns else -1
        if after_ns == stamp_ns:
            return Bracket(before, after, 1.0)
        return None if before < 0 else Bracket(before, after, (stamp_ns - before_ns) / (after_ns - before_ns))

    def brackets(self, stamps_ns: Stamps, newest_ns: Stamps) -> Brackets:
        """Return `bracket` for columns; newest_ns: (N,) newest stamp of this stream at each decision."""
        if len(stamps_ns) == 1:  # live there is one row: faster
            bracket = self.bracket(int(stamps_ns[0]), int(newest_ns[0]))
            slots = np.array([-1, 0] if bracket is None else [bracket.before, bracket.after])
            fraction = np.array([1.0 if bracket is None else bracket.fraction])
            return Brackets(slots[:1], slots[1:], fraction, np.array([bracket is not None]))
        stamps = self.stamps_ns[self.begin : self.size]
        if not len(stamps):
            nowhere = np.zeros(len(stamps_ns), dtype=np.intp)
            return Brackets(nowhere, nowhere, nowhere.astype(float), np.zeros(len(stamps_ns), dtype=bool))
        following = np.minimum(np.searchsorted(stamps, stamps_ns), len(stamps) - 1)
        after_ns = stamps[following]
        gap_ns = np.where(following > 0, after_ns - stamps[np.maximum(following - 1, 0)], self.max_gap_ns + 1)
        near = gap_ns <= self.max_gap_ns
        exact = after_ns == stamps_ns
        found = (stamps_ns <= newest_ns) & (stamps_ns >= newest_ns - self.retention_ns) & (exact | near)
        fraction = np.where(exact, 1.0, (stamps_ns - (after_ns - gap_ns)) / gap_ns)
        after = following + self.begin
        return Brackets(np.where(near, after - 1, -1), after, fraction, found)


# Shortest pause before a new recording, ns: longer than a block of samples and the longest delay, so that no block
# holds samples of two recordings.
SHORTEST_PAUSE_NS = 15_000_000_000


class NewDays:
    """Detection of the first DVL sample of a recording, by stamps alone."""

    def __init__(self, pause_ns: int, recordings_ns: Sequence[int] = ()) -> None:
        """Set the limits of recordings.

        pause_ns: DVL pause that starts a new recording. recordings_ns: stamps between recordings that are replayed
        together.
        """
        self._pause_ns = pause_ns
        self._recordings_ns = sorted(recordings_ns)

    def begins(self, stamp_ns: int, interval_ns: int) -> bool:
        """Return whether a recording begins with this stamp, an interval after the previous one."""
        if interval_ns <= SHORTEST_PAUSE_NS:
            return False
        if interval_ns > self._pause_ns:
            return True
        # in a joint replay, a limit between two recordings lies between the two stamps
        before = bisect_right(self._recordings_ns, stamp_ns - interval_ns)
        return bisect_right(self._recordings_ns, stamp_ns) > before


def parts_by_day(days: Sequence[int], first: int, end: int) -> Iterator[tuple[int, int, bool]]:
    """Yield first row, end, and whether a recording begins, for the parts of rows first .. end - 1.

    days: first rows of recordings, in order.
    """
    if not days or days[-1] < first or days[0] >= end:
        yield first, end, False
        return
    own = [day for day in days if first <= day < end]
    for start, stop in pairwise(sorted({first, *own, end})):
        yield start, stop, start in own


# A dropout is a DVL gap longer than this, ns, and than this multiple of its shortest interval.
DROPOUT_NS = SECOND_NS
DROPOUT_INTERVALS = 3
NEVER_NS = 2**63 - 1


class Dropouts:
    """DVL dropouts since the start or the last restart. longest_ns: longest of them."""

    def __init__(self) -> None:
        self.longest_ns = 0
        self._shortest_interval_ns = NEVER_NS

    def add(self, interval_ns: Stamps) -> int:
        """Add the intervals (N,) between samples, in order. Return the number of dropouts."""
        if not len(interval_ns):
            return 0
        if interval_ns.max() <= DROPOUT_NS:
            self._shortest_interval_ns = min(self._shortest_interval_ns, int(interval_ns.min()))
            return 0
        shortest_ns = np.minimum(np.minimum.accumulate(interval_ns), self._shortest_interval_ns)
        self._shortest_interval_ns = int(shortest_ns[-1])
        dropouts = interval_ns[(interval_ns > DROPOUT_NS) & (interval_ns > DROPOUT_INTERVALS * shortest_ns)]
        if len(dropouts):
            self.longest_ns = max(self.longest_ns, int(dropouts.max()))
        return len(dropouts)
