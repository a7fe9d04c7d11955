"""rosbag2 recordings: folders and single files, MCAP and SQLite, compressed or not, several at once, damaged ones.

SQLite is read by rosbags, MCAP by its index with `salvage_mcap`, which bounds the memory; both until the first damage,
where the salvaging readers take over. Decoding is rosbags'.
"""

from __future__ import annotations

import heapq
import shutil
import sqlite3
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from enum import Enum
from operator import itemgetter
from pathlib import Path, PurePath
from types import TracebackType
from typing import Any

import apsw
import numpy as np
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, ReaderError, StoragePlugin, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from ..errors import InputError
from ..files.yaml_files import load_yaml
from ..messages.drivers import IMU_TYPE, TWIST_TYPE, VELOCITY_TYPES
from .attachments import attach
from .definitions import Definition, DefinitionError, is_empty, known_typestores, typestore
from .salvage.damage import LARGEST_RECORD, DamagedError, Salvaged
from .salvage.mcap_file import MCAP_MAGIC, indexed_messages, read_summary, salvage_mcap
from .salvage.sqlite_file import SQLITE_MAGIC, salvage_sqlite

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
ROS1_MAGIC = b"#ROSBAG"
STORAGE_SUFFIXES = (".mcap", ".db3")
# A compressed file that unpacks to more than this and so many times its size is no recording.
LARGEST_RATIO, SMALL_FILE = 100, 1 << 30
FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}

# Plain tuples: there is one per message, and a named one would cost as much as a third of its decoding.
BagMessage = tuple[str, int, Any, str]
"""Topic, log time (ns), decoded message (None if it cannot be decoded), and then why."""
_Raw = tuple[int, int, str, str, bytes]
"""Log time (ns), index of the source, topic, type, CDR bytes; topic '' marks where a source begins."""


Messages = Callable[[set[str]], Iterator[tuple[int, str, str, bytes]]]
"""Topics -> log time, topic, type and bytes of their messages."""
Salvage = Callable[[Path], Iterator[Salvaged]]


class _Source:
    """One recording: what is in it and its messages in order of log time."""

    def __init__(
        self,
        path: Path,
        topics: dict[str, str],
        counts: dict[str, int],
        definitions: dict[str, Definition],
        span_ns: tuple[int, int],
        messages: Messages,
        damage_noted: bool = False,
    ) -> None:
        self.path = path
        self.damage_noted = damage_noted
        self.topics = topics
        self.counts = counts
        self.span_ns = span_ns
        self.messages = messages
        self._definitions = definitions
        self._stores: dict[str, list[Typestore] | DefinitionError] = {}

    def definition(self, topic: str) -> Definition | None:
        """The embedded definition of a topic's messages."""
        return self._definitions.get(self.topics[topic])

    def decode(self, msgtype: str, data: bytes) -> Any:
        """A message, by the definition embedded in the bag, else by those known here. Raises DefinitionError."""
        stores = self._typestores(msgtype)
        for store in stores[:-1]:  # of several versions, the one that a message fits from beginning to end
            with suppress(Exception):
                message = store.deserialize_cdr(data, msgtype)
                self._stores[msgtype] = [store]
                return message
        return stores[-1].deserialize_cdr(data, msgtype)

    def _typestores(self, msgtype: str) -> list[Typestore]:
        if msgtype not in self._stores:
            definition = self._definitions.get(msgtype)
            try:
                known = is_empty(definition)
                self._stores[msgtype] = known_typestores(msgtype) if known else [typestore(definition, msgtype)]
            except DefinitionError as error:  # once, not for every message
                self._stores[msgtype] = error
        stores = self._stores[msgtype]
        if isinstance(stores, DefinitionError):
            raise stores
        return stores


class BagReader:
    """Reads one or more recordings as one, in order of log time. A context manager.

    notes: what the user should know of what was read (damage), complete after the last message. Raises InputError
    for what is no bag.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.notes: list[str] = []
        self._stack = ExitStack()
        self._sources: list[_Source] = []
        try:
            for path in paths:
                self._sources += self._open(path)
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> BagReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> message type."""
        return {topic: msgtype for source in self._sources for topic, msgtype in source.topics.items()}

    def types_of(self, topic: str) -> set[str]:
        """All types that the recordings hold on a topic; one, if all is well."""
        return {source.topics[topic] for source in self._sources if topic in source.topics}

    def lacks_definition(self, topic: str) -> bool:
        """Whether a recording has a topic of a driver's type that is not Jazzy's, without its definition."""
        sources = [source for source in self._sources if topic in source.topics]
        own = [source for source in sources if getattr(VELOCITY_TYPES.get(source.topics[topic]), "definitions", ())]
        return any(is_empty(source.definition(topic)) for source in own)

    def definition(self, topic: str) -> Definition | None:
        """The embedded definition of a topic's messages, None if there is none."""
        return next((source.definition(topic) for source in self._sources if topic in source.topics), None)

    @property
    def message_counts(self) -> Counter[str]:
        """Topic -> number of messages, as the recordings' indexes say."""
        total: Counter[str] = Counter()
        for source in self._sources:
            total.update(source.counts)
        return total

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        return min(s.span_ns[0] for s in self._sources), max(s.span_ns[1] for s in self._sources)

    def messages(
        self, topics: Iterable[str], wanted: Callable[[str, int], bool] = lambda *_: True
    ) -> Iterator[BagMessage]:
        """Messages of these topics. wanted: by topic and log time, which are decoded at all; the others are left out."""
        for log_ns, source, topic, msgtype, data in self._merged(topics):
            if not wanted(topic, log_ns):
                continue
            try:
                message, why = self._sources[source].decode(msgtype, data), ""
            except (SerdeError, DefinitionError) as error:
                message, why = None, str(error)
            except Exception as error:  # a damaged definition or message can break the generated decoder anyhow
                message, why = None, f"{type(error).__name__}: {error}"
            yield topic, log_ns, message, why

    def raw_messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and CDR bytes of the messages of these topics."""
        for log_ns, _, topic, _, data in self._merged(topics):
            yield topic, log_ns, data

    def _merged(self, topics: Iterable[str]) -> Iterator[_Raw]:
        wanted = set(topics)
        streams = [self._raw(index, wanted) for index in range(len(self._sources))]
        if len(streams) == 1:
            next(streams[0])  # the marker
            return streams[0]
        return (raw for raw in heapq.merge(*streams, key=itemgetter(0)) if raw[2])

    def _raw(self, index: int, topics: set[str]) -> Iterator[_Raw]:
        source = self._sources[index]
        start_ns = newest_ns = source.span_ns[0]
        # a marker where it begins: merging opens a recording only when its time has come
        yield start_ns, index, "", "", b""
        read = lost = 0
        try:
            for log_ns, topic, msgtype, data in source.messages(topics):
                newest_ns = log_ns
                if data[:4] == ZSTD_MAGIC:  # message compression; CDR begins otherwise
                    unpacked = _unpacked_message(data)
                    if unpacked is None:
                        lost += 1
                        continue
                    data = unpacked
                yield log_ns, index, topic, msgtype, data
                read += 1
        except Exception as error:  # the readers raise all sorts of things on damaged bytes
            if not source.damage_noted:
                self.notes.append(
                    f"{source.path}: damaged ({_said(error)}); read {read} whole messages, "
                    f"{1e-9 * (newest_ns - start_ns):.1f} s"
                )
        if lost:
            self.notes.append(f"{source.path}: {lost} compressed messages are damaged and left out")

    # ------------------------------------------------------------------ opening

    def _open(self, path: Path) -> list[_Source]:
        try:
            if path.is_dir():
                return self._open_folder(path)
            if not path.exists():
                raise InputError(f"{path}: no such file or folder")
            if not path.is_file():
                raise InputError(f"{path}: neither file nor folder; give a rosbag2 folder, or a .mcap or .db3 file")
            return [self._open_file(path, path)]
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check name, permissions and disk") from error

    def _open_folder(self, folder: Path) -> list[_Source]:
        """The recordings in a folder. One that gives nothing costs a note, not the others."""
        sources, errors = [], []
        for file in self._files_of(folder):
            try:
                sources.append(self._open_file(file, file))
            except InputError as error:
                errors.append(error)
        if not sources:
            raise errors[0]
        self.notes += [f"{error}; the rest is read" for error in errors]
        return sources

    def _files_of(self, folder: Path) -> list[Path]:
        """The recordings in a folder: those that its metadata.yaml lists, or all if that is missing or damaged."""
        files = sorted(
            (file for file in folder.iterdir() if _storage_suffix(file) in STORAGE_SUFFIXES), key=_natural_order
        )
        if not files:
            raise InputError(f"{folder}: no bag, there is no .mcap or .db3 file in it")
        listed = self._listed(folder)
        if not listed:
            return files
        chosen = [file for file in files if file.name in listed or file.name.removesuffix(".zstd") in listed]
        names = {file.name.removesuffix(".zstd") for file in chosen}
        for name in listed:
            if name.removesuffix(".zstd") not in names:
                self.notes.append(f"{folder}: {name} is missing, which metadata.yaml lists; the rest is read")
        if not chosen:
            return files
        for file in files:
            if file not in chosen:
                self.notes.append(f"{file}: not read, metadata.yaml does not list it; name the file to read it")
        return chosen

    def _listed(self, folder: Path) -> list[str]:
        """Names of the files that metadata.yaml lists; none, with a note, if there is nothing to go by."""
        try:
            metadata = load_yaml(folder / "metadata.yaml", "metadata file")
            return [PurePath(name).name for name in metadata["rosbag2_bagfile_information"]["relative_file_paths"]]
        except (InputError, KeyError, TypeError):
            self.notes.append(f"{folder}: no usable metadata.yaml (recording cut off?); all its files are read")
            return []

    def _open_file(self, path: Path, shown: Path) -> _Source:
        """Open a recording. shown: how the user knows it, when it has been unpacked to another place."""
        path = self._with_journal(path)
        if path.stat().st_size == 0:
            raise InputError(f"{shown}: the file is empty; nothing was recorded")
        with path.open("rb") as file:
            magic = file.read(16)
        if magic.startswith(ZSTD_MAGIC) and path == shown:
            return self._open_file(self._decompressed(path), shown)
        # of a file whose first block was never written, the name has to do
        kind = _storage_suffix(shown) if magic == bytes(16) else ""
        if magic.startswith(MCAP_MAGIC) or kind == ".mcap":
            open_source, salvage = self._mcap, salvage_mcap
        elif magic.startswith(SQLITE_MAGIC) or kind == ".db3":
            open_source, salvage = self._sqlite, salvage_sqlite
        elif magic.startswith(ROS1_MAGIC):
            raise InputError(f"{shown}: a ROS 1 bag; convert it first: rosbags-convert --src {shown.name} --dst NEW")
        else:
            raise InputError(f"{shown}: no bag; give a rosbag2 folder, or a .mcap or .db3 file")
        try:
            source = open_source(path, shown)
        except Exception as error:  # damaged files raise all sorts of things
            return self._salvaged(path, shown, salvage, _said(error))
        return source or self._salvaged(path, shown, salvage, "")

    def _decompressed(self, path: Path) -> Path:
        target = self._temporary_folder() / (path.stem if path.suffix == ".zstd" else path.name)
        most = max(SMALL_FILE, LARGEST_RATIO * path.stat().st_size)
        try:
            with zstd.open(path, "rb") as packed, target.open("wb") as unpacked:
                while piece := packed.read1():  # as it comes: what precedes damage must be out before the damage
                    unpacked.write(piece)
                    if unpacked.tell() > most:
                        raise EOFError(f"it unpacks to more than {most} bytes")
        except (zstd.ZstdError, EOFError) as error:
            self.notes.append(f"{path}: damaged ({error}); what could be unpacked is used")
        return target

    def _with_journal(self, path: Path) -> Path:
        """A database whose recorder died, with what lies in the journal beside it; `path` itself if there is none."""
        journals = [path.with_name(f"{path.name}{suffix}") for suffix in ("-wal", "-journal")]
        if not any(journal.is_file() and journal.stat().st_size for journal in journals):
            return path
        folder = self._temporary_folder()
        for file in (path, *journals):
            if file.is_file():
                shutil.copyfile(file, folder / file.name)
        copy = folder / path.name
        try:
            with closing(sqlite3.connect(copy)) as connection:
                connection.execute("PRAGMA journal_mode=DELETE").fetchall()
        except sqlite3.Error as error:
            self.notes.append(f"{path}: its journal is damaged ({error}) and not used")
            return path
        return copy

    def _temporary_folder(self) -> Path:
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory()))

    def _mcap(self, path: Path, shown: Path) -> _Source | None:
        """An MCAP file by its index; None if it has none."""
        summary = read_summary(path)
        if summary is None or summary.statistics is None:
            return None
        statistics, schemas = summary.statistics, summary.schemas
        names = {number: channel.topic for number, channel in summary.channels.items()}
        types = {
            number: schemas[channel.schema_id].name if channel.schema_id in schemas else ""
            for number, channel in summary.channels.items()
        }
        counts: Counter[str] = Counter()
        for number, count in statistics.channel_message_counts.items():
            counts[names[number]] += count

        def messages(topics: set[str]) -> Iterator[tuple[int, str, str, bytes]]:
            channels = {number for number, name in names.items() if name in topics}
            for log_ns, channel, data in indexed_messages(path, summary, channels):
                yield log_ns, names[channel], types[channel], data

        definitions = {
            schema.name: Definition(
                FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE), schema.data.decode("utf-8", "replace")
            )
            for schema in schemas.values()
        }
        topics = {name: types[number] for number, name in names.items()}
        span_ns = (statistics.message_start_time, statistics.message_end_time)
        return _Source(shown, topics, counts, definitions, span_ns, _until_damage(messages, path, salvage_mcap, counts))

    def _sqlite(self, path: Path, shown: Path) -> _Source:
        # rosbags goes by the suffix; the content has already said what it is
        reader = Reader(path)
        reader.open()
        self._stack.callback(reader.close)
        reader.storage.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, LARGEST_RECORD)  # type: ignore[attr-defined]
        connections = list(reader.connections)
        counts: Counter[str] = Counter()
        for connection in connections:
            counts[connection.topic] += connection.msgcount

        def messages(topics: set[str]) -> Iterator[tuple[int, str, str, bytes]]:
            chosen = [connection for connection in connections if connection.topic in topics]
            for connection, log_ns, data in reader.messages(connections=chosen) if chosen else ():
                yield log_ns, connection.topic, connection.msgtype, data

        return _Source(
            shown,
            {c.topic: c.msgtype for c in connections},
            counts,
            {c.msgtype: Definition(c.msgdef.format, c.msgdef.data) for c in connections},
            (reader.start_time, reader.end_time),
            _until_damage(messages, path, salvage_sqlite, counts),
        )

    def _salvaged(self, path: Path, shown: Path, salvage: Salvage, why: str) -> _Source:
        """A recording that is read from beginning to end. why: its index cannot be used, '' if it has none."""
        topics: dict[str, str] = {}
        definitions: dict[str, Definition] = {}
        counts: Counter[str] = Counter()
        first_ns, last_ns = 2**63 - 1, 0
        damage = ""
        try:
            for message in salvage(path):
                if message.topic not in topics:
                    topics[message.topic] = message.msgtype
                    format_ = FORMATS.get(message.encoding, MessageDefinitionFormat.NONE)
                    definitions[message.msgtype] = Definition(format_, message.definition)
                counts[message.topic] += 1
                first_ns, last_ns = min(first_ns, message.log_ns), max(last_ns, message.log_ns)
        except DamagedError as error:
            damage = str(error)
        total = sum(counts.values())
        if not total and (damage or why):
            raise InputError(f"{shown}: damaged, and no whole message in it ({damage or why}); use another recording")
        read = f"{total} whole messages, {1e-9 * (last_ns - first_ns):.1f} s"
        if damage:
            self.notes.append(f"{shown}: damaged or cut off ({damage}); read {read}")
        elif why:
            self.notes.append(f"{shown}: has no usable index ({why}); read from beginning to end: {read}")
        messages = _in_file_order(path, salvage)
        return _Source(shown, topics, counts, definitions, (first_ns, last_ns), messages, damage_noted=True)


def _unpacked_message(data: bytes) -> bytes | None:
    """A message that was compressed by itself; None if it is damaged, or claims to be larger than messages are."""
    try:
        decompressor = zstd.ZstdDecompressor()
        unpacked = decompressor.decompress(data, max_length=LARGEST_RECORD)
    except zstd.ZstdError:
        return None
    return unpacked if decompressor.eof else None


def _until_damage(messages: Messages, path: Path, salvage: Salvage, counts: Mapping[str, int]) -> Messages:
    """Messages as an index leads to them, after damage those that salvaging finds. counts: what the index announces."""

    def all_messages(topics: set[str]) -> Iterator[tuple[int, str, str, bytes]]:
        newest_ns, read = -1, 0
        newest: list[tuple[str, bytes]] = []
        try:
            for message in messages(topics):
                log_ns, topic, _, data = message
                if log_ns != newest_ns:
                    newest_ns, newest = log_ns, []
                newest.append((topic, data))
                read += 1
                yield message
            if read < (announced := sum(counts[topic] for topic in topics if topic in counts)):
                raise DamagedError(f"it announces {announced} messages, its index leads to {read}")
        except Exception as error:  # damaged files raise all sorts of things
            damage = yield from _rest(salvage(path), topics, newest_ns, newest)
            raise DamagedError(damage or _said(error)) from error

    return all_messages


def _in_file_order(path: Path, salvage: Salvage) -> Messages:
    def messages(topics: set[str]) -> Iterator[tuple[int, str, str, bytes]]:
        for message in salvage(path):
            if message.topic in topics:
                yield message.log_ns, message.topic, message.msgtype, message.data

    return messages


def _rest(
    salvaged: Iterator[Salvaged], topics: set[str], newest_ns: int, newest: list[tuple[str, bytes]]
) -> Generator[tuple[int, str, str, bytes], None, str]:
    """What of a damaged recording comes after the messages that its index led to (at newest_ns: `newest`).

    Returns what is damaged.
    """
    rest, damage = [], ""
    try:
        for message in salvaged:
            is_later = message.log_ns > newest_ns or (
                message.log_ns == newest_ns and (message.topic, message.data) not in newest
            )
            if is_later and message.topic in topics:
                rest.append((message.log_ns, message.topic, message.msgtype, message.data))
    except DamagedError as error:
        damage = str(error)
    yield from sorted(rest, key=itemgetter(0))
    return damage


def _said(error: Exception) -> str:
    return str(error) if isinstance(error, DamagedError | ReaderError) else f"{type(error).__name__}: {error}"


def _storage_suffix(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix == ".zstd" else path.suffix


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """bag_2 before bag_10."""
    parts = "".join(c if c.isdigit() else f" {c} " for c in path.name).split()
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


# ---------------------------------------------------------------------- writing


class Storage(Enum):
    """Storage of a new bag."""

    MCAP = "mcap"
    SQLITE3 = "sqlite3"


class Compression(Enum):
    """Compression of a new bag; chunk is MCAP's own."""

    NONE = "none"
    CHUNK = "chunk"
    MESSAGE = "message"
    FILE = "file"


_COMPRESSION = {
    Compression.NONE: CompressionMode.NONE,
    Compression.CHUNK: CompressionMode.STORAGE,
    Compression.MESSAGE: CompressionMode.MESSAGE,
    Compression.FILE: CompressionMode.FILE,
}


UNKNOWN_HASH = f"RIHS01_{'0' * 64}"


Sample = DvlSample | ReferenceSample | ImuSample
FRAME_IDS = {VelocityFrame.ENU: "map", VelocityFrame.NED: "ned", VelocityFrame.BODY: "base_link"}


class BagWriter:
    """Writes samples to a new rosbag2 folder. A context manager; log time is the stamp. Raises InputError."""

    def __init__(
        self, path: Path, storage: Storage = Storage.MCAP, compression: Compression = Compression.NONE
    ) -> None:
        if path.exists():
            raise InputError(f"{path}: exists already; give another name, or remove it first")
        if storage is Storage.SQLITE3 and compression is Compression.CHUNK:
            raise InputError("compression chunk is MCAP's; with sqlite3 use message or file")
        plugin = StoragePlugin.MCAP if storage is Storage.MCAP else StoragePlugin.SQLITE3
        self._writer = Writer(path, version=9, storage_plugin=plugin)
        self._writer.set_compression(_COMPRESSION[compression], CompressionFormat.ZSTD)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}
        self._storage, self._compression = storage, compression
        self._attachments: list[tuple[str, str, bytes]] = []

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file to the bag. Raises InputError unless it is plain MCAP."""
        if self._storage is not Storage.MCAP or self._compression is Compression.FILE:
            raise InputError(f"{name}: only MCAP holds attachments; use storage mcap, and no file compression")
        self._attachments.append((name, media_type, data))

    def __enter__(self) -> BagWriter:
        try:
            self._writer.open()
        except (OSError, sqlite3.Error) as error:
            raise self._unwritable(error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.__exit__(kind, error, trace)
            for name, media_type, data in self._attachments if error is None else ():
                file = self._writer.path / f"{self._writer.path.name}.mcap"
                attach(file, name, media_type, data, self._compression is Compression.CHUNK)
        except (OSError, sqlite3.Error) as failure:
            error = failure
        if error is not None:  # half a bag would pass for a whole one
            shutil.rmtree(self._writer.path, ignore_errors=True)
        if isinstance(error, OSError | sqlite3.Error):
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError | sqlite3.Error) -> InputError:
        why = getattr(error, "strerror", None) or error
        return InputError(f"{self._writer.path}: cannot be written ({why}); free some space, or name another place")

    def recording(self, *sensors: Iterable[Sample]) -> None:
        """Write the samples of any sensors, each in order of time, to the node's topics in order of time."""
        for sample in heapq.merge(*sensors, key=lambda sample: sample.stamp_ns):
            if isinstance(sample, DvlSample):
                self.dvl("dvl/twist", sample)
            elif isinstance(sample, ReferenceSample):
                self.reference("gnss/twist", sample, FRAME_IDS[sample.frame])
            else:
                self.imu("imu/data", sample)

    def dvl(self, topic: str, sample: DvlSample, frame_id: str = "dvl_link") -> None:
        """Write a DVL velocity as TwistWithCovarianceStamped."""
        self._write(topic, TWIST_TYPE, sample.stamp_ns, self._twist(sample, frame_id))

    def reference(self, topic: str, sample: ReferenceSample, frame_id: str) -> None:
        """Write a reference velocity as TwistWithCovarianceStamped."""
        self._write(topic, TWIST_TYPE, sample.stamp_ns, self._twist(sample, frame_id))

    def imu(self, topic: str, sample: ImuSample, frame_id: str = "base_link") -> None:
        """Write attitude and angular velocity as Imu, with covariance -1 where there is none."""
        types = self._store.types
        quaternion, vector = types["geometry_msgs/msg/Quaternion"], types["geometry_msgs/msg/Vector3"]
        unknown = np.array([-1.0, *[0.0] * 8])
        message = types[IMU_TYPE](
            header=self._header(sample.stamp_ns, frame_id),
            orientation=quaternion(*(sample.orientation or (0.0, 0.0, 0.0, 1.0))),
            orientation_covariance=np.zeros(9) if sample.orientation else unknown,
            angular_velocity=vector(*(sample.angular_velocity or (0.0, 0.0, 0.0))),
            angular_velocity_covariance=np.zeros(9) if sample.angular_velocity else unknown,
            linear_acceleration=vector(0.0, 0.0, 0.0),
            linear_acceleration_covariance=unknown,
        )
        self._write(topic, IMU_TYPE, sample.stamp_ns, message)

    def raw(self, topic: str, msgtype: str, definition: Definition | None, log_ns: int, data: bytes) -> None:
        """Write a message as it was recorded, its definition with it."""
        if topic not in self._connections:
            try:
                type_hash = typestore(definition, msgtype).hash_rihs01(msgtype)
            except Exception:  # unknown types and damaged definitions raise all sorts of things; the messages are whole
                type_hash = UNKNOWN_HASH
            text = "" if definition is None else definition.text
            self._connections[topic] = self._writer.add_connection(topic, msgtype, msgdef=text, rihs01=type_hash)
        self._writer.write(self._connections[topic], log_ns, data)

    def _twist(self, sample: DvlSample | ReferenceSample, frame_id: str) -> Any:
        types = self._store.types
        vector = types["geometry_msgs/msg/Vector3"]
        covariance = np.zeros((6, 6))
        if sample.covariance is not None:
            covariance[:3, :3] = sample.covariance
        twist = types["geometry_msgs/msg/Twist"](vector(*sample.velocity), vector(0.0, 0.0, 0.0))
        inner = types["geometry_msgs/msg/TwistWithCovariance"](twist, covariance.ravel())
        return types[TWIST_TYPE](self._header(sample.stamp_ns, frame_id), inner)

    def _header(self, stamp: int, frame_id: str) -> Any:
        types = self._store.types
        time = types["builtin_interfaces/msg/Time"](stamp // 1_000_000_000, stamp % 1_000_000_000)
        return types["std_msgs/msg/Header"](time, frame_id)

    def _write(self, topic: str, msgtype: str, stamp: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, msgtype, typestore=self._store)
        self._writer.write(self._connections[topic], stamp, self._store.serialize_cdr(message, msgtype))
