"""Read what is whole in a damaged recording: MCAP without footer or cut in a chunk, SQLite cut short.

MCAP: https://mcap.dev/spec. The framing (opcode, length, content) is walked here because a reader that trusts lengths
and indexes gives up, or returns half a message; the records inside are parsed by the mcap library.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import apsw
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
_CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_READ = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK)
# A record that claims more than this is damage: the largest that recorders write are chunks of a few MB.
LARGEST_RECORD = 1 << 30
SMALL_PIECE = 16


class Salvaged(NamedTuple):
    """One whole message. definition is the embedded one, '' if there is none; encoding ros2msg or ros2idl."""

    topic: str
    msgtype: str
    encoding: str
    definition: str
    log_ns: int
    data: bytes


class DamagedError(Exception):
    """What is damaged, in words. Raised after the last message that is whole."""


def salvage_mcap(path: Path) -> Iterator[Salvaged]:
    """All whole messages up to the damage, in file order; then DamagedError, unless the recording is whole."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(len(MCAP_MAGIC))
        for at, opcode, content, whole in _records(file, size):
            if opcode == Opcode.CHUNK:
                yield from _salvage_chunk(at, content, whole, schemas, channels)
            elif whole:
                message = _take(at, opcode, content, schemas, channels)
                if message is not None:
                    yield message
            if opcode == Opcode.DATA_END:
                return
    raise DamagedError(f"it stops at byte {size} without the end of the data")


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes, bool]]:
    """Place, opcode, content and whether it is whole, of every record; after one that is not, DamagedError.

    Records that hold no messages (attachments can be huge) come without their content.
    """
    while head := file.read(_RECORD_HEAD.size):
        at = file.tell() - len(head)
        if len(head) < _RECORD_HEAD.size:
            raise DamagedError(f"cut off at byte {size}")
        opcode, length = _RECORD_HEAD.unpack(head)
        there = min(length, size - file.tell())
        if opcode == 0 or (opcode in _READ and length > LARGEST_RECORD):
            raise DamagedError(f"no record at byte {at}")
        content = b""
        if opcode in _READ:
            content = file.read(there)
        else:
            file.seek(there, SEEK_CUR)
        yield at, opcode, content, there == length
        if there < length:
            raise DamagedError(f"the record at byte {at} is {length - there} bytes short")


def _salvage_chunk(
    at: int, content: bytes, whole: bool, schemas: dict[int, Schema], channels: dict[int, Channel]
) -> Iterator[Salvaged]:
    """Messages of a chunk that may be cut, in order of log time as an indexed reader gives them."""
    unpacked, intact = _unpack_chunk(at, content, whole)
    records = BytesIO(unpacked)
    found = []
    damage = None if intact else DamagedError(f"the chunk at byte {at} is cut off or damaged")
    try:
        for inner_at, opcode, inner, inner_whole in _records(records, len(unpacked)):
            message = _take(inner_at, opcode, inner, schemas, channels) if inner_whole else None
            if message is not None:
                found.append(message)
    except DamagedError as error:
        damage = DamagedError(f"in the chunk at byte {at}: {error}")
    yield from sorted(found, key=lambda message: message.log_ns)
    if damage is not None:
        raise damage


def _unpack_chunk(at: int, content: bytes, whole: bool) -> tuple[bytes, bool]:
    """As much of a chunk's records as its bytes give, and whether that is all of them."""
    try:
        _, _, size, checksum = _CHUNK_HEAD.unpack_from(content)
        (name_length,) = struct.unpack_from("<I", content, _CHUNK_HEAD.size)
        start = _CHUNK_HEAD.size + 4 + name_length + 8
        name = content[_CHUNK_HEAD.size + 4 : start - 8].decode()
        (packed_size,) = struct.unpack_from("<Q", content, start - 8)
        # of the two lengths either may be what is damaged: one that fits says that all of the chunk is there
        packed = content[start:] if whole else content[start : start + packed_size]
        unpacked = _DECOMPRESS[name](packed, min(size, LARGEST_RECORD))
    except (struct.error, UnicodeDecodeError, KeyError) as error:
        raise DamagedError(f"the head of the chunk at byte {at} is cut off or damaged") from error
    intact = len(unpacked) == size
    all_there = whole or len(packed) == packed_size
    if all_there and checksum and (not intact or crc32(unpacked) != checksum):
        # all of it is there and some of it is wrong, nothing says which: none of its messages can be believed
        raise DamagedError(f"the checksum of the chunk at byte {at} does not match")
    return unpacked, whole and all_there and intact


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    import zstandard

    return _unpack_start(lambda: zstandard.ZstdDecompressor().decompressobj().decompress, packed, size)


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    import lz4.frame

    return _unpack_start(lambda: lz4.frame.LZ4FrameDecompressor().decompress, packed, size)


_DECOMPRESS: Mapping[str, Callable[[bytes, int], bytes]] = {
    "": lambda packed, _: packed,
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
}


def _unpack_start(new: Callable[[], Callable[[bytes], bytes]], packed: bytes, size: int) -> bytes:
    """The first `size` bytes that a decompressor makes of `packed`, up to the damage.

    A decompressor that meets damage withholds all that the call would have returned. So what is damaged is fed again
    in small pieces, for the damage to cost what comes after it and not what comes before.
    """
    for piece in (len(packed) or 1, SMALL_PIECE):
        decompress, output = new(), bytearray()
        try:
            for start in range(0, len(packed), piece):
                output += decompress(packed[start : start + piece])
                if len(output) > size:  # damage can make much of little; the chunk has said how much there is
                    break
            return bytes(output[:size])
        except Exception:  # each library has errors of its own
            continue
    return bytes(output[:size])


def _take(
    at: int, opcode: int, content: bytes, schemas: dict[int, Schema], channels: dict[int, Channel]
) -> Salvaged | None:
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
    except Exception as error:  # what is not a record is damage, whatever the parser makes of it
        raise DamagedError(f"the record at byte {at} is damaged") from error
    return None


class _WholePages(apsw.VFSFile):  # type: ignore[misc]
    """A database without its last page if that is cut: SQLite would take the missing bytes for zeros."""

    page_size = 4096

    def xFileSize(self) -> int:  # noqa: N802
        size: int = super().xFileSize()
        return size - size % self.page_size


class _WholePagesVfs(apsw.VFS):  # type: ignore[misc]
    def __init__(self, path: Path) -> None:
        self.name = f"whole-pages-{id(self)}"
        with path.open("rb") as file:
            self._page_size = struct.unpack(">H", file.read(18)[16:])[0]
        super().__init__(self.name, "")

    def xOpen(self, name: Any, flags: list[int]) -> _WholePages:  # noqa: N802
        file = _WholePages("", name, flags)
        file.page_size = 65536 if self._page_size == 1 else max(self._page_size, 1)
        return file


def salvage_sqlite(path: Path) -> Iterator[Salvaged]:
    """All messages of a rosbag2 database that SQLite can still reach, in the order they were written.

    Then DamagedError, if it stopped at damage.
    """
    try:
        vfs = _WholePagesVfs(path)
        uri = f"{path.absolute().as_uri()}?immutable=1"
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        with closing(apsw.Connection(uri, flags=flags, vfs=vfs.name)) as connection:
            # without it, SQLite opens no file that is shorter than its first page says
            connection.execute("PRAGMA writable_schema=ON")
            topics = {key: (name, kind) for key, name, kind in connection.execute("SELECT id, name, type FROM topics")}
            definitions = _sqlite_definitions(connection)
            # by rowid: the index on timestamp may lie behind the damage
            rows = connection.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id")
            for topic_id, log_ns, data in rows:
                if not isinstance(data, bytes):
                    raise TypeError(f"a message is {type(data).__name__}, not bytes")
                name, kind = topics[topic_id]
                yield Salvaged(name, kind, *definitions.get(kind, ("", "")), int(log_ns), data)
    # damage that SQLite sees, and damage that it does not
    except (apsw.Error, struct.error, KeyError, TypeError, ValueError) as error:
        raise DamagedError(f"{type(error).__name__}: {error}") from error


def _sqlite_definitions(connection: apsw.Connection) -> dict[str, tuple[str, str]]:
    """Type -> encoding and text of the embedded definitions; bags of before ROS 2 Iron have none."""
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    with suppress(apsw.Error):
        return {kind: (encoding, text) for kind, encoding, text in connection.execute(query)}
    return {}
