"""Records of MCAP files: what they hold, and where they go on after damage."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from io import BytesIO
from operator import itemgetter
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.summary import Summary
from numpy.typing import NDArray

from ..raw_file import Hole
from .damage import LARGEST_RECORD, Damage, DamagedError, Salvaged
from .mcap_chunks import RECORD_HEAD

# plain numbers: they are compared for every message
SCHEMA, CHANNEL, MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_WINDOW = 1 << 20
# Damaged offsets lead beyond what can be sought in a file
_LARGEST_FILE = 1 << 62
# What damaged bytes make the mcap library raise when it parses records
PARSING = (McapError, struct.error, ValueError, LookupError, OverflowError, EOFError, MemoryError)

# The same from where the record begins, for thousands of them; of its content begins what comes after
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
    """Of N messages: log time (ns), number of the channel, and where its content begins and ends."""

    log_ns: NDArray[np.uint64]
    number: NDArray[np.intp]
    start: NDArray[np.intp]
    end: NDArray[np.intp]


class Tables:
    """The schemas and channels that are known; at the beginning, those of the summary."""

    def __init__(self, summary: Summary | None) -> None:
        self.schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
        self.channels: dict[int, Channel] = dict(summary.channels) if summary else {}
        self._made: dict[int, tuple[str, str, str, str]] = {}

    def copy(self) -> Tables:
        """The same, to go on from."""
        copied = Tables(None)
        copied.schemas, copied.channels = dict(self.schemas), dict(self.channels)
        return copied

    def note(self, at: int, opcode: int, content: bytes) -> None:
        """Take note of a schema or channel; DamagedError if it is none."""
        try:
            if opcode == SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                self.schemas[schema.id] = schema
            else:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                self.channels[channel.id] = channel
        except PARSING as error:
            raise DamagedError(f"the record at byte {at} is damaged") from error
        self._made.clear()

    def salvaged(self, message: Found) -> Salvaged:
        """A message with what is known of its channel."""
        log_ns, channel_id, data = message
        if channel_id not in self._made:
            self._made[channel_id] = self._of(self.channels[channel_id])
        return Salvaged(*self._made[channel_id], log_ns, data)

    def _of(self, channel: Channel) -> tuple[str, str, str, str]:
        known = self.schemas.get(channel.schema_id)
        if known is None:
            return channel.topic, "", "", ""
        return channel.topic, known.name, known.encoding, known.data.decode("utf-8", "replace")


def record_head(file: BinaryIO, at: int) -> tuple[int, int]:
    """Opcode and length of a record."""
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
    """The first place from `start` on that accept(place) agrees to, and where a record may begin.

    That is an opcode between the two given, and a length below 4 GB.
    """
    for window in range(start, size, _WINDOW):
        file.seek(window)
        data = np.frombuffer(file.read(_WINDOW + RECORD_HEAD.size - 1), dtype=np.uint8)
        here = data[: max(len(data) - RECORD_HEAD.size + 1, 0)]
        places = np.flatnonzero((here >= opcodes[0]) & (here <= opcodes[1]))
        for high in range(5, RECORD_HEAD.size):  # the upper half of the length
            places = places[data[places + high] == 0]
        for place in places.tolist():
            if accept(window + place):
                return window + int(place)
    return None


def sound_end(file: BinaryIO, at: int, size: int, tables: Tables) -> int | None:
    """Where the record at `at` says that it ends, if records follow there."""
    with suppress(DamagedError):
        end = at + RECORD_HEAD.size + record_head(file, at)[1]
        if end <= size and _records_follow(file, end, size, tables):
            return end
    return None


def _next_record(file: BinaryIO, at: int, size: int, tables: Tables) -> int:
    """Where schemas, channels or messages go on after damage in the record at `at`; `size` if nowhere."""
    end = sound_end(file, at, size, tables)
    return search_records(file, at, size, tables) if end is None else end


def search_records(file: BinaryIO, at: int, size: int, tables: Tables) -> int:
    """As `_next_record`, of a record whose own end is known to lead nowhere."""
    place = search(file, at + 1, size, (SCHEMA, MESSAGE), lambda place: _records_follow(file, place, size, tables))
    return size if place is None else place


def _records_follow(file: BinaryIO, at: int, size: int, tables: Tables) -> bool:
    """Whether this is where records go on: three in a row make sense, or all up to the end of the file."""
    with suppress(DamagedError, struct.error):
        for number in range(3):
            if at >= size:
                return at == size or number > 1
            opcode, length = record_head(file, at)
            if not 0 < opcode <= Opcode.DATA_END or length > LARGEST_RECORD:
                return False
            if opcode == MESSAGE:
                channel, *_ = _MESSAGE_HEAD.unpack(file.read(_MESSAGE_HEAD.size))
                if length < _MESSAGE_HEAD.size or channel not in tables.channels:
                    return False
            if opcode == Opcode.FOOTER:
                return True
            at += RECORD_HEAD.size + length
        return True
    return False


def places_of(records: bytes, tables: Tables) -> Places | None:
    """The messages of sound records in their order; None where something is wrong, which `messages_of` looks into."""
    places, here, n = [], 0, len(records)
    head = RECORD_HEAD.unpack_from
    try:
        while here < n:
            places.append(here)
            here += 9 + head(records, here)[1]
    except struct.error:
        return None
    if here != n or n < _HEAD_AT.itemsize:
        return None
    start = np.array(places, dtype=np.intp)
    end = np.append(start[1:], n)
    opcode = np.frombuffer(records, dtype=np.uint8)[start]
    is_message = opcode == MESSAGE
    others = np.flatnonzero(~is_message).tolist()
    start, end = start[is_message], end[is_message]
    if (end - start < _HEAD_AT.itemsize).any():
        return None
    heads = np.ndarray((n - _HEAD_AT.itemsize + 1,), _HEAD_AT, records, strides=(1,))[start]
    number = heads["channel"].astype(np.intp)
    if not tables.channels.keys() >= set(np.flatnonzero(np.bincount(number)).tolist()):
        return None
    for other in others:
        if not SCHEMA <= opcode[other] < MESSAGE:
            return None
        try:
            tables.note(places[other], int(opcode[other]), records[places[other] + 9 : (*places, n)[other + 1]])
        except DamagedError:
            return None
    return Places(heads["log_ns"], number, start + _HEAD_AT.itemsize, end)


def places_by_index(records: bytes, starts: NDArray[np.uint64], tables: Tables) -> Places | None:
    """`places_of`, by an index of where messages begin; None where that is not exactly what the records hold."""
    n = len(records)
    start = np.sort(starts).astype(np.intp)
    if not len(start) or start[0] < 0 or start[-1] > n - _HEAD_AT.itemsize:
        return None
    heads = np.ndarray((n - _HEAD_AT.itemsize + 1,), _HEAD_AT, records, strides=(1,))[start]
    length = heads["length"]
    if not ((heads["opcode"] == MESSAGE) & (length >= _MESSAGE_HEAD.size) & (length <= n)).all():
        return None
    end = start + (RECORD_HEAD.size + length.astype(np.intp))
    # what is between messages are other records, else the index lacks some
    before, after = np.concatenate([[0], end]), np.append(start, n)
    if (after < before).any():
        return None
    gaps = np.flatnonzero(after > before).tolist()
    between = [_others(records, int(before[gap]), int(after[gap])) for gap in gaps]
    number = heads["channel"].astype(np.intp)
    if None in between or not tables.channels.keys() >= set(np.flatnonzero(np.bincount(number)).tolist()):
        return None
    for opcode, content in (record for found in between for record in found or ()):
        try:
            tables.note(0, opcode, content)
        except DamagedError:
            return None
    return Places(heads["log_ns"], number, start + _HEAD_AT.itemsize, end)


def _others(records: bytes, here: int, end: int) -> list[tuple[int, bytes]] | None:
    """Opcode and content of the schemas and channels that are all there is between two places; else None."""
    found = []
    while here + RECORD_HEAD.size <= end:
        opcode, length = RECORD_HEAD.unpack_from(records, here)
        if opcode not in (SCHEMA, CHANNEL) or here + RECORD_HEAD.size + length > end:
            return None
        found.append((opcode, records[here + RECORD_HEAD.size : here + RECORD_HEAD.size + length]))
        here += RECORD_HEAD.size + length
    return found if here == end else None


def messages_of(
    at: int,
    records: bytes,
    tables: Tables,
    damage: Damage,
    wanted: Collection[int] | None = None,
    holes: Sequence[Hole] = (),
) -> list[Found]:
    """Messages of a chunk's records, in order of log time; what is damaged among them is skipped and noted.

    wanted: the channels whose messages are given, None for all; the others' are checked, but not copied. holes: what
    of the records could not be read.
    """
    found: list[Found] = []
    channels, n = tables.channels, len(records)
    head, message_head = RECORD_HEAD.unpack_from, _MESSAGE_HEAD.unpack_from
    here = 0
    while here < n:
        try:
            if holes and any(first < here + 9 and here < last for first, last in holes):
                raise DamagedError(f"at byte {at}: a record cannot be read from the disk")
            opcode, length = head(records, here)
            end = here + 9 + length
            if end > n or not SCHEMA <= opcode <= MESSAGE:
                raise DamagedError(f"in the chunk at byte {at}: a record is cut off or damaged")
            if holes and any(first < end and here < last for first, last in holes):
                damage.note(f"at byte {at}: a record cannot be read from the disk", end - here)
            elif opcode == MESSAGE:
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
