"""Batches of recorded messages, located in shared bytes and sorted by log time."""

from __future__ import annotations

import heapq
import struct
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .channels import Channel

# limits of a batch collected from single messages
MOST_MESSAGES, MOST_BYTES = 4096, 4 << 20
# a later log time does not fit int64, the type of columns and SQLite
LATEST_NS = 2**63 - 1

Times = NDArray[Any]
"""(N,) ns, int64; Python integers if damaged ones do not fit int64."""
Index = NDArray[np.intp]


class Batch(NamedTuple):
    """N consecutive messages of a recording, in order of log time.

    log_ns: (N,).
    number: (N,) of each message's channel in `channels`.
    start, end: (N,) bounds of each in `content`.
    """

    log_ns: Times
    number: NDArray[np.intp]
    start: Index
    end: Index
    content: bytes
    channels: Mapping[int, Channel]

    @property
    def size(self) -> int:
        """Number of messages."""
        return len(self.log_ns)

    def part(self, at: Any) -> Batch:
        """Return the messages of a slice, of indices or of a mask."""
        return self._replace(log_ns=self.log_ns[at], number=self.number[at], start=self.start[at], end=self.end[at])

    def data(self) -> Iterator[bytes]:
        """Yield the bytes of each message."""
        content = self.content
        return (content[start:end] for start, end in zip(self.start.tolist(), self.end.tolist(), strict=True))

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages individually."""
        channels = self.channels
        of_each = [channels[number] for number in self.number.tolist()]
        return zip(self.log_ns.tolist(), of_each, self.data(), strict=True)

    def begin_with(self, magic: bytes) -> NDArray[np.bool_]:
        """Return which messages (N,) begin with these bytes."""
        found = np.zeros(self.size, dtype=bool)
        candidates = np.flatnonzero(self.end - self.start >= len(magic))
        content = np.frombuffer(self.content, dtype=np.uint8)
        for position, byte in enumerate(magic):
            candidates = candidates[content[self.start[candidates] + position] == byte]
        found[candidates] = True
        return found

    def rows(self, at: Index, length: int) -> NDArray[Any]:
        """Return a copy of messages of one length above zero, as (M,) items of that many bytes."""
        item = np.dtype(("V", length))
        overlapping = np.ndarray((len(self.content) - length + 1,), item, self.content, strides=(1,))
        return overlapping[self.start[at]]  # `take` would first copy all overlapping items

    def compact(self) -> Batch:
        """Return the batch without unused bytes."""
        end = np.cumsum(self.end - self.start)
        return self._replace(start=end - (self.end - self.start), end=end, content=b"".join(self.data()))

    def merged(self, later: Batch) -> Batch:
        """Merge with another batch of the same channels; at equal times its messages come later."""
        if not self.size:
            return later
        shift = len(self.content)
        log_ns = np.concatenate([self.log_ns, later.log_ns])
        joined = Batch(
            log_ns,
            np.concatenate([self.number, later.number]),
            np.concatenate([self.start, later.start + shift]),
            np.concatenate([self.end, later.end + shift]),
            self.content + later.content,
            self.channels,
        )
        return joined.sorted()

    def sorted(self) -> Batch:
        """Return the batch in order of log time, stable for equal times."""
        if (self.log_ns[1:] >= self.log_ns[:-1]).all():
            return self
        return self.part(np.argsort(self.log_ns, kind="stable"))


def times(log_ns: Any) -> Times:
    """Return log times (N,), also of damaged recordings."""
    array = np.asarray(log_ns)
    if array.dtype.kind == "u":
        return array.astype(np.int64 if not len(array) or array.max() <= LATEST_NS else object)
    try:
        return np.array(log_ns, dtype=np.int64)
    except OverflowError:
        return np.array(log_ns, dtype=object)


def batched(messages: Iterable[BagMessage]) -> Iterator[Batch]:
    """Group single messages in order of log time; those before an exception are yielded first."""
    held: list[BagMessage] = []
    size = 0
    try:
        for message in messages:
            held.append(message)
            size += len(message[2])
            if len(held) >= MOST_MESSAGES or size >= MOST_BYTES:
                yield one_batch(held)
                held, size = [], 0
    except Exception:
        if held:
            yield one_batch(held)
        raise
    if held:
        yield one_batch(held)


def one_batch(messages: Iterable[BagMessage]) -> Batch:
    """Return messages as one batch, in their order."""
    log_ns, channels, data = tuple(zip(*messages, strict=True)) or ((), (), ())
    numbers: dict[int, int] = {}  # the channel's id is cheap; its hash would take most of the time
    number = np.array([numbers.setdefault(id(channel), len(numbers)) for channel in channels], dtype=np.intp)
    return numbered_batch(log_ns, number, data, {numbers[id(channel)]: channel for channel in channels})


def numbered_batch(
    log_ns: Sequence[int], number: Sequence[int] | Index, data: Sequence[bytes], channels: Mapping[int, Channel]
) -> Batch:
    """Return messages with log times and channel numbers (N,) as one batch, in their order."""
    length = np.array([len(message) for message in data], dtype=np.intp)
    end = np.cumsum(length)
    return Batch(times(log_ns), np.asarray(number, dtype=np.intp), end - length, end, b"".join(data), channels)


# bytes sorted in memory at a time; the rest waits on disk
IN_MEMORY = 32 << 20
_HEAD = struct.Struct("<QII")  # log time (ns), channel number, length
# memory per message in addition to its bytes
_OVERHEAD = 200
# bytes read at a time from each sorted part
_PART = 1 << 18

BagMessage = tuple[int, Channel, bytes]
"""Log time (ns), channel and bytes of a message."""


def by_log_time(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """Yield the messages in order of log time, stable for equal times."""
    channels: dict[Channel, int] = {}
    with tempfile.TemporaryFile() as file:
        spans: list[tuple[int, int]] = []
        held: list[BagMessage] = []
        size = 0
        for message in messages:
            held.append(message)
            size += len(message[2]) + _OVERHEAD
            if size > IN_MEMORY:
                spans.append(_write_run(file, held, channels))
                held, size = [], 0
        held.sort(key=itemgetter(0))
        known = list(channels)
        runs = [_read_run(file, *span, known) for span in spans]
        yield from heapq.merge(*runs, held, key=itemgetter(0))


def _write_run(file: BinaryIO, held: list[BagMessage], channels: dict[Channel, int]) -> tuple[int, int]:
    """Append a sorted run to the file. Return its start and end."""
    start = file.seek(0, 2)
    held.sort(key=itemgetter(0))
    for log_ns, channel, data in held:
        number = channels.setdefault(channel, len(channels))
        file.write(_HEAD.pack(log_ns, number, len(data)))
        file.write(data)
    return start, file.tell()


def _read_run(file: BinaryIO, at: int, end: int, channels: list[Channel]) -> Iterator[BagMessage]:
    """Yield a run from the file, read in parts, because all runs share the file."""
    incomplete = b""
    while at < end:
        file.seek(at)
        part = incomplete + file.read(min(_PART, end - at))
        at += len(part) - len(incomplete)
        offset = 0
        while offset + _HEAD.size <= len(part):
            log_ns, number, length = _HEAD.unpack_from(part, offset)
            if offset + _HEAD.size + length > len(part):
                break
            yield log_ns, channels[number], part[offset + _HEAD.size : offset + _HEAD.size + length]
            offset += _HEAD.size + length
        incomplete = part[offset:]
