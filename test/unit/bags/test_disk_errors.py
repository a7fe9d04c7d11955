"""A disk that cannot read some of a recording costs what lies there, and no more; how much is said."""

from __future__ import annotations

import errno
import os
import re
import sqlite3
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import searched
from damage import PAGE, chunk_spans
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from io_fixtures import mcap_bytes, raw, raw_and_notes, run, storage_file, write_bag
from mcap.reader import make_reader
from mcap.writer import CompressionType

from dvl_calib_ros.bags import sources
from dvl_calib_ros.bags.files import SECTOR, holes_in, open_raw, unreadable
from dvl_calib_ros.bags.sources import Database
from dvl_calib_ros.cli.main import main

PREAD = os.pread
NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD


class Disk:
    """os.pread and os.preadv with failures.

    bad: sectors that fail for ever. failing: numbers of the calls that fail once.
    """

    def __init__(self, bad=(), failing=()) -> None:
        self.bad, self.failing, self.calls = set(bad), set(failing), 0

    def pread(self, descriptor: int, size: int, at: int) -> bytes:
        self.calls += 1
        sectors = range(at // SECTOR, (at + max(size, 1) - 1) // SECTOR + 1)
        if self.calls in self.failing or any(sector in self.bad for sector in sectors):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return PREAD(descriptor, size, at)

    def preadv(self, descriptor: int, buffers: list, at: int) -> int:
        data = self.pread(descriptor, len(buffers[0]), at)
        buffers[0][: len(data)] = data
        return len(data)


@contextmanager
def failing(**failures):
    disk = Disk(**failures)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "pread", disk.pread)
        patch.setattr(os, "preadv", disk.preadv)
        # SQLite reads for itself: of a disk with a bad sector it gives up, as rosbags does
        if disk.bad:
            patch.setattr(sources, "Database", BadDatabase)
        yield disk


class BadDatabase(Database):
    """A database on a disk that fails after some rows."""

    rows_before = 0

    def __init__(self, path: Path) -> None:
        if not self.rows_before:
            raise sqlite3.OperationalError("disk I/O error")
        super().__init__(path)

    def batches(self, topics):
        left = self.rows_before
        for batch in super().batches(topics):
            yield batch.part(slice(left))
            left -= batch.size
            if left < 0:
                raise sqlite3.OperationalError("disk I/O error")


@pytest.fixture(scope="module")
def messages():
    with tempfile.TemporaryDirectory() as folder:
        recorded = raw(write_bag(Path(folder) / "bag", run(20.0)))
    return [(topic, log_ns + i, data) for i, (topic, log_ns, data) in enumerate(recorded)]


def whole_without(content: bytes, messages, sector: int):
    """Messages of an uncompressed file of which no byte lies in a sector."""
    start, end = sector * SECTOR, (sector + 1) * SECTOR
    left = []
    for message in messages:
        at = content.index(message[2])
        if at + len(message[2]) <= start or at - 31 >= end:  # 31 bytes: the head of its record
            left.append(message)
    return left


KINDS = {
    "without chunks": {"use_chunking": False},
    "small chunks": {"chunk_size": 3000},
    "large chunks": {"chunk_size": 40_000},
    "without checksums": {"chunk_size": 40_000, "enable_crcs": False},
}


@pytest.mark.spread(2)
@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_behind_an_unreadable_sector_anywhere_in_a_file_reading_goes_on(tmp_path, messages, options):
    content = mcap_bytes(messages, **options)
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    n_sectors = -(-len(content) // SECTOR)
    for sector in range(0, n_sectors, max(1, n_sectors // 12)):
        with failing(bad=[sector]):
            found, notes = raw_and_notes(path)
        # the first sector introduces channels, the last ones hold the index that knows them as well
        assert found == whole_without(content, messages, sector), sector
        if len(found) < len(messages):
            (note,) = notes
            assert "cannot be read from the disk" in note and "bytes skipped" in note
            assert f"{len(found)} whole messages" in note


@pytest.mark.parametrize("compression", [LZ4, ZSTD])
def test_an_unreadable_sector_costs_of_compressed_chunks_those_that_it_is_in(tmp_path, messages, compression):
    content = mcap_bytes(messages, compression=compression, chunk_size=20_000)
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    for sector in range(0, -(-len(content) // SECTOR), 2):
        start, end = sector * SECTOR, (sector + 1) * SECTOR
        hit = [(first, last) for begin, stop, first, last in chunk_spans(content) if begin < end and start < stop]
        with failing(bad=[sector]):
            found, notes = raw_and_notes(path)
        assert set(found) <= set(messages)
        whole = [message for message in messages if not any(first <= message[1] <= last for first, last in hit)]
        assert set(whole) <= set(found)
        assert found == sorted(found, key=lambda message: message[1])
        assert notes or len(found) == len(messages)


@pytest.mark.parametrize("rows_before", [0, 100])
def test_an_unreadable_sector_costs_of_a_database_its_rows_and_no_others(tmp_path, messages, monkeypatch, rows_before):
    monkeypatch.setattr(BadDatabase, "rows_before", rows_before)
    file = storage_file(write_bag(tmp_path / "bag", run(20.0), "sqlite3"))
    content, recorded = file.read_bytes(), raw(file)
    assert PAGE == SECTOR
    with sqlite3.connect(file) as connection:
        ((tables,), *_) = connection.execute("SELECT max(rootpage) FROM sqlite_master WHERE name = 'topics'")
    connection.close()
    for sector in range(1, len(content) // PAGE, 9):
        page = content[sector * PAGE : (sector + 1) * PAGE]
        if sector + 1 == tables:
            continue
        with failing(bad=[sector]):
            found, notes = raw_and_notes(file)
        lost = [message for message in recorded if message not in found]
        assert all(data in page for _, _, data in lost)  # small messages lie in one page
        assert len(found) + len(lost) == len(recorded)
        assert len(notes) == 1
        if lost:  # what SQLite had read before lies there as well
            assert "1 pages cannot be read from the disk" in notes[0]
            told = re.search(r"(\d+) messages lie on damaged pages", notes[0])
            # nobody knows of the last ones how many they were
            assert int(told[1]) >= len(lost) if told else lost[-1] == recorded[-1]


@pytest.mark.parametrize("kind", ["mcap", "mcap zstd", "mcap without index", "mcap in a file of zstd", "sqlite3 cut"])
def test_a_read_that_fails_once_at_whichever_call_costs_nothing(tmp_path, messages, kind):
    if kind == "sqlite3 cut":
        file = storage_file(write_bag(tmp_path / "bag", run(6.0), "sqlite3"))
        os.truncate(file, file.stat().st_size * 2 // 3)
    elif kind == "mcap in a file of zstd":
        file = storage_file(write_bag(tmp_path / "bag", run(20.0), "mcap", "file"))
    else:
        content = mcap_bytes(messages, compression=ZSTD if "zstd" in kind else NONE, chunk_size=10_000)
        file = tmp_path / "bag.mcap"
        file.write_bytes(content[:-37] if "without" in kind else content)
    with failing() as disk:
        expected = raw_and_notes(file)
    assert expected[0] and disk.calls > 2
    for number in range(1, disk.calls + 1):
        with failing(failing=[number]):
            assert raw_and_notes(file) == expected, number


@searched(25, HealthCheck.function_scoped_fixture)
@given(bad=st.sets(st.integers(0, 40), max_size=12), compression=st.sampled_from([NONE, LZ4, ZSTD]), data=st.data())
def test_any_unreadable_sectors_never_give_a_message_that_was_not_recorded(tmp_path, messages, bad, compression, data):
    options = data.draw(st.sampled_from(list(KINDS.values())))
    content = mcap_bytes(messages, compression=compression, **options)
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    bad = {sector % (len(content) // SECTOR) for sector in bad}
    with failing(bad=bad):
        try:
            found, notes = raw_and_notes(path)
        except Exception as error:
            found, notes = [], [str(error)]
            assert "no whole message" in str(error)
    assert set(found) <= set(messages)
    assert len(found) == len(messages) or notes


def test_what_is_told_of_unreadable_bytes_is_exact(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(range(256)) * 64)
    with failing(bad=[1, 2]), open_raw(path) as file:
        content = file.read()
        whole = path.read_bytes()
        assert content == whole[:SECTOR] + bytes(2 * SECTOR) + whole[3 * SECTOR :]
        assert holes_in(file, 0, 10**6) == [(SECTOR, 3 * SECTOR)]
        assert holes_in(file, 0, SECTOR + 5) == [(SECTOR, SECTOR + 5)] and not holes_in(file, 0, SECTOR)
        assert unreadable(file) == 2 * SECTOR


@pytest.mark.parametrize(
    ("calls", "error"),
    [(("pread", "preadv"), (errno.ESTALE, "Stale file handle")), (("open",), (errno.EACCES, "Permission denied"))],
)
def test_other_errors_of_a_disk_than_unreadable_places_are_told_in_one_line(
    tmp_path, capsys, monkeypatch, calls, error
):
    bag = write_bag(tmp_path / "bag", run(6.0))

    def fails(*_):
        raise OSError(*error)

    for call in calls:
        monkeypatch.setattr(os, call, fails)
    assert main(["replay", str(bag)]) == 2
    said = capsys.readouterr().err
    assert error[1] in said and said.count("\n") == 1


def test_salvage_from_a_bad_disk_writes_what_can_be_read(tmp_path, messages, capsys):
    content = mcap_bytes(messages, chunk_size=20_000)
    (tmp_path / "bad.mcap").write_bytes(content)
    with failing(bad=[7]):
        assert main(["salvage", str(tmp_path / "bad.mcap"), "-o", str(tmp_path / "new")]) == 0
    assert "cannot be read from the disk" in capsys.readouterr().err
    new = storage_file(tmp_path / "new")
    assert raw(new) == whole_without(content, messages, 7)
    with new.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == len(raw(new))
