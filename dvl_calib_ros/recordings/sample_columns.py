"""Vectorised decoding of kept messages to samples, with the same results as individual decoding."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import (
    FRAME_CODES,
    Covariances,
    DvlSample,
    ImuSample,
    Mask,
    ReferenceSample,
    SampleBlock,
    Stamps,
    Stream,
    Streams,
    no_samples,
    sample_block,
)
from ..messages.decode import AS_SENT, HALF_TURN, WRONG_FRAME, Axes, MessageDecoder, Refusal
from ..messages.live_feed import DecodedMessages
from .columns import DecodedRows, TopicColumns

# messages of a stretch: enough for columns to be efficient, few enough for the caches
STRETCH_MESSAGES = 4096
# a share of a recording is read in this number of windows, each of at least this number of stretches
WINDOWS, STRETCHES_OF_A_WINDOW = 3, 10
Decoded = DvlSample | ReferenceSample | ImuSample | Refusal
Row = tuple[int, int, Any, str]
"""Arrival, log time (ns), message (None if it cannot be decoded) and the reason for None."""


class Stretch(NamedTuple):
    """Samples of consecutive messages of a recording. log_ns: log time of the last one."""

    streams: Streams
    log_ns: int


def stretches(
    columns: Mapping[Stream, Sequence[TopicColumns]], decoder: MessageDecoder, share: float = 1.0
) -> Iterator[Stretch]:
    """Yield all messages of streams, `STRETCH_MESSAGES` at a time; `SampleBlock.arrival` has their order of log time.

    columns: of each stream's topic, one part per recording. share: of them, in `WINDOWS`; the last window ends with the
    recording.
    """
    at_once = STRETCH_MESSAGES
    all_parts = [part for parts in columns.values() for part in parts]
    arrival = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *(part.arrivals[0] for part in all_parts)]))
    if share < 1.0:  # samples after a gap are processed individually, which must be a small part of a window
        at_once = min(at_once, 1 + int(len(arrival) * share / (WINDOWS * STRETCHES_OF_A_WINDOW)))
    ends = [*arrival[at_once::at_once].tolist(), int(arrival[-1]) + 1] if len(arrival) else []
    cuts = {stream: [_Cut(part, ends) for part in columns.get(stream, ())] for stream in Stream}
    for index in range(len(ends)):
        if (len(ends) - 1 - index) * WINDOWS % len(ends) >= share * len(ends):
            continue
        log_ns = max(part.newest_ns(index) for parts in cuts.values() for part in parts)
        dvl, reference, imu = (
            _block(
                stream,
                [decoded for cut in cuts[stream] if len(decoded := cut.decoded(index))],
                [cut.singles(index) for cut in cuts[stream]],
                decoder,
            )
            for stream in (Stream.DVL, Stream.REFERENCE, Stream.IMU)
        )
        yield Stretch(Streams(dvl, reference, imu), log_ns)


class _Cut:
    """A topic's messages, cut at the ends of stretches."""

    def __init__(self, part: TopicColumns, ends: Sequence[int]) -> None:
        """Set up. ends: for each stretch, the first arrival after it."""
        self._part = part
        self._laid = [0, *np.searchsorted(part.decoded.arrival, ends).tolist()]
        self._singles = [0, *np.searchsorted(part.singles.arrival, ends).tolist()]

    def decoded(self, index: int) -> DecodedRows:
        return self._part.decoded.part(slice(self._laid[index], self._laid[index + 1]))

    def singles(self, index: int) -> Iterator[Row]:
        return self._part.singles.messages(slice(self._singles[index], self._singles[index + 1]))

    def newest_ns(self, index: int) -> int:
        """Return the log time of the last message up to the end of this stretch; 0 without any."""
        ends = (self._part.decoded, self._laid[index + 1]), (self._part.singles, self._singles[index + 1])
        return max(int(messages.log_ns[end - 1]) if end else 0 for messages, end in ends)


def _block(
    stream: Stream, decoded: Sequence[DecodedRows], singles: Sequence[Iterator[Row]], decoder: MessageDecoder
) -> SampleBlock:
    """Return the samples of one stream, in order of arrival.

    decoded: messages of fixed layouts. singles: messages that are decoded individually.
    """
    judge: Callable[[str], object]
    decode: Callable[[Any, int], Decoded]
    judge, decode = {
        Stream.DVL: (decoder.accepts_dvl_frame, decoder.dvl),
        Stream.REFERENCE: (decoder.reference_frame, decoder.reference),
        Stream.IMU: (decoder.note_imu_frame, decoder.imu),
    }[stream]
    # a frame is judged at its first message: the DVL's first frame is the DVL's own
    pending = deque(sorted(first for rows in decoded for first in _first_of_frames(rows)))
    samples: list[tuple[int, Decoded]] = []
    for arrival, log_ns, message, why in heapq.merge(*singles, key=lambda row: row[0]):
        while pending and pending[0][0] < arrival:
            judge(pending.popleft()[1])
        samples.append((arrival, decoder.undecodable(stream, why) if why else decode(message, log_ns)))
    for _, name in pending:
        judge(name)
    make = _imu if stream is Stream.IMU else _velocity
    blocks = [make(stream, rows, decoder) for rows in decoded] + ([_of_rows(stream, samples)] if samples else [])
    if not blocks:
        return no_samples(stream)
    if len(blocks) == 1:
        return blocks[0]
    block = blocks[0].joined(*blocks[1:])
    return block.part(np.argsort(block.arrival, kind="stable"))


def _first_of_frames(decoded: DecodedRows) -> list[tuple[int, str]]:
    """Return the arrival of the first message of each frame, and the frame's name."""
    if (decoded.frame == decoded.frame[0]).all():
        places = [int(decoded.frame[0])]
    else:
        places = np.flatnonzero(np.bincount(decoded.frame)).tolist()
    return [(int(decoded.arrival[np.argmax(decoded.frame == place)]), decoded.frames[place]) for place in places]


def _velocity(stream: Stream, decoded: DecodedRows, decoder: MessageDecoder) -> SampleBlock:
    """Return the samples of DVL or reference, after all frames were judged."""
    refused = np.zeros(len(decoded), dtype=np.uint8)
    reasons: list[str] = []
    frames = np.zeros(len(decoded), dtype=np.uint8)
    values, covariances = decoded.values, decoded.covariances
    names = {place: decoded.frames[place] for place in np.flatnonzero(np.bincount(decoded.frame)).tolist()}
    is_other = np.zeros(len(decoded.frames), dtype=bool)
    broken: list[tuple[str, Any]] = []
    if stream is Stream.DVL:
        for place, name in names.items():
            is_other[place] = name != decoder.dvl_frame
        broken = [(rule.counter, decoded.broken == code) for code, rule in enumerate(decoder.dvl_type.rules, start=1)]
    else:
        codes = np.zeros(len(decoded.frames), dtype=np.uint8)
        axes: dict[Axes, Mask] = {}
        for place, name in names.items():
            declared = decoder.reference_frame(name)
            is_other[place] = declared is None
            codes[place] = 0 if declared is None else FRAME_CODES[declared.frame]
            if declared is not None and declared.axes is not AS_SENT:
                axes.setdefault(declared.axes, np.zeros(len(decoded.frames), dtype=bool))[place] = True
        frames = codes[decoded.frame]
        for frame_axes, of_frame in axes.items():
            values, covariances = _turned(frame_axes, values, covariances, of_frame[decoded.frame])
    for reason, is_broken in [(WRONG_FRAME, is_other[decoded.frame]), *broken]:
        new = is_broken & (refused == 0)
        if new.any():
            refused[new] = 1 + _index_of_reason(reasons, reason)
    if stream is Stream.DVL and not refused.all():
        decoder.note_axes()
        if decoder.turns_dvl:
            values, covariances = _turned(HALF_TURN, values, covariances, np.ones(len(decoded), dtype=bool))
    return sample_block(
        stream, _stamped(stream, decoded, decoder, refused), values, covariance=covariances, frames=frames,
        arrival=decoded.arrival, refused=refused, reasons=reasons,
    )  # fmt: skip


def _turned(axes: Axes, values: Array, covariances: Covariances, which: Mask) -> tuple[Array, Covariances]:
    """Convert the velocities (N, 3) marked by `which` (N,) from other axes, with their covariances."""
    rotated = axes.covariance(covariances.distinct)
    if which.all():
        return axes.velocity(values), Covariances(rotated, covariances.index)
    n = len(covariances.distinct)
    distinct = np.concatenate([covariances.distinct, rotated])
    index = np.where(which & (covariances.index >= 0), covariances.index + n, covariances.index)
    return np.where(which[:, None], axes.velocity(values), values), Covariances(distinct, index.astype(np.intp))


def _imu(stream: Stream, decoded: DecodedRows, decoder: MessageDecoder) -> SampleBlock:
    """Return attitudes and angular velocities."""
    refused = np.zeros(len(decoded), dtype=np.uint8)
    stamps_ns = _stamped(stream, decoded, decoder, refused)
    block = sample_block(stream, stamps_ns, decoded.values, arrival=decoded.arrival, refused=refused)
    return decoder.imu_alignment.block(block)


def _stamped(stream: Stream, decoded: DecodedRows, decoder: MessageDecoder, refused: Any) -> Stamps:
    """Return stamps, with the log time for missing ones."""
    is_zero = (decoded.stamps_ns == 0) & (refused == 0)
    if is_zero.any():
        decoder.note_zero_stamps(stream, int(np.count_nonzero(is_zero)))
    return np.where(is_zero, decoded.log_ns, decoded.stamps_ns)


def _of_rows(stream: Stream, rows: list[tuple[int, Decoded]]) -> SampleBlock:
    """Return the samples that were decoded individually."""
    messages = DecodedMessages()
    for _, decoded in rows:
        messages.add(stream, decoded.reason if isinstance(decoded, Refusal) else decoded)
    return messages.block(stream, np.array([arrival for arrival, _ in rows], dtype=np.int64))


def _index_of_reason(reasons: list[str], reason: str) -> int:
    if reason not in reasons:
        reasons.append(reason)
    return reasons.index(reason)
