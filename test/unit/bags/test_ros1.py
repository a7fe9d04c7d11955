"""Recordings of ROS 1 are read as those of ROS 2 with the same data: .bag files, and MCAP with ros1msg schemas."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from io_fixtures import TOPICS, estimates, raw, raw_and_notes, run, write_bag
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import recover
from dvl_calib_ros.cli.main import main

NOETIC = get_typestore(Stores.ROS1_NOETIC)
COUNTER = 41


def ros1_messages(source: Path) -> list[tuple[str, int, bytes]]:
    """The messages of a rosbag2, serialized by rosbags' types of ROS 1, whose headers have a counter."""
    with BagReader([source]) as bag:
        found = list(bag.messages(TOPICS))
    for _, _, message, _ in found:
        header = message.header
        message.header = NOETIC.types["std_msgs/msg/Header"](COUNTER, header.stamp, header.frame_id)
    return [(topic, at, bytes(NOETIC.serialize_ros1(message, TOPICS[topic]))) for topic, at, message, _ in found]


def write_ros1_bag(path: Path, source: Path, compression: str = "none") -> Path:
    writer = Writer(path)
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, data in ros1_messages(source):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, TOPICS[topic], typestore=NOETIC)
            writer.write(connections[topic], log_ns, data)
    return path


def write_ros1_mcap(path: Path, source: Path) -> Path:
    output = io.BytesIO()
    writer = McapWriter(output)
    writer.start("ros1")
    channels = {}
    for topic, kind in TOPICS.items():
        text, _ = NOETIC.generate_msgdef(kind)
        schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", text.encode())
        channels[topic] = writer.register_channel(topic, "ros1", schema)
    for topic, log_ns, data in ros1_messages(source):
        writer.add_message(channels[topic], log_ns, data, log_ns)
    writer.finish()
    path.write_bytes(output.getvalue())
    return path


@pytest.fixture(scope="module")
def ros2(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("ros2") / "bag", run(20.0))


@pytest.fixture(params=["none", "LZ4", "BZ2", "mcap", "mcap without an index"])
def ros1(request, tmp_path, ros2) -> Path:
    if not request.param.startswith("mcap"):
        return write_ros1_bag(tmp_path / "run.bag", ros2, request.param)
    path = write_ros1_mcap(tmp_path / "run.mcap", ros2)
    if "without" in request.param:
        path.write_bytes(path.read_bytes()[:-400])
    return path


@pytest.mark.spread(2)
def test_messages_and_answer_are_those_of_the_same_data_in_ros2(ros1, ros2):
    assert raw(ros1) == raw(ros2)
    assert estimates(ros1) == estimates(ros2)


def test_a_folder_of_bags_is_read_without_a_warning(tmp_path, ros2):
    write_ros1_bag(tmp_path / "run.bag", ros2)
    assert raw_and_notes(tmp_path) == (raw(ros2), [])


def test_salvage_writes_what_ros2_reads(tmp_path, ros2):
    recover([write_ros1_bag(tmp_path / "run.bag", ros2)], tmp_path / "new")
    assert raw(tmp_path / "new") == raw(ros2)
    assert estimates(tmp_path / "new") == estimates(ros2)


def test_a_damaged_bag_is_read_to_the_damage_which_is_named(tmp_path, ros2):
    path = write_ros1_bag(tmp_path / "run.bag", ros2)
    damaged = bytearray(path.read_bytes())
    middle = damaged.index(b"op=\x02", len(damaged) // 2)  # the header of a message
    damaged[middle : middle + 4] = bytes(4)
    path.write_bytes(damaged)
    found, notes = raw_and_notes(path)
    assert 0 < len(found) < len(raw(ros2)) and found == raw(ros2)[: len(found)]
    assert len(notes) == 1 and f"{path}: damaged" in notes[0] and f"read {len(found)} whole messages" in notes[0]


def test_a_bag_without_an_index_names_what_makes_one(tmp_path, capsys, ros2):
    path = write_ros1_bag(tmp_path / "run.bag", ros2)
    path.write_bytes(path.read_bytes()[:-3000])
    assert main(["replay", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and str(path) in said and "rosbag reindex" in said
