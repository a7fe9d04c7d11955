"""ROS 1 recordings: .bag files by their index, and conversion of ROS 1 messages to CDR."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from ..errors import InputError
from .batches import Batch, batched, one_batch
from .channels import DECODING, KEPT, SEPARATOR, Channel, DefinitionError, definition_of, typestore
from .salvage.damage import DamagedError

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader

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
            for each in reader.connections:
                counts[channels[each.id]] += each.msgcount
            return counts, (reader.start_time, reader.end_time - 1)
    except DamagedError as error:
        raise InputError(f"{shown}: a ROS 1 bag without a usable index ({error}); run rosbag reindex on it") from error


def bag_batches(path: Path, topics: Collection[str]) -> Iterator[Batch]:
    """Yield the messages of topics of a .bag in ROS 1's layout. Raises DamagedError after the last."""
    with _reader(path) as (reader, channels):
        wanted = [each for each in reader.connections if each.topic in topics]
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
