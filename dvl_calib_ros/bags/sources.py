"""One recorded file: MCAP, SQLite or a .bag of ROS 1, whole or damaged.

It is read by its index, and after the first damage by the salvaging readers. Only exceptions due to damaged bytes and
bad disks are caught; an incompatible library must not be reported as damage.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import lru_cache, partial
from itertools import islice, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from ..errors import InputError
from .batches import (
    LATEST_NS,
    MOST_BYTES,
    MOST_MESSAGES,
    BagMessage,
    Batch,
    batched,
    by_log_time,
    numbered_batch,
    one_batch,
)
from .channels import DECODING, KEPT, SEPARATOR, Channel, Definition, DefinitionError, definition_of, typestore
from .files import ZSTD_MAGIC, NewFolder, decompressed, open_raw, storage_suffix, with_journal
from .salvage.damage import LARGEST_RECORD, DamagedError, Salvaged
from .salvage.mcap_file import MCAP_MAGIC, bytes_at_once, indexed_messages, read_summary, salvage_mcap
from .salvage.sqlite_file import SQLITE_MAGIC, salvage_sqlite

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader


# ROS 1 recordings: .bag files by their index, and conversion of ROS 1 messages to CDR.

ROS1_MAGIC, ROS1_ENCODING = b"#ROSBAG", "ros1msg"
# built-in types of ROS 1 are messages in ROS 2, whose headers have no counter
_TIMES = "".join(
    f"{SEPARATOR}MSG: builtin_interfaces/{name}\nint32 sec\nuint32 nanosec\n" for name in ("Time", "Duration")
)
_HEADER, _COUNTER = "MSG: std_msgs/Header", "uint32 seq\n"


def open_bag(path: Path, shown: Path) -> tuple[Counter[Channel], tuple[int, int]]:
    """Return the number of messages of each channel of a .bag, and first and last log time. Raises InputError."""
    try:
        with _reader(path) as (reader, channels):
            counts: Counter[Channel] = Counter()
            for connection in reader.connections:
                counts[channels[connection.id]] += connection.msgcount
            return counts, (reader.start_time, reader.end_time - 1)
    except DamagedError as error:
        raise InputError(f"{shown}: a ROS 1 bag without a usable index ({error}); run rosbag reindex on it") from error


def bag_batches(path: Path, topics: Collection[str]) -> Iterator[Batch]:
    """Yield the messages of topics of a .bag in ROS 1's layout. Raises DamagedError after the last."""
    with _reader(path) as (reader, channels):
        wanted = [connection for connection in reader.connections if connection.topic in topics]
        if wanted:  # for rosbags an empty list means all
            yield from batched((at, channels[each.id], data) for each, at, data in reader.messages(wanted))


@contextmanager
def _reader(path: Path) -> Iterator[tuple[Reader, Mapping[int, Channel]]]:
    """Open a .bag, with the channel of each connection. Raises DamagedError for rosbags' errors on damage."""
    from rosbags.rosbag1 import Reader, ReaderError

    damage = (ReaderError, AssertionError, struct.error, ValueError, LookupError, RuntimeError, OverflowError)
    try:
        with Reader(path) as reader:
            yield (
                reader,
                {
                    each.id: Channel(each.topic, each.msgtype, definition_of(ROS1_ENCODING, each.msgdef.data))
                    for each in reader.connections
                },
            )
    except damage as error:
        raise DamagedError(str(error) or "damaged") from error


def as_ros2(channels: Collection[Channel]) -> dict[Channel, Channel]:
    """Map each channel to its name and definition in ROS 2; other channels to themselves."""
    return {channel: _ros2_types(channel)[0] if is_ros1(channel) else channel for channel in channels}


def is_ros1(channel: Channel) -> bool:
    """Return whether messages of a channel have ROS 1's layout."""
    return channel.definition is not None and channel.definition.is_ros1


def batch_as_ros2(batch: Batch) -> Batch:
    """Convert messages to CDR; one that does not fit its definition becomes empty, and counts as undecodable."""
    types = {id(channel): _ros2_types(channel) for channel in batch.channels.values() if is_ros1(channel)}
    if not types:
        return batch

    def converted(channel: Channel, data: bytes) -> tuple[Channel, bytes]:
        """Convert a ROS 1 message to ROS 2; empty bytes if it cannot be decoded."""
        if id(channel) not in types:
            return channel, data
        as_ros2, store = types[id(channel)]
        try:
            return as_ros2, bytes(store.ros1_to_cdr(data, as_ros2.msgtype))
        except (*DECODING, AssertionError):
            return as_ros2, b""

    return one_batch((log_ns, *converted(channel, data)) for log_ns, channel, data in batch.messages())


@lru_cache(maxsize=KEPT)
def _ros2_types(channel: Channel) -> tuple[Channel, Typestore]:
    """Return a ROS 1 channel in ROS 2's terms, and the types that convert its messages."""
    msgtype = normalize_msgtype(channel.msgtype)
    parts = (channel.definition.text if channel.definition else "").split(SEPARATOR)
    parts = [part.replace(_COUNTER, "") if part.startswith(_HEADER) else part for part in parts]
    try:
        store = typestore(definition_of("ros2msg", SEPARATOR.join(parts).rstrip() + "\n" + _TIMES), msgtype)
        text, _ = store.generate_msgdef(msgtype, ros_version=2)
        return Channel(channel.topic, msgtype, definition_of("ros2msg", text)), store
    except (DefinitionError, TypesysError):  # types of ROS itself are known anyway
        return Channel(channel.topic, msgtype), get_typestore(Stores.ROS2_JAZZY)


# limit of memory for merging chunks that overlap in time, as written by a recorder that caches by topic
MERGED_AT_ONCE = 64 << 20
DAMAGE = (DamagedError, OSError, sqlite3.Error, struct.error)

Batches = Callable[[Collection[str]], Iterator[Batch]]
"""Topics -> batches of their messages."""
Salvage = Callable[[Path], Iterator[Salvaged]]


class Source:
    """One recorded file.

    path: as given by the user.
    counts: channel -> announced number of messages.
    span_ns: first and last log time.
    batches: messages of some topics, in order of log time; raises `DAMAGE` after the last, unless damage_noted.
    """

    def __init__(
        self,
        path: Path,
        counts: Mapping[Channel, int],
        span_ns: tuple[int, int],
        batches: Batches,
        damage_noted: bool = False,
    ) -> None:
        """Describe a recorded file; the arguments are those of the class."""
        self.path = path
        self.counts = counts
        self.span_ns = min(span_ns[0], LATEST_NS), min(span_ns[1], LATEST_NS)
        self.batches = batches
        self.damage_noted = damage_noted
        self._by_topic: dict[str, list[Channel]] = {}
        for channel in counts:
            self._by_topic.setdefault(channel.topic, []).append(channel)

    def channels(self, topic: str) -> list[Channel]:
        """Return the channels of a topic."""
        return self._by_topic.get(topic, [])


def open_source(path: Path, new_folder: NewFolder, notes: list[str], shown: Path | None = None) -> Source:
    """Open a recorded file. Raises InputError, or OSError if it cannot be read.

    notes: receives messages to the user. shown: the user's name of a file that was unpacked elsewhere.
    """
    shown = shown or path
    if not path.is_file():
        path.stat()  # raises OSError for a bad path
        raise InputError(f"{shown}: not a file; remove it from the bag")
    if path.stat().st_size == 0:
        raise InputError(f"{shown}: the file is empty; nothing was recorded")
    with open_raw(path) as file:
        magic = file.read(16)
    if magic.startswith(ZSTD_MAGIC) and path == shown:
        return open_source(decompressed(path, new_folder, notes), new_folder, notes, shown)
    if magic.startswith(ROS1_MAGIC):
        return _in_ros2(Source(shown, *open_bag(path, shown), partial(bag_batches, path)))
    # if the first bytes are lost or were never written, use the name
    kinds = {MCAP_MAGIC: ".mcap", SQLITE_MAGIC: ".db3"}
    kind = next((kinds[kind] for kind in kinds if magic.startswith(kind)), storage_suffix(shown))
    if kind == ".mcap":
        return _open_or_salvage(path, shown, _open_mcap, salvage_mcap, notes)
    if kind == ".db3":
        return _open_or_salvage(with_journal(path, new_folder, notes), shown, _open_sqlite, salvage_sqlite, notes)
    raise InputError(f"{shown}: no bag; give a rosbag2 folder, or a .mcap, .db3 or .bag file")


def _open_or_salvage(
    path: Path,
    shown: Path,
    by_index: Callable[[Path, Path, list[str]], Source | None],
    salvage: Salvage,
    notes: list[str],
) -> Source:
    """Open a file by its index, or salvage its messages if the index is damaged."""
    try:
        source, why = by_index(path, shown, notes), ""
    except DAMAGE as error:
        source, why = None, message_of(error)
    return _in_ros2(source or _open_salvaged(path, shown, salvage, why, notes))


def _in_ros2(source: Source) -> Source:
    """Convert a source's ROS 1 messages to ROS 2's layout."""
    if not any(map(is_ros1, source.counts)):
        return source
    counts: Counter[Channel] = Counter()
    for channel, new in as_ros2(source.counts).items():
        counts[new] += source.counts[channel]

    def batches(topics: Collection[str]) -> Iterator[Batch]:
        return map(batch_as_ros2, source.batches(topics))

    return Source(source.path, counts, source.span_ns, batches, source.damage_noted)


def _open_mcap(path: Path, shown: Path, notes: list[str]) -> Source | None:
    """Open an MCAP file by its index; None if it has none."""
    summary = read_summary(path)
    if summary is None or summary.statistics is None:
        return None
    statistics, schemas = summary.statistics, summary.schemas
    types = {
        number: (schema.name, definition_of(schema.encoding, schema.data.decode("utf-8", "replace")))
        for number, schema in schemas.items()
    }
    channels = {
        number: Channel(channel.topic, *types.get(channel.schema_id, ("",)))
        for number, channel in summary.channels.items()
    }
    counts = dict.fromkeys(channels.values(), 0)
    for number, count in statistics.channel_message_counts.items():
        counts[channels[number]] += count

    def batches(topics: Collection[str]) -> Iterator[Batch]:
        """Yield batches of these topics, in order of log time if they fit into memory."""
        wanted = {number: channel for number, channel in channels.items() if channel.topic in topics}
        in_order = bytes_at_once(summary, wanted) <= MERGED_AT_ONCE
        found = indexed_messages(path, summary, wanted, in_order)
        return found if in_order else batched(by_log_time(message for batch in found for message in batch.messages()))

    span_ns = (statistics.message_start_time, statistics.message_end_time)
    return Source(shown, counts, span_ns, _salvaging_after_damage(batches, path, salvage_mcap, counts))


def _open_sqlite(path: Path, shown: Path, notes: list[str]) -> Source:
    """Open an SQLite bag; messages after a damaged place are salvaged."""
    database = Database(path)
    if database.astray:
        notes.append(f"{shown}: {database.astray} messages belong to topics that it does not list; they are left out")
    found = _salvaging_after_damage(database.batches, path, salvage_sqlite, database.counts)
    return Source(shown, database.counts, database.span_ns, found)


def _open_salvaged(path: Path, shown: Path, salvage: Salvage, why: str, notes: list[str]) -> Source:
    """Open a recording that is read from beginning to end. why: fault of its index, '' if it has none."""
    counts: Counter[Channel] = Counter()
    first_ns, last_ns = 2**63 - 1, 0
    damage, in_order = "", True
    try:
        for log_ns, channel, _ in _with_channels(salvage(path)):
            counts[channel] += 1
            in_order = in_order and log_ns >= last_ns
            first_ns, last_ns = min(first_ns, log_ns), max(last_ns, log_ns)
    except DAMAGE as error:
        damage = message_of(error)
    total = counts.total()
    if not total and (damage or why):
        raise InputError(f"{shown}: damaged, and no whole message in it ({damage or why}); use another recording")
    read = f"{total} whole messages, {1e-9 * (last_ns - first_ns):.1f} s"
    if damage:
        notes.append(f"{shown}: damaged or cut off ({damage}); read {read}")
    elif why:
        notes.append(f"{shown}: has no usable index ({why}); read from beginning to end: {read}")

    def messages(topics: Collection[str]) -> Iterator[BagMessage]:
        with suppress(*DAMAGE):  # was already noted
            yield from (message for message in _with_channels(salvage(path)) if message[1].topic in topics)

    def batches(topics: Collection[str]) -> Iterator[Batch]:
        return batched(messages(topics) if in_order else by_log_time(messages(topics)))

    return Source(shown, counts, (first_ns, last_ns), batches, damage_noted=True)


def _with_channels(salvaged: Iterator[Salvaged]) -> Iterator[BagMessage]:
    """Replace topic, type and definition of salvaged messages by their channel."""
    channels: dict[tuple[str, ...], Channel] = {}
    for topic, msgtype, encoding, definition, log_ns, data in salvaged:
        key = (topic, msgtype, encoding, definition)
        channel = channels.get(key)
        if channel is None:
            known = definition_of(encoding, definition) if definition else None
            channel = channels[key] = Channel(topic, msgtype, known)
        yield log_ns, channel, data


def _salvaging_after_damage(batches: Batches, path: Path, salvage: Salvage, counts: Mapping[Channel, int]) -> Batches:
    """Read by the index and, after damage, the remaining messages by salvaging. counts: announced by the index."""

    def all_batches(topics: Collection[str]) -> Iterator[Batch]:
        """Yield the batches of the index, then what salvaging finds beyond them. Raises DamagedError."""
        read = 0
        announced = sum(count for channel, count in counts.items() if channel.topic in topics)
        try:
            for batch in batches(topics):
                read += batch.size
                yield batch
            if read < announced:
                raise DamagedError(f"it announces {announced} messages, its index leads to {read}")
        except DAMAGE as error:
            damage, found = yield from _unread_messages(salvage(path), topics, _AlreadyRead(batches(topics), read))
            raise DamagedError(damage or message_of(error), max(announced - read - found, 0)) from error

    return all_batches


class _AlreadyRead:
    """Multiset of the first messages of batches, which the reader already has.

    They are recognised by content: in a damaged recording neither log time nor position identifies a message.
    """

    def __init__(self, batches: Iterator[Batch], count: int) -> None:
        messages = (message for batch in batches for message in batch.messages())
        keys = np.sort(np.fromiter((_key(message) for message in islice(messages, count)), np.int64))
        first = np.flatnonzero(np.diff(keys, prepend=~keys[:1]))
        self._keys, self._left = keys[first], np.diff(first, append=len(keys))

    def __contains__(self, message: BagMessage) -> bool:
        key = _key(message)
        at = int(np.searchsorted(self._keys, key))
        if at == len(self._keys) or self._keys[at] != key or not self._left[at]:
            return False
        self._left[at] -= 1
        return True


def _key(message: BagMessage) -> int:
    _, channel, data = message
    return hash((channel.topic, data))


def _unread_messages(
    salvaged: Iterator[Salvaged], topics: Collection[str], given: _AlreadyRead
) -> Generator[Batch, None, tuple[str, int]]:
    """Yield the messages of a damaged recording that were not yielded before. Return the damage and their number."""
    damage, found = "", 0

    def others() -> Iterator[BagMessage]:
        """Yield the salvaged messages that the index has not given."""
        nonlocal damage, found
        try:
            for message in _with_channels(salvaged):
                if message[1].topic in topics and message not in given:
                    found += 1
                    yield message
        # salvaging does not see the index's messages, so its own count of lost ones is too high
        except DAMAGE as error:
            damage = error.what if isinstance(error, DamagedError) else message_of(error)

    yield from batched(by_log_time(others()))
    return damage, found


def message_of(error: Exception) -> str:
    """Return an error of `DAMAGE` as text."""
    return str(error) if isinstance(error, DamagedError) else f"{type(error).__name__}: {error}"


class Database:
    """A recording in SQLite. Raises sqlite3.Error or DamagedError if it cannot be read.

    counts: channel -> number of its messages.
    span_ns: first and last log time.
    astray: number of messages of unlisted topics.
    """

    def __init__(self, path: Path) -> None:
        """Count the messages of each channel, and find the first and the last log time (ns)."""
        self._path = path
        with closing(self._connection()) as connection:
            self._channels = _channels(connection)
            rows = _rows(
                connection,
                "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id",
                (int, int, int, int),
            )
        self.counts: dict[Channel, int] = dict.fromkeys(self._channels.values(), 0)
        self.astray = 0
        for number, count, *_ in rows:
            if number in self._channels:
                self.counts[self._channels[number]] += count
            else:
                self.astray += count
        known = [row for row in rows if row[0] in self._channels]
        self.span_ns = (min((row[2] for row in known), default=0), max((row[3] for row in known), default=0))

    def batches(self, topics: Collection[str]) -> Iterator[Batch]:
        """Yield messages of these topics in order of log time; those before an exception come first."""
        numbers = [number for number, channel in self._channels.items() if channel.topic in topics]
        tail = f"FROM messages WHERE topic_id IN ({','.join('?' * len(numbers))}) AND length(data) <= {LARGEST_RECORD}"
        query = f"SELECT timestamp, topic_id, data {tail} ORDER BY timestamp"
        with closing(self._connection()) as connection:
            # with grouping by topic, SQLite would sort the messages themselves
            ((longest,),) = connection.execute(f"SELECT max(length(data)) {tail}", numbers)
            at_once = max(1, min(MOST_MESSAGES, MOST_BYTES // max(longest or 1, 1)))
            cursor = connection.execute(query, numbers)
            error: Exception | None = None
            while error is None:
                rows: list[tuple[Any, Any, Any]] = []
                try:
                    rows.extend(islice(cursor, at_once))
                except sqlite3.Error as raised:  # rows read before the error are in the list
                    error = raised
                if not rows:
                    break
                log_ns, number, data = zip(*rows, strict=True)
                sound = _count_valid(log_ns, data)
                if sound:
                    yield numbered_batch(log_ns[:sound], number[:sound], data[:sound], self._channels)
                if sound < len(rows):
                    raise DamagedError("a message is missing or damaged")
            if error is not None:
                raise error

    def _connection(self) -> sqlite3.Connection:
        # immutable: SQLite looks for no journal and no lock, so that it writes nothing next to a recording
        uri = f"file:{quote(str(self._path.absolute()), safe='/')}?immutable=1&mode=ro"
        return sqlite3.connect(uri, uri=True, check_same_thread=False)


def _count_valid(log_ns: Sequence[Any], data: Sequence[Any]) -> int:
    """Return the number of leading rows that are valid messages."""
    if set(map(type, log_ns)) == {int} and set(map(type, data)) == {bytes} and min(log_ns) >= 0:
        return len(log_ns)
    are = (type(at) is int and at >= 0 and type(content) is bytes for at, content in zip(log_ns, data, strict=True))
    return sum(1 for _ in takewhile(bool, are))


def _channels(connection: sqlite3.Connection) -> dict[int, Channel]:
    """Return topics by number, with types and definitions. Raises DamagedError without the tables."""
    tables = {name for (name,) in _rows(connection, "SELECT name FROM sqlite_master WHERE type = 'table'", (str,))}
    if not {"topics", "messages"} <= tables:
        raise DamagedError("its tables of topics and messages are missing")
    of_topics = {row[1] for row in connection.execute("PRAGMA table_info(topics)")}
    has_hash = "type_description_hash" in of_topics
    hashed = "type_description_hash" if has_hash else "''"
    topics = _rows(connection, f"SELECT id, name, type, {hashed} FROM topics ORDER BY id", (int, str, str, str))
    definitions: dict[tuple[str, str], Definition] = {}
    if "message_definitions" in tables:
        columns = f"topic_type, {hashed}, encoding, encoded_message_definition"
        query = f"SELECT {columns} FROM message_definitions ORDER BY id"
        for msgtype, digest, encoding, text in _rows(connection, query, (str, str, str, str)):
            definition = definition_of(encoding, text)
            definitions.setdefault((msgtype, digest), definition)
            definitions.setdefault((msgtype, ""), definition)  # for topics without the hash of their definition
    return {
        number: Channel(name, msgtype, definitions.get((msgtype, digest)) or definitions.get((msgtype, "")))
        for number, name, msgtype, digest in topics
    }


def _rows(connection: sqlite3.Connection, query: str, types: tuple[type, ...]) -> list[Any]:
    """Return all rows of a query with columns of these types; damaged pages can have anything."""
    try:
        rows = connection.execute(query).fetchall()
    except UnicodeDecodeError as error:  # SQLite's message would contain the damaged names
        raise DamagedError("its tables are damaged") from error
    if any(type(value) is not expected for row in rows for value, expected in zip(row, types, strict=True)):
        raise DamagedError("a table holds values that no recording has")
    return rows
