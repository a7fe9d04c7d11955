"""Messages of recordings as columns, window by window: what is laid out alike at once, the rest one by one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .batches import Batch, Index
from .channels import Channel, Decoder, DecodingError
from .layout import Layout, MessageColumns, NoLayoutError, Rows, layout_of
from .reader import BagReader

# Messages that are read at once, and their bytes: enough for columns to pay, few enough for any memory.
WINDOW_MESSAGES, WINDOW_BYTES = 4096, 4 << 20
ENOUGH_MESSAGES = 1024
# A recorder has one layout or a few; garbage could have ever new ones.
_MOST_LAYOUTS = 8
Stamps = NDArray[np.int64]
_LATEST_NS = 2**63 - 1


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
        log_ns = np.concatenate([np.minimum(batch.log_ns, _LATEST_NS).astype(np.int64) for batch in batches])
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
        except (NoLayoutError, LookupError):
            return False
        return True
