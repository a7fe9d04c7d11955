"""Clock domains: streams stamped by one clock or by several, from the times of arrival.

Where velocities and turns show how the clocks stand, it does not matter when messages came. Where they do not, stamps
that differ by more than any delay that is looked for pair velocities of other times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models.parameters import Parameters
from ..numerics.robust import median
from ..numerics.samples import SampleBlock, Stamps, Stream, Streams
from ..streams.interpolation import LONGEST_DELAY_S


class ArrivalOffset(NamedTuple):
    """Stamps of a stream are ahead of those of the other by so many s beyond what the parameters take off."""

    stream: Stream
    other: Stream
    ahead: float

    @property
    def side(self) -> str:
        """In words."""
        return "ahead of" if self.ahead > 0.0 else "behind"


def limit_s(parameters: Parameters) -> float:
    """Clocks that differ by less are for the calibration to find, s."""
    return LONGEST_DELAY_S + parameters.position_window


def arrival_offset(ahead: Mapping[Stream, float], parameters: Parameters, late_s: float = 0.0) -> list[ArrivalOffset]:
    """Streams by another clock than the rest.

    ahead: of each stream, the DVL first, how far its stamps are ahead of its messages' arrival, s, beside any common
    time. late_s: by how much that may be wrong.
    """
    offsets = {
        Stream.DVL: parameters.dvl_time_offset,
        Stream.REFERENCE: parameters.reference_time_offset,
        Stream.IMU: parameters.imu_time_offset,
    }
    corrected = {stream: seconds - offsets[stream] for stream, seconds in ahead.items()}
    if len(corrected) < 2:
        return []
    # beside the DVL's, unless of three that is the one that is alone
    other = next(iter(corrected))
    if len(corrected) > 2:
        middle = sorted(corrected.values())[1]
        if abs(corrected[other] - middle) > limit_s(parameters):
            other = min(corrected, key=lambda stream: abs(corrected[stream] - middle))
    found = (
        ArrivalOffset(stream, other, corrected[stream] - corrected[other])
        for stream in corrected
        if stream is not other
    )
    # samples that are old when they are stamped arrive by neither clock's fault
    return [
        each
        for each in found
        if min(abs(each.ahead), abs(ahead[each.stream] - ahead[other])) - late_s > limit_s(parameters)
    ]


SPOKEN: Mapping[Stream, str] = {
    Stream.DVL: "the DVL's",
    Stream.REFERENCE: "the reference's",
    Stream.IMU: "the IMU's",
}
# Seconds by which a well-known clock is ahead of UTC, to the second (since 2017).
WELL_KNOWN = {18: "GPS time, without its leap seconds, is 18 s ahead of UTC", 37: "TAI is 37 s ahead of UTC"}


# So many messages of a stream, evenly spread, tell well enough how far its stamps are ahead; no more are kept.
MOST = 8192
# Live, one by one, so many are added together.
AT_ONCE = 64


class StreamClocks:
    """Of messages the stamp against that of the DVL's message that arrived last before it, or live the next."""

    def __init__(self) -> None:
        self._ahead: dict[Stream, _Spread] = {stream: _Spread() for stream in (Stream.REFERENCE, Stream.IMU)}
        self._newest: dict[Stream, int] = {}  # live, stamps by stream, and what waits to be added of each
        self._waiting: dict[Stream, list[int]] = {stream: [] for stream in self._ahead}
        self._said: tuple[Parameters, list[Reason]] | None = None  # of all that came

    def arrived(self, stream: Stream, stamp_ns: int) -> None:
        """Take one message of a stream, live."""
        self._newest[stream] = stamp_ns
        if stream is Stream.DVL:
            for other, waiting in self._waiting.items():
                if (newest := self._newest.pop(other, None)) is not None:
                    waiting.append(newest - stamp_ns)
                    self._said = None
                if len(waiting) == AT_ONCE:
                    self._add_waiting(other)

    def _add_waiting(self, stream: Stream) -> None:
        self._ahead[stream].add(np.array(self._waiting[stream], dtype=np.int64))
        self._waiting[stream] = []

    def add(self, streams: Streams) -> None:
        """Take what arrived one after the other."""
        self._said = None
        dvl = _read(streams.dvl)
        for stream, block in ((Stream.REFERENCE, streams.reference), (Stream.IMU, streams.imu)):
            other = _read(block)
            other = other.part(other.arrival > dvl.arrival[0]) if len(dvl) else other.part(slice(0))
            before = np.searchsorted(dvl.arrival, other.arrival) - 1
            self._ahead[stream].add(other.stamps_ns - dvl.stamps_ns[before])

    def objections(self, parameters: Parameters) -> list[Reason]:
        """What clocks that differ by more than any model looks for say against every calibration."""
        if self._said is None or self._said[0] is not parameters:
            self._said = parameters, self._objections(parameters)
        return self._said[1]

    def _objections(self, parameters: Parameters) -> list[Reason]:
        ahead = {Stream.DVL: 0.0}
        for stream, spread in self._ahead.items():
            self._add_waiting(stream)
            if len(spread.kept):
                ahead[stream] = float(median(1e-9 * spread.kept))
        said = []
        for each in arrival_offset(ahead, parameters):
            known = WELL_KNOWN.get(round(abs(each.ahead)))
            said.append(
                finding(
                    "CLOCKS_APART",
                    whose=SPOKEN[each.stream],
                    seconds=abs(each.ahead),
                    side=each.side,
                    other=SPOKEN[each.other],
                    known=f" ({known})" if known else "",
                )
            )
        return said


class _Spread:
    """Every so many-th of some numbers, for them to be no more than MOST. kept: those (M,)."""

    def __init__(self) -> None:
        self.kept: Stamps = np.zeros(0, dtype=np.int64)
        self._every = 1
        self._next = 0  # of what comes, the place of the next one to be kept

    def add(self, values: Stamps) -> None:
        """Take further ones (N,)."""
        self.kept = np.concatenate([self.kept, values[self._next :: self._every]])
        self._next = (self._next - len(values)) % self._every
        while len(self.kept) > MOST:
            # the next one to be kept is the one after the last by so many, where that one stays
            self._next += self._every * (len(self.kept) % 2)
            self.kept = self.kept[::2]
            self._every *= 2


def _read(block: SampleBlock) -> SampleBlock:
    return block.part(block.refused == 0)
