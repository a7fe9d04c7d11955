"""Recordings of every kind give the same data, and the same estimates."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from io_fixtures import (
    TOPICS,
    estimates,
    mcap_bytes,
    raw,
    raw_and_notes,
    replayed,
    rewrite,
    run,
    storage_file,
    write_bag,
)
from mcap.writer import CompressionType, IndexType
from yaml_text import parsed, written

from dvl_calib_ros.bags import batches, sources
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter, Compression, Storage
from dvl_calib_ros.calibration.numerics.samples import DvlSample, VelocityFrame
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.messages.encode import SampleWriter

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

KINDS = [
    ("mcap", "none"), ("mcap", "chunk"), ("mcap", "message"), ("mcap", "file"),
    ("sqlite3", "none"), ("sqlite3", "message"), ("sqlite3", "file"),
]  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("plain") / "bag", run())


@pytest.fixture(scope="module")
def expected(plain) -> dict:
    return estimates(plain)


@pytest.mark.spread(3)
@pytest.mark.parametrize(("storage", "compression"), KINDS)
def test_every_storage_and_compression_gives_the_same_estimates(tmp_path, expected, storage, compression):
    assert estimates(write_bag(tmp_path / "bag", run(), storage, compression)) == expected


@pytest.mark.parametrize(("storage", "compression"), KINDS)
def test_a_file_alone_gives_the_same_messages_and_so_does_a_folder_without_metadata(
    tmp_path, plain, storage, compression
):
    bag = write_bag(tmp_path / "bag", run(), storage, compression)
    assert raw_and_notes(storage_file(bag)) == (raw(plain), [])
    (bag / "metadata.yaml").unlink()
    messages, notes = raw_and_notes(bag)
    assert messages == raw(plain)
    assert len(notes) == 1 and "metadata.yaml" in notes[0]


@pytest.mark.parametrize("text", ["", "[1, 2", "rosbag2_bagfile_information: 3", "\x00", "a: {b: c}"])
def test_a_damaged_metadata_file_costs_nothing_but_a_note(tmp_path, plain, text):
    bag = write_bag(tmp_path / "bag", run())
    (bag / "metadata.yaml").write_text(text)
    messages, notes = raw_and_notes(bag)
    assert messages == raw(plain)
    assert "metadata.yaml" in notes[0]


@pytest.mark.spread(2)
@pytest.mark.parametrize(("storage", "split"), [("mcap", 1), ("sqlite3", 500), ("mcap", 1234)])
def test_two_halves_of_a_run_give_the_same_as_the_whole_in_either_order(tmp_path, expected, storage, split):
    first = write_bag(tmp_path / "first", run()[:split], storage)
    second = write_bag(tmp_path / "second", run()[split:], storage)
    assert estimates(first, second) == expected
    assert estimates(second, first) == expected


def test_bags_of_one_sensor_each_are_merged_by_log_time(tmp_path, plain):
    kinds = {type(sample) for sample in run()}
    bags = [write_bag(tmp_path / kind.__name__, [s for s in run() if type(s) is kind]) for kind in kinds]
    merged = raw(*bags)
    assert [log_ns for _, log_ns, _ in merged] == sorted(log_ns for _, log_ns, _ in merged)
    assert sorted(merged) == sorted(raw(plain))


def test_the_parts_of_a_split_bag_are_read_in_order_and_only_those_that_metadata_lists(tmp_path):
    bag = write_bag(tmp_path / "bag", run()[:100])
    for number, samples in ((2, run()[100:200]), (10, run()[200:300])):
        part = write_bag(tmp_path / f"part{number}", samples)
        shutil.copy(storage_file(part), bag / f"bag_{number}.mcap")
    metadata = parsed((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] += ["bag_2.mcap", "bag_3.mcap"]
    (bag / "metadata.yaml").write_text(written(metadata))
    messages, notes = raw_and_notes(bag)
    assert len(messages) == 200
    assert any("bag_3.mcap is missing" in note for note in notes)
    assert any("bag_10.mcap: not read" in note for note in notes)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE])
def test_mcap_files_of_other_writers_give_the_same_messages(tmp_path, plain, compression, chunked, index):
    content = mcap_bytes(raw(plain), compression=compression, use_chunking=chunked, index_types=index)
    (tmp_path / "other.mcap").write_bytes(content)
    messages, notes = raw_and_notes(tmp_path / "other.mcap")
    assert messages == raw(plain) and not notes


CHUNKS = {"chunk_size": 30_000, "compression": CompressionType.LZ4}


@pytest.mark.spread(4)
@pytest.mark.parametrize(
    ("options", "at_once", "in_memory", "is_cut"),
    [
        (CHUNKS, 0, batches.IN_MEMORY, False), (CHUNKS, 0, 20_000, False), (CHUNKS, 1 << 30, 20_000, False),
        *(({"use_chunking": False}, None, kept, cut) for cut in (False, True) for kept in (batches.IN_MEMORY, 20_000)),
    ],
)  # fmt: skip
def test_log_times_of_one_topic_after_the_other_are_put_in_order_in_memory_or_on_disk(
    tmp_path, plain, monkeypatch, options, at_once, in_memory, is_cut
):
    """As of a recorder that caches by topic, in chunks with an index or without either."""
    monkeypatch.setattr(sources, "MERGED_AT_ONCE", sources.MERGED_AT_ONCE if at_once is None else at_once)
    monkeypatch.setattr(batches, "IN_MEMORY", in_memory)
    by_topic = sorted(raw(plain), key=lambda message: message[0])
    content = mcap_bytes(by_topic, **options)
    (tmp_path / "by_topic.mcap").write_bytes(content[:-37] if is_cut else content)
    found, notes = raw_and_notes(tmp_path / "by_topic.mcap")
    assert [log_ns for _, log_ns, _ in found] == sorted(log_ns for _, log_ns, _ in by_topic)
    assert sorted(found) == sorted(by_topic)
    assert len(notes) == is_cut
    assert estimates(tmp_path / "by_topic.mcap") == estimates(plain)


def test_a_file_is_known_by_its_content_whatever_its_name(tmp_path, plain):
    for storage in ("mcap", "sqlite3"):
        bag = write_bag(tmp_path / storage, run(), storage)
        shutil.copy(storage_file(bag), tmp_path / f"{storage}#50%?.bin")
        assert raw(tmp_path / f"{storage}#50%?.bin") == raw(plain)


def test_topics_are_found_with_and_without_a_leading_slash(tmp_path, expected):
    assert estimates(write_bag(tmp_path / "bag", run(), prefix="/")) == expected


def test_zero_stamps_fall_back_to_the_log_time_and_are_reported(tmp_path, expected):
    def change(_, message):
        message.header.stamp.sec = message.header.stamp.nanosec = 0
        return message

    bag = rewrite(tmp_path / "bag", change, run())
    assert estimates(bag) == expected  # the writer's log time is the stamp
    notes = replayed(bag).notes
    assert any(f"{len(run())} messages had no header stamp" in note for note in notes)
    assert sum("without a header stamp" in note for note in notes) == 3  # once per stream


def test_a_dvl_that_publishes_in_the_body_frame_is_refused_with_the_remedy(tmp_path):
    bag = write_bag(tmp_path / "bag", run(), dvl_frame="base_link")
    with pytest.raises(InputError, match=r"wrong_frame.*base_link.*dvl_frame"):
        replayed(bag)


@pytest.mark.spread(1)
@pytest.mark.parametrize("frame", [VelocityFrame.BODY, VelocityFrame.ENU])
def test_prior_source_reference_takes_sway_and_heave_from_the_reference(tmp_path, frame):
    bag = write_bag(tmp_path / "bag", run(frame=frame))
    assert estimates(bag, prior_source="reference")["M5"] != estimates(bag)["M5"]
    assert estimates(bag, prior_source="reference")["M3"] == estimates(bag)["M3"]


def test_prior_source_reference_is_not_misled_by_invalid_samples(tmp_path):
    def change(topic, message):
        if topic == "gnss/twist":
            message.twist.twist.linear.y = float("nan")
        return message

    first = [sample for sample in run(frame=VelocityFrame.BODY)][:60]
    bad = rewrite(tmp_path / "bad", change, first)
    good = write_bag(tmp_path / "good", run(frame=VelocityFrame.BODY)[60:])
    assert all(abs(value) < 10 for value in estimates(bad, good, prior_source="reference")["M5"])


def test_prior_source_reference_without_a_reference_names_the_remedy(tmp_path):
    bag = write_bag(tmp_path / "bag", [s for s in run() if isinstance(s, DvlSample)])
    with pytest.raises(InputError, match=r"prior_source reference.*gnss/twist.*--gnss-topic"):
        replayed(bag, prior_source="reference")


def test_a_bag_that_cannot_be_finished_is_not_left_behind(tmp_path):
    def full() -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="No space left"), BagWriter(tmp_path / "bag") as bag:
        SampleWriter(bag).dvl("dvl/twist", DvlSample(1, (1.0, 0.0, 0.0)))
        bag._parts[0].writer.close = full
    assert not (tmp_path / "bag").exists()


def test_sqlite_bags_refuse_chunk_compression_and_existing_names(tmp_path):
    with pytest.raises(InputError, match="chunk is MCAP's"):
        BagWriter(tmp_path / "bag", Storage.SQLITE3, Compression.CHUNK)
    with pytest.raises(InputError, match="exists already"):
        BagWriter(tmp_path)


def test_a_compressed_file_that_is_cut_gives_what_can_be_unpacked(tmp_path, plain):
    content = mcap_bytes(raw(plain))
    packed = b"".join(zstd.compress(content[at : at + 8192]) for at in range(0, len(content), 8192))
    (tmp_path / "cut.mcap.zstd").write_bytes(packed[: len(packed) * 2 // 3])
    messages, notes = raw_and_notes(tmp_path / "cut.mcap.zstd")
    assert 200 < len(messages) < len(raw(plain))
    assert messages == raw(plain)[: len(messages)]
    assert all(str(tmp_path / "cut.mcap.zstd") in note for note in notes)


def test_the_topics_of_a_bag_are_listed_with_their_types_and_counts(plain):
    with BagReader([plain, plain]) as bag:
        assert bag.topics == TOPICS
        assert sum(bag.message_counts.values()) == 2 * len(run())
