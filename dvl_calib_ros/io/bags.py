"""rosbag2 recordings: folders and single files, MCAP and SQLite, compressed or not, several at once, damaged ones.

Reading and decoding is rosbags'; what rosbags gives up on goes to `salvage`.
"""

from __future__ import annotations

import heapq
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..calibration.samples import DvlSample, ImuSample, ReferenceSample
from .errors import InputError
from .messages import IMU_TYPE, TWIST_TYPE
from .salvage import MCAP_MAGIC, SQLITE_MAGIC, Salvaged, salvage_mcap, salvage_sqlite

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
STORAGE_SUFFIXES = (".mcap", ".db3")


class BagMessage(NamedTuple):
    """One message: decoded, or None with the reason in `undecodable`."""

    topic: str
    log_ns: int
    message: Any
    undecodable: str = ""


class _Raw(NamedTuple):
    log_ns: int
    source: int
    topic: str
    msgtype: str
    data: bytes


class _Definition(NamedTuple):
    format: MessageDefinitionFormat
    text: str


class _Source:
    """One recording: what is in it and its messages in order of log time."""

    def __init__(
        self,
        path: Path,
        topics: dict[str, str],
        counts: dict[str, int],
        definitions: dict[str, _Definition],
        span_ns: tuple[int, int],
        messages: Callable[[set[str]], Iterator[tuple[int, str, str, bytes]]],
    ) -> None:
        self.path = path
        self.topics = topics
        self.counts = counts
        self.span_ns = span_ns
        self.messages = messages
        self._definitions = definitions
        self._stores: dict[str, Typestore] = {}

    def typestore(self, msgtype: str) -> Typestore:
        """Types for a message: from the definition embedded in the bag, else Jazzy's."""
        if msgtype not in self._stores:
            definition = self._definitions.get(msgtype)
            if definition is None or definition.format is MessageDefinitionFormat.NONE:
                self._stores[msgtype] = get_typestore(Stores.ROS2_JAZZY)
            else:
                store = get_typestore(Stores.EMPTY)
                store.register(_parse_definition(definition, msgtype))
                self._stores[msgtype] = store
        return self._stores[msgtype]


def _parse_definition(definition: _Definition, msgtype: str) -> Any:
    if definition.format is MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.text, msgtype)
    separator = "=" * 80 + "\n"
    types: dict[str, Any] = {}
    for part in definition.text.split(separator):
        idl = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if idl.strip():
            types.update(get_types_from_idl(idl))
    return types


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

    def messages(self, topics: Iterable[str]) -> Iterator[BagMessage]:
        """Messages of these topics."""
        for log_ns, source, topic, msgtype, data in self._merged(topics):
            try:
                store = self._sources[source].typestore(msgtype)
                yield BagMessage(topic, log_ns, store.deserialize_cdr(data, msgtype))
            except SerdeError as error:
                yield BagMessage(topic, log_ns, None, str(error))
            except Exception as error:  # a damaged definition or message can break the generated decoder anyhow
                yield BagMessage(topic, log_ns, None, f"{type(error).__name__}: {error}")

    def raw_messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and CDR bytes of the messages of these topics."""
        for raw in self._merged(topics):
            yield raw.topic, raw.log_ns, raw.data

    def _merged(self, topics: Iterable[str]) -> Iterator[_Raw]:
        wanted = set(topics)
        streams = [self._raw(index, wanted) for index in range(len(self._sources))]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=lambda raw: raw.log_ns)

    def _raw(self, index: int, topics: set[str]) -> Iterator[_Raw]:
        source = self._sources[index]
        read = 0
        newest_ns = source.span_ns[0]
        try:
            for log_ns, topic, msgtype, data in source.messages(topics):
                if data[:4] == ZSTD_MAGIC:  # message compression, in a file without the metadata that would say so
                    data = zstd.decompress(data)
                yield _Raw(log_ns, index, topic, msgtype, data)
                read += 1
                newest_ns = log_ns
        except Exception as error:  # the readers raise all sorts of things on damaged bytes
            self.notes.append(
                f"{source.path}: damaged after {read} messages, {1e-9 * (newest_ns - source.span_ns[0]):.1f} s into "
                f"the recording ({type(error).__name__}: {error}); what came before the damage is used"
            )

    # ------------------------------------------------------------------ opening

    def _open(self, path: Path) -> list[_Source]:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if path.is_dir():
            return self._open_folder(path)
        return [self._open_file(path)]

    def _open_folder(self, folder: Path) -> list[_Source]:
        files = sorted(
            (file for file in folder.iterdir() if _storage_suffix(file) in STORAGE_SUFFIXES), key=_natural_order
        )
        if not files:
            raise InputError(f"{folder}: no bag, there is no .mcap or .db3 file in it")
        if (folder / "metadata.yaml").exists():
            with suppress(Exception):  # whatever is wrong with it shows when the files are opened one by one
                return [self._with_rosbags(folder)]
            self.notes.append(f"{folder}: metadata.yaml does not fit the files; they are read one by one")
        else:
            self.notes.append(f"{folder}: no metadata.yaml (recording cut off?); its files are read one by one")
        return [self._open_file(file) for file in files]

    def _open_file(self, path: Path) -> _Source:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; nothing was recorded")
        if path.suffix == ".zstd":
            return self._open_file(self._decompressed(path))
        with path.open("rb") as file:
            magic = file.read(16)
        if magic.startswith(MCAP_MAGIC):
            salvage = salvage_mcap
        elif magic.startswith(SQLITE_MAGIC):
            salvage = salvage_sqlite
        else:
            raise InputError(f"{path}: no bag; give a rosbag2 folder, or a .mcap or .db3 file")
        try:
            return self._with_rosbags(path)
        except Exception as error:  # damaged files raise all sorts of things
            return self._salvaged(path, salvage, f"{type(error).__name__}: {error}")

    def _decompressed(self, path: Path) -> Path:
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        target = folder / path.stem
        try:
            with zstd.open(path, "rb") as packed, target.open("wb") as unpacked:
                shutil.copyfileobj(packed, unpacked)
        except (zstd.ZstdError, EOFError) as error:
            self.notes.append(f"{path}: damaged ({error}); what could be unpacked is used")
        return target

    def _with_rosbags(self, path: Path) -> _Source:
        # rosbags goes by the suffix; the content has already said what it is
        reader = Reader(path)
        reader.open()
        self._stack.callback(reader.close)
        connections = list(reader.connections)

        def messages(topics: set[str]) -> Iterator[tuple[int, str, str, bytes]]:
            chosen = [connection for connection in connections if connection.topic in topics]
            if chosen:
                for connection, log_ns, data in reader.messages(connections=chosen):
                    yield log_ns, connection.topic, connection.msgtype, data

        counts: Counter[str] = Counter()
        for connection in connections:
            counts[connection.topic] += connection.msgcount
        return _Source(
            path,
            {c.topic: c.msgtype for c in connections},
            counts,
            {c.msgtype: _Definition(c.msgdef.format, c.msgdef.data) for c in connections},
            (reader.start_time, reader.end_time),
            messages,
        )

    def _salvaged(self, path: Path, salvage: Callable[[Path], Iterator[Salvaged]], why: str) -> _Source:
        formats = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
        topics: dict[str, str] = {}
        definitions: dict[str, _Definition] = {}
        counts: Counter[str] = Counter()
        first_ns, last_ns = 2**63 - 1, 0
        for message in salvage(path):
            if message.topic not in topics:
                topics[message.topic] = message.msgtype
                format_ = formats.get(message.encoding, MessageDefinitionFormat.NONE)
                definitions[message.msgtype] = _Definition(format_, message.definition)
            counts[message.topic] += 1
            first_ns, last_ns = min(first_ns, message.log_ns), max(last_ns, message.log_ns)
        total = sum(counts.values())
        if not total:
            raise InputError(f"{path}: damaged, and no whole message in it ({why})")
        self.notes.append(
            f"{path}: damaged or cut off ({why}); read up to the damage: {total} whole messages, "
            f"{1e-9 * (last_ns - first_ns):.1f} s"
        )

        def messages(wanted: set[str]) -> Iterator[tuple[int, str, str, bytes]]:
            for message in salvage(path):
                if message.topic in wanted:
                    yield message.log_ns, message.topic, message.msgtype, message.data

        return _Source(path, topics, counts, definitions, (first_ns, last_ns), messages)


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

    def __enter__(self) -> BagWriter:
        try:
            self._writer.open()
        except OSError as error:
            raise InputError(f"{self._writer.path}: cannot be written: {error.strerror}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)

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
