"""Messages of recordings as columns, and their layout in CDR.

CDR aligns every number to its size, counted from the end of the 4 bytes of encapsulation, so the lengths of strings
decide where everything behind them lies. A `Layout` is that of one message; others of the same length in bytes share it
where all their strings are as long. Messages with sequences have none.
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

# Messages that are read at once, and their bytes: enough for columns to pay, few enough for any memory.
WINDOW_MESSAGES, WINDOW_BYTES = 4096, 4 << 20
ENOUGH_MESSAGES = 1024
# A recorder has one layout or a few; garbage could have ever new ones.
_MOST_LAYOUTS = 8
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """Messages of one channel in a window, in order.

    arrival: (N,) their places among all messages that are read. log_ns: (N,). columns: of these messages, None where
    they are not laid out alike.
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
        """The bytes of each message."""
        return self._data if self.columns is None else self.columns.messages()

    def messages(self) -> Iterator[tuple[Any, str]]:
        """One by one: the decoded message, None if it cannot be decoded, and then why."""
        for data in self.data():
            try:
                yield self._decoder(self.channel, data), ""
            except DecodingError as error:
                yield None, str(error)


@dataclass(frozen=True)
class Window:
    """Messages that follow each other in a recording. log_ns: of the last."""

    parts: list[Part]
    log_ns: int


def windows(bag: BagReader, topics: Collection[str], one_by_one: Collection[str] = ()) -> Iterator[Window]:
    """Messages of these topics. one_by_one: topics of which no columns are asked for."""
    layouts = _Layouts(bag.decoder)
    arrived = 0
    for batches in _windows(bag.batches(topics)):
        places = np.cumsum([0, *(batch.size for batch in batches)])
        log_ns = np.concatenate([np.minimum(batch.log_ns, LATEST_NS).astype(np.int64) for batch in batches])
        by_kind: dict[tuple[int, int], list[tuple[Batch, Index, Index]]] = {}
        for batch, first in zip(batches, places.tolist(), strict=False):
            for number, length, at in _kinds(batch):
                kind = (id(batch.channels[number]), length)  # by the channel's id: its hash costs more than all else
                by_kind.setdefault(kind, []).append((batch, at, first + at))
        parts = []
        for (_, length), found in by_kind.items():
            batch, at, _ = found[0]
            channel = batch.channels[int(batch.number[at[0]])]
            place = np.concatenate([place for *_, place in found])
            if channel.topic in one_by_one or not length:
                data = [each for batch, at, _ in found for each in batch.part(at).data()]
                parts.append(Part(channel, place + arrived, log_ns[place], None, data, bag.decoder))
                continue
            rows_of = [batch.rows(at, length) for batch, at, _ in found]
            contents = rows_of[0] if len(rows_of) == 1 else np.concatenate(rows_of)
            for columns, rows in layouts.split(channel, contents):
                own = place if len(rows) == len(place) else place[rows]
                data = [] if columns is not None else [each.tobytes() for each in contents[rows]]
                parts.append(Part(channel, own + arrived, log_ns[own], columns, data, bag.decoder))
        arrived += len(log_ns)
        yield Window(parts, int(log_ns[-1]))


def _windows(batches: Iterator[Batch]) -> Iterator[list[Batch]]:
    """The messages of each window."""
    taken: list[Batch] = []
    count = size = 0
    for batch in batches:
        sizes = np.cumsum(batch.end - batch.start)
        first = 0
        while first < batch.size:
            before = int(sizes[first - 1]) if first else 0
            full = 1 + int(np.searchsorted(sizes, WINDOW_BYTES - size + before))
            end = min(first + WINDOW_MESSAGES - count, full, batch.size)
            taken.append(batch.part(slice(first, end)))
            count, size, first = count + end - first, size + int(sizes[end - 1]) - before, end
            # what comes by the thousand is taken as it comes: to join it with what follows would copy it
            if count >= WINDOW_MESSAGES or size >= WINDOW_BYTES or (first == batch.size and count >= ENOUGH_MESSAGES):
                yield taken
                taken, count, size = [], 0, 0
    if taken:
        yield taken


def _kinds(batch: Batch) -> Iterator[tuple[int, int, Index]]:
    """Channels' numbers and lengths of messages, each with where (M,) such messages are, in order of the first."""
    kinds = batch.number + ((batch.end - batch.start) << 16)
    order = np.argsort(kinds, kind="stable")
    of_each = np.split(order, np.flatnonzero(np.diff(kinds[order])) + 1)
    for at in sorted(of_each, key=lambda at: int(at[0])):
        kind = int(kinds[at[0]])
        yield kind & 0xFFFF, kind >> 16, at


class _Layouts:
    """The layouts found so far, by channel and length of message."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._known: dict[tuple[Channel, int], list[Layout]] = {}

    def split(self, channel: Channel, data: Rows) -> Iterator[tuple[MessageColumns | None, Index]]:
        """Messages of one length, and which of them they are, by layout; those without any last, with None."""
        known = self._known.setdefault((channel, data.itemsize), [])
        left = np.arange(len(data))
        tried = 0
        while len(left):
            if tried == len(known) and not self._learn(channel, data[left[0]].tobytes(), known):
                break
            layout = known[tried]
            tried += 1
            rows = layout.view(data if len(left) == len(data) else data[left])
            shared = layout.shared(rows)
            if shared.all():
                yield MessageColumns(layout, rows), left
                return
            if shared.any():
                yield MessageColumns(layout, rows[shared]), left[shared]
            left = left[~shared]
        if len(left):
            yield None, left

    def _learn(self, channel: Channel, data: bytes, known: list[Layout]) -> bool:
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
# A message may end with as much padding; rosbags takes no more.
_PADDING = 3
# Where a message has more fields than this, viewing it costs more than it spares.
_MOST_FIELDS = 500
# Parts of a dtype that are no fields of the message; no field's name begins so
_KIND, _LENGTH, _END = "<kind>", "<length>", "<end>"
Rows = NDArray[Any]
Mask = NDArray[np.bool_]


class NoLayoutError(Exception):
    """A message that others do not share their layout with."""


@dataclass(frozen=True)
class Layout:
    """dtype: of one message; its names are paths, as ``twist.twist.linear.x`` or ``beams[2].valid``.

    lengths: path -> of the strings, bytes without terminator. flags: paths of what is bool.
    """

    dtype: np.dtype[Any]
    kind: bytes
    lengths: dict[str, int]
    flags: frozenset[str]

    @cached_property
    def inner(self) -> frozenset[str]:
        """Paths of what has fields of its own."""
        paths = (path.split(".") for path in self.dtype.names or ())
        return frozenset(".".join(steps[:depth]) for steps in paths for depth in range(1, len(steps)))

    def view(self, messages: Rows) -> Rows:
        """Messages (N,), items of this many bytes, as rows, of which those count that `shared` says."""
        return messages.view(self.dtype)

    def shared(self, rows: Rows) -> Mask:
        """(N,) which rows are laid out so, with nothing but ASCII in their strings."""
        shared: Mask = rows[_KIND] == int.from_bytes(self.kind, "little")
        for path, length in self.lengths.items():
            shared &= (rows[_LENGTH + path] == length + 1) & (rows[_END + path] == 0)
            if length and len(rows) and rows[path].max() >= 0x80:  # of all at once is a tenth of row by row
                shared &= (rows[path] < 0x80).all(axis=1)
        return shared


class MessageColumns:
    """Rows with the names of a message's fields, as a message has them: ``columns.twist.twist.linear.x`` is (N,).

    Strings are (N, length) bytes, arrays of numbers (N, size). Raises AttributeError for what is no field.
    """

    def __init__(self, layout: Layout, rows: Rows, prefix: str = "") -> None:
        self._layout, self._rows, self._prefix = layout, rows, prefix

    def __len__(self) -> int:
        return len(self._rows)

    def __getattr__(self, name: str) -> Any:
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
        """The bytes of each message, as recorded."""
        return (row.tobytes() for row in self._rows.view(("V", self._rows.itemsize)))

    def part(self, at: Any) -> MessageColumns:
        """The rows of a slice, of indices or of a mask."""
        return MessageColumns(self._layout, self._rows[at], self._prefix)


def layout_of(store: Typestore, msgtype: str, data: bytes) -> Layout:
    """The layout of a message. Raises NoLayoutError, also where rosbags makes something else of the message."""
    if len(data) < ENCAPSULATION or data[:2] not in PLAIN_CDR:
        raise NoLayoutError("no CDR")
    walk = _LayoutWalk(store, data)
    walk.message("", msgtype)
    if not walk.at <= len(data) <= walk.at + _PADDING:
        raise NoLayoutError("of another length than it says")
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
    """Goes through a message's definition and the message at once."""

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
        kind, what = description
        if kind == Nodetype.NAME:
            self.message(f"{path}.", what)
        elif kind == Nodetype.ARRAY:
            self._array(path, *what)
        elif kind == Nodetype.SEQUENCE:
            raise NoLayoutError(f"{path} is a sequence")
        elif what[0] == "string":
            self._string(path)
        else:
            self._numbers(path, what[0])

    def _array(self, path: str, description: Any, size: int) -> None:
        kind, what = description
        if kind == Nodetype.BASE and what[0] in _FORMATS and what[0] != "bool":
            self._numbers(path, what[0], size)
            return
        for number in range(size):
            self._field(f"{path}[{number}]", description)

    def _numbers(self, path: str, name: str, size: int | None = None) -> None:
        if name not in _FORMATS:
            raise NoLayoutError(f"{path} is {name}")
        format_ = self._order + _FORMATS[name]
        each = np.dtype(format_).itemsize
        self._align(each)
        if name == "bool":
            self.flags.append(path)
        self._add(path, format_ if size is None else (format_, (size,)), each * (1 if size is None else size))

    def _string(self, path: str) -> None:
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
        if len(self.fields) > _MOST_FIELDS:
            raise NoLayoutError("more fields than are worth it")
        self.fields[path] = format_, self.at
        self.at += size


def _compare(layout: Layout, rows: Rows, message: Any) -> None:
    """Raise NoLayoutError unless a row holds to the last bit what rosbags made of the message."""
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
    for step in path.split("."):
        name, _, index = step.partition("[")
        message = getattr(message, name)
        for number in index.rstrip("]").split("][") if index else ():
            message = message[int(number)]
    return message
