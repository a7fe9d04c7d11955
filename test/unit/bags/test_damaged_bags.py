"""Whatever is damaged: what is whole before the damage comes out, a note says how much, nothing else happens."""

from __future__ import annotations

import os
import random
import re
import resource
import sqlite3
import struct
import sys
import tempfile
from contextlib import contextmanager
from functools import cache
from io import BytesIO
from pathlib import Path

import damage
import lz4.frame
import pytest
from conftest import searched
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from io_fixtures import estimates, mcap_bytes, raw, raw_and_notes, replayed, run, storage_file, write_bag
from mcap.reader import make_reader
from mcap.writer import CompressionType

from dvl_calib_ros.bags import files
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.salvage import mcap_file
from dvl_calib_ros.calibration.numerics.samples import DvlSample
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import InputError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD
Message = tuple[str, int, bytes]
SEARCH = searched(40, HealthCheck.function_scoped_fixture)


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


def test_all_that_is_whole_comes_out_and_nothing_else(tmp_path):
    """And how much was read and how much is lost is said in one note."""
    for case in damage.cases():
        suffix = "mcap" if case.name.startswith("MCAP") else "db3"
        found, notes = read(tmp_path, case.content, f"damaged.{suffix}")
        assert set(found) == set(case.whole), case.name
        (note,) = notes
        assert f"{len(found)} whole messages" in note, case.name
        said = ("bytes skipped", "bytes short", "damaged pages")
        assert any(words in note for words in said) or len(found) == 1800, case.name


@pytest.mark.parametrize("compression", [NONE, LZ4, ZSTD])
def test_a_damaged_chunk_costs_no_other_and_the_bytes_it_costs_are_said(tmp_path, compression):
    whole = bytearray(content(compression))
    number = len(chunks(compression)) // 2
    end, count = chunks(compression)[number]
    start, before = chunks(compression)[number - 1]
    whole[end - 40] ^= 0xFF
    found, notes = read(tmp_path, bytes(whole))
    assert tuple(found) == messages()[:before] + messages()[count:]
    (note,) = notes
    skipped = int(re.search(r"(\d+) bytes skipped", note)[1])
    assert 0 < skipped <= end - start
    assert f"{len(found)} whole messages" in note


def test_only_lost_messages_of_the_topics_that_are_read_are_counted(tmp_path):
    whole = bytearray(content(ZSTD))
    (_, before), (end, count) = chunks(ZSTD)[1:3]
    whole[end - 40] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(whole)
    with BagReader([path]) as bag:
        found = list(bag.raw_messages(["dvl/twist"]))
        (note,) = bag.notes
    lost = [topic for topic, *_ in messages()[before:count]].count("dvl/twist")
    assert 1 == lost < count - before
    assert ", 1 message lost)" in note and f"{len(found)} whole messages" in note


def test_a_damaged_length_in_a_chunk_without_checksum_costs_only_its_message(tmp_path):
    whole = bytearray(mcap_bytes(messages(), enable_crcs=False, chunk_size=10**7))
    victim = bytes(whole).index(messages()[50][2])
    whole[victim - 22 - 8 : victim - 22] = struct.pack("<Q", 10**15)
    found, notes = read(tmp_path, bytes(whole))
    assert tuple(found) == messages()[:50] + messages()[51:]
    assert len(notes) == 1


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"use_chunking": False, "enable_crcs": True}])
def test_a_wild_log_time_and_a_damaged_length_behind_it_cost_one_message_and_it_is_counted(tmp_path, options):
    """A bit of each: what came before the damage was judged by the newest log time, and all of it was left out."""
    whole = bytearray(mcap_bytes(messages(), **{"enable_crcs": False, "chunk_size": 8000, **options}))
    wild, long = (bytes(whole).index(messages()[number][2]) for number in (20, 90))
    whole[wild - 16 + 7] ^= 0x40
    whole[long - 22 - 8 + 1] ^= 0x01
    found, notes = read(tmp_path, bytes(whole))
    assert [data for *_, data in messages()[:90] + messages()[91:]] == sorted(
        (data for *_, data in found), key=[data for *_, data in messages()].index
    )
    (note,) = notes
    assert "1 message lost" in note and f"{len(found)} whole messages" in note


@pytest.mark.parametrize("swallowed", [1, 4])
def test_a_length_that_leads_to_where_a_later_message_begins_costs_no_other(tmp_path, swallowed):
    alike = [("dvl/twist", 10**18 + i, bytes([i]) * 33) for i in range(100)]  # records of 64 bytes
    whole = bytearray(mcap_bytes(alike, enable_crcs=False, use_chunking=False))
    whole[bytes(whole).index(alike[50][2]) - 22 - 8] += 64 if swallowed == 1 else 0
    whole[bytes(whole).index(alike[50][2]) - 22 - 7] += 1 if swallowed == 4 else 0
    found, notes = read(tmp_path, bytes(whole))
    assert found == alike[:50] + alike[51:]
    assert "1 message lost" in notes[0]


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"chunk_size": 3000, "enable_crcs": False}])
@pytest.mark.parametrize("bit", range(8))
def test_a_bit_of_the_record_behind_the_messages_costs_none(tmp_path, bit, options):
    """Of the end of the data, or of an index of messages, which one bit makes the end of the data."""
    whole = bytearray(mcap_bytes(messages(), **options))
    last = bytes(whole).rindex(messages()[-1][2]) + len(messages()[-1][2])
    end_of_data = bytes(whole).rindex(b"\x0f\x04" + bytes(7))
    for at in {last, end_of_data}:
        damaged = bytearray(whole)
        damaged[at] ^= 1 << bit
        assert tuple(read(tmp_path, bytes(damaged))[0]) == messages()
        assert sorted(read(tmp_path, bytes(damaged[:-9]))[0]) == sorted(messages())  # without the index at the end


def test_mcap_1474_a_file_cut_in_its_index_gives_a_new_one_that_every_reader_reads(tmp_path, capsys):
    """`mcap recover` ended well, and wrote statistics that nobody could read."""
    case = next(case for case in damage.cases() if "the middle of the index" in case.name)
    (tmp_path / "malformed.mcap").write_bytes(case.content)
    assert main(["salvage", str(tmp_path / "malformed.mcap"), "-o", str(tmp_path / "new")]) == 0
    output = capsys.readouterr()
    assert f"new: {len(case.whole)} messages" in output.out
    assert "read from beginning to end: 1800 whole messages" in output.err
    file = storage_file(tmp_path / "new")
    for reader in damage.MCAP_READERS:
        assert list(damage.READERS[reader](file)) == case.whole, reader
    with file.open("rb") as stream:
        statistics = make_reader(stream).get_summary().statistics
    assert statistics.message_count == sum(statistics.channel_message_counts.values()) == len(case.whole)


@pytest.mark.parametrize("compression", [LZ4, ZSTD])
def test_mcap_1390_reading_goes_on_after_a_chunk_that_cannot_be_decompressed(tmp_path, compression):
    """`mcap recover` stopped at it: "failed to decompress chunk: unexpected EOF"."""
    whole = bytearray(mcap_bytes(messages(), compression=compression, enable_crcs=False))
    spans = damage.chunk_spans(bytes(whole))
    begin, end, first, last = spans[len(spans) // 2]
    whole[begin + 80 : end] = bytes(end - begin - 80)
    found, _ = read(tmp_path, bytes(whole[:-37]))
    assert [m for m in found if not first <= m[1] <= last] == [m for m in messages() if not first <= m[1] <= last]


def test_mcap_1220_a_truncated_file_whose_end_reads_as_a_giant_record_takes_no_memory(tmp_path):
    """The mcap library took the bytes before the end for the length of a footer: MemoryError."""
    whole = content(ZSTD)
    cut = whole[: len(whole) // 2]
    giant = cut + b"\x02" + struct.pack("<Q", 2**62) + bytes(20) + whole[-8:]
    expected, _ = read(tmp_path, cut)
    with limited_memory():
        found, notes = read(tmp_path, giant)
    assert found == expected and len(found) > 0
    assert len(notes) == 1


@pytest.mark.parametrize("claimed", [2**31, 2**33, 2**63 - 1, 2**64 - 1])
@pytest.mark.parametrize("place", ["header", "chunk", "records", "summary"])
def test_a_length_that_claims_gigabytes_takes_no_memory(tmp_path, claimed, place):
    whole = bytearray(content(ZSTD))
    first_chunk = whole.index(b"\x06", 30)
    at = {"header": 9, "chunk": first_chunk + 1, "records": first_chunk + 9 + 16, "summary": len(whole) - 28}[place]
    whole[at : at + 8] = struct.pack("<Q", claimed)
    with limited_memory(300):
        found, notes = read(tmp_path, bytes(whole))
    assert len(found) > 0.8 * len(messages())
    assert notes or len(found) == len(messages())  # a chunk says twice how long it is


@contextmanager
def limited_memory(megabytes: int = 1200):
    """Taking more than so much beyond what is taken now is a MemoryError; what is used here is far below."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + megabytes * 10**6, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def bomb(compression: CompressionType, claimed: int) -> bytes:
    """A file whose one chunk unpacks to 2.5 GB and claims another size; its index is sound."""
    packed = {ZSTD: zstd_zeros, LZ4: lz4_zeros}[compression](2_500_000_000)
    whole = mcap_bytes([("dvl/twist", 1, bytes(100_000))], compression=compression, chunk_size=10**8)
    begin, end, *_ = damage.chunk_spans(whole)[0]
    name = compression.name.lower().encode()
    head = struct.pack("<QQQII", 1, 1, claimed, 0, len(name)) + name + struct.pack("<Q", len(packed))
    chunk = struct.pack("<BQ", 6, len(head) + len(packed)) + head + packed
    summary = whole[end:].replace(struct.pack("<Q", end - begin), struct.pack("<Q", len(chunk)))
    data_end = summary.index(b"\x0f\x04" + bytes(7))
    moved = begin + len(chunk) + data_end + 13
    footer = b"\x02" + struct.pack("<QQQI", 20, moved, 0, 0) + whole[-8:]
    return whole[:begin] + chunk + summary[:-37] + footer


@cache
def zstd_zeros(size: int) -> bytes:
    compressor = zstd.ZstdCompressor()
    return b"".join([*(compressor.compress(bytes(10**7)) for _ in range(size // 10**7)), compressor.flush()])


@cache
def lz4_zeros(size: int) -> bytes:
    compressor = lz4.frame.LZ4FrameCompressor()
    begin = compressor.begin()
    return b"".join([begin, *(compressor.compress(bytes(10**7)) for _ in range(size // 10**7)), compressor.flush()])


@pytest.mark.spread(2)
@pytest.mark.parametrize("claimed", [1000, 2_500_000_000])
@pytest.mark.parametrize("compression", [LZ4, ZSTD])
def test_a_chunk_that_unpacks_to_gigabytes_takes_no_memory(tmp_path, compression, claimed):
    content = bomb(compression, claimed)
    with limited_memory():
        found, notes = read(tmp_path, content)
    assert found == [] and notes


@pytest.mark.parametrize("compression", [LZ4, ZSTD])
@pytest.mark.parametrize("content_of_chunk", ["as recorded", "damaged", "gigabytes"])
def test_a_footer_that_names_a_chunk_as_the_index_costs_no_message_and_no_memory(
    tmp_path, compression, content_of_chunk
):
    whole = bytearray(bomb(compression, 2_500_000_000) if content_of_chunk == "gigabytes" else content(compression))
    number = 0 if content_of_chunk == "gigabytes" else 2
    begin, end, *_ = damage.chunk_spans(content(compression))[number]
    whole[-28:-20] = struct.pack("<Q", begin)
    if content_of_chunk == "damaged":
        whole[end - 300 : end - 200] = bytes(100)
    with limited_memory():
        found, notes = read(tmp_path, bytes(whole))
    before, after = (chunks(compression)[at][1] for at in (number - 1, number))
    expected = {"as recorded": messages(), "damaged": messages()[:before] + messages()[after:], "gigabytes": ()}
    assert tuple(found) == expected[content_of_chunk]
    assert notes


def test_a_compressed_message_that_unpacks_to_gigabytes_is_left_out_and_told_of(tmp_path):
    good = messages()[:3]
    packed = [("dvl/twist", 5, zstd_zeros(2_500_000_000)), ("dvl/twist", 6, zstd.compress(b"x" * 99)[:-9])]
    (tmp_path / "bomb.mcap").write_bytes(mcap_bytes([*packed, *good]))
    with limited_memory():
        found, notes = raw_and_notes(tmp_path / "bomb.mcap")
    assert found == list(good)
    assert "2 compressed messages" in notes[0]


def test_a_compressed_file_that_unpacks_to_far_more_than_a_recording_does_not_fill_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "SMALL_FILE", 10**6)
    whole = content(NONE)
    (tmp_path / "bomb.mcap.zstd").write_bytes(zstd.compress(whole[:-37]) + zstd_zeros(200_000_000))
    found, notes = raw_and_notes(tmp_path / "bomb.mcap.zstd")
    assert tuple(found) == messages()
    assert "unpacks to more than" in notes[0]


@pytest.mark.parametrize("part", [0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99])
def test_a_truncated_sqlite_file_gives_what_is_whole_in_it_in_order(tmp_path, part):
    whole = storage_file(write_bag(tmp_path / "bag", run(20.0), "sqlite3")).read_bytes()
    found, notes = read(tmp_path, whole[: int(part * len(whole))], "cut.db3")
    remaining = iter(raw(tmp_path / "bag"))
    assert all(message in remaining for message in found)
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
    "ros1.bag": (lambda p: p.write_bytes(b"#ROSBAG V2.0\n"), "rosbag reindex"),
    "empty_folder": (lambda p: p.mkdir(), "no .mcap, .db3 or .bag file in it"),
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
        (["--dvl-topic", "imu/data"], "topic imu/data holds sensor_msgs/msg/Imu, expected geo"),
        (["--gnss-topic", "imu/data"], "set --gnss-topic"),
        (["--gnss-topic", "imu/data", "-p", "prior_source:=reference"], "set --gnss-topic"),
        (["--imu-topic", "gnss/twist"], "expected sensor_msgs/msg/Imu; set --imu-topic"),
        (["--gnss-topic", "dvl/twist"], "must be different topics"),
        (["--dvl-topic", "[/b]"], "no topic '[/b]'"),
        (["--gnss-topic", "gnss/twits"], "did you mean gnss/twist?"),
        (["--imu-topic", "/imu/dat"], "did you mean imu/data?"),
    ],
)
def test_a_topic_of_another_type_is_named_with_the_option_to_set(tmp_path, capsys, options, expected):
    bag = write_bag(tmp_path / "bag", run(6.0))
    assert main(["replay", str(bag), *options]) == 2
    output = capsys.readouterr()
    assert output.err.count("\n") == 1 and expected in output.err


def test_a_database_whose_journal_is_lost_gives_what_the_database_holds(tmp_path):
    file = storage_file(write_bag(tmp_path / "bag", run(6.0), "sqlite3"))
    expected = raw(file)
    with sqlite3.connect(file) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA wal_autocheckpoint=0")
        connection.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 5, x'00')")
        connection.commit()
        (tmp_path / "lost.db3").write_bytes(file.read_bytes())
    connection.close()
    assert raw(tmp_path / "lost.db3") == expected


@pytest.mark.parametrize("compression", [NONE, ZSTD])
@pytest.mark.parametrize("second", ["the same", "shorter", "of other channels", "cut off"])
def test_recordings_joined_by_cat_give_all_of_their_messages(tmp_path, compression, second):
    """`cat a.mcap b.mcap`: the index at the end knows the last one alone, in places that are another's."""
    options = {"compression": compression}
    last = list(messages())
    if second == "shorter":
        last = last[: len(last) // 3]
    elif second == "of other channels":
        last = [(topic, log_ns, data) for topic, log_ns, data in reversed(last)]
    joined = mcap_bytes(last, **options)
    whole = mcap_bytes(messages(), **options) + joined
    if second == "cut off":
        whole, last = whole[: -len(joined) // 2], None
    found, notes = read(tmp_path, whole)
    if last is None:
        assert len(found) > 1.2 * len(messages()) and set(found) == set(messages())
    else:
        assert sorted(found) == sorted([*messages(), *last])
    assert len(notes) == 1 and f"{len(found)} whole messages" in notes[0]


@pytest.mark.parametrize("kind", ["cut off", "0xff", "other bytes"])
@pytest.mark.parametrize("n", [5, 8, 600])
def test_a_file_whose_first_bytes_are_lost_gives_the_chunks_behind(tmp_path, kind, n):
    whole = content(ZSTD)
    begin = {"cut off": b"", "0xff": b"\xff" * n, "other bytes": b"x" * n}[kind]
    index = make_reader(BytesIO(whole)).get_summary().chunk_indexes
    lost_until_ns = max((chunk.message_end_time for chunk in index if chunk.chunk_start_offset < n), default=0)
    found, notes = read(tmp_path, begin + whole[n:])
    assert found == [message for message in messages() if message[1] > lost_until_ns]
    assert len(found) > 0.9 * len(messages())
    assert len(notes) == 1 and f"{len(found)} whole messages" in notes[0]


@pytest.mark.parametrize("place", ["hole", "tail"])
def test_zeros_are_passed_without_looking_at_each(tmp_path, place, monkeypatch):
    """Of a file that was grown before it was written, or lost blocks: gigabytes, passed as fast as they are read."""
    looked = 0
    begins = mcap_file.is_chunk

    def counted(*arguments):
        nonlocal looked
        looked += 1
        return begins(*arguments)

    monkeypatch.setattr(mcap_file, "is_chunk", counted)
    whole = content(ZSTD)
    end, count = chunks(ZSTD)[len(chunks(ZSTD)) // 2]
    zeros = bytes(4 << 20)
    data = whole[:end] + zeros + (whole[end:] if place == "hole" else b"")
    found, notes = read(tmp_path, data)
    assert found == list(messages() if place == "hole" else messages()[:count])
    assert looked < 1000 and len(notes) == 1


@pytest.mark.spread(1)
@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_salvage_writes_all_topics_with_their_definitions_and_calibrates_the_same(tmp_path, kind):
    bag = write_bag(tmp_path / "bag", run(20.0), compression="chunk")
    file = storage_file(bag)
    os.truncate(file, file.stat().st_size * 2 // 3)
    assert main(["salvage", str(bag), "-o", str(tmp_path / "new"), "--storage", kind]) == 0
    assert raw(tmp_path / "new") == raw(bag)
    assert estimates(tmp_path / "new") == estimates(bag)


def test_salvage_refuses_an_existing_bag_and_leaves_none_behind_that_is_empty(tmp_path, capsys):
    (tmp_path / "nothing.mcap").write_bytes(content()[:20])
    assert main(["salvage", str(tmp_path / "nothing.mcap"), "-o", str(tmp_path / "new")]) == 2
    assert not (tmp_path / "new").exists()
    assert main(["salvage", str(write_bag(tmp_path / "bag", run(6.0))), "-o", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
