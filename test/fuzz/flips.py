"""Bits flipped in MCAP files, and an account of every message: what no flip hit comes out, what is lost is said."""

from __future__ import annotations

import random
import re
import struct
from collections import Counter
from collections.abc import Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.errors import InputError

MESSAGES = 240
# Opcode and length; of a chunk what stands before its records: times, sizes, checksum, compression
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_ALL = frozenset(range(MESSAGES))
LAYOUTS: tuple[dict[str, Any], ...] = (
    {"use_chunking": False},
    {"use_chunking": False, "enable_crcs": False},
    {"enable_crcs": False},
    {"enable_crcs": False, "index_types": IndexType.NONE},
    {"use_chunking": False, "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
    {},
    {"compression": CompressionType.LZ4},
    {"compression": CompressionType.ZSTD},
    {"compression": CompressionType.ZSTD, "enable_crcs": False},
    {"compression": CompressionType.LZ4, "index_types": IndexType.NONE},
)


class Recorded(NamedTuple):
    """A sound file. spans: first byte and the one after the last, and the messages that a flip between may cost.

    definitions: the same of schemas and channels; repeated: of the same in the summary, which begins at `summary`.
    """

    content: bytes
    messages: list[tuple[str, int, bytes]]
    spans: list[tuple[int, int, frozenset[int]]]
    definitions: list[tuple[int, int]]
    repeated: list[tuple[int, int]]
    summary: int


@cache
def recorded(layout: int) -> Recorded:
    """Write three topics: of one length, of that of another, of any."""
    source = random.Random(layout)
    start_ns = 1_700_000_000_000_000_000
    messages = []
    for number in range(MESSAGES):
        topic, size = (("/dvl", 33), ("/imu", 97), ("/log", source.randrange(1, 300)))[number % 7 % 3]
        body = number.to_bytes(4, "little") + source.randbytes(size // 2) + bytes(size - size // 2)
        messages.append((topic, start_ns + number * 7_000_000, b"\0\1\0\0" + body))
    output = BytesIO()
    options = {"chunk_size": 4000, "compression": CompressionType.NONE, **LAYOUTS[layout]}
    writer = Writer(output, **options)
    writer.start("ros2", "")
    channels: dict[str, int] = {}
    for number, (topic, log_ns, data) in enumerate(messages):
        if topic not in channels:
            schema = writer.register_schema(f"a/msg/{topic[1:].title()}", "ros2msg", b"uint8 x")
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic], log_ns, data, log_ns, number)
    writer.finish()
    return _mapped(output.getvalue(), messages, options)


def _mapped(content: bytes, messages: list[tuple[str, int, bytes]], options: dict[str, Any]) -> Recorded:
    numbers = {data: number for number, (_, _, data) in enumerate(messages)}
    spans: list[tuple[int, int, frozenset[int]]] = []
    definitions: list[tuple[int, int]] = []
    at, behind, summary = 8, 0, len(content)
    while at < summary:
        opcode, length = _HEAD.unpack_from(content, at)
        end = at + _HEAD.size + length
        if opcode == Opcode.CHUNK:
            name_length = _CHUNK_HEAD.unpack_from(content, at + _HEAD.size)[-1]
            begin = at + _HEAD.size + _CHUNK_HEAD.size + name_length + 8
            is_checked = options["compression"] is not CompressionType.NONE or options.get("enable_crcs", True)
            last = behind + _count(options, content[begin:end], name_length)
            spans.append((at, end if is_checked else begin, frozenset(range(behind, last))))
            if is_checked:
                definitions.append((at, end))
                behind = last
            else:
                inner = _records(content, begin, end, numbers)
                spans += [span for span in inner if span[2]]
                definitions += [span[:2] for span in inner if not span[2]]
                behind = last
        elif opcode == Opcode.DATA_END:
            summary = end
        else:
            (span,) = _records(content, at, end, numbers)
            spans.append(span)
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append(span[:2])
        at = end
    repeated = [
        (start, stop)
        for start, stop, opcode in _heads(content, summary, len(content) - 8)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
    ]
    return Recorded(content, messages, spans, definitions, repeated, summary)


def _count(options: dict[str, Any], packed: bytes, name_length: int) -> int:
    """Return how many messages a chunk holds."""
    if name_length == 3:
        import lz4.frame

        packed = lz4.frame.decompress(packed)
    elif name_length:
        from dvl_calib_ros.bags.reader import zstd

        packed = zstd.decompress(packed)
    return sum(1 for *_, opcode in _heads(packed, 0, len(packed)) if opcode == Opcode.MESSAGE)


def _heads(content: bytes, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    while at < end:
        opcode, length = _HEAD.unpack_from(content, at)
        yield at, at + _HEAD.size + length, opcode
        at += _HEAD.size + length


def _records(content: bytes, at: int, end: int, numbers: dict[bytes, int]) -> list[tuple[int, int, frozenset[int]]]:
    return [
        (start, stop, frozenset([numbers[content[start + 31 : stop]]] if opcode == Opcode.MESSAGE else []))
        for start, stop, opcode in _heads(content, at, end)
    ]


def flipped(data: bytes) -> tuple[Recorded, bytes, list[int]]:
    """Return a file by an input: the first byte chooses it, each four more a bit to flip, five at most."""
    of = recorded(data[0] % len(LAYOUTS))
    content = bytearray(of.content)
    places = []
    for at in range(1, min(len(data), 21) - 3, 4):
        bit = int.from_bytes(data[at : at + 4], "little") % (8 * len(content))
        content[bit // 8] ^= 1 << bit % 8
        places.append(bit // 8)
    return of, bytes(content), places


def cost(of: Recorded, places: list[int], has_checksum: bool) -> frozenset[int]:
    """Return the messages that flips at these bytes may cost."""
    hit: frozenset[int] = frozenset()
    for place in places:
        for start, end, messages in of.spans:
            if start <= place < end:
                hit |= messages
    in_summary = any(place >= of.summary for place in places)
    in_definitions, in_repeated = (
        any(start <= place < end for place in places for start, end in spans) for spans in (of.definitions, of.repeated)
    )
    # what is said twice is lost where both are damaged; of two that differ, without a checksum, either may be right
    return _ALL if (in_summary and in_definitions) or (in_repeated and not has_checksum) else hit


def run_flips(data: bytes, path: Path) -> None:
    """Read a file with flipped bits, and account for its messages."""
    if len(data) < 5:
        return
    of, content, places = flipped(data)
    path.write_bytes(content)
    try:
        with BagReader([path]) as bag:
            found = [(channel.topic, data) for _, channel, data in bag.raw_messages(bag.topics)]
            notes = bag.notes
    except InputError as error:
        found, notes = [], [str(error)]
    options = LAYOUTS[data[0] % len(LAYOUTS)]
    hit = cost(of, places, options.get("enable_crcs", True))
    counts = Counter(found)
    wanted = {(topic, content) for number, (topic, _, content) in enumerate(of.messages) if number not in hit}
    lost = [each for each in wanted if counts[each] != 1]
    assert not lost, f"{len(lost)} of {MESSAGES} messages lost or doubled, of which no bit was flipped"
    others = len(found) - sum(counts[topic, content] for topic, _, content in of.messages)
    assert others <= len(places) + len(hit), f"{others} messages that were not recorded"
    missing = MESSAGES - len(found)
    assert missing <= 0 or notes, f"{missing} messages lost, and nothing said"
    said = re.search(r"(\d+) messages? lost", " ".join(notes))
    # a message that came out as another one is lost as well, whether or not that is noticed
    assert said is None or missing <= int(said[1]) <= missing + others + len(places), f"{missing} lost: {notes}"
    is_counted = options.get("use_statistics", True) and all(place < of.summary for place in places)
    assert said or missing <= 0 or not is_counted, f"{missing} lost: {notes}"


def flip_seeds() -> Iterator[bytes]:
    """Yield two flips in each layout: in a log time, and in a later length."""
    for layout in range(len(LAYOUTS)):
        of = recorded(layout)
        start, later = (of.spans[len(of.spans) * part // 4][0] for part in (1, 3))
        bits = 8 * (start + 15 + 7) + 5, 8 * (later + 1) + 6
        yield bytes([layout]) + b"".join(bit.to_bytes(4, "little") for bit in bits)
    yield from (bytes([layout]) + random.Random(layout).randbytes(20) for layout in range(len(LAYOUTS)))
