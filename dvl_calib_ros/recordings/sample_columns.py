"""Samples of kept messages, the same as those of a `MessageDecoder` that receives them individually."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import (
    FRAME_CODES,
    FRAMES,
    Codes,
    Covariances,
    Mask,
    SampleBlock,
    Stamps,
    Stream,
    Streams,
    no_samples,
    sample_block,
)
from ..messages.decode import AS_SENT, FIRST_FIX, HALF_TURN, INVALID, WRONG_FRAME, Axes, MessageDecoder
from ..messages.positions import SATELLITES
from .columns import TopicColumns, differenced, joined

# messages of a stretch: enough for columns to be efficient, few enough for the caches
STRETCH_MESSAGES = 4096
# a share of a recording is read in this number of windows, each of at least this number of stretches
WINDOWS, STRETCHES_OF_A_WINDOW = 3, 10


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
    arrival = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *(part.arrival for part in all_parts)]))
    if share < 1.0:  # samples after a gap are processed individually, which must be a small part of a window
        at_once = min(at_once, 1 + int(len(arrival) * share / (WINDOWS * STRETCHES_OF_A_WINDOW)))
    # for each stretch, the first arrival after it
    ends = [*arrival[at_once::at_once].tolist(), int(arrival[-1]) + 1] if len(arrival) else []
    cuts = {id(part): [0, *np.searchsorted(part.arrival, ends).tolist()] for part in all_parts}
    for index in range(len(ends)):
        if (len(ends) - 1 - index) * WINDOWS % len(ends) >= share * len(ends):
            continue
        until = [(part, cuts[id(part)][index + 1]) for part in all_parts]
        log_ns = max(int(part.log_ns[end - 1]) if end else 0 for part, end in until)
        blocks = {}
        for stream in (Stream.DVL, Stream.REFERENCE, Stream.IMU):
            rows = [part.part(slice(*cuts[id(part)][index : index + 2])) for part in columns.get(stream, ())]
            rows = [part for part in rows if len(part)]
            blocks[stream] = _block(stream, joined(rows), decoder) if rows else no_samples(stream)
        yield Stretch(Streams(blocks[Stream.DVL], blocks[Stream.REFERENCE], blocks[Stream.IMU]), log_ns)


def _block(stream: Stream, rows: TopicColumns, decoder: MessageDecoder) -> SampleBlock:
    """Return the samples of one stream, in order of arrival."""
    judge: Mapping[Stream, Callable[[str], object]] = {
        Stream.DVL: decoder.accepts_dvl_frame, Stream.REFERENCE: decoder.reference_frame,
        Stream.IMU: decoder.note_imu_frame,
    }  # fmt: skip
    readable = rows.readable
    # a frame is judged at its first message: the DVL's first frame is the DVL's own
    places, first = np.unique(readable.frame, return_index=True)
    for place in places[np.argsort(first)].tolist():
        judge[stream](readable.frames[place])
    block = (_imu if stream is Stream.IMU else _velocity)(stream, readable, decoder)
    if len(readable) == len(rows):
        return block
    for reason in rows.unread_reasons:
        decoder.undecodable(stream, reason)
    unread = rows.part(rows.frame < 0)
    refused = sample_block(
        stream, unread.stamps_ns, unread.values, arrival=unread.arrival, refused=np.ones(len(unread), dtype=np.uint8),
        reasons=(INVALID,),
    )  # fmt: skip
    block = block.joined(refused)
    return block.part(np.argsort(block.arrival, kind="stable"))


def _velocity(stream: Stream, rows: TopicColumns, decoder: MessageDecoder) -> SampleBlock:
    """Return the samples of DVL or reference, after all frames were judged."""
    values, covariances = rows.values, rows.covariances
    counters = [rule.counter for rule in decoder.dvl_type.rules] if stream is Stream.DVL else []
    places, index = np.unique(rows.frame, return_inverse=True)
    names = [rows.frames[place] for place in places.tolist()]
    if stream is Stream.DVL:
        is_other = np.array([name != decoder.dvl_frame for name in names], dtype=bool)[index]
        frames = np.zeros(len(rows), dtype=np.uint8)
    else:
        declared = [decoder.reference_frame(name) for name in names]
        is_other = np.array([each is None for each in declared], dtype=bool)[index]
        frames = np.array([FRAME_CODES[each.frame] if each else 0 for each in declared], dtype=np.uint8)[index]
        position = decoder.reference_type.position
        for axes in {each.axes for each in declared if each and position is not SATELLITES} - {AS_SENT}:
            which = np.array([each is not None and each.axes == axes for each in declared], dtype=bool)[index]
            values, covariances = _turned(axes, values, covariances, which)
        if position is not None:
            counters = [*(rule.counter for rule in decoder.reference_type.rules), FIRST_FIX]
            indices, distinct = covariances.index.astype(np.int32), covariances.distinct
            rows = replace(rows, values=values, covariance=indices, distinct=distinct)
            rows = _between_positions(rows, is_other, frames, decoder)
            values, covariances = rows.values, rows.covariances
    reasons = [WRONG_FRAME, *counters]
    broken = rows.broken + (rows.broken > 0) if counters else np.zeros(len(rows))
    refused = np.where(is_other, 1, broken).astype(np.uint8)
    if stream is Stream.DVL and not refused.all():
        decoder.note_axes()
        if decoder.turns_dvl:
            values, covariances = _turned(HALF_TURN, values, covariances, np.ones(len(rows), dtype=bool))
    return sample_block(
        stream, _stamped(stream, rows, decoder, refused), values, covariance=covariances, frames=frames,
        arrival=rows.arrival, refused=refused, reasons=reasons,
    )  # fmt: skip


def _between_positions(rows: TopicColumns, is_other: Mask, frames: Codes, decoder: MessageDecoder) -> TopicColumns:
    """Return positions as velocities between them; valid positions go to the decoder's `on_fix`.

    is_other: positions in another frame, which are not used.
    """
    stamps_ns, broken = _stamped(Stream.REFERENCE, rows, decoder, is_other), np.where(is_other, 1, rows.broken)
    rows = replace(rows, stamps_ns=stamps_ns, broken=broken.astype(np.uint8))
    valid = rows.part(broken == 0)
    places = [(x, y, z) for x, y, z in valid.values.tolist()]
    of_frames = [FRAMES[code] for code in frames[broken == 0].tolist()]
    for fix in zip(valid.stamps_ns.tolist(), places, valid.covariances.matrices, of_frames, strict=True):
        decoder.note_fix(*fix)
    return differenced(rows, decoder.fixes)


def _turned(axes: Axes, values: Array, covariances: Covariances, which: Mask) -> tuple[Array, Covariances]:
    """Convert the velocities (N, 3) marked by `which` (N,) from other axes, with their covariances."""
    rotated = axes.covariance(covariances.distinct)
    if which.all():
        return axes.velocity(values), Covariances(rotated, covariances.index)
    n = len(covariances.distinct)
    distinct = np.concatenate([covariances.distinct, rotated])
    index = np.where(which & (covariances.index >= 0), covariances.index + n, covariances.index)
    return np.where(which[:, None], axes.velocity(values), values), Covariances(distinct, index.astype(np.intp))


def _imu(stream: Stream, rows: TopicColumns, decoder: MessageDecoder) -> SampleBlock:
    """Return attitudes and angular velocities."""
    refused = np.zeros(len(rows), dtype=np.uint8)
    stamps_ns = _stamped(stream, rows, decoder, refused)
    block = sample_block(stream, stamps_ns, rows.values, arrival=rows.arrival, refused=refused)
    return decoder.imu_alignment.block(block)


def _stamped(stream: Stream, rows: TopicColumns, decoder: MessageDecoder, refused: Any) -> Stamps:
    """Return stamps, with the log time for missing ones."""
    is_zero = (rows.stamps_ns == 0) & (refused == 0)
    if is_zero.any():
        decoder.note_zero_stamps(stream, int(np.count_nonzero(is_zero)))
    return np.where(is_zero, rows.log_ns, rows.stamps_ns)
