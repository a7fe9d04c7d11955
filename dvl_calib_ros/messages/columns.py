"""Recorded messages to samples, thousands at once: the same samples, refusals and problems as one by one."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..bags.columns import Part, Window, windows
from ..bags.layout import Columns
from ..bags.reader import BagReader
from ..calibration.frames import FLU_FROM_FRD, Array
from ..calibration.samples import (
    FRAME_CODES,
    Codes,
    Covariances,
    DvlSample,
    ImuSample,
    Index,
    Mask,
    ReferenceSample,
    SampleBlock,
    Stamps,
    Stream,
    Streams,
    no_samples,
    sample_block,
)
from .decode import NO_DATA, TURNED_COVARIANCE, UNREADABLE, WRONG_FRAME, MessageDecoder, Refusal
from .drivers import VelocityType

Decoded = DvlSample | ReferenceSample | ImuSample | Refusal


class Stretch(NamedTuple):
    """What messages that follow each other in a recording are. log_ns: of the last of them."""

    streams: Streams
    log_ns: int


def sample_streams(bag: BagReader, topics: Mapping[str, Stream], decoder: MessageDecoder) -> Iterator[Stretch]:
    """All messages of some topics as columns, in bounded memory; `SampleBlock.arrival` has their order of log time."""
    streams = {name: stream for name, stream in topics.items() if name in bag.topics}
    types = {Stream.DVL: decoder.dvl_type, Stream.REFERENCE: decoder.reference_type}
    one_by_one = [name for name, stream in streams.items() if stream in types and not types[stream].is_read_in_columns]
    for window in windows(bag, streams.keys(), one_by_one):
        yield _stretch(window, streams, decoder)


def _stretch(window: Window, streams: Mapping[str, Stream], decoder: MessageDecoder) -> Stretch:
    of: dict[Stream, list[Part]] = {stream: [] for stream in Stream}
    for part in window.parts:
        of[streams[part.channel.topic]].append(part)
    blocks = {stream: _block(stream, parts, decoder) for stream, parts in of.items()}
    return Stretch(Streams(blocks[Stream.DVL], blocks[Stream.REFERENCE], blocks[Stream.IMU]), window.log_ns)


def _block(stream: Stream, parts: list[Part], decoder: MessageDecoder) -> SampleBlock:
    """The messages of one stream, in their order of arrival."""
    make: Callable[[Part], _Columns] = _Imu if stream is Stream.IMU else lambda part: _Velocity(stream, part, decoder)
    in_columns: list[_Columns] = []
    singly: list[Part] = []
    for part in parts:
        try:
            in_columns.append(make(part))
        except UNREADABLE:  # its definition has other fields; one by one it is said what is missing
            singly.append(part)
    # a frame is judged when the first message of it arrives: the DVL's first is its own
    pending = deque(sorted((arrival, name) for each in in_columns for name, arrival in each.frames.items()))
    judge = {
        Stream.DVL: decoder.accepts_dvl_frame, Stream.REFERENCE: decoder.reference_frame,
        Stream.IMU: decoder.note_imu_frame,
    }[stream]  # fmt: skip
    rows: list[tuple[int, int, Decoded]] = []
    decode: Callable[[Any, int], Decoded] = {
        Stream.DVL: decoder.dvl, Stream.REFERENCE: decoder.reference, Stream.IMU: decoder.imu
    }[stream]  # fmt: skip
    for arrival, log_ns, (message, why) in heapq.merge(*map(_rows, singly), key=lambda row: row[0]):
        while pending and pending[0][0] < arrival:
            judge(pending.popleft()[1])
        rows.append((arrival, log_ns, decoder.undecodable(stream, why) if why else decode(message, log_ns)))
    for _, name in pending:
        judge(name)
    blocks = [each.block(decoder) for each in in_columns] + ([_of_rows(stream, rows)] if rows else [])
    if not blocks:
        return no_samples(stream)
    block = blocks[0]
    for other in blocks[1:]:
        block = block.joined(other)
    return block if len(blocks) == 1 else block.part(np.argsort(block.arrival, kind="stable"))


def _rows(part: Part) -> Iterator[tuple[int, int, tuple[Any, str]]]:
    return zip(part.arrival.tolist(), part.log_ns.tolist(), part.messages(), strict=True)


def _of_rows(stream: Stream, rows: list[tuple[int, int, Decoded]]) -> SampleBlock:
    """Messages that were decoded one by one."""
    n = len(rows)
    reasons: list[str] = []
    refused, frames = np.zeros(n, dtype=np.uint8), np.zeros(n, dtype=np.uint8)
    stamps_ns = np.zeros(n, dtype=np.int64)
    values = np.full((n, 7 if stream is Stream.IMU else 3), np.nan)
    distinct: list[Array] = []
    index = np.full(n, -1, dtype=np.intp)
    for row, (_, _, decoded) in enumerate(rows):
        if isinstance(decoded, Refusal):
            refused[row] = 1 + _place(reasons, decoded.reason)
            continue
        stamps_ns[row] = decoded.stamp_ns
        if isinstance(decoded, ImuSample):
            values[row, :4] = np.nan if decoded.orientation is None else decoded.orientation
            values[row, 4:] = np.nan if decoded.angular_velocity is None else decoded.angular_velocity
            continue
        values[row] = decoded.velocity
        if isinstance(decoded, ReferenceSample):
            frames[row] = FRAME_CODES[decoded.frame]
        if decoded.covariance is not None:
            if not distinct or distinct[-1] is not decoded.covariance:
                distinct.append(decoded.covariance)
            index[row] = len(distinct) - 1
    covariances = Covariances(np.array(distinct).reshape(-1, 3, 3), index)
    arrival = np.array([row[0] for row in rows], dtype=np.int64)
    return sample_block(
        stream, stamps_ns, values, covariance=covariances, frames=frames, arrival=arrival, refused=refused,
        reasons=reasons,
    )  # fmt: skip


def _place(reasons: list[str], reason: str) -> int:
    if reason not in reasons:
        reasons.append(reason)
    return reasons.index(reason)


class _Columns:
    """Messages of one layout. frames: frame_id -> arrival of the first message of it. Raises what is `UNREADABLE`."""

    def __init__(self, stream: Stream, part: Part, frame_ids: Any) -> None:
        if part.columns is None:
            raise ValueError("not laid out alike")
        self._stream, self._part, self._columns = stream, part, part.columns
        self._frame_names, self._frame_index = _names(frame_ids)
        firsts = [int(np.argmax(self._frame_index == place)) for place in range(len(self._frame_names))]
        self.frames = {name: int(part.arrival[first]) for name, first in zip(self._frame_names, firsts, strict=True)}
        stamp = part.columns.header.stamp
        self._stamps_ns: Stamps = stamp.sec.astype(np.int64) * 1_000_000_000 + stamp.nanosec

    def block(self, decoder: MessageDecoder) -> SampleBlock:
        """Samples and refusals, once all frames are judged."""
        raise NotImplementedError

    def _stamped(self, decoder: MessageDecoder, refused: Codes) -> Stamps:
        """Stamps, with the log time where there is none."""
        is_zero = (self._stamps_ns == 0) & (refused == 0)
        if is_zero.any():
            decoder.note_zero_stamps(self._stream, int(np.count_nonzero(is_zero)))
        return np.where(is_zero, self._part.log_ns, self._stamps_ns)


class _Velocity(_Columns):
    """Velocities of the DVL or of the reference."""

    def __init__(self, stream: Stream, part: Part, decoder: MessageDecoder) -> None:
        self._kind: VelocityType = decoder.dvl_type if stream is Stream.DVL else decoder.reference_type
        super().__init__(stream, part, self._kind.frame_id(part.columns))
        self._velocity = self._kind.velocity(part.columns)
        self._values = np.column_stack([self._velocity.x, self._velocity.y, self._velocity.z]).astype(float)
        self._covariances = _covariances(self._kind, self._columns)
        rules = self._kind.rules if stream is Stream.DVL else ()
        self._broken = [(rule.counter, rule.broken(self._columns, decoder.parameters)) for rule in rules]

    def block(self, decoder: MessageDecoder) -> SampleBlock:
        n = len(self._part)
        refused = np.zeros(n, dtype=np.uint8)
        reasons: list[str] = []
        frames = np.zeros(n, dtype=np.uint8)
        values, covariances = self._values, self._covariances
        if self._stream is Stream.DVL:
            accepted = np.array([name == decoder.dvl_frame for name in self._frame_names])
        else:
            known = [decoder.reference_frame(name) for name in self._frame_names]
            accepted = np.array([said is not None for said in known])
            codes = np.array([0 if said is None else FRAME_CODES[said.frame] for said in known], dtype=np.uint8)
            frames = codes[self._frame_index]
            down = np.array([said is not None and said.points_down for said in known])[self._frame_index]
            if down.any():
                values, covariances = _turned(values, covariances, down)
        for reason, is_broken in [(WRONG_FRAME, ~accepted[self._frame_index]), *self._broken]:
            new = np.asarray(is_broken) & (refused == 0)
            if new.any():
                refused[new] = 1 + _place(reasons, reason)
        if self._stream is Stream.DVL and not refused.all():
            decoder.note_axes()
            if decoder.turns_dvl:
                values, covariances = _turned(values, covariances, np.ones(n, dtype=bool))
        return sample_block(
            self._stream, self._stamped(decoder, refused), values, covariance=covariances, frames=frames,
            arrival=self._part.arrival, refused=refused, reasons=reasons,
        )  # fmt: skip


def _turned(values: Array, covariances: Covariances, which: Mask) -> tuple[Array, Covariances]:
    """Those of N velocities that are forward-right-down (N,) as forward-left-up, with their covariances."""
    if which.all():
        return values * FLU_FROM_FRD.diagonal(), Covariances(
            covariances.distinct * TURNED_COVARIANCE, covariances.index
        )
    n = len(covariances.distinct)
    both = np.concatenate([covariances.distinct, covariances.distinct * TURNED_COVARIANCE])
    index = np.where(which & (covariances.index >= 0), covariances.index + n, covariances.index)
    return np.where(which[:, None], values * FLU_FROM_FRD.diagonal(), values), Covariances(both, index.astype(np.intp))


def _covariances(kind: VelocityType, columns: Columns) -> Covariances:
    given, n = kind.covariance(columns), len(columns)
    if given is None:
        return Covariances.none(n)
    size = {9: 3, 36: 6}.get(given.shape[1])
    if size is None:
        raise ValueError(f"a covariance of {given.shape[1]} numbers")
    covariances = Covariances.of(given.reshape(n, size, size)[:, :3, :3], n)
    lacks = kind.lacks_covariance(columns)
    return Covariances(covariances.distinct, np.where(lacks, -1, covariances.index).astype(np.intp))


class _Imu(_Columns):
    """Attitudes and angular velocities."""

    def __init__(self, part: Part) -> None:
        super().__init__(Stream.IMU, part, part.columns.header.frame_id if part.columns else None)
        q, w = self._columns.orientation, self._columns.angular_velocity
        self._values = np.column_stack([q.x, q.y, q.z, q.w, w.x, w.y, w.z]).astype(float)
        self._values[self._columns.orientation_covariance[:, 0] == NO_DATA, :4] = np.nan
        self._values[self._columns.angular_velocity_covariance[:, 0] == NO_DATA, 4:] = np.nan

    def block(self, decoder: MessageDecoder) -> SampleBlock:
        refused = np.zeros(len(self._part), dtype=np.uint8)
        block = sample_block(
            Stream.IMU, self._stamped(decoder, refused), self._values, arrival=self._part.arrival, refused=refused
        )
        return decoder.imu_alignment.block(block)


def _names(frame_ids: Any) -> tuple[list[str], Index]:
    """Of (N, length) ASCII the distinct texts, and which is a row's."""
    n = len(frame_ids)
    if not frame_ids.shape[1] or (frame_ids == frame_ids[0]).all():
        return [frame_ids[0].tobytes().decode("ascii")], np.zeros(n, dtype=np.intp)
    places: dict[bytes, int] = {}
    index = [places.setdefault(row.tobytes(), len(places)) for row in frame_ids]
    return [name.decode("ascii") for name in places], np.array(index, dtype=np.intp)
