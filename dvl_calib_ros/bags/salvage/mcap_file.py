"""MCAP read so that damage costs no more than what it hits: by its index while that is sound, else record by record.

https://mcap.dev/spec. A reader that trusts lengths and indexes gives up at the first damage, takes gigabytes for a
length that claims them, or returns half a message. Here every length is checked against what is there, what is
unpacked is bounded, and after damage the next place is searched where records begin. A chunk whose checksum does not
match gives nothing: some of it is wrong, and nothing says which.
"""

from __future__ import annotations

import heapq
import re
import struct
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from itertools import chain
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, ChunkIndex, Schema
from mcap.summary import Summary

from .damage import LARGEST_RECORD, Damage, DamagedError, Salvaged

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MCAP_MAGIC = b"\x89MCAP0\r\n"
# plain numbers: they are compared for every message
SCHEMA, CHANNEL, MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)
FIRST_PRIVATE = 0x80
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, unpacked size, CRC, length of the compression's name
_LONGEST_CHUNK_HEAD = _CHUNK_HEAD.size + len("zstd") + 8
# How a chunk begins: its opcode, a length below 4 GB, 28 bytes of times, size and checksum, the compression, a length
_CHUNK_BEGIN = re.compile(rb"(?=\x06.{4}\0{4}.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd).{4}\0{4})", re.DOTALL)
_RECORD_BEGIN = re.compile(rb"(?=[\x03-\x05].{4}\0{4})", re.DOTALL)
_WINDOW, _OVERLAP = 1 << 20, 64
SMALL_PIECE = 16

_Found = tuple[int, int, bytes]
"""Log time (ns), channel and content of a message."""


class _Tables:
    """The schemas and channels that are known; at the beginning, those of the summary."""

    def __init__(self, summary: Summary | None) -> None:
        self.schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
        self.channels: dict[int, Channel] = dict(summary.channels) if summary else {}

    def note(self, at: int, opcode: int, content: bytes) -> None:
        """Take note of a schema or channel; DamagedError if it is none."""
        try:
            if opcode == SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                self.schemas[schema.id] = schema
            else:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                self.channels[channel.id] = channel
        except Exception as error:  # what is not a record is damage, whatever the parser makes of it
            raise DamagedError(f"the record at byte {at} is damaged") from error

    def salvaged(self, message: _Found) -> Salvaged:
        log_ns, channel_id, data = message
        channel = self.channels[channel_id]
        known = self.schemas.get(channel.schema_id)
        if known is None:
            return Salvaged(channel.topic, "", "", "", log_ns, data)
        definition = known.data.decode("utf-8", "replace")
        return Salvaged(channel.topic, known.name, known.encoding, definition, log_ns, data)


def read_summary(path: Path) -> Summary | None:
    """The index at the end of the file if there is one that leads to messages; any error if it is damaged."""
    with path.open("rb") as file:
        summary = _summary(file)
    usable = summary is not None and summary.statistics and summary.chunk_indexes and summary.channels
    return summary if usable else None


def _summary(file: BinaryIO) -> Summary | None:
    return SeekingReader(file, record_size_limit=LARGEST_RECORD).get_summary()


def indexed_messages(path: Path, summary: Summary, channels: Collection[int]) -> Iterator[_Found]:
    """Messages of these channels in order of log time. Raises DamagedError where the index leads to no whole chunk."""

    def read(index: ChunkIndex) -> Iterator[_Found]:
        yield from _whole_chunk(file, size, index, tables, wanted)

    tables = _Tables(summary)
    wanted = frozenset(channels)
    size = path.stat().st_size
    with path.open("rb") as file:
        for group in _overlapping(summary.chunk_indexes, wanted):
            if len(group) == 1:
                yield from read(group[0])
            else:
                # a marker where each begins: merging opens a chunk only when its time has come
                streams = [chain([(index.message_start_time, -1, b"")], read(index)) for index in group]
                yield from (found for found in heapq.merge(*streams, key=itemgetter(0)) if found[1] >= 0)


def _overlapping(indexes: Collection[ChunkIndex], wanted: Collection[int]) -> Iterator[list[ChunkIndex]]:
    """Chunks that hold wanted channels, as far as the index says, in groups that overlap in time."""
    group: list[ChunkIndex] = []
    newest_ns = -1
    for index in sorted(indexes, key=attrgetter("message_start_time")):
        offsets = index.message_index_offsets
        if offsets and not any(channel in wanted for channel in offsets):
            continue
        if group and index.message_start_time > newest_ns:
            yield group
            group = []
        group.append(index)
        newest_ns = max(newest_ns, index.message_end_time)
    if group:
        yield group


def _whole_chunk(
    file: BinaryIO, size: int, index: ChunkIndex, tables: _Tables, wanted: Collection[int]
) -> list[_Found]:
    at = index.chunk_start_offset
    opcode, length = _head(file, at)
    if opcode != Opcode.CHUNK:
        raise DamagedError(f"no chunk at byte {at}")
    chunk = _open_chunk(file, at, length, size)
    if chunk.damage:
        raise DamagedError(chunk.damage)
    damage = Damage()
    found = _messages(at, chunk.records, tables, damage, wanted)
    damage.raise_if_any()
    return found


def salvage_mcap(path: Path) -> Iterator[Salvaged]:
    """All whole messages, in file order; then DamagedError, unless the recording is whole."""
    with path.open("rb") as file:
        yield from salvage_mcap_stream(file, path.stat().st_size)


def salvage_mcap_stream(file: BinaryIO, size: int) -> Iterator[Salvaged]:
    """As `salvage_mcap`, of an open file of so many bytes."""
    damage, summary = Damage(), None
    with suppress(Exception):  # schemas and channels once more: the chunk that introduces them may be damaged
        summary = _summary(file)
    tables = _Tables(summary)
    walk = _Walk(file, size, tables, damage)
    at: int | None = len(MCAP_MAGIC)
    while at is not None and at < size:
        found, at = walk.step(at)
        yield from map(tables.salvaged, found)
    if at is not None and not damage:
        damage.note(f"it stops at byte {size} without the end of the data", 0)
    damage.raise_if_any()


class _Walk:
    """Goes through a file record by record."""

    def __init__(self, file: BinaryIO, size: int, tables: _Tables, damage: Damage) -> None:
        self._file, self._size, self._tables, self._damage = file, size, tables, damage
        self._may_hold_chunks = True
        self._holds_chunks = False

    def step(self, at: int) -> tuple[list[_Found], int | None]:
        """Messages of the record at `at`, and where to go on: None at the end of the data."""
        try:
            opcode, length = _head(self._file, at)
            if opcode == Opcode.CHUNK or (not SCHEMA <= opcode <= MESSAGE and _is_chunk(self._file, at, length)):
                return self._chunk(at, length)
            end = at + _RECORD_HEAD.size + length
            if opcode == 0 or Opcode.DATA_END < opcode < FIRST_PRIVATE:
                raise DamagedError(f"no record at byte {at}")
            if end > self._size or (SCHEMA <= opcode <= MESSAGE and length > LARGEST_RECORD):
                raise DamagedError(f"the record at byte {at} is cut off or damaged")
            if opcode == Opcode.DATA_END:
                return [], None
            found: list[_Found] = []
            if SCHEMA <= opcode <= MESSAGE:
                self._file.seek(at)
                found = _messages(at, self._file.read(end - at), self._tables, self._damage)
            return found, end
        except DamagedError as error:
            return [], self._go_on(at, str(error))

    def _chunk(self, at: int, length: int) -> tuple[list[_Found], int]:
        self._holds_chunks = True
        chunk = _open_chunk(self._file, at, length, self._size)
        # of what is not believed only the channels, which later chunks need
        within = Damage() if chunk.damage else self._damage
        found = _messages(at, chunk.records, self._tables, within)
        if not chunk.damage:
            return found, chunk.end
        if not chunk.is_believed:
            return [], self._go_on(at, chunk.damage)
        self._damage.note(chunk.damage, within.skipped)
        return found, self._next_place(at)

    def _go_on(self, at: int, what: str) -> int:
        """Where to go on after damage in the record at `at`, of which nothing is used."""
        place = self._next_place(at)
        self._damage.note(what, place - at)
        return place

    def _next_place(self, at: int) -> int:
        """Where to go on after the damaged record at `at`: at its end, if records follow there; else search."""
        end = _sound_end(self._file, at, self._size, self._tables)
        if end is not None:
            return end
        if self._may_hold_chunks:
            place = _search(self._file, at + 1, self._size, _CHUNK_BEGIN, self._is_chunk_at)
            if place is not None:
                return place
            self._may_hold_chunks = False
        if self._holds_chunks:  # outside of chunks, with their checksums, what looks like messages is not believed
            return self._size
        return _search_records(self._file, at, self._size, self._tables)

    def _is_chunk_at(self, at: int) -> bool:
        return _is_chunk(self._file, at, _head(self._file, at)[1])


def _head(file: BinaryIO, at: int) -> tuple[int, int]:
    """Opcode and length of a record."""
    file.seek(at)
    head = file.read(_RECORD_HEAD.size)
    if len(head) < _RECORD_HEAD.size:
        raise DamagedError(f"cut off at byte {at + len(head)}")
    opcode, length = _RECORD_HEAD.unpack(head)
    return opcode, length


def _search(
    file: BinaryIO, start: int, size: int, pattern: re.Pattern[bytes], accept: Callable[[int], bool]
) -> int | None:
    """The first place from `start` on where the pattern matches and accept(place) agrees."""
    for window in range(start, size, _WINDOW):
        file.seek(window)
        data = file.read(_WINDOW + _OVERLAP)
        for match in pattern.finditer(data):
            if match.start() < _WINDOW and accept(window + match.start()):
                return window + match.start()
    return None


def _sound_end(file: BinaryIO, at: int, size: int, tables: _Tables) -> int | None:
    """Where the record at `at` says that it ends, if records follow there."""
    with suppress(DamagedError):
        end = at + _RECORD_HEAD.size + _head(file, at)[1]
        if end <= size and _records_follow(file, end, size, tables):
            return end
    return None


def _next_record(file: BinaryIO, at: int, size: int, tables: _Tables) -> int:
    """Where schemas, channels or messages go on after damage in the record at `at`; `size` if nowhere."""
    end = _sound_end(file, at, size, tables)
    return _search_records(file, at, size, tables) if end is None else end


def _search_records(file: BinaryIO, at: int, size: int, tables: _Tables) -> int:
    """As `_next_record`, of a record whose own end is known to lead nowhere."""
    place = _search(file, at + 1, size, _RECORD_BEGIN, lambda place: _records_follow(file, place, size, tables))
    return size if place is None else place


def _records_follow(file: BinaryIO, at: int, size: int, tables: _Tables) -> bool:
    """Whether this is where records go on: three in a row make sense, or all up to the end of the file."""
    with suppress(DamagedError, struct.error):
        for number in range(3):
            if at >= size:
                return at == size or number > 1
            opcode, length = _head(file, at)
            if not 0 < opcode <= Opcode.DATA_END or length > LARGEST_RECORD:
                return False
            if opcode == MESSAGE:
                channel, *_ = _MESSAGE_HEAD.unpack(file.read(_MESSAGE_HEAD.size))
                if length < _MESSAGE_HEAD.size or channel not in tables.channels:
                    return False
            if opcode == Opcode.FOOTER:
                return True
            at += _RECORD_HEAD.size + length
        return True
    return False


# ---------------------------------------------------------------------- chunks


class _ChunkHead(NamedTuple):
    unpacked_size: int
    checksum: int
    compression: str
    size: int
    packed_size: int


class _Chunk(NamedTuple):
    """records: what could be unpacked. damage: '' if that is all. is_believed: nothing says that they are wrong."""

    records: bytes
    damage: str
    is_believed: bool
    end: int


def _chunk_head(file: BinaryIO, at: int) -> _ChunkHead:
    """The head of the chunk whose record is at `at`; DamagedError if there is none."""
    file.seek(at + _RECORD_HEAD.size)
    head = file.read(_LONGEST_CHUNK_HEAD)
    try:
        _, _, unpacked_size, checksum, name_length = _CHUNK_HEAD.unpack_from(head)
        end_of_name = _CHUNK_HEAD.size + name_length
        (packed_size,) = struct.unpack_from("<Q", head, end_of_name)
        compression = head[_CHUNK_HEAD.size : end_of_name].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError(f"the head of the chunk at byte {at} is cut off or damaged") from error
    if compression not in _DECOMPRESS:
        raise DamagedError(f"the chunk at byte {at} has unknown compression {compression!r}")
    return _ChunkHead(unpacked_size, checksum, compression, end_of_name + 8, packed_size)


def _is_chunk(file: BinaryIO, at: int, length: int) -> bool:
    """Whether a record is a chunk in all but its opcode."""
    with suppress(DamagedError):
        head = _chunk_head(file, at)
        return head.size + head.packed_size == length and 0 < head.unpacked_size <= LARGEST_RECORD
    return False


def _open_chunk(file: BinaryIO, at: int, length: int, size: int) -> _Chunk:
    """Unpack a chunk. Its length is there twice: of the two, either may be what is damaged."""
    head = _chunk_head(file, at)
    lengths = [each for each in (head.packed_size, length - head.size) if 0 <= each <= LARGEST_RECORD]
    if not lengths or head.unpacked_size > LARGEST_RECORD:
        raise DamagedError(f"the chunk at byte {at} claims more than {LARGEST_RECORD} bytes")
    start = at + _RECORD_HEAD.size + head.size
    chunk = _unpack_chunk(file, at, start, head, lengths[0], size)
    if chunk.damage and lengths[1:] and lengths[1] != lengths[0]:
        other = _unpack_chunk(file, at, start, head, lengths[1], size)
        return chunk if other.damage else other
    return chunk


def _unpack_chunk(file: BinaryIO, at: int, start: int, head: _ChunkHead, packed_size: int, size: int) -> _Chunk:
    file.seek(start)
    packed = file.read(packed_size)
    is_cut = len(packed) < packed_size
    records = _DECOMPRESS[head.compression](packed, head.unpacked_size)
    damage = ""
    if is_cut:
        damage = f"the chunk at byte {at} is cut off"
    elif head.checksum and crc32(records) != head.checksum:
        damage = f"the checksum of the chunk at byte {at} does not match"
    elif len(records) != head.unpacked_size:
        damage = f"the chunk at byte {at} is damaged"
    return _Chunk(records, damage, is_cut or not head.checksum or not damage, min(start + packed_size, size))


def _unpack_zstd(packed: bytes, size: int) -> bytes:
    return _unpack_start(zstd.ZstdDecompressor, packed, size)


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    import lz4.frame

    return _unpack_start(lz4.frame.LZ4FrameDecompressor, packed, size)


_DECOMPRESS: Mapping[str, Callable[[bytes, int], bytes]] = {
    "": lambda packed, _: packed,
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
}


def _unpack_start(new: Callable[[], Any], packed: bytes, size: int) -> bytes:
    """What a decompressor makes of `packed`, up to the damage, and no more than `size` bytes and one.

    A decompressor that meets damage withholds all that the call would have returned. So what is damaged is fed again
    in small pieces, for the damage to cost what comes after it and not what comes before.
    """
    output = bytearray()
    for piece in (len(packed) or 1, SMALL_PIECE):
        decompressor, output = new(), bytearray()
        try:
            for start in range(0, len(packed), piece):
                fed = packed[start : start + piece]
                while fed and len(output) <= size:
                    output += decompressor.decompress(fed, max_length=size + 1 - len(output))
                    fed = decompressor.unused_data if decompressor.eof else b""
                    decompressor = new() if fed else decompressor
            break
        except Exception:  # each library has errors of its own
            continue
    return bytes(output)


def _messages(
    at: int, records: bytes, tables: _Tables, damage: Damage, wanted: Collection[int] | None = None
) -> list[_Found]:
    """Messages of a chunk's records, in order of log time; what is damaged among them is skipped and noted.

    wanted: the channels whose messages are given, None for all; the others' are checked, but not copied.
    """
    found: list[_Found] = []
    channels, n = tables.channels, len(records)
    head, message_head = _RECORD_HEAD.unpack_from, _MESSAGE_HEAD.unpack_from
    here = 0
    while here < n:
        try:
            opcode, length = head(records, here)
            end = here + 9 + length
            if end > n or not SCHEMA <= opcode <= MESSAGE:
                raise DamagedError(f"in the chunk at byte {at}: a record is cut off or damaged")
            if opcode == MESSAGE:
                channel_id, _, log_ns, _ = message_head(records, here + 9)
                if length < 22 or channel_id not in channels:
                    raise DamagedError(f"in the chunk at byte {at}: a message is of no known channel")
                if wanted is None or channel_id in wanted:
                    found.append((log_ns, channel_id, records[here + 31 : end]))
            else:
                tables.note(at, opcode, records[here + 9 : end])
            here = end
        except (struct.error, DamagedError) as error:
            start, here = here, _next_record(BytesIO(records), here, n, tables)
            damage.note(str(error), here - start)
    found.sort(key=itemgetter(0))
    return found
