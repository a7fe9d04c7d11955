"""Whatever is damaged: what is whole before the damage comes out, a note says how much, nothing else happens."""

from __future__ import annotations

import os
import random
import resource
import struct
import subprocess
import sys
import tempfile
from functools import cache
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from io_fixtures import mcap_bytes, raw, raw_and_notes, replayed, run, storage_file, write_bag
from mcap.reader import make_reader
from mcap.writer import CompressionType

from dvl_calib_ros.calibration.samples import DvlSample
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.io.errors import InputError

NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD
Message = tuple[str, int, bytes]
SEARCH = settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@cache
def messages(seconds: float = 6.0) -> tuple[Message, ...]:
    with tempfile.TemporaryDirectory() as folder:
        recorded = raw(write_bag(Path(folder) / "bag", run(seconds)))
    # log times of their own tell which chunk a message is in
    return tuple((topic, log_ns + i, data) for i, (topic, log_ns, data) in enumerate(recorded))


@cache
def content(compression: CompressionType = NONE, chunked: bool = True) -> bytes:
    return mcap_bytes(messages(), compression=compression, use_chunking=chunked)


@cache
def chunks(compression: CompressionType) -> list[tuple[int, int]]:
    """(first byte after the chunk, messages up to there) for every chunk."""
    index = make_reader(BytesIO(content(compression))).get_summary().chunk_indexes
    return [
        (c.chunk_start_offset + c.chunk_length, sum(log_ns <= c.message_end_time for _, log_ns, _ in messages()))
        for c in index
    ]


def read(tmp_path: Path, data: bytes, name: str = "damaged.mcap") -> tuple[list[Message], list[str]]:
    """What comes out of a file with these bytes; nothing, if it is refused."""
    path = tmp_path / name
    path.write_bytes(data)
    try:
        return raw_and_notes(path)
    except InputError as error:
        assert str(path) in str(error)
        return [], [str(error)]


@SEARCH
@given(part=st.floats(0.0, 1.0, exclude_max=True), chunked=st.booleans())
def test_an_uncompressed_file_cut_anywhere_gives_exactly_the_messages_before_the_cut(tmp_path, part, chunked):
    whole = content(NONE, chunked)
    cut = int(part * len(whole))
    expected = [message for message in messages() if whole.index(message[2]) + len(message[2]) <= cut]
    found, notes = read(tmp_path, whole[:cut])
    assert found == expected
    assert len(notes) == 1 and (not expected or f"{len(expected)} whole messages" in notes[0])


@SEARCH
@given(part=st.floats(0.0, 1.0, exclude_max=True), compression=st.sampled_from([LZ4, ZSTD]))
def test_a_compressed_file_cut_anywhere_gives_at_least_all_chunks_before_the_cut(tmp_path, part, compression):
    cut = int(part * len(content(compression)))
    in_whole_chunks = max((count for end, count in chunks(compression) if end <= cut), default=0)
    found, notes = read(tmp_path, content(compression)[:cut])
    assert tuple(found) == messages()[: len(found)]
    assert len(found) >= in_whole_chunks
    assert len(notes) == 1


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_is_cut_gives_its_beginning(tmp_path, compression):
    """One chunk of 250 kB, incompressible enough for several blocks: half of it must give a good part of it."""
    many = [("dvl/twist", i, random.Random(i).randbytes(372)) for i in range(700)]
    whole = mcap_bytes(many, compression=compression, chunk_size=10**7)
    found, _ = read(tmp_path, whole[: len(whole) * 6 // 10])
    assert 300 < len(found) < 450
    assert found == many[: len(found)]


@SEARCH
@given(data=st.data(), compression=st.sampled_from([NONE, LZ4, ZSTD]))
def test_corrupt_bytes_anywhere_never_give_a_message_that_was_not_recorded(tmp_path, data, compression):
    whole = bytearray(content(compression))
    for _ in range(data.draw(st.integers(1, 3))):
        whole[data.draw(st.integers(8, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    found, notes = read(tmp_path, bytes(whole))
    recorded = {bytes_ for _, _, bytes_ in messages()}
    assert all(bytes_ in recorded for _, _, bytes_ in found)
    assert len(found) == len(messages()) or notes


@pytest.mark.parametrize("compression", [NONE, LZ4, ZSTD])
def test_damage_in_the_middle_gives_what_comes_before_and_says_how_much(tmp_path, compression):
    whole = bytearray(content(compression))
    number = len(chunks(compression)) // 2
    whole[chunks(compression)[number][0] - 40] ^= 0xFF
    before = chunks(compression)[number - 1][1]
    found, notes = read(tmp_path, bytes(whole))
    assert tuple(found) == messages()[:before]
    assert len(notes) == 1 and f"{before} messages" in notes[0]


def test_a_damaged_length_in_a_chunk_without_checksum_costs_only_what_comes_after_it(tmp_path):
    whole = bytearray(mcap_bytes(messages(), enable_crcs=False, chunk_size=10**7))
    victim = bytes(whole).index(messages()[50][2])
    whole[victim - 22 - 8 : victim - 22] = struct.pack("<Q", 10**15)
    found, notes = read(tmp_path, bytes(whole))
    assert tuple(found) == messages()[:50]
    assert len(notes) == 1


@pytest.mark.parametrize("claimed", [2**31, 2**33, 2**63 - 1, 2**64 - 1])
@pytest.mark.parametrize("place", ["header", "chunk", "records", "summary"])
def test_a_length_that_claims_gigabytes_takes_no_memory(tmp_path, claimed, place):
    whole = bytearray(content(ZSTD))
    first_chunk = whole.index(b"\x06", 30)
    at = {"header": 9, "chunk": first_chunk + 1, "records": first_chunk + 9 + 16, "summary": len(whole) - 28}[place]
    whole[at : at + 8] = struct.pack("<Q", claimed)
    path = tmp_path / "claims.mcap"
    path.write_bytes(whole)
    script = (
        "import resource, sys; from pathlib import Path; from dvl_calib_ros.io.bags import BagReader;"
        "from dvl_calib_ros.io.errors import InputError\n"
        "try:\n    list(BagReader([Path(sys.argv[1])]).raw_messages(['dvl/twist']))\n"
        "except InputError: pass\n"
        "sys.exit(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > 400_000)"
    )
    limit = lambda: resource.setrlimit(resource.RLIMIT_CPU, (30, 30))  # noqa: E731
    subprocess.run([sys.executable, "-c", script, str(path)], check=True, preexec_fn=limit)


@pytest.mark.parametrize("compression", [LZ4, ZSTD])
def test_a_chunk_that_unpacks_to_far_more_than_it_says_is_not_unpacked(tmp_path, compression):
    bomb = mcap_bytes([("dvl/twist", 1, bytes(50_000_000))], compression=compression, chunk_size=10**8)
    cut = bytearray(bomb[:-60])  # no footer
    at = cut.index(b"\x06", 30) + 9 + 16
    cut[at : at + 8] = struct.pack("<Q", 1000)
    found, notes = read(tmp_path, bytes(cut))
    assert found == [] and "no whole message" in notes[0]


@pytest.mark.parametrize("part", [0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99])
def test_a_truncated_sqlite_file_gives_a_beginning_of_the_recording(tmp_path, part):
    whole = storage_file(write_bag(tmp_path / "bag", run(20.0), "sqlite3")).read_bytes()
    found, notes = read(tmp_path, whole[: int(part * len(whole))], "cut.db3")
    assert found == raw(tmp_path / "bag")[: len(found)]
    assert notes
    if part > 0.25:
        assert len(found) > 0.5 * part * len(raw(tmp_path / "bag"))


@SEARCH
@given(places=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=20))
def test_corrupt_bytes_in_a_sqlite_file_raise_nothing_but_input_error(tmp_path, places):
    if not (tmp_path / "bag").exists():
        write_bag(tmp_path / "bag", run(6.0), "sqlite3")
    whole = bytearray(storage_file(tmp_path / "bag").read_bytes())
    for part, change in places:
        whole[int(part * len(whole))] ^= change
    found, _ = read(tmp_path, bytes(whole), "corrupt.db3")
    assert len(found) <= len(messages())


def test_a_replay_of_a_damaged_bag_equals_that_of_what_is_whole_in_it(tmp_path):
    samples = run(40.0)
    bag = write_bag(tmp_path / "bag", samples, compression="chunk")
    file = storage_file(bag)
    os.truncate(file, file.stat().st_size // 2)
    damaged = replayed(bag)
    count = sum(damaged.result.counts[name]["received"] for name in ("dvl", "reference", "imu"))
    whole = replayed(write_bag(tmp_path / "whole", samples[:count])).result
    assert 0 < count < len(samples)
    assert [*damaged.result.estimates["M3"].state] == [*whole.estimates["M3"].state]
    assert any(f"{count} whole messages" in note for note in damaged.notes)


def test_a_message_that_cannot_be_decoded_is_counted_and_skipped_and_told_of_once(tmp_path):
    broken = [
        (topic, log_ns, data[: 20 + i % 7] if topic == "dvl/twist" and i % 5 == 0 else data)
        for i, (topic, log_ns, data) in enumerate(messages())
    ]
    (tmp_path / "broken.mcap").write_bytes(mcap_bytes(broken))
    replay = replayed(tmp_path / "broken.mcap")
    n_broken = sum(now != then for now, then in zip(broken, messages(), strict=True))
    assert replay.result.counts["dvl"]["invalid"] == n_broken > 1
    assert sum("could not be decoded" in note for note in replay.notes) == 1


BAD_BAGS = {
    "nonsense": (lambda p: p.write_bytes(b"no bag at all"), "no bag; give a rosbag2 folder"),
    "empty_file.mcap": (lambda p: p.touch(), "the file is empty"),
    "empty.mcap.zstd": (lambda p: p.write_bytes(b"\x28\xb5\x2f\xfd"), "empty"),
    "garbage.mcap.zstd": (lambda p: p.write_bytes(b"\x28\xb5\x2f\xfd" + bytes(range(200))), "garbage.mcap.zstd"),
    "only_magic.mcap": (lambda p: p.write_bytes(b"\x89MCAP0\r\n"), "no whole message"),
    "only_magic.db3": (lambda p: p.write_bytes(b"SQLite format 3\0" + bytes(100)), "no whole message"),
    "ros1.bag": (lambda p: p.write_bytes(b"#ROSBAG V2.0\n"), "rosbags-convert"),
    "empty_folder": (lambda p: p.mkdir(), "no .mcap or .db3 file in it"),
    "missing": (lambda p: None, "no such file or folder"),
    "n" * 300: (lambda p: None, "File name too long"),
    "pipe": (lambda p: os.mkfifo(p), "neither file nor folder"),
    "no_topics": (lambda p: write_bag(p, []), "has no topics"),
    "no_topics_db3": (lambda p: write_bag(p, [], "sqlite3"), "has no topics"),
    "no_mcap_messages.mcap": (lambda p: p.write_bytes(mcap_bytes([])), "has no topics"),
    "no_dvl": (lambda p: write_bag(p, [s for s in run(6.0) if not isinstance(s, DvlSample)]),
               "--dvl-topic. The bag has: gnss/twist (geometry_msgs/msg/TwistWithCovarianceStamped), imu/data (sens"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_BAGS)
def test_what_cannot_be_replayed_is_named_in_one_line_with_exit_code_2(tmp_path, capsys, name):
    make, expected = BAD_BAGS[name]
    make(tmp_path / name)
    assert main(["replay", str(tmp_path / name)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1 and output.err.startswith("dvl-calib replay: ")
    assert name in output.err and expected in output.err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (
            ["--dvl-topic", "imu/data", "--imu-topic", "x"],
            "topic imu/data holds sensor_msgs/msg/Imu, expected geo",
        ),
        (["--gnss-topic", "imu/data", "--imu-topic", "x"], "set --gnss-topic"),
        (["--gnss-topic", "imu/data", "--imu-topic", "x", "-p", "prior_source:=reference"], "set --gnss-topic"),
        (["--imu-topic", "gnss/twist", "--gnss-topic", "x"], "expected sensor_msgs/msg/Imu; set --imu-topic"),
        (["--gnss-topic", "dvl/twist"], "must be different topics"),
        (["--dvl-topic", "[/b]"], "no topic '[/b]'"),
    ],
)
def test_a_topic_of_another_type_is_named_with_the_option_to_set(tmp_path, capsys, options, expected):
    bag = write_bag(tmp_path / "bag", run(6.0))
    assert main(["replay", str(bag), *options]) == 2
    output = capsys.readouterr()
    assert output.err.count("\n") == 1 and expected in output.err


def test_a_file_without_permission_is_named_in_one_line(tmp_path, capsys, monkeypatch):
    bag = write_bag(tmp_path / "bag", run(6.0))

    def denied(self, *_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    assert main(["replay", str(bag)]) == 2
    assert "Permission denied" in capsys.readouterr().err
