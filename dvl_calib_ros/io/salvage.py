"""Read what is whole in a damaged recording: MCAP without footer or cut in a chunk, SQLite cut short.

MCAP: https://mcap.dev/spec. The framing (opcode, length, content) is walked here because a reader that trusts lengths
and indexes gives up, or returns half a message; the records inside are parsed by the mcap library.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
_CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC
_LENGTH = struct.Struct("<Q")
# A record that claims more than this is damage: the largest that recorders write are chunks of a few MB.
LARGEST_RECORD = 1 << 30


class Salvaged(NamedTuple):
    """One whole message. definition is the embedded one, '' if there is none; encoding ros2msg or ros2idl."""

    topic: str
    msgtype: str
    encoding: str
    definition: str
    log_ns: int
    data: bytes


class _CutError(Exception):
    """The record is not all there."""


def salvage_mcap(path: Path) -> Iterator[Salvaged]:
    """All whole messages up to the damage, in file order."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        size = path.stat().st_size
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            return
        for opcode, content, whole in _records(file, size):
            if opcode == Opcode.CHUNK:
                yield from _salvage_chunk(content, schemas, channels)
            elif whole:
                message = _take(opcode, content, schemas, channels)
                if message is not None:
                    yield message
            if opcode == Opcode.DATA_END:
                return


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, bytes, bool]]:
    """Opcode, content and whether it is whole, of every record up to the first that is cut or absurd."""
    while True:
        head = file.read(9)
        if len(head) < 9:
            return
        (length,) = _LENGTH.unpack_from(head, 1)
        if length > LARGEST_RECORD or head[0] == 0:
            return
        content = file.read(min(length, size))
        whole = len(content) == length
        yield head[0], content, whole
        if not whole:
            return


def _salvage_chunk(content: bytes, schemas: dict[int, Schema], channels: dict[int, Channel]) -> Iterator[Salvaged]:
    """Messages of a chunk that may be cut, in order of log time as an indexed reader gives them."""
    try:
        records = BytesIO(_decompress_start(content))
    except _CutError:
        return
    found = []
    for opcode, inner, whole in _records(records, records.getbuffer().nbytes):
        message = _take(opcode, inner, schemas, channels) if whole else None
        if message is not None:
            found.append(message)
    yield from sorted(found, key=lambda message: message.log_ns)


def _decompress_start(content: bytes) -> bytes:
    """As much of a chunk's records as its bytes give."""
    at = _CHUNK_HEAD.size
    if len(content) < at + 4:
        raise _CutError
    (name_length,) = struct.unpack_from("<I", content, at)
    name = content[at + 4 : at + 4 + name_length]
    compressed = content[at + 4 + name_length + 8 :]
    if name == b"zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor().decompressobj()
        return _feed_pieces(decompressor.decompress, compressed, zstandard.ZstdError)
    if name == b"lz4":
        import lz4.frame

        return _feed_pieces(lz4.frame.LZ4FrameDecompressor().decompress, compressed, RuntimeError)
    if name == b"":
        return compressed
    raise _CutError


def _feed_pieces(decompress, compressed: bytes, error: type[Exception]) -> bytes:  # type: ignore[no-untyped-def]
    """Decompress piece by piece, so that damage costs what comes after it and not what comes before."""
    output = bytearray()
    piece = 4096
    try:
        for start in range(0, len(compressed), piece):
            output += decompress(compressed[start : start + piece])
    except (error, EOFError):
        pass
    return bytes(output)


def _take(opcode: int, content: bytes, schemas: dict[int, Schema], channels: dict[int, Channel]) -> Salvaged | None:
    """Take note of a schema or channel, or return a message."""
    stream = ReadDataStream(BytesIO(content))
    try:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            message = Message.read(stream, len(content))
            channel = channels[message.channel_id]
            known = schemas.get(channel.schema_id)
            return Salvaged(
                channel.topic,
                known.name if known else "",
                known.encoding if known else "",
                known.data.decode("utf-8", "replace") if known else "",
                message.log_time,
                message.data,
            )
    except Exception:  # what is not a record is damage, whatever the parser makes of it
        return None
    return None


def salvage_sqlite(path: Path) -> Iterator[Salvaged]:
    """All messages of a damaged rosbag2 database that SQLite can still reach, in the order they were written."""
    connection = sqlite3.connect(f"file:{path}?immutable=1", uri=True)
    try:
        topics = dict(_rows(connection, "SELECT id, name FROM topics"))
        types = dict(_rows(connection, "SELECT id, type FROM topics"))
        definitions = {
            name: (encoding, text)
            for name, encoding, text in _rows(
                connection, "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
        }
        # by rowid: the index on timestamp may lie behind the damage
        for topic_id, log_ns, data in _rows(
            connection, "SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id"
        ):
            if topic_id in topics:
                encoding, text = definitions.get(types[topic_id], ("", ""))
                yield Salvaged(topics[topic_id], types[topic_id], encoding, text, log_ns, data)
    finally:
        connection.close()


def _rows(connection: sqlite3.Connection, query: str) -> Iterator[tuple]:  # type: ignore[type-arg]
    """Rows up to the first that cannot be read."""
    try:
        yield from connection.execute(query)
    except sqlite3.Error:
        return
