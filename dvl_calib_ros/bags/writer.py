"""Writing of new rosbag2 recordings by rosbags, with attachments for MCAP, and recovery of damaged ones."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple
from urllib.parse import quote

import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import Stores, get_typestore

from ..disk.atomic import NO_SPACE
from ..disk.text_files import load_yaml
from ..errors import InputError
from .batches import LATEST_NS
from .channels import Channel, Definition, DefinitionError, typestore
from .reader import BagReader


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


UNKNOWN_HASH = f"RIHS01_{'0' * 64}"


class _Sqlite3Writer(Sqlite3Writer):
    """Writer for any path; rosbags' own misreads characters of URI escapes, queries or fragments."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        self.path = path / f"{path.name}.db3"
        self.conn = sqlite3.connect(f"file:{quote(str(self.path.absolute()), safe='/')}", uri=True)
        self.conn.executescript(self.SQLITE_SCHEMA)
        self.cursor = self.conn.cursor()


class _Writer(Writer):
    STORAGE_PLUGINS = {**Writer.STORAGE_PLUGINS, StoragePlugin.SQLITE3: _Sqlite3Writer}  # noqa: RUF012


class BagWriter:
    """Context manager that writes messages to a new rosbag2 folder. Raises InputError."""

    def __init__(
        self, path: Path, storage: Storage = Storage.MCAP, compression: Compression = Compression.NONE
    ) -> None:
        """Check the path and the combination of storage and compression; nothing is written before `__enter__`."""
        if os.path.lexists(path):  # also true for a dangling link
            raise InputError(f"{path}: exists already; give another name, or remove it first")
        if storage is Storage.SQLITE3 and compression is Compression.CHUNK:
            raise InputError("compression chunk is MCAP's; with sqlite3 use message or file")
        self.typestore = get_typestore(Stores.ROS2_JAZZY)
        self._path, self._storage, self._compression = path, storage, compression
        self._made_for_it = [folder for folder in path.parents if not folder.exists()]  # the deepest first
        self._attachments: list[tuple[str, str, bytes]] = []
        # a file has one definition per type: rosbag2 and rosbags look it up by the type's name
        self._parts: list[_Part] = []
        self._part_of: dict[Channel, _Part] = {}
        self._channels: dict[tuple[str, str], Channel] = {}

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file to the bag. Raises InputError unless it is plain MCAP."""
        if self._storage is not Storage.MCAP or self._compression is Compression.FILE:
            raise InputError(f"{name}: only MCAP holds attachments; use storage mcap, and no file compression")
        self._attachments.append((name, media_type, data))

    def __enter__(self) -> BagWriter:
        """Create the bag; remove it again if that fails."""
        try:
            self._new_part()
        except WriterError as error:  # created by another process since the check
            raise InputError(f"{self._path}: {error}; give another name") from error
        except BaseException as error:  # including an interrupt
            self._remove()
            if isinstance(error, OSError | sqlite3.Error):
                raise self._unwritable(error) from error
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the bag and add its attachments; remove it if anything failed."""
        try:
            for part in self._parts:
                part.writer.__exit__(kind, error, trace)
            if error is None:
                self._join_parts()
            for name, media_type, data in self._attachments if error is None else ():
                attach(
                    self._path / f"{self._path.name}.mcap", name, media_type, data,
                    self._compression is Compression.CHUNK,
                )  # fmt: skip
        except (OSError, sqlite3.Error) as failure:
            error = failure
        if error is not None:  # a partial bag could be mistaken for a whole one
            self._remove()
        if isinstance(error, OSError | sqlite3.Error):
            raise self._unwritable(error) from error

    def message(self, topic: str, msgtype: str, log_ns: int, message: Any) -> None:
        """Write a message of a type that `typestore` has."""
        channel = self._channels.get((topic, msgtype))
        if channel is None:
            text, _ = self.typestore.generate_msgdef(msgtype, ros_version=2)
            channel = Channel(topic, msgtype, Definition(MessageDefinitionFormat.MSG, text))
            self._channels[topic, msgtype] = channel
        self._write(channel, log_ns, bytes(self.typestore.serialize_cdr(message, msgtype)))

    def raw(self, channel: Channel, log_ns: int, data: bytes) -> None:
        """Write a message unchanged, with its definition."""
        self._write(channel, log_ns, data)

    def _write(self, channel: Channel, log_ns: int, data: bytes) -> None:
        """Write a message to the part that fits its channel."""
        part = self._part_of.get(channel)
        if part is None:
            part = self._part_of[channel] = self._part_for(channel)
        if self._storage is Storage.SQLITE3:
            log_ns = min(log_ns, LATEST_NS)  # SQLite has no larger number
        part.writer.write(part.connections[channel], log_ns, data)

    def _part_for(self, channel: Channel) -> _Part:
        """Return a file whose definitions agree with a channel's, a new one if there is none."""
        fitting = [part for part in self._parts if part.fits(channel)]
        part = fitting[0] if fitting else self._new_part()
        part.add(channel)
        return part

    def _new_part(self) -> _Part:
        """Open one more file of the bag."""
        number = len(self._parts)
        path = self._path / f"{self._path.name}_{number}" if number else self._path
        writer = _Writer(path, version=9, storage_plugin=StoragePlugin[self._storage.name])
        is_chunk = self._compression is Compression.CHUNK
        mode = CompressionMode.STORAGE if is_chunk else CompressionMode[self._compression.name]
        writer.set_compression(mode, CompressionFormat.ZSTD)
        writer.open()
        self._parts.append(_Part(writer))
        return self._parts[-1]

    def _join_parts(self) -> None:
        """Join the parts, written as bags of their own, into one bag of several files."""
        first, *others = (part.writer.path for part in self._parts)
        if not others:
            return
        metadata = [load_yaml(path / "metadata.yaml", "metadata file") for path in (first, *others)]
        joined, *added = (document["rosbag2_bagfile_information"] for document in metadata)
        for path, information in zip(others, added, strict=True):
            for name in information["relative_file_paths"]:
                os.replace(path / name, first / name)
            shutil.rmtree(path)
            for key in ("relative_file_paths", "files", "topics_with_message_count"):
                joined[key] += information[key]
            joined["message_count"] += information["message_count"]
        files = [file for file in joined["files"] if file["message_count"]]
        starts = [file["starting_time"]["nanoseconds_since_epoch"] for file in files]
        ends = [start + file["duration"]["nanoseconds"] for start, file in zip(starts, files, strict=True)]
        joined["starting_time"] = {"nanoseconds_since_epoch": min(starts)}
        joined["duration"] = {"nanoseconds": max(ends) - min(starts)}
        (first / "metadata.yaml").write_text(yaml.safe_dump(metadata[0], sort_keys=False), encoding="utf-8")

    def _unwritable(self, error: OSError | sqlite3.Error) -> InputError:
        """Return the error for a failed write, with a remedy."""
        why = getattr(error, "strerror", None) or error
        # SQLite reports a full disk only as text, and a file that may not grow like any failure
        full = isinstance(error, sqlite3.Error) or error.errno in NO_SPACE
        remedy = "free some space, or name another place" if full else "name another place"
        return InputError(f"{self._path}: cannot be written ({why}); {remedy}")

    def _remove(self) -> None:
        """Remove the bag and the folders created for it."""
        shutil.rmtree(self._path, ignore_errors=True)
        for folder in self._made_for_it:
            with suppress(OSError):  # another process also writes there
                folder.rmdir()


class _Part:
    """One file of a bag."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self.connections: dict[Channel, Any] = {}
        self._definitions: dict[str, Definition | None] = {}

    def fits(self, channel: Channel) -> bool:
        """Return whether the file has no other definition of the channel's type."""
        return self._definitions.get(channel.msgtype, channel.definition) == channel.definition

    def add(self, channel: Channel) -> None:
        """Add a channel with its definition and the hash of its type."""
        topic, msgtype, definition = channel
        self._definitions[msgtype] = definition
        text = definition.text if definition else ""
        digest = _type_hash(definition, msgtype)
        self.connections[channel] = self.writer.add_connection(topic, msgtype, msgdef=text, rihs01=digest)


def _type_hash(definition: Definition | None, msgtype: str) -> str:
    """Return the REP 2011 hash of a type, or `UNKNOWN_HASH` if its definition is damaged."""
    try:
        return typestore(definition, msgtype).hash_rihs01(msgtype)
    except (DefinitionError, LookupError):  # a damaged or incomplete definition; its messages are whole
        return UNKNOWN_HASH


def attach(path: Path, name: str, media_type: str, data: bytes, compressed: bool) -> None:
    """Add an attachment to an MCAP file, by writing a new file that replaces it."""
    new = path.with_name(f"{path.name}.tmp")
    with path.open("rb") as source, new.open("xb") as target:
        reader = make_reader(source)
        header = reader.get_header()
        writer = McapWriter(target, compression=CompressionType.ZSTD if compressed else CompressionType.NONE)
        writer.start(header.profile, header.library)
        channels: dict[int, int] = {}
        start_ns = 0
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if schema is not None and channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            start_ns = start_ns or message.log_time
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.add_attachment(start_ns, start_ns, name, media_type, data)
        writer.finish()  # type: ignore[no-untyped-call]
    os.replace(new, path)


PROGRESS_EVERY = 1000


class Recovered(NamedTuple):
    """Result of a recovery. counts: messages of each topic. notes: sentences on the losses."""

    counts: dict[str, int]
    notes: tuple[str, ...]


def recover(
    bags: Sequence[Path],
    output: Path,
    storage: Storage = Storage.MCAP,
    compression: Compression = Compression.NONE,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Recovered:
    """Write every readable message of every topic into a new bag. Raises InputError."""
    counts: Counter[str] = Counter()
    with BagReader(bags) as reader:
        topics, total = reader.topics, max(sum(reader.message_counts.values()), 1)
        if not topics:
            raise InputError(f"{', '.join(map(str, bags))}: there is no message in it; record it again")
        with BagWriter(output, storage, compression) as writer:
            for number, (log_ns, channel, data) in enumerate(reader.raw_messages(topics)):
                writer.raw(channel, log_ns, data)
                counts[channel.topic] += 1
                if number % PROGRESS_EVERY == 0:
                    on_progress(number / total)
        return Recovered(dict(sorted(counts.items())), tuple(reader.notes))
