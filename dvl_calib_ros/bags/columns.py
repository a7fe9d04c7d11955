"""Messages of recordings as columns, window by window: what is laid out alike at once, the rest one by one."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .channels import Channel, Decoder, DecodingError
from .layout import Columns, Layout, NoLayoutError, layout_of
from .reader import BagReader, Wanted
from .sorting import BagMessage

# Messages that are read at once, and their bytes: enough for columns to pay, few enough for any memory.
WINDOW_MESSAGES, WINDOW_BYTES = 4096, 4 << 20
# A recorder has one layout or a few; garbage could have ever new ones.
_MOST_LAYOUTS = 8
Stamps = NDArray[np.int64]
Index = NDArray[np.intp]
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
    columns: Columns | None
    _data: list[bytes]
    _decoder: Decoder

    def __len__(self) -> int:
        return len(self.arrival)

    def messages(self) -> Iterator[tuple[Any, str]]:
        """One by one: the decoded message, None if it cannot be decoded, and then why."""
        for data in self._data:
            try:
                yield self._decoder(self.channel, data), ""
            except DecodingError as error:
                yield None, str(error)


@dataclass(frozen=True)
class Window:
    """Messages that follow each other in a recording. log_ns: of the last."""

    parts: list[Part]
    log_ns: int


def windows(
    bag: BagReader, topics: Collection[str], one_by_one: Collection[str] = (), wanted: Wanted | None = None
) -> Iterator[Window]:
    """Messages of these topics that are wanted, None for all. one_by_one: topics of which no columns are asked for."""
    messages = bag.raw_messages(topics, wanted)
    layouts = _Layouts(bag.decoder)
    arrived = 0
    while taken := _taken(messages):
        by_kind: dict[tuple[int, int], list[int]] = {}  # by the channel's id: its hash costs more than all else here
        for place, (_, channel, data) in enumerate(taken):
            by_kind.setdefault((id(channel), len(data)), []).append(place)
        log_ns = np.array([min(message[0], _LATEST_NS) for message in taken], dtype=np.int64)
        parts = []
        for places in by_kind.values():
            channel = taken[places[0]][1]
            at = np.array(places, dtype=np.intp)
            contents = [taken[place][2] for place in places]
            split = [(None, at)] if channel.topic in one_by_one else layouts.split(channel, contents, at)
            for columns, rows in split:
                own = contents if len(rows) == len(contents) else [taken[place][2] for place in rows.tolist()]
                parts.append(Part(channel, rows.astype(np.int64) + arrived, log_ns[rows], columns, own, bag.decoder))
        arrived += len(taken)
        yield Window(parts, int(log_ns[-1]))


def _taken(messages: Iterator[BagMessage]) -> list[BagMessage]:
    """The messages of the next window."""
    taken: list[BagMessage] = []
    size = 0
    for message in messages:
        taken.append(message)
        size += len(message[2])
        if len(taken) >= WINDOW_MESSAGES or size >= WINDOW_BYTES:
            break
    return taken


class _Layouts:
    """The layouts found so far, by channel and length of message."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._known: dict[tuple[Channel, int], list[Layout]] = {}

    def split(self, channel: Channel, data: list[bytes], at: Index) -> Iterator[tuple[Columns | None, Index]]:
        """Messages of one length, which are at these places, by layout; those without any last, with None."""
        known = self._known.setdefault((channel, len(data[0])), [])
        left = np.arange(len(data))
        tried = 0
        while len(left):
            if tried == len(known) and not self._learn(channel, data[left[0]], known):
                break
            layout = known[tried]
            tried += 1
            some = data if len(left) == len(data) else [data[place] for place in left.tolist()]
            rows = layout.view(some)
            shared = layout.shared(rows)
            if shared.all():
                yield Columns(layout, rows), at[left]
                return
            if shared.any():
                yield Columns(layout, rows[shared]), at[left[shared]]
            left = left[~shared]
        if len(left):
            yield None, at[left]

    def _learn(self, channel: Channel, data: bytes, known: list[Layout]) -> bool:
        store = self._decoder.typestore(channel)
        if store is None or len(known) >= _MOST_LAYOUTS:
            return False
        try:
            known.append(layout_of(store, channel.msgtype, data))
        except (NoLayoutError, LookupError):
            return False
        return True
