"""Records and chunks of MCAP files, and the search for the next record after damage.

A chunk with a wrong checksum gives nothing: some of it is wrong, and it is unknown which part.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from operator import attrgetter, itemgetter
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from mcap.summary import Summary
from numpy.typing import NDArray

from ..files import Hole, holes_in, zstd
from .damage import LARGEST_RECORD, Damage, DamagedError, Salvaged

# plain integers, because they are compared for every message
SCHEMA, CHANNEL, MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
MESSAGE_START = 31  # offset of a message's content from the start of its record
# number of parts of a head; how many are sound after two flipped bits, and never by chance elsewhere
ALIKE, ENOUGH_ALIKE = 4, 2
_WINDOW = 1 << 20
# damaged offsets exceed the largest seekable position
_LARGEST_FILE = 1 << 62
# log times with the same upper bits are within 2^48 ns, three days; this detects a flipped bit above
ERA_BITS = 48
# per record type: the table's name, and the fields that must be the same in each repetition
_DEFINITIONS: Mapping[int, tuple[Any, str, attrgetter[Any]]] = {
    SCHEMA: (Schema, "schemas", attrgetter("name", "encoding", "data")),
    CHANNEL: (Channel, "channels", attrgetter("topic", "schema_id")),
}
# exceptions of the mcap library for damaged records
PARSING = (McapError, struct.error, ValueError, LookupError, OverflowError, EOFError, MemoryError)

# head of a message record for arrays of them; the remaining fields come after
_HEAD_AT = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_ns"],
        "formats": ["u1", "<u8", "<u2", "<u8"],
        "offsets": [0, 1, 9, 15],
        "itemsize": 31,
    }
)

Found = tuple[int, int, bytes]
"""Log time (ns), channel and content of a message."""


class Places(NamedTuple):
    """Positions of N messages: log time (ns), channel number, start and end of the content."""

    log_ns: NDArray[np.uint64]
    number: NDArray[np.intp]
    start: NDArray[np.intp]
    end: NDArray[np.intp]


class Tables:
    """Known schemas and channels, initially from the summary, and statistics of messages.

    eras: periods of three days (`ERA_BITS`) with log times. lengths: channel -> length of its last message.
    """

    def __init__(self, summary: Summary | None) -> None:
        """Start from the file's summary; None if it is lost."""
        self.schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
        self.channels: dict[int, Channel] = dict(summary.channels) if summary else {}
        self.eras: set[int] = set()
        self.lengths: dict[int, int] = {}
        self._met = {(SCHEMA, schema) for schema in self.schemas} | {(CHANNEL, channel) for channel in self.channels}
        self._made: dict[int, tuple[str, str, str, str]] = {}
        if summary and summary.statistics and summary.statistics.message_count:
            self.note_era(summary.statistics.message_start_time)
            self.note_era(summary.statistics.message_end_time)

    def copy(self) -> Tables:
        """Return a copy."""
        copied = Tables(None)
        copied.schemas, copied.channels = dict(self.schemas), dict(self.channels)
        copied.eras, copied._met = set(self.eras), set(self._met)
        return copied

    def mark_replaceable(self) -> Tables:
        """Mark a summary's tables as replaceable, because it may belong to another recording. Return self."""
        self._met.clear()
        return self

    def note_era(self, log_ns: int) -> None:
        """Note the era of a log time."""
        era = log_ns >> ERA_BITS
        if era not in self.eras:
            self.eras.update((era - 1, era, era + 1))

    def note(self, at: int, opcode: int, content: bytes) -> None:
        """Note a schema or channel. Raises DamagedError if it is invalid or contradicts the known one."""
        kind, known, meaning = _DEFINITIONS[opcode]
        table = getattr(self, known)
        try:
            record = kind.read(ReadDataStream(BytesIO(content)))
        except PARSING as error:
            raise DamagedError(f"the record at byte {at} is damaged") from error
        if (opcode, record.id) in self._met and meaning(table[record.id]) != meaning(record):
            raise DamagedError(f"the record at byte {at} contradicts others about {known} {record.id}")
        self._met.add((opcode, record.id))
        table[record.id] = record
        self._made.clear()

    def salvaged(self, message: Found) -> Salvaged:
        """Return a message with its channel's topic, type and definition."""
        log_ns, channel_id, data = message
        if channel_id not in self._made:
            self._made[channel_id] = self._type_of(self.channels[channel_id])
        return Salvaged(*self._made[channel_id], log_ns, data)

    def _type_of(self, channel: Channel) -> tuple[str, str, str, str]:
        """Return topic, type, encoding and definition of a channel, empty where the schema is missing."""
        known = self.schemas.get(channel.schema_id)
        if known is None:
            return channel.topic, "", "", ""
        return channel.topic, known.name, known.encoding, known.data.decode("utf-8", "replace")


def record_head(file: BinaryIO, at: int) -> tuple[int, int]:
    """Return opcode and length of a record."""
    if at > _LARGEST_FILE:
        raise DamagedError(f"cut off before byte {at}")
    file.seek(at)
    head = file.read(RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        raise DamagedError(f"cut off at byte {at + len(head)}")
    opcode, length = RECORD_HEAD.unpack(head)
    return opcode, length


def search(
    file: BinaryIO, start: int, size: int, opcodes: tuple[int, int], accept: Callable[[int], bool]
) -> int | None:
    """Return the first position from `start` on that `accept` confirms and that may begin a record.

    Such a record has an opcode between the two given and a length below 4 GB.
    """
    for window in range(start, size, _WINDOW):
        file.seek(window)
        data = np.frombuffer(file.read(_WINDOW + RECORD_HEAD.size - 1), dtype=np.uint8)
        first_bytes = data[: max(len(data) - RECORD_HEAD.size + 1, 0)]
        candidates = np.flatnonzero((first_bytes >= opcodes[0]) & (first_bytes <= opcodes[1]))
        for high in range(5, RECORD_HEAD.size):  # the upper half of the length
            candidates = candidates[data[candidates + high] == 0]
        for candidate in candidates.tolist():
            if accept(window + candidate):
                return window + int(candidate)
    return None


def sound_end(file: BinaryIO, at: int, size: int, tables: Tables) -> int | None:
    """Return the end of the record at `at` by its own length, if a record follows there."""
    with suppress(DamagedError):
        end = at + RECORD_HEAD.size + record_head(file, at)[1]
        if end <= size and _record_follows(file, end, size, tables):
            return end
    return None


class Resumed(NamedTuple):
    """Position at which reading continues. is_before_damaged: whether the record before it is damaged, too."""

    place: int
    is_before_damaged: bool


def resumed(file: BinaryIO, before: int | None, at: int, size: int, tables: Tables) -> Resumed:
    """Return the next sound schema, channel or message after damage at `at`; `size` if there is none.

    before: start of the record whose length led to `at`. That length may be damaged, and have skipped records.
    """
    start = at if before is None else before
    place = search(
        file, start + 1, size, (SCHEMA, Opcode.DATA_END), lambda each: each != at and _begins(file, each, size, tables)
    )
    place = size if place is None else place
    return Resumed(place, before is not None and (place < at or not _may_be_head(file, at, size, tables)))


def likeness(head: bytes, room: int, tables: Tables) -> int:
    """Return how many of the four parts of a message's head are sound: opcode, length, channel and log time.

    head: bytes from the opcode on. room: number of bytes from there to the end.
    """
    if len(head) < MESSAGE_START:
        return 0
    opcode, length = RECORD_HEAD.unpack_from(head)
    channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(head, RECORD_HEAD.size)
    is_length = _MESSAGE_HEAD.size <= length <= room - RECORD_HEAD.size
    is_time = not tables.eras or log_ns >> ERA_BITS in tables.eras
    return (opcode == MESSAGE) + is_length + (channel in tables.channels) + is_time


def head_at(file: BinaryIO, at: int) -> bytes:
    """Return the bytes of a message record before its content; fewer at the end of the file."""
    file.seek(at)
    return file.read(MESSAGE_START)


def _may_be_head(file: BinaryIO, at: int, size: int, tables: Tables) -> bool:
    """Return whether a record with a partly damaged head may begin here."""
    head = head_at(file, at)
    if len(head) < MESSAGE_START:
        return True
    opcode, length = RECORD_HEAD.unpack_from(head)
    return opcode <= Opcode.DATA_END or length < size or likeness(head, size - at, tables) >= ENOUGH_ALIKE


def _begins(file: BinaryIO, at: int, size: int, tables: Tables) -> bool:
    """Return whether a sound message, schema, channel or end of data begins here, followed by a record."""
    head = head_at(file, at)
    opcode, length = RECORD_HEAD.unpack_from(head)
    end = at + RECORD_HEAD.size + length
    if end > size:
        return False
    if opcode == MESSAGE:
        return likeness(head, size - at, tables) == ALIKE and _record_follows(file, end, size, tables)
    if opcode in (SCHEMA, CHANNEL):
        return is_definition(file, at, opcode, length) and _record_follows(file, end, size, tables)
    return opcode == Opcode.DATA_END and length == 4


def is_definition(file: BinaryIO, at: int, opcode: int, length: int) -> bool:
    """Return whether a record holds a definition that ends where the record does."""
    if length > LARGEST_RECORD:
        return False
    file.seek(at + RECORD_HEAD.size)
    content = BytesIO(file.read(length))
    with suppress(*PARSING):
        _DEFINITIONS[opcode][0].read(ReadDataStream(content))
        return content.tell() == length
    return False


def _record_follows(file: BinaryIO, at: int, size: int, tables: Tables, deep: int = 3) -> bool:
    """Return whether a record begins at `at`: a message, perhaps with a damaged head, or `deep` other records."""
    if at == size or not deep:
        return True
    head = head_at(file, at)
    if likeness(head, size - at, tables) >= ENOUGH_ALIKE:
        return True
    if len(head) < RECORD_HEAD.size:
        return False
    opcode, length = RECORD_HEAD.unpack_from(head)
    if opcode == MESSAGE or not 0 < opcode <= Opcode.DATA_END or length > LARGEST_RECORD:
        return False
    if opcode == Opcode.FOOTER:
        return True
    end: int = at + RECORD_HEAD.size + length
    return end <= size and _record_follows(file, end, size, tables, deep - 1)


def message_head(
    head: bytes, at: int, offset: int, n: int, tables: Tables, holds: Callable[[int], bytes]
) -> tuple[int, int]:
    """Return channel and log time of a message record at `offset` of `n`. Raises DamagedError if invalid.

    at: position of all records in the file. holds: function that returns the bytes at a position.
    """
    if len(head) < RECORD_HEAD.size + _MESSAGE_HEAD.size:
        raise DamagedError(f"at byte {at}: a message is cut off")
    _, length = RECORD_HEAD.unpack_from(head)
    channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(head, RECORD_HEAD.size)
    if length < _MESSAGE_HEAD.size or channel not in tables.channels:
        raise DamagedError(f"at byte {at}: a message is of no known channel")
    expected = tables.lengths.get(channel, length)
    if expected != length and tables.eras:  # a damaged length may lead into the message or past others
        ends = [offset + RECORD_HEAD.size + size for size in (expected, length)]
        by_usual, by_own = (likeness(holds(end), n - end, tables) for end in ends)
        if by_usual == ALIKE and (expected < length or by_own < ENOUGH_ALIKE):
            raise DamagedError(f"at byte {at}: the length of a message is damaged")
    tables.lengths[channel] = length
    tables.note_era(log_ns)
    return channel, log_ns


def places_of(records: bytes, tables: Tables) -> Places | None:
    """Return the messages of sound records in order; None if something is wrong, to be handled by `messages_of`."""
    places, at, n = [], 0, len(records)
    head = RECORD_HEAD.unpack_from
    try:
        while at < n:
            places.append(at)
            at += 9 + head(records, at)[1]
    except struct.error:
        return None
    if at != n or n < _HEAD_AT.itemsize:
        return None
    start = np.array(places, dtype=np.intp)
    end = np.append(start[1:], n)
    opcode = np.frombuffer(records, dtype=np.uint8)[start]
    is_message = opcode == MESSAGE
    others = np.flatnonzero(~is_message).tolist()
    start, end = start[is_message], end[is_message]
    if (end - start < _HEAD_AT.itemsize).any():
        return None
    if any(not SCHEMA <= opcode[other] < MESSAGE for other in others):
        return None
    definitions = [
        (places[other], int(opcode[other]), records[places[other] + 9 : (*places, n)[other + 1]]) for other in others
    ]
    return _known_places(_heads(records, start), start, end, definitions, tables)


def places_by_index(records: bytes, starts: NDArray[np.uint64], tables: Tables) -> Places | None:
    """Return `places_of` by an index of message starts; None if that does not match the records exactly."""
    n = len(records)
    if not len(starts) or int(starts.max()) > n - _HEAD_AT.itemsize:
        return None
    start = np.sort(starts).astype(np.intp)
    heads = _heads(records, start)
    length = heads["length"]
    if not ((heads["opcode"] == MESSAGE) & (length >= _MESSAGE_HEAD.size) & (length <= n)).all():
        return None
    end = start + (RECORD_HEAD.size + length.astype(np.intp))
    # between messages there must be only other records, else the index is incomplete
    before, after = np.concatenate([[0], end]), np.append(start, n)
    if (after < before).any():
        return None
    gaps = np.flatnonzero(after > before).tolist()
    between = [_definitions_between(records, int(before[gap]), int(after[gap])) for gap in gaps]
    if None in between:
        return None
    definitions = [(0, *record) for found in between for record in found or ()]
    return _known_places(heads, start, end, definitions, tables)


def _heads(records: bytes, start: NDArray[np.intp]) -> NDArray[Any]:
    """Return the heads of message records at these positions."""
    return np.ndarray((len(records) - _HEAD_AT.itemsize + 1,), _HEAD_AT, records, strides=(1,))[start]


def _known_places(
    heads: NDArray[Any], start: NDArray[np.intp], end: NDArray[np.intp],
    definitions: Sequence[tuple[int, int, bytes]], tables: Tables,
) -> Places | None:  # fmt: skip
    """Note schemas and channels (position, opcode, content) and return the messages; None if anything is unknown."""
    number = heads["channel"].astype(np.intp)
    if not tables.channels.keys() >= set(np.flatnonzero(np.bincount(number)).tolist()):
        return None
    for definition in definitions:
        try:
            tables.note(*definition)
        except DamagedError:
            return None
    return Places(heads["log_ns"], number, start + _HEAD_AT.itemsize, end)


def _definitions_between(records: bytes, start: int, end: int) -> list[tuple[int, bytes]] | None:
    """Return opcode and content of the schemas and channels between two positions; None if there is anything else."""
    found = []
    while start + RECORD_HEAD.size <= end:
        opcode, length = RECORD_HEAD.unpack_from(records, start)
        if opcode not in (SCHEMA, CHANNEL) or start + RECORD_HEAD.size + length > end:
            return None
        found.append((opcode, records[start + RECORD_HEAD.size : start + RECORD_HEAD.size + length]))
        start += RECORD_HEAD.size + length
    return found if start == end else None


def messages_of(
    chunk_at: int,
    records: bytes,
    tables: Tables,
    damage: Damage,
    wanted: Collection[int] | None = None,
    holes: Sequence[Hole] = (),
) -> list[Found]:
    """Return messages of a chunk's records, by log time; damaged ones are skipped and noted.

    wanted: channels to return, None for all; messages of others are checked but not copied. holes: unreadable parts.
    """
    found: list[Found] = []
    n = len(records)
    position, previous, n_before_previous = 0, None, 0
    while position < n:
        try:
            if holes and any(first < position + 9 and position < last for first, last in holes):
                raise DamagedError(f"at byte {chunk_at}: a record cannot be read from the disk")
            opcode, length = RECORD_HEAD.unpack_from(records, position)
            end = position + 9 + length
            if end > n or not SCHEMA <= opcode <= MESSAGE:
                raise DamagedError(f"in the chunk at byte {chunk_at}: a record is cut off or damaged")
            head = records[position : position + MESSAGE_START]
            count = len(found)
            if holes and any(first < end and position < last for first, last in holes):
                damage.note(f"at byte {chunk_at}: a record cannot be read from the disk", end - position)
            elif opcode == MESSAGE:
                channel, log_ns = message_head(
                    head, chunk_at, position, n, tables, lambda start: records[start : start + MESSAGE_START]
                )
                if wanted is None or channel in wanted:
                    found.append((log_ns, channel, records[position + MESSAGE_START : end]))
            else:
                tables.note(chunk_at, opcode, records[position + 9 : end])
            position, previous, n_before_previous = end, position, count
        except (struct.error, DamagedError) as error:
            resume_at, is_before_damaged = resumed(BytesIO(records), previous, position, n, tables)
            if is_before_damaged and previous is not None:
                del found[n_before_previous:]
                position = previous
            damage.note(str(error), resume_at - position)
            position, previous = resume_at, None
    found.sort(key=itemgetter(0))
    return found


RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, unpacked size, CRC, length of the compression's name
_LONGEST_CHUNK_HEAD = _CHUNK_HEAD.size + len("zstd") + 8
SMALL_PIECE = 16


class ChunkHead(NamedTuple):
    """Head of a chunk before its records. size: of the head, after the record's opcode and length."""

    unpacked_size: int
    checksum: int
    compression: str
    size: int
    packed_size: int

    @classmethod
    def of_index(cls, index: ChunkIndex) -> ChunkHead:
        """Build from the index at the end of the file, which has no checksum."""
        size = _CHUNK_HEAD.size + len(index.compression.encode()) + 8
        return cls(index.uncompressed_size, 0, index.compression, size, index.compressed_size)


class Chunk(NamedTuple):
    """Unpacked chunk. damage: '' if complete. is_believed: no sign of wrong records. holes: unreadable parts."""

    records: bytes
    damage: str
    is_believed: bool
    end: int
    holes: Sequence[Hole] = ()


def chunk_head(file: BinaryIO, at: int) -> ChunkHead:
    """Return the head of the chunk record at `at`. Raises DamagedError if there is none."""
    start = at + RECORD_HEAD.size
    file.seek(start)
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
    if holes_in(file, at, start + end_of_name + 8):
        raise DamagedError(f"the head of the chunk at byte {at} cannot be read from the disk")
    return ChunkHead(unpacked_size, checksum, compression, end_of_name + 8, packed_size)


def is_chunk(file: BinaryIO, at: int, length: int) -> bool:
    """Return whether a record with a damaged opcode looks like a chunk."""
    with suppress(DamagedError):
        head = chunk_head(file, at)
        return head.size + head.packed_size == length and 0 < head.unpacked_size <= LARGEST_RECORD
    return False


def open_chunk(file: BinaryIO, at: int, length: int, size: int, index: ChunkIndex | None = None) -> Chunk:
    """Unpack a chunk. Its length is stored twice, and either copy may be damaged.

    index: entry at the end of the file, used instead of a head that the disk cannot read.
    """
    if index is not None and index.compression in _DECOMPRESS:
        head = ChunkHead.of_index(index)
        length = head.size + head.packed_size
    else:
        head = chunk_head(file, at)
    lengths = [packed for packed in (head.packed_size, length - head.size) if 0 <= packed <= LARGEST_RECORD]
    if not lengths or head.unpacked_size > LARGEST_RECORD:
        raise DamagedError(f"the chunk at byte {at} claims more than {LARGEST_RECORD} bytes")
    start = at + RECORD_HEAD.size + head.size
    if lengths[1:] and lengths[1] != lengths[0]:
        lengths.sort(key=lambda packed: not _record_follows(file, start + packed, size, Tables(None)))
    chunk = _unpack_chunk(file, at, start, head, lengths[0], size)
    if chunk.damage and lengths[1:] and lengths[1] != lengths[0]:
        other = _unpack_chunk(file, at, start, head, lengths[1], size)
        return chunk if other.damage else other
    return chunk


def _unpack_chunk(file: BinaryIO, at: int, start: int, head: ChunkHead, packed_size: int, size: int) -> Chunk:
    """Decompress a chunk as far as readable, and note its damage."""
    file.seek(start)
    packed = file.read(packed_size)
    is_cut = len(packed) < packed_size
    end = min(start + packed_size, size)
    if is_cut and not head.compression:  # both lengths may be damaged and extend over other chunks
        packed = packed[: head.unpacked_size]
    if holes := [(first - start, last - start) for first, last in holes_in(file, start, start + len(packed))]:
        lost = sum(last - first for first, last in holes)
        damage = f"{lost} bytes of the chunk at byte {at} cannot be read from the disk"
        if head.compression:  # compressed data after a gap cannot be unpacked
            return Chunk(_DECOMPRESS[head.compression](packed[: holes[0][0]], head.unpacked_size), damage, True, end)
        return Chunk(packed, damage, True, end, holes)
    records = _DECOMPRESS[head.compression](packed, head.unpacked_size)
    damage = ""
    if is_cut:
        damage = f"the chunk at byte {at} is cut off"
    elif head.checksum and crc32(records) != head.checksum:
        damage = f"the checksum of the chunk at byte {at} does not match"
    elif len(records) != head.unpacked_size:
        damage = f"the chunk at byte {at} is damaged"
    is_believed = is_cut or not head.checksum or not damage
    return Chunk(records, damage, is_believed, end)


def _unpack_lz4(packed: bytes, size: int) -> bytes:
    import lz4.frame

    return _unpack_start(lz4.frame.LZ4FrameDecompressor, packed, size)


_DECOMPRESS: Mapping[str, Callable[[bytes, int], bytes]] = {
    "": lambda packed, _: packed,
    "zstd": lambda packed, size: _unpack_start(zstd.ZstdDecompressor, packed, size),
    "lz4": _unpack_lz4,
}


def _unpack_start(new: Callable[[], Any], packed: bytes, size: int) -> bytes:
    """Decompress up to the damage, and at most `size` + 1 bytes.

    A decompressor that meets damage returns nothing of that call. So damaged data are fed again in small pieces, to
    lose only the data after the damage.
    """
    with suppress(zstd.ZstdError, RuntimeError, EOFError):  # nearly all data are sound: avoid a copy
        decompressor = new()
        whole: bytes = decompressor.decompress(packed, max_length=size + 1)
        if decompressor.eof and not decompressor.unused_data:
            return whole
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
        except (zstd.ZstdError, RuntimeError, EOFError):  # RuntimeError: lz4's
            continue
    return bytes(output)
