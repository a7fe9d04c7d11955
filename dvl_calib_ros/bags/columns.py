"""Messages of recordings as columns, by their layout in CDR.

CDR aligns every number to its size, counted from the end of the 4 bytes of encapsulation, so the lengths of strings
determine the positions of everything after them. A `Layout` belongs to one message. Messages with the same number of
bytes share it if their strings have the same lengths. Messages with sequences have no layout.
https://www.omg.org/spec/DDS-XTYPES, 7.4.3 (XCDR version 1, plain).
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from .batches import LATEST_NS, Batch, Index
from .channels import PLAIN_CDR, Channel, Decoder, DecodingError
from .reader import BagReader

# limits of a window: enough messages for columns to be efficient, few enough for the memory
WINDOW_MESSAGES, WINDOW_BYTES = 4096, 4 << 20
ENOUGH_MESSAGES = 1024
# a recorder has few layouts; garbage could have ever new ones
_MOST_LAYOUTS = 8
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """Messages of one channel in a window, in order.

    arrival: (N,) positions among all messages read.
    log_ns: (N,).
    columns: of these messages, None if their layouts differ.
    """

    channel: Channel
    arrival: Stamps
    log_ns: Stamps
    columns: MessageColumns | None
    _data: Sequence[bytes]
    _decoder: Decoder

    def __len__(self) -> int:
        return len(self.arrival)

    def data(self) -> Iterable[bytes]:
        """Return the bytes of each message."""
        return self._data if self.columns is None else self.columns.messages()

    def messages(self) -> Iterator[tuple[Any, str]]:
        """Yield each decoded message, or None and the reason why it cannot be decoded."""
        for data in self.data():
            try:
                yield self._decoder(self.channel, data), ""
            except DecodingError as error:
                yield None, str(error)


@dataclass(frozen=True)
class Window:
    """Consecutive messages of a recording. log_ns: of the last."""

    parts: list[Part]
    log_ns: int


def windows(bag: BagReader, topics: Collection[str], one_by_one: Collection[str] = ()) -> Iterator[Window]:
    """Yield windows of messages on these topics. one_by_one: topics without columns."""
    layouts = _Layouts(bag.decoder)
    arrived = 0
    for batches in _windows(bag.batches(topics)):
        offsets = np.cumsum([0, *(batch.size for batch in batches)])
        log_ns = np.concatenate([np.minimum(batch.log_ns, LATEST_NS).astype(np.int64) for batch in batches])
        by_kind: dict[tuple[int, int], list[tuple[Batch, Index, Index]]] = {}
        for batch, first in zip(batches, offsets.tolist(), strict=False):
            for number, length, index in _kinds(batch):
                # the channel's id is cheap; its hash would take most of the time
                kind = (id(batch.channels[number]), length)
                by_kind.setdefault(kind, []).append((batch, index, first + index))
        parts = []
        for (_, length), chunks in by_kind.items():
            batch, index, _ = chunks[0]
            channel = batch.channels[int(batch.number[index[0]])]
            position = np.concatenate([position for *_, position in chunks])
            if channel.topic in one_by_one or not length:
                data = [message for batch, index, _ in chunks for message in batch.part(index).data()]
                parts.append(Part(channel, position + arrived, log_ns[position], None, data, bag.decoder))
                continue
            rows_of = [batch.rows(index, length) for batch, index, _ in chunks]
            contents = rows_of[0] if len(rows_of) == 1 else np.concatenate(rows_of)
            for columns, rows in layouts.split(channel, contents):
                positions = position if len(rows) == len(position) else position[rows]
                data = [] if columns is not None else [row.tobytes() for row in contents[rows]]
                parts.append(Part(channel, positions + arrived, log_ns[positions], columns, data, bag.decoder))
        arrived += len(log_ns)
        yield Window(parts, int(log_ns[-1]))


def _windows(batches: Iterator[Batch]) -> Iterator[list[Batch]]:
    """Yield the batches of each window."""
    pending: list[Batch] = []
    count = size = 0
    for batch in batches:
        sizes = np.cumsum(batch.end - batch.start)
        first = 0
        while first < batch.size:
            before = int(sizes[first - 1]) if first else 0
            full = 1 + int(np.searchsorted(sizes, WINDOW_BYTES - size + before))
            end = min(first + WINDOW_MESSAGES - count, full, batch.size)
            pending.append(batch.part(slice(first, end)))
            count, size, first = count + end - first, size + int(sizes[end - 1]) - before, end
            # large batches are used directly, because joining would copy them
            if count >= WINDOW_MESSAGES or size >= WINDOW_BYTES or (first == batch.size and count >= ENOUGH_MESSAGES):
                yield pending
                pending, count, size = [], 0, 0
    if pending:
        yield pending


def _kinds(batch: Batch) -> Iterator[tuple[int, int, Index]]:
    """Yield channel number and length of messages, with the indices (M,) of such messages, by first occurrence."""
    kinds = batch.number + ((batch.end - batch.start) << 16)
    order = np.argsort(kinds, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(kinds[order])) + 1)
    for group in sorted(groups, key=lambda group: int(group[0])):
        kind = int(kinds[group[0]])
        yield kind & 0xFFFF, kind >> 16, group


class _Layouts:
    """Layouts found so far, by channel and length of message."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._known: dict[tuple[Channel, int], list[Layout]] = {}

    def split(self, channel: Channel, data: Rows) -> Iterator[tuple[MessageColumns | None, Index]]:
        """Yield columns and indices of messages of one length, by layout; those without one last, with None."""
        known = self._known.setdefault((channel, data.itemsize), [])
        remaining = np.arange(len(data))
        tried = 0
        while len(remaining):
            if tried == len(known) and not self._learn(channel, data[remaining[0]].tobytes(), known):
                break
            layout = known[tried]
            tried += 1
            rows = layout.view(data if len(remaining) == len(data) else data[remaining])
            shared = layout.shared(rows)
            if shared.all():
                yield MessageColumns(layout, rows), remaining
                return
            if shared.any():
                yield MessageColumns(layout, rows[shared]), remaining[shared]
            remaining = remaining[~shared]
        if len(remaining):
            yield None, remaining

    def _learn(self, channel: Channel, data: bytes, known: list[Layout]) -> bool:
        """Add the layout of a message to the known ones. Return False if it has none."""
        store = self._decoder.typestore(channel)
        if store is None or len(known) >= _MOST_LAYOUTS:
            return False
        try:
            known.append(layout_of(store, channel.msgtype, data))
        except (NoLayoutError, LookupError, RecursionError):
            return False
        return True


_FORMATS = {
    "bool": "u1", "byte": "i1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
ENCAPSULATION = 4
# most padding at the end of a message, as in rosbags
_PADDING = 3
# with more fields than this, columns cost more than they save
_MOST_FIELDS = 500
# parts of the dtype that are no fields of the message; no field's name begins with <
_KIND, _LENGTH, _END = "<kind>", "<length>", "<end>"
Rows = NDArray[Any]
Mask = NDArray[np.bool_]


class NoLayoutError(Exception):
    """A message does not share its layout with others."""


@dataclass(frozen=True)
class Layout:
    """Layout of a message. dtype: its names are paths, such as ``twist.twist.linear.x`` or ``beams[2].valid``.

    lengths: path -> length of the string, bytes without terminator. flags: paths of bool fields.
    """

    dtype: np.dtype[Any]
    kind: bytes
    lengths: dict[str, int]
    flags: frozenset[str]

    @cached_property
    def inner(self) -> frozenset[str]:
        """Paths of fields that have fields of their own."""
        paths = (path.split(".") for path in self.dtype.names or ())
        return frozenset(".".join(steps[:depth]) for steps in paths for depth in range(1, len(steps)))

    def view(self, messages: Rows) -> Rows:
        """Return messages (N,), items of this many bytes, as rows; only the rows in `shared` are valid."""
        return messages.view(self.dtype)

    def shared(self, rows: Rows) -> Mask:
        """Return which rows (N,) have this layout, with only ASCII in their strings."""
        shared: Mask = rows[_KIND] == int.from_bytes(self.kind, "little")
        for path, length in self.lengths.items():
            shared &= (rows[_LENGTH + path] == length + 1) & (rows[_END + path] == 0)
            # one test of all takes a tenth of the time of tests by row
            if length and len(rows) and rows[path].max() >= 0x80:
                shared &= (rows[path] < 0x80).all(axis=1)
        return shared


class MessageColumns:
    """Columns with the attribute names of a message: ``columns.twist.twist.linear.x`` is (N,).

    Strings are (N, length) bytes, arrays of numbers (N, size). Raises AttributeError for a missing field.
    """

    def __init__(self, layout: Layout, rows: Rows, prefix: str = "") -> None:
        self._layout, self._rows, self._prefix = layout, rows, prefix

    def __len__(self) -> int:
        return len(self._rows)

    def __getattr__(self, name: str) -> Any:
        """Return a field of all messages as an array, or as further columns for a nested message."""
        layout, path = self._layout, self._prefix + name
        if path in layout.flags:
            return self._rows[path] != 0
        if path in layout.dtype.names:  # type: ignore[operator]
            return self._rows[path]
        if path in layout.lengths:
            return np.zeros((len(self), 0), dtype=np.uint8)
        if path not in layout.inner:
            raise AttributeError(f"no field {path!r}")
        return MessageColumns(layout, self._rows, f"{path}.")

    def messages(self) -> Iterator[bytes]:
        """Yield the bytes of each message, as recorded."""
        return (row.tobytes() for row in self._rows.view(("V", self._rows.itemsize)))

    def part(self, at: Any) -> MessageColumns:
        """Return the rows of a slice, of indices or of a mask."""
        return MessageColumns(self._layout, self._rows[at], self._prefix)


def layout_of(store: Typestore, msgtype: str, data: bytes) -> Layout:
    """Return the layout of a message. Raises NoLayoutError if it has none or rosbags decodes it differently."""
    if len(data) < ENCAPSULATION or data[:2] not in PLAIN_CDR:
        raise NoLayoutError("no CDR")
    walk = _LayoutWalk(store, data)
    walk.message("", msgtype)
    if not walk.at <= len(data) <= walk.at + _PADDING:
        raise NoLayoutError("its length differs from the announced one")
    fields = walk.fields
    dtype = np.dtype(
        {
            "names": list(fields),
            "formats": [format_ for format_, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": len(data),
        }
    )
    layout = Layout(dtype, data[:2], walk.lengths, frozenset(walk.flags))
    try:
        message = store.deserialize_cdr(data, msgtype)
    except SerdeError as error:
        raise NoLayoutError(str(error)) from error
    _compare(layout, np.frombuffer(data, dtype), message)
    return layout


class _LayoutWalk:
    """Walk through a message's definition and its bytes in parallel."""

    def __init__(self, store: Typestore, data: bytes) -> None:
        self._store, self._data = store, data
        self._order = "<" if data[1] else ">"
        self.at = ENCAPSULATION
        self.fields: dict[str, tuple[Any, int]] = {_KIND: ("<u2", 0)}
        self.lengths: dict[str, int] = {}
        self.flags: list[str] = []

    def message(self, prefix: str, msgtype: str) -> None:
        for name, description in self._store.get_msgdef(msgtype).fields:
            self._field(f"{prefix}{name}", description)

    def _field(self, path: str, description: Any) -> None:
        """Add a field by its kind. Raises NoLayoutError for a sequence."""
        kind, detail = description
        if kind == Nodetype.NAME:
            self.message(f"{path}.", detail)
        elif kind == Nodetype.ARRAY:
            self._array(path, *detail)
        elif kind == Nodetype.SEQUENCE:
            raise NoLayoutError(f"{path} is a sequence")
        elif detail[0] == "string":
            self._string(path)
        else:
            self._numbers(path, detail[0])

    def _array(self, path: str, description: Any, size: int) -> None:
        """Add an array of fixed size, as one column if its elements are numbers."""
        kind, detail = description
        if kind == Nodetype.BASE and detail[0] in _FORMATS and detail[0] != "bool":
            self._numbers(path, detail[0], size)
            return
        for number in range(size):
            self._field(f"{path}[{number}]", description)

    def _numbers(self, path: str, name: str, size: int | None = None) -> None:
        """Add one number, or an array of `size`, aligned to its size."""
        if name not in _FORMATS:
            raise NoLayoutError(f"{path} is {name}")
        format_ = self._order + _FORMATS[name]
        each = np.dtype(format_).itemsize
        self._align(each)
        if name == "bool":
            self.flags.append(path)
        self._add(path, format_ if size is None else (format_, (size,)), each * (1 if size is None else size))

    def _string(self, path: str) -> None:
        """Add a string of the length in this message. Raises NoLayoutError."""
        self._align(4)
        try:
            (length,) = struct.unpack_from(f"{self._order}I", self._data, self.at)
        except struct.error as error:
            raise NoLayoutError("cut off") from error
        if not 0 < length <= len(self._data) - self.at:
            raise NoLayoutError(f"{path} is longer than the message")
        self.lengths[path] = length - 1
        self._add(_LENGTH + path, f"{self._order}u4", 4)
        if length > 1:
            self._add(path, ("u1", (length - 1,)), length - 1)
        self._add(_END + path, "u1", 1)

    def _align(self, size: int) -> None:
        self.at += -(self.at - ENCAPSULATION) % size

    def _add(self, path: str, format_: Any, size: int) -> None:
        """Add a column of this NumPy format and number of bytes."""
        if len(self.fields) > _MOST_FIELDS:
            raise NoLayoutError("more fields than can be read as columns")
        self.fields[path] = format_, self.at
        self.at += size


def _compare(layout: Layout, rows: Rows, message: Any) -> None:
    """Raise NoLayoutError unless a row equals rosbags' decoded message to the last bit."""
    if not layout.shared(rows)[0]:
        raise NoLayoutError("not only ASCII")
    for path in (*layout.dtype.names, *layout.lengths):  # type: ignore[misc]
        if path.startswith("<"):
            continue
        expected = _value_at(message, path)
        if path in layout.lengths:
            found = rows[path][0].tobytes().decode("ascii") if layout.lengths[path] else ""
            is_same = found == expected
        elif path in layout.flags:
            is_same = bool(rows[path][0]) == expected
        else:
            is_same = np.array_equal(rows[path][0], expected, equal_nan=layout.dtype[path].base.kind == "f")
        if not is_same:
            raise NoLayoutError(f"{path} is not what rosbags reads")


def _value_at(message: Any, path: str) -> Any:
    """Return the value of a message at a path such as ``a.b[2]``."""
    for step in path.split("."):
        name, _, index = step.partition("[")
        message = getattr(message, name)
        for number in index.rstrip("]").split("][") if index else ():
            message = message[int(number)]
    return message
