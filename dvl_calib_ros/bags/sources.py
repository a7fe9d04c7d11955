"""One recorded file: what is in it, and its messages in order of log time, past whatever is damaged.

It is read by its index while that is sound, SQLite's or MCAP's, and after the first damage by the salvaging readers.
What is caught here is what damaged bytes and bad disks cause, and no more: that a library of another version does not
fit is no damage, and is not to be reported as such.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from ..errors import InputError
from .batches import Batch, batched
from .channels import Channel, definition_of
from .files import ZSTD_MAGIC, NewFolder, decompressed, storage_suffix, with_journal
from .raw_file import open_raw
from .salvage.damage import DamagedError, Salvaged
from .salvage.mcap_file import MCAP_MAGIC, bytes_at_once, indexed_messages, read_summary, salvage_mcap
from .salvage.sqlite_file import SQLITE_MAGIC, salvage_sqlite
from .sorting import BagMessage, by_log_time
from .sqlite import Database

ROS1_MAGIC = b"#ROSBAG"
# Chunks that overlap in time, as of a recorder that caches by topic, are merged in memory up to so many bytes.
MERGED_AT_ONCE = 64 << 20
DAMAGE = (DamagedError, OSError, sqlite3.Error, struct.error)

Batches = Callable[[Collection[str]], Iterator[Batch]]
"""Topics -> their messages."""
Salvage = Callable[[Path], Iterator[Salvaged]]


class Source:
    """One recorded file.

    path: as the user knows it. counts: channel -> how many messages it announces. span_ns: first and last log time.
    batches: messages of some topics, in order of log time; raises what is in `DAMAGE` after the last, unless
    damage_noted.
    """

    def __init__(
        self,
        path: Path,
        counts: Mapping[Channel, int],
        span_ns: tuple[int, int],
        batches: Batches,
        damage_noted: bool = False,
    ) -> None:
        self.path = path
        self.counts = counts
        self.span_ns = span_ns
        self.batches = batches
        self.damage_noted = damage_noted

    def channels(self, topic: str) -> list[Channel]:
        """The channels of a topic."""
        return [channel for channel in self.counts if channel.topic == topic]


def open_source(path: Path, new_folder: NewFolder, notes: list[str], shown: Path | None = None) -> Source:
    """Open a recorded file. Raises InputError, or OSError if it cannot be read at all.

    notes: where to say what the user should know. shown: how the user knows it, when it has been unpacked elsewhere.
    """
    shown = shown or path
    if not path.is_file():
        path.stat()  # raises what is wrong with the path
        raise InputError(f"{shown}: not a file; remove it from the bag")
    if path.stat().st_size == 0:
        raise InputError(f"{shown}: the file is empty; nothing was recorded")
    with open_raw(path) as file:
        magic = file.read(16)
    if magic.startswith(ZSTD_MAGIC) and path == shown:
        return open_source(decompressed(path, new_folder, notes), new_folder, notes, shown)
    if magic.startswith(ROS1_MAGIC):
        raise InputError(f"{shown}: a ROS 1 bag; convert it first: rosbags-convert --src {shown.name} --dst NEW")
    # of a file whose first bytes were never written, or are lost, the name has to do
    kinds = {MCAP_MAGIC: ".mcap", SQLITE_MAGIC: ".db3"}
    kind = next((kinds[each] for each in kinds if magic.startswith(each)), storage_suffix(shown))
    if kind == ".mcap":
        return _opened(path, shown, _mcap, salvage_mcap, notes)
    if kind == ".db3":
        return _opened(with_journal(path, new_folder, notes), shown, _sqlite, salvage_sqlite, notes)
    raise InputError(f"{shown}: no bag; give a rosbag2 folder, or a .mcap or .db3 file")


def _opened(
    path: Path,
    shown: Path,
    by_index: Callable[[Path, Path, list[str]], Source | None],
    salvage: Salvage,
    notes: list[str],
) -> Source:
    try:
        source, why = by_index(path, shown, notes), ""
    except DAMAGE as error:
        source, why = None, said(error)
    return source or _salvaged(path, shown, salvage, why, notes)


def _mcap(path: Path, shown: Path, notes: list[str]) -> Source | None:
    """An MCAP file by its index; None if it has none."""
    summary = read_summary(path)
    if summary is None or summary.statistics is None:
        return None
    statistics, schemas = summary.statistics, summary.schemas
    channels = {}
    for number, channel in summary.channels.items():
        schema = schemas.get(channel.schema_id)
        if schema is None:
            channels[number] = Channel(channel.topic, "")
        else:
            definition = definition_of(schema.encoding, schema.data.decode("utf-8", "replace"))
            channels[number] = Channel(channel.topic, schema.name, definition)
    counts = dict.fromkeys(channels.values(), 0)
    for number, count in statistics.channel_message_counts.items():
        if number not in channels:
            raise DamagedError(f"its index counts messages of channel {number}, which it does not name")
        counts[channels[number]] += count

    def batches(topics: Collection[str]) -> Iterator[Batch]:
        wanted = {number: channel for number, channel in channels.items() if channel.topic in topics}
        in_order = bytes_at_once(summary, wanted) <= MERGED_AT_ONCE
        found = indexed_messages(path, summary, wanted, in_order)
        return found if in_order else batched(by_log_time(message for batch in found for message in batch.messages()))

    span_ns = (statistics.message_start_time, statistics.message_end_time)
    return Source(shown, counts, span_ns, _until_damage(batches, path, salvage_mcap, counts))


def _sqlite(path: Path, shown: Path, notes: list[str]) -> Source:
    database = Database(path)
    if database.astray:
        notes.append(f"{shown}: {database.astray} messages belong to topics that it does not list; they are left out")
    found = _until_damage(database.batches, path, salvage_sqlite, database.counts)
    return Source(shown, database.counts, database.span_ns, found)


def _salvaged(path: Path, shown: Path, salvage: Salvage, why: str, notes: list[str]) -> Source:
    """A recording that is read from beginning to end. why: its index cannot be used, '' if it has none."""
    counts: Counter[Channel] = Counter()
    first_ns, last_ns = 2**63 - 1, 0
    damage, in_order = "", True
    try:
        for log_ns, channel, _ in _with_channels(salvage(path)):
            counts[channel] += 1
            in_order = in_order and log_ns >= last_ns
            first_ns, last_ns = min(first_ns, log_ns), max(last_ns, log_ns)
    except DAMAGE as error:
        damage = said(error)
    total = counts.total()
    if not total and (damage or why):
        raise InputError(f"{shown}: damaged, and no whole message in it ({damage or why}); use another recording")
    read = f"{total} whole messages, {1e-9 * (last_ns - first_ns):.1f} s"
    if damage:
        notes.append(f"{shown}: damaged or cut off ({damage}); read {read}")
    elif why:
        notes.append(f"{shown}: has no usable index ({why}); read from beginning to end: {read}")

    def messages(topics: Collection[str]) -> Iterator[BagMessage]:
        with suppress(*DAMAGE):  # it has been told of
            yield from (message for message in _with_channels(salvage(path)) if message[1].topic in topics)

    def batches(topics: Collection[str]) -> Iterator[Batch]:
        return batched(messages(topics) if in_order else by_log_time(messages(topics)))

    return Source(shown, counts, (first_ns, last_ns), batches, damage_noted=True)


def _with_channels(salvaged: Iterator[Salvaged]) -> Iterator[BagMessage]:
    channels: dict[tuple[str, ...], Channel] = {}
    for topic, msgtype, encoding, definition, log_ns, data in salvaged:
        key = (topic, msgtype, encoding, definition)
        channel = channels.get(key)
        if channel is None:
            known = definition_of(encoding, definition) if definition else None
            channel = channels[key] = Channel(topic, msgtype, known)
        yield log_ns, channel, data


def _until_damage(batches: Batches, path: Path, salvage: Salvage, counts: Mapping[Channel, int]) -> Batches:
    """Messages as an index leads to them, after damage those that salvaging finds. counts: what the index announces."""

    def all_batches(topics: Collection[str]) -> Iterator[Batch]:
        newest_ns, read = -1, 0
        newest: list[BagMessage] = []
        try:
            for batch in batches(topics):
                if batch.log_ns[0] != newest_ns:
                    newest = []
                if batch.log_ns[-1] != newest_ns:
                    newest_ns, newest = int(batch.log_ns[-1]), []
                newest += batch.part(batch.log_ns == newest_ns).messages()
                read += batch.size
                yield batch
            if read < (announced := sum(count for channel, count in counts.items() if channel.topic in topics)):
                raise DamagedError(f"it announces {announced} messages, its index leads to {read}")
        except DAMAGE as error:
            damage = yield from _rest(salvage(path), topics, newest_ns, newest)
            raise DamagedError(damage or said(error)) from error

    return all_batches


def _rest(
    salvaged: Iterator[Salvaged], topics: Collection[str], newest_ns: int, newest: Sequence[BagMessage]
) -> Generator[Batch, None, str]:
    """What of a damaged recording comes after the messages that its index led to (at newest_ns: `newest`).

    Returns what is damaged.
    """
    damage = ""
    known = {(channel.topic, data) for _, channel, data in newest}

    def later() -> Iterator[BagMessage]:
        nonlocal damage
        try:
            for message in _with_channels(salvaged):
                log_ns, channel, data = message
                is_later = log_ns > newest_ns or (log_ns == newest_ns and (channel.topic, data) not in known)
                if is_later and channel.topic in topics:
                    yield message
        except DAMAGE as error:
            damage = said(error)

    yield from batched(by_log_time(later()))
    return damage


def said(error: Exception) -> str:
    """An error of `DAMAGE` in words."""
    return str(error) if isinstance(error, DamagedError) else f"{type(error).__name__}: {error}"
