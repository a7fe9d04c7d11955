"""Clock domains: streams stamped by one clock or by several, from their arrival times.

Arrival times matter where the motion does not determine the delays. There, an offset beyond every searched delay pairs
velocities of different times.
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
    """Offset `ahead` (s) of the stamps of a stream relative to another stream, beyond the configured delays."""

    stream: Stream
    other: Stream
    ahead: float

    @property
    def side(self) -> str:
        """Direction of the offset in words."""
        return "ahead of" if self.ahead > 0.0 else "behind"


def limit_s(parameters: Parameters) -> float:
    """Return the largest clock offset that the calibration estimates, s."""
    return LONGEST_DELAY_S + parameters.position_window


def arrival_offset(ahead: Mapping[Stream, float], parameters: Parameters, std_s: float = 0.0) -> list[ArrivalOffset]:
    """Return the streams stamped by another clock than the rest.

    ahead: stamp minus arrival time of each stream, s, up to a common offset; the DVL first. std_s: uncertainty of
    these values.
    """
    configured = {
        Stream.DVL: parameters.dvl_time_offset,
        Stream.REFERENCE: parameters.reference_time_offset,
        Stream.IMU: parameters.imu_time_offset,
    }
    corrected = {stream: seconds - configured[stream] for stream, seconds in ahead.items()}
    if len(corrected) < 2:
        return []
    # relative to the DVL, unless the DVL is the outlier of three
    base = next(iter(corrected))
    if len(corrected) > 2:
        middle = sorted(corrected.values())[1]
        if abs(corrected[base] - middle) > limit_s(parameters):
            base = min(corrected, key=lambda stream: abs(corrected[stream] - middle))
    offsets = (
        ArrivalOffset(stream, base, corrected[stream] - corrected[base]) for stream in corrected if stream is not base
    )
    # samples that are old when they are stamped have a configured delay, but no clock offset
    return [
        offset
        for offset in offsets
        if min(abs(offset.ahead), abs(ahead[offset.stream] - ahead[base])) - std_s > limit_s(parameters)
    ]


SPOKEN: Mapping[Stream, str] = {Stream.DVL: "the DVL's", Stream.REFERENCE: "the reference's", Stream.IMU: "the IMU's"}
# Offsets of known time scales from UTC, in whole seconds (since 2017).
TIME_SCALES = {18: "GPS time, without its leap seconds, is 18 s ahead of UTC", 37: "TAI is 37 s ahead of UTC"}


# Most stamps kept per stream, evenly spread; more do not improve the median.
MOST = 8192
# Live messages per addition.
AT_ONCE = 64


class StreamClocks:
    """Stamps of reference and IMU minus the stamp of the last DVL message before them (live: of the next one)."""

    def __init__(self) -> None:
        self._ahead = {stream: _ThinnedValues() for stream in (Stream.REFERENCE, Stream.IMU)}
        self._newest: dict[Stream, int] = {}  # live: newest stamp by stream, and values to be added
        self._waiting: dict[Stream, list[int]] = {stream: [] for stream in self._ahead}
        self._cached: tuple[Parameters, list[Reason]] | None = None  # of all messages so far

    def arrived(self, stream: Stream, stamp_ns: int) -> None:
        """Add one live message of a stream."""
        self._newest[stream] = stamp_ns
        if stream is Stream.DVL:
            for other, waiting in self._waiting.items():
                if (newest := self._newest.pop(other, None)) is not None:
                    waiting.append(newest - stamp_ns)
                    self._cached = None
                if len(waiting) == AT_ONCE:
                    self._add_waiting(other)

    def _add_waiting(self, stream: Stream) -> None:
        self._ahead[stream].add(np.array(self._waiting[stream], dtype=np.int64))
        self._waiting[stream] = []

    def add(self, streams: Streams) -> None:
        """Add blocks of recorded messages, in order."""
        self._cached = None
        dvl = _read(streams.dvl)
        for stream, block in ((Stream.REFERENCE, streams.reference), (Stream.IMU, streams.imu)):
            own = _read(block)
            own = own.part(own.arrival > dvl.arrival[0]) if len(dvl) else own.part(slice(0))
            last_dvl = np.searchsorted(dvl.arrival, own.arrival) - 1
            self._ahead[stream].add(own.stamps_ns - dvl.stamps_ns[last_dvl])

    def objections(self, parameters: Parameters) -> list[Reason]:
        """Return findings of clock offsets beyond the range of every model."""
        if self._cached is None or self._cached[0] is not parameters:
            self._cached = parameters, self._objections(parameters)
        return self._cached[1]

    def _objections(self, parameters: Parameters) -> list[Reason]:
        """Return a finding for each clock offset beyond `limit_s`, from the order of arrival."""
        ahead = {Stream.DVL: 0.0}
        for stream, spread in self._ahead.items():
            self._add_waiting(stream)
            if len(spread.kept):
                ahead[stream] = float(median(1e-9 * spread.kept))
        reasons = []
        for offset in arrival_offset(ahead, parameters):
            time_scale = TIME_SCALES.get(round(abs(offset.ahead)))
            known = f" ({time_scale})" if time_scale else ""
            values = {"seconds": abs(offset.ahead), "side": offset.side, "other": SPOKEN[offset.other], "known": known}
            reasons.append(finding("CLOCKS_APART", whose=SPOKEN[offset.stream], **values))
        return reasons


class _ThinnedValues:
    """Evenly thinned numbers, at most MOST. kept: (M,)."""

    def __init__(self) -> None:
        self.kept: Stamps = np.zeros(0, dtype=np.int64)
        self._every = 1
        self._next = 0  # index of the next kept number in the input

    def add(self, values: Stamps) -> None:
        """Add numbers (N,)."""
        self.kept = np.concatenate([self.kept, values[self._next :: self._every]])
        self._next = (self._next - len(values)) % self._every
        while len(self.kept) > MOST:
            # if the last number remains (odd count), the next one is a doubled step after it
            self._next += self._every * (len(self.kept) % 2)
            self.kept = self.kept[::2]
            self._every *= 2


def _read(block: SampleBlock) -> SampleBlock:
    return block.part(block.refused == 0)
