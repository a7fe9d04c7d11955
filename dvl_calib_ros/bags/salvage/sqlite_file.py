"""Reading of damaged rosbag2 databases without SQLite, page by page.

https://www.sqlite.org/fileformat2.html. SQLite gives up at the first damaged page. Tables are recognised by the shape
of their rows, because the pages that locate tables may be lost. Pages have no checksum: zeroed or cut pages are
detected, a changed byte of data is not.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ..files import holes_in, open_raw
from .damage import LARGEST_RECORD, DamagedError, Salvaged

SQLITE_MAGIC = b"SQLite format 3\x00"
DEFAULT_PAGE_SIZE = 4096
_FILE_HEADER = 100
_LEAF, _LEAF_HEADER = 0x0D, 8
_INTEGER_SIZES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_FORMATS = ("ros2msg", "ros2idl", "unknown")


class _TableRow(NamedTuple):
    """A row of a table: its number and its columns; a column that repeats the number is None."""

    number: int
    columns: list[Any]


def salvage_sqlite(path: Path) -> Iterator[Salvaged]:
    """Yield all whole messages in the order of writing; then raise DamagedError, unless none is missing."""
    with open_raw(path) as file:
        yield from salvage_sqlite_stream(file, path.stat().st_size)


def salvage_sqlite_stream(file: BinaryIO, size: int) -> Iterator[Salvaged]:
    """Read an open file of `size` bytes like `salvage_sqlite`."""
    pages = _Pages(file, size)
    topics: dict[int, _Topic] = {}
    definitions: dict[tuple[str, str], tuple[str, str]] = {}
    leaves: dict[int, int] = {}  # number of the first message -> page
    for page in range(1, pages.count + 1):
        for row in pages.rows(page):
            if _is_message(row.columns):
                leaves.setdefault(row.number, page)
                break
            _note(row, topics, definitions)
    count, astray, last = 0, 0, 0
    for page in (leaves[number] for number in sorted(leaves)):
        for row in pages.rows(page):
            if not _is_message(row.columns):
                continue
            _, topic_id, log_ns, data = row.columns
            count, last = count + 1, max(last, row.number)
            if topic_id not in topics:
                astray += 1
                continue
            name, kind, digest = topics[topic_id]
            definition = definitions.get((kind, digest)) or definitions.get((kind, ""), ("", ""))
            yield Salvaged(name, kind, *definition, log_ns, data)
    if leaves and not topics:
        raise DamagedError("the page with the names of the topics is damaged")
    damage = [f"the file is {pages.missing} bytes short"] if pages.missing else []
    if pages.unread:
        size = len(pages.unread) * pages.size
        damage.append(f"{len(pages.unread)} pages cannot be read from the disk, {size} bytes skipped")
    if last > count:  # rosbag2 numbers messages from 1
        damage.append(f"{last - count} messages lie on damaged pages")
    if astray:
        damage.append(f"{astray} messages belong to topics that it does not list")
    if damage:
        raise DamagedError(", ".join(damage))


class _Topic(NamedTuple):
    """A topic. digest: hash of the type's description, '' before ROS 2 Iron."""

    name: str
    msgtype: str
    digest: str


def _is_message(columns: list[Any]) -> bool:
    """Return whether a row is a message: id, topic, log time, data."""
    return (
        len(columns) == 4
        and columns[0] is None
        and isinstance(columns[1], int)
        and isinstance(columns[2], int)
        and columns[2] >= 0
        and isinstance(columns[3], bytes)
    )


def _note(row: _TableRow, topics: dict[int, _Topic], definitions: dict[tuple[str, str], tuple[str, str]]) -> None:
    """Note a topic (id, name, type, cdr, QoS, hash) or a definition (id, type, format, text, hash)."""
    number, columns = row
    if len(columns) < 4 or columns[0] is not None or not all(isinstance(text, str) for text in columns[1:]):
        return
    if columns[2] in _FORMATS:
        definition = (columns[2], columns[3])
        definitions.setdefault((columns[1], columns[4] if len(columns) > 4 else ""), definition)
        definitions.setdefault((columns[1], ""), definition)  # for topics without the hash of their definition
    elif "/" in columns[2]:
        topics[number] = _Topic(columns[1], columns[2], columns[5] if len(columns) > 5 else "")


class _Pages:
    """Pages of a database file, numbered from 1.

    size: bytes per page.
    missing: bytes by which the file is shorter than its header states.
    unread: unreadable pages.
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        """Read page size and count from the header; assume the default if it is damaged. size: of the file, bytes."""
        header = file.read(_FILE_HEADER).ljust(_FILE_HEADER, b"\0")
        (page_size,) = struct.unpack_from(">H", header, 16)
        page_size = 65536 if page_size == 1 else page_size
        is_sound = header.startswith(SQLITE_MAGIC) and page_size >= 512 and page_size & (page_size - 1) == 0
        self.size = page_size if is_sound else DEFAULT_PAGE_SIZE
        self._usable = self.size - (header[20] if is_sound and header[20] <= 32 else 0)
        self._file = file
        self.unread: set[int] = set()
        self.count = -(-size // self.size)  # the last may be cut
        (page_count,) = struct.unpack_from(">I", header, 28)
        self.missing = max(0, page_count * self.size - size) if is_sound else 0

    def rows(self, number: int) -> Iterator[_TableRow]:
        """Yield the whole rows of a page, if it is a leaf of a table."""
        page = self._read(number)
        start = _FILE_HEADER if number == 1 else 0
        if len(page) < start + _LEAF_HEADER or page[start] != _LEAF:
            return
        (n_cells,) = struct.unpack_from(">H", page, start + 3)
        for i in range(min(n_cells, self.size // 4)):
            try:
                (cell,) = struct.unpack_from(">H", page, start + _LEAF_HEADER + 2 * i)
                yield self._row(page, cell)
            except (IndexError, struct.error, ValueError):  # an invalid row
                continue

    def _read(self, number: int) -> bytes:
        """Return a page; empty, and noted as unread, if the disk cannot read it."""
        at = (number - 1) * self.size
        self._file.seek(at)
        page = self._file.read(self.size)
        if holes_in(self._file, at, at + self.size):
            self.unread.add(number)
            return b""
        return page

    def _row(self, page: bytes, at: int) -> _TableRow:
        """Return the row of a table's leaf page at an offset. Raises ValueError."""
        size, at = _varint(page, at)
        number, at = _varint(page, at)
        if size > min(LARGEST_RECORD, self.count * self.size):
            raise ValueError("longer than the file")
        return _TableRow(number, _columns(self._payload(page, at, size)))

    def _payload(self, page: bytes, at: int, size: int) -> bytes:
        """Return the content of a row, with its overflow pages (section 1.6 of https://sqlite.org/fileformat2.html)."""
        largest, smallest = self._usable - 35, (self._usable - 12) * 32 // 255 - 23
        if size <= largest:
            local = size
        else:
            local = smallest + (size - smallest) % (self._usable - 4)
            local = smallest if local > largest else local
        if at + local > min(self._usable, len(page)):
            raise ValueError("cut off by the end of its page")
        content = bytearray(page[at : at + local])
        chain = page[at + local :]
        while len(content) < size:
            (following,) = struct.unpack_from(">I", chain)
            if not 0 < following <= self.count:
                raise ValueError("its chain of pages is broken")
            chain = self._read(following)
            if not any(chain):  # file systems zero unwritten blocks
                raise ValueError("zeroed")
            content += chain[4 : 4 + min(self._usable - 4, size - len(content))]
        return bytes(content)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return SQLite's variable-length integer at a place, and the place after it."""
    value = 0
    for i in range(8):
        byte = data[at + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    return value << 8 | data[at + 8], at + 9


def _columns(payload: bytes) -> list[Any]:
    """Return the values of a record. Raises ValueError if they do not match its header exactly."""
    header_size, at = _varint(payload, 0)
    values: list[Any] = []
    offset = header_size
    while at < header_size:
        kind, at = _varint(payload, at)
        if kind >= 12:
            size = (kind - 12) // 2
            value: Any = payload[offset : offset + size]
            value = value.decode() if kind % 2 else value
        elif kind in _INTEGER_SIZES:
            size = _INTEGER_SIZES[kind]
            value = int.from_bytes(payload[offset : offset + size], "big", signed=True)
        elif kind in (0, 8, 9):
            size, value = 0, {0: None, 8: 0, 9: 1}[kind]
        else:
            raise ValueError("no column of a recording")
        offset += size
        values.append(value)
    if offset != len(payload):
        raise ValueError("its length differs from the announced one")
    return values
