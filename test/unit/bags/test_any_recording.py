"""Recordings as they lie about: any name, links, folders with other things in them, types in two definitions."""

from __future__ import annotations

import io
import os
import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from driver_fixtures import A50, Maker, forget_definitions, write_driver_bag
from io_fixtures import JAZZY, TOPICS, estimates, mcap_bytes, raw, raw_and_notes, replayed, run, storage_file, write_bag
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dvl_calib_ros.bags import channels, sources
from dvl_calib_ros.bags.channels import Channel, DecodingError, Definition, is_empty
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter, Storage
from dvl_calib_ros.calibration.numerics.samples import DvlSample
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.messages.drivers import KNOWN_DEFINITIONS, TWIST_TYPE
from dvl_calib_ros.recordings.recording import open_bags, open_recording

# ---------------------------------------------------------------------- names

HOSTILE = [
    "run#1", "run%31", "run?mode=memory", "run%", "a b", "日本", "-x", "~", "'", '"', ";", "..a", "$HOME", "#",
]  # fmt: skip


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    return {kind: write_bag(folder / kind, run(6.0), kind) for kind in ("mcap", "sqlite3")}


def copy(bag: Path, target: Path) -> Path:
    """The bag under another name, its file as well."""
    target.mkdir(parents=True)
    file = storage_file(bag)
    shutil.copy(file, target / f"{target.name}{file.suffix}")
    return target


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_names_to_reading_salvage_and_writing(tmp_path, bags, kind, name):
    check_name(tmp_path, bags, kind, name)


def check_name(folder: Path, bags: dict[str, Path], kind: str, name: str) -> None:
    bag = copy(bags[kind], folder / "in" / name)
    other = copy(bags[kind], folder / "in" / "run1")  # what run%31 is read as where names are taken for URIs
    (other / f"run1{storage_file(bag).suffix}").write_bytes(b"another bag")
    for path in (bag, storage_file(bag)):
        assert raw(path) == raw(bags[kind])
    (folder / "out").mkdir()
    assert main(["salvage", "-o", str(folder / "out" / name), "--storage", kind, "--", str(bag)]) == 0
    assert [path.name for path in (folder / "out").iterdir()] == [name]
    assert raw(folder / "out" / name) == raw(bags[kind])
    assert {path.name for path in folder.iterdir()} == {"in", "out"}


# ---------------------------------------------------------------------- links and folders


@pytest.mark.parametrize("journal", ["beside the target", "linked as well"])
def test_a_linked_database_is_read_with_its_journal(tmp_path, journal):
    file = storage_file(write_bag(tmp_path / "bag", run(), "sqlite3"))
    expected, store = raw(file), tmp_path / "store"
    store.mkdir()
    target = store / ("crashed.db3" if journal == "beside the target" else "0a1b2c")
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA wal_autocheckpoint=0")
        connection.execute("DELETE FROM messages WHERE id > 700")
        connection.commit()
        shutil.copy(file, target)
        shutil.copy(f"{file}-wal", f"{target}-wal" if journal == "beside the target" else store / "3d4e5f")
    link = tmp_path / "crashed.db3"
    link.symlink_to(target)
    if journal != "beside the target":
        (tmp_path / "crashed.db3-wal").symlink_to(store / "3d4e5f")
    assert raw(link) == expected[:700]


@pytest.mark.parametrize("is_listed", [False, True])
def test_of_a_folder_with_what_cannot_be_read_the_rest_is_read_and_it_is_said(tmp_path, is_listed):
    bag = write_bag(tmp_path / "bag", run(6.0))
    expected = raw(bag)
    hindrances = {
        "a.mcap": lambda path: path.symlink_to(bag / "nowhere.mcap"),
        "b.mcap": lambda path: path.symlink_to(path),
        "x.mcap": Path.mkdir,
        "y.mcap": os.mkfifo,
        "z.mcap": lambda path: path.write_bytes(b"no bag"),
    }
    for name, hinder in hindrances.items():
        hinder(bag / name)
    if is_listed:
        text, names = (bag / "metadata.yaml").read_text(), [*hindrances]
        listed = "".join(f"  - {name}\n" for name in [*names[:2], "bag.mcap", *names[2:]])
        (bag / "metadata.yaml").write_text(text.replace("  - bag.mcap\n", listed))
        assert "z.mcap" in (bag / "metadata.yaml").read_text()
    else:
        (bag / "metadata.yaml").unlink()
    found, notes = raw_and_notes(bag)
    assert found == expected
    for name in hindrances:
        assert sum(name in note and "the rest is read" in note for note in notes) == 1
    assert main(["replay", str(bag), "-p", "model:=M3"]) == 0


def test_a_file_in_a_folder_that_may_not_be_read_costs_a_note(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", run(6.0))
    expected = raw(bag)
    shutil.copy(storage_file(bag), bag / "secret.mcap")
    (bag / "metadata.yaml").unlink()
    opened = os.open

    def denied(path, *arguments, **options):
        if str(path).endswith("secret.mcap"):
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *arguments, **options)

    monkeypatch.setattr(os, "open", denied)
    found, notes = raw_and_notes(bag)
    assert found == expected
    assert any("secret.mcap" in note and "Permission denied" in note for note in notes)


@pytest.mark.parametrize("is_damaged", [False, True])
def test_rows_of_topics_that_a_database_does_not_name_are_counted(tmp_path, is_damaged):
    file = storage_file(write_bag(tmp_path / "bag", run(6.0), "sqlite3"))
    n_dvl = sum(topic == "dvl/twist" for topic, _, _ in raw(file))
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute("DELETE FROM topics WHERE name = 'dvl/twist'")
    if is_damaged:  # SQLite gives up at the table of the tables
        content = bytearray(file.read_bytes())
        content[100:105] = bytes(5)
        file.write_bytes(content)
    found, notes = raw_and_notes(file)
    assert {topic for topic, _, _ in found} == {"gnss/twist", "imu/data"}
    assert len(notes) == 1 and f"{n_dvl} messages belong to topics that it does not list" in notes[0]


# ---------------------------------------------------------------------- two definitions of one type

STANDARD, _ = JAZZY.generate_msgdef(TWIST_TYPE, ros_version=2)
UPGRADED = "float64 temperature\n" + STANDARD


def two_definitions(one_topic: bool) -> bytes:
    """A hundred messages of a type, and a hundred of its next version, on one topic or on two."""
    upgraded = get_typestore(Stores.EMPTY)
    upgraded.register(get_types_from_msg(UPGRADED, TWIST_TYPE))
    output = io.BytesIO()
    writer = McapWriter(output, compression=CompressionType.NONE, chunk_size=5000)
    writer.start("ros2")
    topics = ["dvl/twist", "dvl/twist" if one_topic else "gnss/twist"]
    for number, (topic, store, text) in enumerate(zip(topics, (JAZZY, upgraded), (STANDARD, UPGRADED), strict=True)):
        schema = writer.register_schema(TWIST_TYPE, "ros2msg", text.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        for i in range(100):
            stamp = 10**18 + (i if not one_topic else 100 * number + i) * 10**8 + number
            message = twist(store, stamp, "dvl_link" if one_topic or not number else "map")
            writer.add_message(channel, stamp, bytes(store.serialize_cdr(message, TWIST_TYPE)), stamp)
    writer.finish()
    return output.getvalue()


def twist(store, stamp_ns: int, frame_id: str):
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"]
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), frame_id)
    inner = types["geometry_msgs/msg/TwistWithCovariance"](
        types["geometry_msgs/msg/Twist"](vector(1.5, 0.1, 0.05), vector(0.0, 0.0, 0.0)), np.zeros(36)
    )
    return types[TWIST_TYPE](*([20.0] if store is not JAZZY else []), header, inner)


def velocities(path: Path) -> list[tuple[float, float, float]]:
    with BagReader([path]) as bag:
        assert not bag.notes
        linear = [message.twist.twist.linear for _, _, message, why in bag.messages(bag.topics) if not why]
    return [(each.x, each.y, each.z) for each in linear]


@pytest.mark.parametrize("one_topic", [True, False])
def test_a_type_in_two_definitions_is_read_by_the_one_of_its_channel(tmp_path, one_topic):
    (tmp_path / "two.mcap").write_bytes(two_definitions(one_topic))
    assert velocities(tmp_path / "two.mcap") == [(1.5, 0.1, 0.05)] * 200
    counts = replayed(tmp_path / "two.mcap").result.counts
    assert counts["dvl"]["received"] == counts["dvl"]["accepted"] == (200 if one_topic else 100)
    assert not counts["reference"]["invalid"]


@pytest.mark.parametrize("one_topic", [True, False])
@pytest.mark.parametrize(
    "options", [[], ["--storage", "sqlite3"], ["--compression", "file"], ["--compression", "chunk"]]
)
def test_salvage_of_a_type_in_two_definitions_gives_messages_that_can_be_decoded(tmp_path, one_topic, options):
    (tmp_path / "two.mcap").write_bytes(two_definitions(one_topic))
    assert main(["salvage", str(tmp_path / "two.mcap"), "-o", str(tmp_path / "new"), *options]) == 0
    assert velocities(tmp_path / "new") == [(1.5, 0.1, 0.05)] * 200
    assert raw(tmp_path / "new") == raw(tmp_path / "two.mcap")
    files = [path for path in (tmp_path / "new").iterdir() if path.name != "metadata.yaml"]
    assert len(files) == 2 and all(path.is_file() for path in files)
    with Reader(tmp_path / "new") as reader:  # as others see it
        assert reader.message_count == 200
        assert reader.duration == max(t for _, t, _ in raw(tmp_path / "new")) - 10**18 + 1


@pytest.mark.slow
def test_a_driver_that_was_upgraded_between_two_bags_is_read_by_the_definitions_of_each(tmp_path):
    samples = [sample for sample in run(20.0) if isinstance(sample, DvlSample)]
    old = write_driver_bag(tmp_path / "old", samples[:50], A50, maker=Maker("first"))
    new = write_driver_bag(tmp_path / "new", samples[50:], A50, maker=Maker("fixed sizes"))
    assert replayed(old, new).result.counts["dvl"]["accepted"] == len(samples)
    assert main(["salvage", str(new), str(old), "-o", str(tmp_path / "both")]) == 0
    assert replayed(tmp_path / "both").result.counts["dvl"]["accepted"] == len(samples)
    assert estimates(tmp_path / "both") == estimates(old, new)


def test_a_database_with_two_definitions_of_a_type_tells_them_by_their_hash(tmp_path, monkeypatch):
    """As rosbag2 writes it since ROS 2 Iron: the topic's hash says which."""
    upgraded = get_typestore(Stores.EMPTY)
    upgraded.register(get_types_from_msg(UPGRADED, TWIST_TYPE))
    with BagWriter(tmp_path / "bag", Storage.SQLITE3) as bag:
        for i in range(10):
            bag.message("dvl/twist", TWIST_TYPE, i, twist(JAZZY, i, "dvl_link"))
    file = storage_file(tmp_path / "bag")
    with closing(sqlite3.connect(file)) as connection, connection:
        digest = upgraded.hash_rihs01(TWIST_TYPE)
        row = (TWIST_TYPE, "ros2msg", UPGRADED, digest)
        connection.execute(
            "INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition, type_description_hash) "
            "VALUES (?, ?, ?, ?)", row,
        )  # fmt: skip
        connection.execute("INSERT INTO topics VALUES (7, 'gnss/twist', ?, 'cdr', '', ?)", (TWIST_TYPE, digest))
        data = bytes(upgraded.serialize_cdr(twist(upgraded, 5, "map"), TWIST_TYPE))
        connection.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (7, 5, ?)", (data,))
    assert velocities(file) == [(1.5, 0.1, 0.05)] * 11

    def broken(*_):
        raise sqlite3.DatabaseError("malformed")

    monkeypatch.setattr(sources, "Database", broken)
    with BagReader([file]) as bag:
        found = [(message.twist.twist.linear.x, why) for _, _, message, why in bag.messages(TOPICS)]
    assert found == [(1.5, "")] * 11


def test_salvage_of_a_bag_without_definitions_writes_none(tmp_path):
    """As it was recorded: nobody knows whether its messages are laid out as Jazzy's."""
    bag = forget_definitions(write_bag(tmp_path / "bag", run(6.0), "sqlite3"))
    assert main(["salvage", str(bag), "-o", str(tmp_path / "new"), "--storage", "sqlite3"]) == 0
    with BagReader([tmp_path / "new"]) as reader:
        assert all(is_empty(channel.definition) for topic in TOPICS for channel in reader.channels(topic))
    assert raw(tmp_path / "new") == raw(bag)


# ---------------------------------------------------------------------- definitions and encodings


@pytest.mark.parametrize(
    ("text", "which"),
    [
        (
            "geometry_msgs/TwistWithCovarianceStamped again\n",
            "geometry_msgs/msg/TwistWithCovarianceStamped contains itself",
        ),
        (f"a/B2 x\n{'=' * 80}\nMSG: a/B2\na/B3[2] y\n{'=' * 80}\nMSG: a/B3\na/B2 z\n", "a/msg/B2 contains itself"),
        (
            "a/N0 x\n" + "".join(f"{'=' * 80}\nMSG: a/N{i}\na/N{i + 1} x\na/N{i + 1} y\n" for i in range(30)),
            "a/msg/N16 unfolds to more than 8192 fields",
        ),
    ],
)
def test_a_definition_without_end_is_told_of_its_topic(tmp_path, capsys, text, which):
    samples = raw(write_bag(tmp_path / "bag", run(6.0)))
    (tmp_path / "round.mcap").write_bytes(mcap_bytes(samples, {"dvl/twist": (TWIST_TYPE, text)}))
    assert main(["doctor", str(tmp_path / "round.mcap")]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"dvl/twist: 30 of 30 messages cannot be decoded: the definition of {which}" in said


def big_endian(topic: str, data: bytes) -> bytes:
    kind = TOPICS[topic]
    return bytes(JAZZY.serialize_cdr(JAZZY.deserialize_cdr(data, kind), kind, little_endian=False))


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    "change", [big_endian, lambda _, data: data + bytes(4)], ids=["big-endian", "4 bytes of padding"]
)
def test_messages_in_big_endian_or_with_padding_are_read_as_they_are(tmp_path, change):
    samples = raw(write_bag(tmp_path / "bag", run(20.0)))
    changed = [(topic, log_ns, change(topic, data)) for topic, log_ns, data in samples]
    (tmp_path / "changed.mcap").write_bytes(mcap_bytes(changed))
    assert estimates(tmp_path / "changed.mcap") == estimates(tmp_path / "bag")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: data + b"\xff" * 4, "it is longer than a sensor_msgs/msg/Imu"),
        (lambda data: b"\0\7" + data[2:], "it begins with 00 07, but plain CDR begins with 00 00 or 00 01"),
        (lambda data: data[:60], "Could not deserialize"),
    ],
)
def test_why_messages_of_a_topic_cannot_be_decoded_is_said_of_the_topic(tmp_path, capsys, change, reason):
    samples = raw(write_bag(tmp_path / "bag", run(6.0)))
    changed = [(topic, at, change(data) if topic == "imu/data" else data) for topic, at, data in samples]
    (tmp_path / "changed.mcap").write_bytes(mcap_bytes(changed))
    assert main(["doctor", str(tmp_path / "changed.mcap")]) == 1  # six seconds are too few
    said = " ".join(capsys.readouterr().out.split())
    assert f"imu/data: 120 of 120 messages cannot be decoded: {reason}" in said
    assert "dvl/twist: 30 of" not in said and "DOCTOR_NO_ORIENTATION" not in said


def test_why_a_dvl_cannot_be_decoded_is_said_where_none_is_found(tmp_path, capsys):
    samples = raw(write_bag(tmp_path / "bag", run(6.0)))
    changed = [(topic.replace("dvl/twist", "a50/velocity"), at, b"\0\7" + data[2:]) for topic, at, data in samples]
    twist = (TWIST_TYPE, JAZZY.generate_msgdef(TWIST_TYPE, ros_version=2)[0])
    (tmp_path / "changed.mcap").write_bytes(mcap_bytes(changed, {"a50/velocity": twist}))
    assert main(["doctor", str(tmp_path / "changed.mcap")]) == 2
    error = capsys.readouterr().err
    assert f"a50/velocity ({TWIST_TYPE}, which cannot be decoded: it begins with 00 07" in error


@pytest.mark.slow
def test_thousands_of_channels_are_opened_in_a_time_that_goes_with_their_number(tmp_path):
    output = io.BytesIO()
    writer = McapWriter(output)
    writer.start("ros2")
    schema = writer.register_schema(TWIST_TYPE, "ros2msg", STANDARD.encode())
    channels_ = [writer.register_channel(f"t{number}", "cdr", schema) for number in range(10_000)]
    for _, log_ns, data in raw_twists():
        writer.add_message(channels_[7], log_ns, data, log_ns)
    writer.finish()
    (tmp_path / "many.mcap").write_bytes(output.getvalue())
    began = time.process_time()
    with open_bags([tmp_path / "many.mcap"]) as bag:
        assert len(bag.topics) == 10_000
        assert all(len(bag.types_of(topic)) == 1 and not bag.lacks_definition(topic) for topic in bag.topics)
        assert len(list(bag.messages(bag.topics))) == 4
    recording = open_recording([tmp_path / "many.mcap"])
    assert len(recording.types) == 10_000
    assert time.process_time() - began < 3.5  # without an index it grows with the square


# ---------------------------------------------------------------------- what is no damage


@pytest.mark.parametrize(
    "error", [AttributeError, TypeError, ImportError, NotImplementedError, AssertionError, NameError]
)
@pytest.mark.parametrize(
    ("kind", "module", "name"),
    [
        ("mcap", sources, "read_summary"), ("mcap", sources, "indexed_messages"), ("mcap", sources, "salvage_mcap"),
        ("sqlite3", sources, "Database"), ("mcap", channels, "get_types_from_msg"),
        ("mcap", channels, "typestore"),
    ],
)  # fmt: skip
def test_what_does_not_fit_of_a_library_is_no_damage(bags, tmp_path, monkeypatch, kind, module, name, error):
    def unfit(*_, **__):
        raise error("no such thing in this version")

    channels.typestore.cache_clear()
    bag = bags[kind]
    if name == "salvage_mcap":
        file = tmp_path / "cut.mcap"
        file.write_bytes(storage_file(bag).read_bytes()[:-37])
        bag = file
    monkeypatch.setattr(module, name, unfit)
    with pytest.raises(error, match="no such thing"), BagReader([bag]) as reader:
        list(reader.messages(reader.topics))


def test_what_a_damaged_definition_makes_of_messages_is_told_of_each():
    bad = [
        "float64 a\nfloat64 a\n", "geometry_msgs/Nowhere a\n", "float64[99999999] a\n", "float128 a\n", "x y z\n",
        "a/B self\n", "float64 class\n", "float64[] a\nstring<=3 b\n",
    ]  # fmt: skip
    for text in bad:
        decoder = channels.Decoder(KNOWN_DEFINITIONS)
        channel = Channel("a", "a/msg/B", Definition(channels.FORMATS["ros2msg"], text))
        for data in (b"", b"\0\1\0\0", b"\0\1\0\0" + bytes(range(64)), b"\0\0\0\0" + b"\xff" * 64):
            try:
                decoder(channel, data)
            except DecodingError as error:
                assert str(error)


@pytest.mark.parametrize(
    ("log_times", "options"),
    [((5, 2**64 - 1, 2**63, 7), {}), ((5, 2**64 - 1, 2**63, 7), {"use_chunking": False}), ((2**63 - 1,) * 4, {})],
)
def test_log_times_beyond_all_reason_are_no_reason_to_stop(tmp_path, log_times, options):
    messages = [("dvl/twist", log_ns, data) for log_ns, (_, _, data) in zip(log_times, raw_twists(), strict=True)]
    (tmp_path / "wild.mcap").write_bytes(mcap_bytes(messages, **options))
    assert sorted(raw(tmp_path / "wild.mcap")) == sorted(messages)
    for kind, latest_ns in (("mcap", 2**64 - 1), ("sqlite3", 2**63 - 1)):  # SQLite has no larger number
        assert main(["salvage", str(tmp_path / "wild.mcap"), "-o", str(tmp_path / kind), "--storage", kind]) == 0
        expected = [(topic, min(log_ns, latest_ns), data) for topic, log_ns, data in messages]
        assert sorted(raw(tmp_path / kind)) == sorted(expected)
        assert main(["doctor", str(tmp_path / kind)]) == 1  # four messages are too few


def raw_twists():
    return [
        ("dvl/twist", i, bytes(JAZZY.serialize_cdr(twist(JAZZY, 10**9 + i, "dvl_link"), TWIST_TYPE))) for i in range(4)
    ]
