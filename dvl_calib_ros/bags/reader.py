"""Reader of rosbag2 recordings: folders and files, MCAP and SQLite, compressed, several together, damaged."""

from __future__ import annotations

import heapq
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from typing import Any

from rosbags.typesys.store import Typestore

from ..errors import InputError
from .batches import BagMessage, Batch, batched, one_batch
from .channels import Channel, Decoder, DecodingError
from .files import ZSTD_MAGIC, files_of, zstd
from .salvage.damage import LARGEST_RECORD
from .sources import DAMAGE, Source, message_of, open_source

# a plain tuple per message, because a named one would cost a third of the decoding time
DecodedMessage = tuple[str, int, Any, str]
"""Topic, log time (ns), decoded message (None if it cannot be decoded), and the reason for None."""
# start of a recording
_MARKER = Channel("", "")


class BagReader:
    """Context manager that reads one or more recordings as one, in order of log time.

    known: type -> known versions of its definition, for recordings without.
    notes: messages to the user on damage, complete after the last message.
    topics: topic -> message type. Raises InputError for a path that is no bag.
    """

    def __init__(self, paths: Sequence[Path], known: Mapping[str, Sequence[str]] | None = None) -> None:
        """Open the files of all recordings, and list their topics; close all again if one cannot be opened."""
        self.notes: list[str] = []
        self.decoder = Decoder(known)
        self._stack = ExitStack()
        self._sources: list[Source] = []
        try:
            for path in paths:
                self._sources += self._open(path)
        except BaseException:
            self._stack.close()
            raise
        self.topics = {channel.topic: channel.msgtype for source in self._sources for channel in source.counts}

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove decompressed files."""
        self._stack.close()

    def channels(self, topic: str) -> list[Channel]:
        """Return all channels of a topic; one, unless the recording is inconsistent."""
        return list(dict.fromkeys(channel for source in self._sources for channel in source.channels(topic)))

    def types_of(self, topic: str) -> set[str]:
        """Return all types on a topic; one, unless the recording is inconsistent."""
        return {channel.msgtype for channel in self.channels(topic)}

    def lacks_definition(self, topic: str) -> bool:
        """Return whether a topic's type is neither in ROS nor defined in a recording."""
        return any(self.decoder.lacks_definition(channel) for channel in self.channels(topic))

    def fields_of(self, topic: str) -> tuple[str, ...]:
        """Return the names of the fields of a topic's messages; none if unknown."""
        store = self.typestore(topic)
        return () if store is None else tuple(name for name, _ in store.fielddefs[self.topics[topic]][1])

    def typestore(self, topic: str) -> Typestore | None:
        """Return types that decode a topic's messages; None if unknown."""
        for channel in self.channels(topic):
            store = self.decoder.typestore(channel)
            if store is not None and channel.msgtype in store.fielddefs:
                return store
        return None

    @property
    def message_counts(self) -> Counter[str]:
        """Topic -> number of messages, by the recordings' indexes."""
        total: Counter[str] = Counter()
        for source in self._sources:
            for channel, count in source.counts.items():
                total[channel.topic] += count
        return total

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        return min(s.span_ns[0] for s in self._sources), max(s.span_ns[1] for s in self._sources)

    @property
    def file_spans_ns(self) -> list[tuple[int, int]]:
        """First and last log time of each file with a message."""
        return [source.span_ns for source in self._sources if sum(source.counts.values())]

    def messages(self, topics: Iterable[str]) -> Iterator[DecodedMessage]:
        """Yield messages of these topics."""
        for log_ns, channel, data in self.raw_messages(topics):
            try:
                message, why = self.decoder(channel, data), ""
            except DecodingError as error:
                message, why = None, str(error)
            yield channel.topic, log_ns, message, why

    def raw_messages(self, topics: Iterable[str]) -> Iterator[BagMessage]:
        """Yield log time, channel and CDR bytes of the messages of these topics."""
        chosen = frozenset(topics)
        if len(self._sources) == 1:
            return (message for batch in self._of_source(self._sources[0], chosen) for message in batch.messages())
        streams = [self._single_messages(source, chosen) for source in self._sources]
        return (message for message in heapq.merge(*streams, key=itemgetter(0)) if message[1] is not _MARKER)

    def batches(self, topics: Iterable[str]) -> Iterator[Batch]:
        """Yield batches of messages of these topics."""
        chosen = frozenset(topics)
        if len(self._sources) == 1:
            return self._of_source(self._sources[0], chosen)
        return batched(self.raw_messages(chosen))

    def _single_messages(self, source: Source, topics: frozenset[str]) -> Iterator[BagMessage]:
        """Yield single messages of one source, after a marker at its first log time."""
        # a marker at the start: merging opens a recording only when its time comes
        yield source.span_ns[0], _MARKER, b""
        for batch in self._of_source(source, topics):
            yield from batch.messages()

    def _of_source(self, source: Source, topics: frozenset[str]) -> Iterator[Batch]:
        """Yield a file's batches up to the first damage, which is noted."""
        start_ns = newest_ns = source.span_ns[0]
        read = lost = 0
        try:
            for batch in source.batches(topics):
                newest_ns = int(batch.log_ns[-1])
                unpacked = _unpacked(batch)
                lost += batch.size - unpacked.size
                read += unpacked.size
                if unpacked.size:
                    yield unpacked
        except DAMAGE as error:
            if not source.damage_noted:
                self.notes.append(
                    f"{source.path}: damaged ({message_of(error)}); read {read} whole messages, "
                    f"{1e-9 * (newest_ns - start_ns):.1f} s"
                )
        if lost:
            self.notes.append(f"{source.path}: {lost} compressed messages are damaged and left out")

    def _open(self, path: Path) -> list[Source]:
        """Open a bag, or all bags in a folder. Raises InputError."""
        try:
            if path.is_dir():
                return self._open_folder(path)
            if not path.exists():
                raise InputError(f"{path}: no such file or folder")
            if not path.is_file():
                raise InputError(
                    f"{path}: neither file nor folder; give a rosbag2 folder, or a .mcap, .db3 or .bag file"
                )
            return [self._open_file(path)]
        except OSError as error:
            raise _unreadable(path, error) from error

    def _open_folder(self, folder: Path) -> list[Source]:
        """Open the recordings in a folder. An unusable one gives a note and does not affect the others."""
        sources, errors = [], []
        for file in files_of(folder, self.notes):
            try:
                sources.append(self._open_file(file))
            except InputError as error:
                errors.append(error)
            except OSError as error:
                errors.append(_unreadable(file, error))
        if not sources:
            raise errors[0]
        self.notes += [f"{error}; the rest is read" for error in errors]
        return sources

    def _open_file(self, path: Path) -> Source:
        return open_source(path, self._temporary_folder, self.notes)

    def _temporary_folder(self) -> Path:
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory()))


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be read ({error.strerror}); check name, permissions and disk")


def _unpacked(batch: Batch) -> Batch:
    """Decompress individually compressed messages, and drop damaged ones."""
    packed = batch.begin_with(ZSTD_MAGIC)  # CDR begins with other bytes
    if not packed.any():
        return batch
    each = zip(packed.tolist(), batch.messages(), strict=True)
    unpacked = ((log_ns, channel, _unpacked_message(data) if is_packed else data)
                for is_packed, (log_ns, channel, data) in each)  # fmt: skip
    return one_batch((log_ns, channel, data) for log_ns, channel, data in unpacked if data is not None)


def _unpacked_message(data: bytes) -> bytes | None:
    """Decompress a message; None if it is damaged or claims an implausible size."""
    try:
        decompressor = zstd.ZstdDecompressor()
        unpacked = decompressor.decompress(data, max_length=LARGEST_RECORD)
    except zstd.ZstdError:
        return None
    return unpacked if decompressor.eof else None
