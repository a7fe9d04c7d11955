"""Whether the streams of a recording are stamped by one clock: by which stamps arrived together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..calibration.delay.rows import LONGEST_DELAY_S
from ..calibration.parameters import Parameters
from ..calibration.robust import median
from ..calibration.samples import SampleBlock, Stamps, Stream, Streams
from ..calibration.verification import Word

SPOKEN: Mapping[Stream, str] = {Stream.REFERENCE: "the reference's", Stream.IMU: "the IMU's"}
# Seconds by which a well-known clock is ahead of UTC, to the second (since 2017).
WELL_KNOWN = {18: "GPS time, without its leap seconds, is 18 s ahead of UTC", 37: "TAI is 37 s ahead of UTC"}


class StreamClocks:
    """Of every message the stamp against that of the DVL's message that arrived last before it."""

    def __init__(self) -> None:
        self._ahead_ns: dict[Stream, list[Stamps]] = {stream: [] for stream in SPOKEN}

    def add(self, streams: Streams) -> None:
        """Take what arrived one after the other."""
        dvl = _read(streams.dvl)
        for stream, block in ((Stream.REFERENCE, streams.reference), (Stream.IMU, streams.imu)):
            other = _read(block)
            other = other.part(other.arrival > dvl.arrival[0]) if len(dvl) else other.part(slice(0))
            before = np.searchsorted(dvl.arrival, other.arrival) - 1
            self._ahead_ns[stream].append(other.stamps_ns - dvl.stamps_ns[before])

    def objections(self, parameters: Parameters) -> list[tuple[Word, str]]:
        """What clocks that differ by more than any model looks for say against every calibration."""
        offsets = {Stream.REFERENCE: parameters.reference_time_offset, Stream.IMU: parameters.imu_time_offset}
        said = []
        for stream, whose in SPOKEN.items():
            ahead_ns = np.concatenate(self._ahead_ns[stream] or [np.zeros(0, dtype=np.int64)])
            if not len(ahead_ns):
                continue
            ahead_s = float(median(1e-9 * ahead_ns)) - offsets[stream] + parameters.dvl_time_offset
            if abs(ahead_s) <= LONGEST_DELAY_S + parameters.position_window:
                continue
            known = WELL_KNOWN.get(round(abs(ahead_s)))
            side = "ahead of" if ahead_s > 0.0 else "behind"
            said.append(
                (
                    Word.REJECT,
                    f"{whose} stamps are {abs(ahead_s):.1f} s {side} those of the DVL's messages with which they came"
                    f"{f' ({known})' if known else ''}: set the clocks by one source, correct the recording's stamps",
                )
            )
        return said


def _read(block: SampleBlock) -> SampleBlock:
    return block.part(block.refused == 0)
