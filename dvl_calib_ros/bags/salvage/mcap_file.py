"""MCAP reading with minimal loss by damage: by the index while it is sound, else record by record.

https://mcap.dev/spec. A reader that trusts lengths and indexes gives up at the first damage, allocates gigabytes for a
damaged length, or returns half a message. Here every length is checked against the file, unpacking is bounded, and
after damage the next record is searched. Unreadable disk sectors cost only the records that they are in.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import accumulate, chain
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex
from mcap.summary import Summary
from numpy.typing import NDArray

from ..batches import Batch, numbered_batch, times
from ..channels import Channel
from ..files import holes_in, open_raw
from .damage import LARGEST_RECORD, Damage, DamagedError, Salvaged
from .mcap_records import (
    CHANNEL,
    MESSAGE,
    MESSAGE_START,
    PARSING,
    RECORD_HEAD,
    SCHEMA,
    Found,
    Resumed,
    Tables,
    head_at,
    is_chunk,
    is_definition,
    likeness,
    message_head,
    messages_of,
    open_chunk,
    places_by_index,
    places_of,
    record_head,
    resumed,
    search,
    sound_end,
)

MCAP_MAGIC = b"\x89MCAP0\r\n"
FIRST_PRIVATE = 0x80
# records that end the data, and their lengths: the data end or, if that is damaged, the footer at the end of the file
_ENDS = {int(Opcode.DATA_END): 4, int(Opcode.FOOTER): 20}
# of a message's head: length, channel and log time
ALL_BUT_OPCODE = 3
_CHUNK_BEGIN_SIZE = 64
# the data end before a summary: opcode and length
_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)
_LARGEST_SUMMARY = 16 << 20
# an index of messages: opcode, length, channel, bytes of its pairs of log time and position
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_OWN = _INDEX_HEAD.size - RECORD_HEAD.size
# at the end of the file: start of the summary and of its offsets, CRC, magic
_FOOTER = struct.Struct("<QQI8s")
_CHECKSUM_TO_END = 12


def read_summary(path: Path) -> Summary | None:
    """Read the index at the end of the file, if there is one. Raises DamagedError if it is damaged."""
    with open_raw(path) as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise DamagedError("its beginning is damaged")
        summary = _summary(file)
    usable = summary is not None and summary.statistics and summary.chunk_indexes and summary.channels
    return summary if usable else None


def _summary(file: BinaryIO) -> Summary | None:
    """Return the summary at the end of the file. Raises DamagedError."""
    size = file.seek(0, os.SEEK_END)
    if size < _FOOTER.size:
        raise DamagedError("it is cut off")
    file.seek(size - _FOOTER.size)
    start, _, _, magic = _FOOTER.unpack(file.read(_FOOTER.size))
    if magic != MCAP_MAGIC:
        raise DamagedError("it does not end as a finished recording does")
    _check_no_chunk(file, start, size)
    _check_sum(file, start, size)
    # the library expects the magic bytes at the current position; those at the beginning may be unreadable
    file.seek(size - len(MCAP_MAGIC))
    try:
        summary = SeekingReader(file, record_size_limit=LARGEST_RECORD).get_summary()
    except PARSING as error:
        raise DamagedError(f"{type(error).__name__}: {error}") from error
    if holes := holes_in(file, start, size):
        lost = sum(last - first for first, last in holes)
        raise DamagedError(f"{lost} bytes of its index cannot be read from the disk")
    if summary is not None and summary.statistics is not None:
        counts = summary.statistics.channel_message_counts
        is_named = not summary.channels or counts.keys() <= summary.channels.keys()
        if not is_named or summary.statistics.message_count != sum(counts.values()):
            raise DamagedError("its count of messages is damaged")
    return summary


def _check_no_chunk(file: BinaryIO, start: int, size: int) -> None:
    """Raise DamagedError if an index at `start` contains a chunk, which the library would unpack without limit."""
    at = start
    while 0 < at < size - _FOOTER.size:
        opcode, length = record_head(file, at)
        if opcode in (0, Opcode.CHUNK):
            raise DamagedError(f"its index would begin at byte {start}, before {'messages' if opcode else 'zeros'}")
        if opcode == Opcode.FOOTER:
            if at != size - _FOOTER.size - RECORD_HEAD.size:
                raise DamagedError("its index belongs to another part: several recordings were joined in one file")
            return
        at += RECORD_HEAD.size + length


def _check_sum(file: BinaryIO, start: int, size: int) -> None:
    """Raise DamagedError if the index at `start` has a checksum that does not match."""
    end = size - _CHECKSUM_TO_END
    if not 0 < start < end or end - start > LARGEST_RECORD:
        return
    file.seek(start)
    content = file.read(end + 4 - start)
    (checksum,) = struct.unpack_from("<I", content, end - start)
    if checksum and crc32(memoryview(content)[:-4]) != checksum:
        raise DamagedError("the checksum of its index does not match")


def bytes_at_once(summary: Summary, channels: Collection[int]) -> int:
    """Return the largest unpacked size of the chunks with messages of these channels at one time."""
    wanted = frozenset(channels)
    changes = [
        change
        for index in chain.from_iterable(_overlapping(summary.chunk_indexes, wanted))
        for change in (
            (index.message_start_time, 0, index.uncompressed_size),
            (index.message_end_time, 1, -index.uncompressed_size),
        )
    ]
    return max(accumulate(change for *_, change in sorted(changes)), default=0)


def indexed_messages(
    path: Path, summary: Summary, channels: Mapping[int, Channel], in_order: bool = True
) -> Iterator[Batch]:
    """Yield messages of these channels in order of log time, or chunk by chunk. Raises DamagedError at damage.

    Merging takes as much memory as `bytes_at_once`.
    """
    tables = Tables(summary)
    size = path.stat().st_size
    with open_raw(path) as file:
        for group in _overlapping(summary.chunk_indexes, channels):
            read = (_whole_chunk(file, size, index, tables, channels) for index in group)
            found = _merged(group, read) if len(group) > 1 and in_order else read
            yield from (batch for batch in found if batch.size)


def _merged(group: Sequence[ChunkIndex], chunks: Iterator[Batch]) -> Iterator[Batch]:
    """Merge overlapping chunks by log time; each chunk is read when its time comes."""
    held = next(chunks)
    for index in group[1:]:
        before = int(np.searchsorted(held.log_ns, index.message_start_time, side="right"))
        yield held.part(slice(before))
        held = held.part(slice(before, None)).compact().merged(next(chunks))
    yield held


def _overlapping(indexes: Collection[ChunkIndex], wanted: Collection[int]) -> Iterator[list[ChunkIndex]]:
    """Yield groups of chunks that overlap in time, without chunks that lack the wanted channels by their index."""
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
    file: BinaryIO, size: int, index: ChunkIndex, tables: Tables, channels: Mapping[int, Channel]
) -> Batch:
    """Return an undamaged chunk's messages, by its index if possible. Raises DamagedError."""
    at = index.chunk_start_offset
    opcode, length = record_head(file, at)
    if opcode != Opcode.CHUNK:
        raise DamagedError(f"no chunk at byte {at}")
    chunk = open_chunk(file, at, length, size)
    if chunk.damage:
        raise DamagedError(chunk.damage)
    starts = _indexed_starts(file, index, chunk.end)
    located = None if starts is None else places_by_index(chunk.records, starts, tables)
    located = located or places_of(chunk.records, tables)
    if located is not None:
        batch = Batch(times(located.log_ns), *located[1:], chunk.records, channels)
        if len(channels) < len(tables.channels):
            batch = batch.part(np.isin(batch.number, list(channels)))
        return batch.sorted()
    damage = Damage()
    messages = messages_of(at, chunk.records, tables, damage, channels)
    damage.raise_if_any()
    log_ns, number, data = tuple(zip(*messages, strict=True)) or ((), (), ())
    return numbered_batch(log_ns, number, data, channels)


def _indexed_starts(file: BinaryIO, index: ChunkIndex, end: int) -> NDArray[np.uint64] | None:
    """Return the starts of messages in a chunk by the indexes after its end; None if those are not sound."""
    if not index.message_index_offsets or not 0 < index.message_index_length <= LARGEST_RECORD:
        return None
    file.seek(end)
    content = file.read(index.message_index_length)
    starts = []
    at = 0
    while at + _INDEX_HEAD.size <= len(content):
        opcode, length, _, size = _INDEX_HEAD.unpack_from(content, at)
        end = at + RECORD_HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or end != at + _INDEX_HEAD.size + size or size % 16 or end > len(content):
            return None
        starts.append(np.frombuffer(content, "<u8", size // 8, at + _INDEX_HEAD.size)[1::2])
        at = end
    return np.concatenate(starts) if starts and at == len(content) else None


def salvage_mcap(path: Path) -> Iterator[Salvaged]:
    """Yield all whole messages, in file order; then raise DamagedError, unless the recording is whole."""
    with open_raw(path) as file:
        yield from salvage_mcap_stream(file, path.stat().st_size)


def salvage_mcap_stream(file: BinaryIO, size: int) -> Iterator[Salvaged]:
    """Read an open file of `size` bytes like `salvage_mcap`."""
    damage, summary = Damage(), None
    with suppress(DamagedError):  # the summary repeats schemas and channels, whose own chunk may be damaged
        summary = _summary(file)
    repeated = Tables(summary) if summary else _unreferenced_tables(file, size).mark_replaceable()
    announced = Counter(summary.statistics.channel_message_counts if summary and summary.statistics else {})
    file.seek(0)
    is_cut = file.read(len(MCAP_MAGIC)) != MCAP_MAGIC and not holes_in(file, 0, len(MCAP_MAGIC))
    if is_cut:
        damage.note("its first bytes are lost or damaged", 0)
    begins: int | None = 0 if is_cut else len(MCAP_MAGIC)
    while begins is not None:  # more than one pass if recordings were joined by `cat`
        tables = repeated.copy()
        walk = _FileWalk(file, size, tables, damage, summary.chunk_indexes if summary else ())
        at = begins
        while at < size and not walk.has_ended:
            found, at = walk.step(at)
            announced.subtract(number for _, number, _ in found)
            yield from map(tables.salvaged, found)
        announced.subtract(number for _, number, _ in walk.held)
        yield from map(tables.salvaged, walk.held)
        if not walk.has_ended and not damage:
            damage.note(f"it stops at byte {size} without the end of the data", 0)
        begins = _next_recording(file, at, size)
    damage.lost = (+announced).total()
    damage.raise_if_any()


def _unreferenced_tables(file: BinaryIO, size: int) -> Tables:
    """Return the schemas and channels of a summary that the damaged end of the file does not lead to."""
    tables = Tables(None)
    first = max(size - _LARGEST_SUMMARY, 0)
    file.seek(first)
    content = file.read(_LARGEST_SUMMARY)
    at = content.rfind(_DATA_END)
    with suppress(DamagedError, struct.error):
        while 0 <= at < len(content):
            opcode, length = RECORD_HEAD.unpack_from(content, at)
            if opcode in (SCHEMA, CHANNEL):
                tables.note(first + at, opcode, content[at + RECORD_HEAD.size : at + RECORD_HEAD.size + length])
            at += RECORD_HEAD.size + length
    return tables


def _next_recording(file: BinaryIO, at: int, size: int) -> int | None:
    """Return the start of another recording's records after the summary at `at`; None if there is none."""
    with suppress(DamagedError):
        while at < size:
            opcode, length = record_head(file, at)
            at += RECORD_HEAD.size + length
            if opcode == Opcode.FOOTER and at < size:
                file.seek(at)
                begins = file.read(2 * len(MCAP_MAGIC)) == 2 * MCAP_MAGIC
                return at + 2 * len(MCAP_MAGIC) if begins else None
    return None


class _FileWalk:
    """Walk through a damaged MCAP file record by record."""

    def __init__(
        self, file: BinaryIO, size: int, tables: Tables, damage: Damage, indexes: Collection[ChunkIndex]
    ) -> None:
        """Start before the first record.

        file, size: the MCAP file and its length, bytes.
        tables: known schemas and channels.
        damage: receives the damage found.
        indexes: chunk indexes of the summary, if readable.
        """
        self._file, self._size, self._tables, self._damage = file, size, tables, damage
        self._indexes = {index.chunk_start_offset: index for index in indexes}
        self._may_hold_chunks = True
        self._holds_chunks = False
        self._before: int | None = None
        self.held: list[Found] = []
        self.has_ended = False

    def step(self, at: int) -> tuple[list[Found], int]:
        """Return the messages of the record before `at`, and the next position.

        has_ended: set at the end of the data. held: messages of the record at `at` itself, which count only if the
        record leads on to another.
        """
        messages, self.held, before = self.held, [], None
        try:
            self.held, end, before = self._record(at)
        except DamagedError as error:
            resumed_at, is_before_damaged = self._resume_after(at)
            if is_before_damaged and self._before is not None:
                messages, at = [], self._before
            self._damage.note(str(error), resumed_at - at)
            end = resumed_at
        self._before = before
        return messages, end

    def _record(self, at: int) -> tuple[list[Found], int, int | None]:
        """Return the messages of the record at `at`, its end, and its start if the end is uncertain."""
        if index := self._index_instead_of_head(at):
            return *self._chunk(at, 0, index), None
        opcode, length = record_head(self._file, at)
        if holes_in(self._file, at, at + RECORD_HEAD.size):
            raise DamagedError(f"the record at byte {at} cannot be read from the disk")
        if opcode == Opcode.CHUNK or (opcode != MESSAGE and is_chunk(self._file, at, length)):
            return *self._chunk(at, length), None
        end = at + RECORD_HEAD.size + length
        is_end = opcode in _ENDS
        if opcode == 0 or Opcode.DATA_END < opcode < FIRST_PRIVATE or (is_end and length != _ENDS[opcode]):
            raise DamagedError(f"no record at byte {at}")
        is_read = SCHEMA <= opcode <= MESSAGE
        if end > self._size or (is_read and length > LARGEST_RECORD):
            raise DamagedError(f"the record at byte {at} is cut off or damaged")
        head = head_at(self._file, at)
        is_message = likeness(head, self._size - at, self._tables) >= ALL_BUT_OPCODE and bool(self._tables.eras)
        # an index after a chunk resembles a message except for the opcode
        is_index = self._holds_chunks and is_message and _INDEX_HEAD.unpack_from(head)[-1] == length - _INDEX_OWN
        resembles_another = is_message and (opcode == MESSAGE) == is_index
        if resembles_another and not (opcode in (SCHEMA, CHANNEL) and is_definition(self._file, at, opcode, length)):
            raise DamagedError(f"the record at byte {at} is damaged")
        self.has_ended = is_end
        if is_end and opcode == Opcode.FOOTER:  # the end of the data is damaged
            return [], at, None
        if not is_read:  # a wrong length may have led into several such records in a row
            return [], end, at if self._before is None else self._before
        self._file.seek(at)
        content = self._file.read(end - at)
        if holes_in(self._file, at, end):
            self._damage.note(f"at byte {at}: a record cannot be read from the disk", end - at)
        elif opcode == MESSAGE:
            channel, log_ns = message_head(head, at, at, self._size, self._tables, partial(head_at, self._file))
            return [(log_ns, channel, content[MESSAGE_START:])], end, at
        else:
            self._tables.note(at, opcode, content[RECORD_HEAD.size :])
        return [], end, at

    def _index_instead_of_head(self, at: int) -> ChunkIndex | None:
        """Return the index entry of the chunk at `at` if the disk cannot read the chunk's start."""
        index = self._indexes.get(at)
        if index is None:
            return None
        self._file.seek(at)
        return index if holes_in(self._file, at, at + len(self._file.read(_CHUNK_BEGIN_SIZE))) else None

    def _chunk(self, at: int, length: int, index: ChunkIndex | None = None) -> tuple[list[Found], int]:
        """Return a chunk's messages and the place after it. Raises DamagedError if its content is not trusted."""
        self._holds_chunks, self._before = True, None
        chunk = open_chunk(self._file, at, length, self._size, index)
        # of a chunk that is not trusted, use only the channels, which later chunks need
        within = Damage() if chunk.damage else self._damage
        found = messages_of(at, chunk.records, self._tables, within, holes=chunk.holes)
        if not chunk.damage:
            return found, chunk.end
        if not chunk.is_believed:
            raise DamagedError(chunk.damage)
        self._damage.note(chunk.damage, within.skipped)
        return found, chunk.end if index else self._next_place(at)

    def _next_place(self, at: int) -> int:
        """Return where to continue after the damaged chunk at `at`: at its end if records follow there, else search."""
        end = sound_end(self._file, at, self._size, self._tables)
        return self._resume_after(at).place if end is None else end

    def _resume_after(self, at: int) -> Resumed:
        """Return where to continue after the damaged record at `at`: its own end, if sound, else the next found."""
        if self._before is None and not head_at(self._file, at).startswith(bytes([MESSAGE])):
            end = sound_end(self._file, at, self._size, self._tables)
            if end is not None:
                return Resumed(end, False)
        found = self._search_after(at)
        headless = (start for start in self._indexes if at < start < found.place and self._index_instead_of_head(start))
        return found._replace(place=min(headless, default=found.place))

    def _search_after(self, at: int) -> Resumed:
        """Search where to continue after damage: at a chunk, or without chunks at a record."""
        if self._may_hold_chunks:
            start = at if self._before is None else self._before
            place = search(self._file, start + 1, self._size, (Opcode.CHUNK, Opcode.CHUNK), self._is_chunk_at)
            if place is not None:
                return Resumed(place, place < at)
            self._may_hold_chunks = False
        if self._holds_chunks:  # outside of chunks, with their checksums, data that resemble messages are not trusted
            return Resumed(self._size, False)
        return resumed(self._file, self._before, at, self._size, self._tables)

    def _is_chunk_at(self, at: int) -> bool:
        return is_chunk(self._file, at, record_head(self._file, at)[1])
