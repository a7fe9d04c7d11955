"""Order and pairing of the three streams, decided by header stamps alone.

Nothing here looks at a clock, nor at the order in which *different* topics arrive, as long as one topic does not lag
another by more than a bounded time in stamps. So a live run and a replay of its recording decide alike.
"""

from __future__ import annotations

from bisect import bisect_left
from enum import Enum
from typing import Generic, NamedTuple, Protocol, TypeVar


class Stamped(Protocol):
    """Anything with a header stamp."""

    @property
    def stamp_ns(self) -> int:
        """Integer nanoseconds."""


S = TypeVar("S", bound=Stamped)


class Order(Enum):
    """What a stamp is after the ones before it in the same stream."""

    NEXT = "next"
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out_of_order"
    HELD = "held"
    CONFIRMED_GAP = "confirmed_gap"
    CONFIRMED_RESTART = "confirmed_restart"


class Sequencer(Generic[S]):
    """Lets a stream's samples through in strictly increasing order of stamps.

    One wrong stamp must not poison the timeline, and a real jump (a dropout, a clock set, a bag that loops) must not
    stop it. So a sample more than `max_jump_ns` away is held until the next sample confirms it (a gap or, back in
    time, a restart) or contradicts it (the held one was stray and is dropped).
    """

    def __init__(self, max_jump_ns: int) -> None:
        self._max_jump_ns = max_jump_ns
        self.last_ns: int | None = None
        self.held: S | None = None
        self.stray = 0

    def goes_on(self, stamp_ns: int) -> bool:
        """Take note of a stamp and say True if it simply is the next one, as nearly all are; else call `admit`."""
        last = self.last_ns
        if last is None or self.held is not None or not last < stamp_ns <= last + self._max_jump_ns:
            return False
        self.last_ns = stamp_ns
        return True

    def admit(self, sample: S) -> tuple[Order, tuple[S, ...]]:
        """What the sample is, and the samples that may now go on (the held one before it, once confirmed)."""
        stamp, last = sample.stamp_ns, self.last_ns
        if last is None:
            self.last_ns = stamp
            return Order.NEXT, (sample,)
        if -self._max_jump_ns <= stamp - last <= self._max_jump_ns:
            self._drop_held()
            if stamp > last:
                self.last_ns = stamp
                return Order.NEXT, (sample,)
            return (Order.DUPLICATE if stamp == last else Order.OUT_OF_ORDER), ()
        held = self.held
        if held is not None and 0 <= stamp - held.stamp_ns <= self._max_jump_ns:
            if stamp == held.stamp_ns:
                return Order.DUPLICATE, ()
            order = Order.CONFIRMED_GAP if held.stamp_ns > last else Order.CONFIRMED_RESTART
            self.held = None
            self.last_ns = stamp
            return order, (held, sample)
        self._drop_held()
        self.held = sample
        return Order.HELD, ()

    def _drop_held(self) -> None:
        if self.held is not None:
            self.stray += 1
            self.held = None


class Bracket(NamedTuple, Generic[S]):
    """The samples before and at or after a time, and where between them it lies (0..1; 1 is exactly the later)."""

    before: S | None
    after: S
    fraction: float


class Track(Generic[S]):
    """The recent past of one stream, to be interpolated but never extrapolated.

    max_gap_ns: longest gap that is interpolated across. max_latency_ns: by how much other streams may run ahead of
    this one before it is given up waiting for. retention_ns: how much past is kept.
    """

    def __init__(self, max_gap_ns: int, max_latency_ns: int, retention_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._max_latency_ns = max_latency_ns
        self._retention_ns = retention_ns
        self._stamps: list[int] = []
        self._samples: list[S] = []

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample."""
        return self._stamps[-1] if self._stamps else None

    @property
    def newest(self) -> S | None:
        """The newest sample."""
        return self._samples[-1] if self._samples else None

    def append(self, sample: S) -> None:
        """Add the next sample (stamps strictly increasing)."""
        self._stamps.append(sample.stamp_ns)
        self._samples.append(sample)
        if len(self._stamps) >= 512 and self._stamps[256] < sample.stamp_ns - self._retention_ns:
            del self._stamps[:256], self._samples[:256]

    def clear(self) -> None:
        """Forget everything."""
        self._stamps.clear()
        self._samples.clear()

    def decided(self, stamp_ns: int, horizon_ns: int) -> bool:
        """Whether `bracket(stamp_ns)` can no longer change, with horizon_ns the newest stamp of any stream.

        Either this stream has reached the time, or what could still bracket it (at the time itself, or within
        max_gap of the newest sample) should have come by now.
        """
        newest = self.newest_ns
        return (newest is not None and newest >= stamp_ns) or horizon_ns >= self.deadline_ns(stamp_ns)

    def deadline_ns(self, stamp_ns: int) -> int:
        """The horizon from which a time that this stream has not reached is decided all the same."""
        newest = self.newest_ns
        last_chance_ns = stamp_ns if newest is None else max(stamp_ns, newest + self._max_gap_ns)
        return last_chance_ns + self._max_latency_ns

    def bracket(self, stamp_ns: int) -> Bracket[S] | None:
        """The samples around a time; None without one at or after it, or across too long a gap."""
        stamps = self._stamps
        at = bisect_left(stamps, stamp_ns)
        if at == len(stamps):
            return None
        after_ns = stamps[at]
        before_ns = stamps[at - 1] if at and after_ns - stamps[at - 1] <= self._max_gap_ns else None
        if after_ns == stamp_ns:
            return Bracket(None if before_ns is None else self._samples[at - 1], self._samples[at], 1.0)
        if before_ns is None:
            return None
        fraction = (stamp_ns - before_ns) / (after_ns - before_ns)
        return Bracket(self._samples[at - 1], self._samples[at], fraction)
