"""Recordings damaged as power losses and bad disks do it, and what this and other readers get out of them.

`python test/damage.py` prints a table: messages that each reader recovers, and the number of whole ones.
"""

from __future__ import annotations

import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from io_fixtures import mcap_bytes, raw, run, storage_file, write_bag
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType
from rosbags.rosbag2 import Reader

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.errors import InputError

Recorded = tuple[str, int, bytes]
GIGABYTES = struct.pack("<Q", 8 << 30)
CHUNK_SIZE = 1 << 15
PAGE = 4096


class Damaged(NamedTuple):
    """A damaged file, and the messages in it that are whole: not cut, and in no chunk whose checksum fails."""

    name: str
    content: bytes
    whole: list[Recorded]
    recorded: list[Recorded]


def recorded(seconds: float = 60.0) -> list[Recorded]:
    with tempfile.TemporaryDirectory() as folder:
        messages = raw(write_bag(Path(folder) / "bag", run(seconds)))
    return [(topic, log_ns + i, data) for i, (topic, log_ns, data) in enumerate(messages)]


def chunk_spans(content: bytes) -> list[tuple[int, int, int, int]]:
    """First and last byte, first and last log time of every chunk."""
    return [
        (c.chunk_start_offset, c.chunk_start_offset + c.chunk_length, c.message_start_time, c.message_end_time)
        for c in make_reader(BytesIO(content)).get_summary().chunk_indexes
    ]


def _changed(content: bytes, at: int, new: bytes) -> bytes:
    return content[:at] + new + content[at + len(new) :]


def mcap_cases(messages: list[Recorded]) -> Iterator[Damaged]:
    packed = {
        name: mcap_bytes(messages, compression=kind, chunk_size=CHUNK_SIZE)
        for name, kind in (
            ("zstd", CompressionType.ZSTD),
            ("lz4", CompressionType.LZ4),
            ("not compressed", CompressionType.NONE),
        )
    }
    zstd, plain = packed["zstd"], packed["not compressed"]
    chunks = chunk_spans(zstd)
    begin, end, first, _ = chunks[len(chunks) // 2]

    def case(name: str, content: bytes, whole: list[Recorded]) -> Damaged:
        return Damaged(f"MCAP, {name}", content, whole, messages)

    before = [message for message in messages if message[1] < first]
    yield case("zstd: cut in the middle of a chunk", zstd[: (begin + end) // 2], before)
    cut = plain[: len(plain) * 6 // 10]
    yield case("not compressed: cut in the middle of a chunk", cut, [m for m in messages if m[2] in cut])
    index = zstd.rindex(b"\x08", 0, len(zstd) - 400)
    yield case("zstd: cut in the middle of the index", zstd[: index + 40], messages)
    yield case("zstd: without footer", zstd[:-37], messages)
    for name, content in packed.items():
        spans = chunk_spans(content)
        begin, end, first, last = spans[len(spans) // 2]
        at = (begin + end) // 2
        damaged = _changed(content, at, bytes([content[at] ^ 0xFF]))
        whole = [message for message in messages if not first <= message[1] <= last]
        yield case(f"{name}: a damaged chunk in the middle", damaged, whole)
        cut = damaged[: spans[-1][0] + 20]
        whole = [message for message in whole if message[1] < spans[-1][2]]
        yield case(f"{name}: a damaged chunk in the middle, the last one cut", cut, whole)
    claims = _changed(zstd, chunks[len(chunks) // 2][0] + 1, GIGABYTES)
    yield case("zstd: a chunk that claims 8 GB, without footer", claims[:-37], messages)
    flat = mcap_bytes(messages, use_chunking=False)
    middle = messages[len(messages) // 2]
    claims = _changed(flat, flat.index(middle[2]) - 22 - 8, GIGABYTES)
    yield case("without chunks: a message that claims 8 GB", claims, [m for m in messages if m != middle])
    yield case("zstd: the first 16 bytes were never written", bytes(16) + zstd[16:], messages)


def sqlite_cases() -> Iterator[Damaged]:
    with tempfile.TemporaryDirectory() as folder:
        file = storage_file(write_bag(Path(folder) / "bag", run(60.0), "sqlite3"))
        messages = raw(file)
        content = file.read_bytes()
        with sqlite3.connect(file) as connection:
            ((root,),) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
        connection.close()

    # a small message lies in one piece; one that goes on in another page is not here
    places = [(message, content.find(message[2])) for message in messages]

    def whole(damaged: bytes) -> list[Recorded]:
        return [m for m, at in places if at >= 0 and damaged[at : at + len(m[2])] == m[2]]

    cut = content[: len(content) * 6 // 10]
    yield Damaged("SQLite: cut at 60 %", cut, whole(cut), messages)
    middle = len(content) // PAGE // 2 * PAGE
    for name, at in (
        ("a page in the middle zeroed", middle),
        ("the root page of the messages zeroed", (root - 1) * PAGE),
        ("the first page zeroed", 0),
    ):
        damaged = _changed(content, at, bytes(PAGE))
        yield Damaged(f"SQLite: {name}", damaged, whole(damaged), messages)


# ---------------------------------------------------------------------- readers


def _ours(path: Path) -> Iterator[Recorded]:
    with suppress(InputError), BagReader([path]) as bag:
        yield from ((channel.topic, log_ns, data) for log_ns, channel, data in bag.raw_messages(bag.topics))


def _rosbags(path: Path) -> Iterator[Recorded]:
    with Reader(path) as bag:
        for connection, log_ns, data in bag.messages():
            yield connection.topic, log_ns, data


def _mcap(path: Path) -> Iterator[Recorded]:
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            yield channel.topic, message.log_time, message.data


def _mcap_linear(path: Path) -> Iterator[Recorded]:
    """Record by record until it gives up, with checksums: what `mcap recover` does."""
    channels: dict[int, str] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            for inner in breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]:
                if isinstance(inner, Channel):
                    channels[inner.id] = inner.topic
                elif isinstance(inner, Message):
                    yield channels[inner.channel_id], inner.log_time, inner.data


def _sqlite(path: Path) -> Iterator[Recorded]:
    connection = sqlite3.connect(f"file:{path}?immutable=1", uri=True)
    query = "SELECT name, timestamp, data FROM messages JOIN topics ON topic_id = topics.id"
    yield from connection.execute(query)


READERS: dict[str, Callable[[Path], Iterator[Recorded]]] = {
    "ours": _ours,
    "rosbags": _rosbags,
    "mcap reader": _mcap,
    "mcap, linear": _mcap_linear,
    "sqlite3": _sqlite,
}
MCAP_READERS, SQLITE_READERS = ("ours", "rosbags", "mcap reader", "mcap, linear"), ("ours", "rosbags", "sqlite3")


def readers_of(case: Damaged) -> Sequence[str]:
    return MCAP_READERS if case.name.startswith("MCAP") else SQLITE_READERS


def recover(case: Damaged, reader: str, folder: Path) -> tuple[int, int]:
    """Whole messages that a reader gets, and messages that were never recorded so."""
    path = folder / f"damaged.{'mcap' if case.name.startswith('MCAP') else 'db3'}"
    path.write_bytes(case.content)
    found: list[Recorded] = []
    with suppress(Exception):  # that they give up is what is counted
        found.extend(READERS[reader](path))
    whole = set(case.whole)
    return len(whole.intersection(found)), len(set(found).difference(case.recorded))


@cache
def cases() -> list[Damaged]:
    return [*mcap_cases(recorded()), *sqlite_cases()]


def table() -> str:
    lines = [f"| damage | whole | {' | '.join(READERS)} |", f"|---|---|{'---|' * len(READERS)}"]
    with tempfile.TemporaryDirectory() as folder:
        for case in cases():
            cells = {}
            for reader in readers_of(case):
                whole, wrong = recover(case, reader, Path(folder))
                cells[reader] = f"{whole}" + (f" and {wrong} wrong" if wrong else "")
            shown = " | ".join(cells.get(reader, "-") for reader in READERS)
            lines.append(f"| {case.name} | {len(case.whole)} | {shown} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(table(), end="")
