"""Messages in order of log time, however many there are."""

from __future__ import annotations

import heapq
import struct
import tempfile
from collections.abc import Iterable, Iterator
from operator import itemgetter
from typing import BinaryIO

from .channels import Channel

# What is sorted in memory at once; the rest waits on disk.
IN_MEMORY = 32 << 20
_HEAD = struct.Struct("<QII")  # log time (ns), number of the channel, length
# What a message takes in memory beside its bytes
_OVERHEAD = 200
# Read at once of each sorted part
_PART = 1 << 18

BagMessage = tuple[int, Channel, bytes]
"""Log time (ns), channel and bytes of a message."""


def by_log_time(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """The messages in order of log time, those of one time in the order they come in."""
    channels: dict[Channel, int] = {}
    with tempfile.TemporaryFile() as file:
        spans: list[tuple[int, int]] = []
        held: list[BagMessage] = []
        size = 0
        for message in messages:
            held.append(message)
            size += len(message[2]) + _OVERHEAD
            if size > IN_MEMORY:
                spans.append(_spill(file, held, channels))
                held, size = [], 0
        held.sort(key=itemgetter(0))
        known = list(channels)
        runs = [_run(file, *span, known) for span in spans]
        yield from heapq.merge(*runs, held, key=itemgetter(0))


def _spill(file: BinaryIO, held: list[BagMessage], channels: dict[Channel, int]) -> tuple[int, int]:
    """Write a sorted run to the end of the file; where it begins and ends."""
    start = file.seek(0, 2)
    held.sort(key=itemgetter(0))
    for log_ns, channel, data in held:
        number = channels.setdefault(channel, len(channels))
        file.write(_HEAD.pack(log_ns, number, len(data)))
        file.write(data)
    return start, file.tell()


def _run(file: BinaryIO, at: int, end: int, channels: list[Channel]) -> Iterator[BagMessage]:
    """A run from the file, read a part at a time: all runs share the file."""
    rest = b""
    while at < end:
        file.seek(at)
        part = rest + file.read(min(_PART, end - at))
        at += len(part) - len(rest)
        here = 0
        while here + _HEAD.size <= len(part):
            log_ns, number, length = _HEAD.unpack_from(part, here)
            if here + _HEAD.size + length > len(part):
                break
            yield log_ns, channels[number], part[here + _HEAD.size : here + _HEAD.size + length]
            here += _HEAD.size + length
        rest = part[here:]
