"""Files of recordings: the files of a folder, decompression, and the journal left by a dead recorder."""

from __future__ import annotations

import errno
import io
import os
import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path, PurePath
from typing import Any

from ..disk.text_files import load_yaml
from ..errors import InputError

# bytes that the system reads at a time, so the smallest loss by one bad sector
SECTOR = 4096
# heads of records are read individually
_BUFFER = 1 << 16

Hole = tuple[int, int]
"""First unreadable byte and the one after the last."""


class _RawFile(io.RawIOBase):
    """Raw file that has zeros for unreadable bytes; `holes` lists them, in order, as far as read."""

    def __init__(self, path: Path) -> None:
        self.holes: list[Hole] = []
        self._at = 0
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position. Raises OSError for one before the start."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: os.fstat(self._descriptor).st_size}[whence]
        if start + offset < 0:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self._at = start + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the present position, with zeros in unreadable places. Return the count."""
        try:
            count = os.preadv(self._descriptor, [buffer], self._at)
        except OSError:  # read in pieces, and note the holes
            data = self._read(len(buffer), self._at)
            count = len(data)
            buffer[:count] = data
        self._at += count
        return count

    def close(self) -> None:
        if not self.closed:
            os.close(self._descriptor)
        super().close()

    def _read(self, size: int, at: int) -> bytes:
        """Read bytes; after an error read halves, so that a bad sector costs no more than itself."""
        data = self._read_once(size, at)
        if data is not None:
            return data
        size = min(size, os.fstat(self._descriptor).st_size - at)
        next_sector = (at // SECTOR + 1) * SECTOR
        if at + size <= next_sector:
            data = self._read_once(size, at)  # a single failure may be transient
            if data is None:
                self._note(at, at + size)
                return bytes(size)
            return data
        middle = max((at + size // 2) // SECTOR * SECTOR, next_sector)
        return self._read(middle - at, at) + self._read(at + size - middle, middle)

    def _read_once(self, size: int, at: int) -> bytes | None:
        """Read once; None if the disk cannot read it."""
        try:
            return os.pread(self._descriptor, size, at)
        except OSError as error:
            if at >= os.fstat(self._descriptor).st_size:  # a damaged index has positions beyond the end of any file
                return b""
            if error.errno != errno.EIO:
                raise
            return None

    def _note(self, start: int, end: int) -> None:
        """Note an unreadable range, joined with those that it touches."""
        touching = [hole for hole in self.holes if hole[0] <= end and start <= hole[1]]
        self.holes = sorted(
            [hole for hole in self.holes if hole not in touching]
            + [(min([start, *(hole[0] for hole in touching)]), max([end, *(hole[1] for hole in touching)]))]
        )


def open_raw(path: Path) -> io.BufferedReader:
    """Open a file for reading past unreadable places, listed by `holes_in`. Raises OSError."""
    return io.BufferedReader(_RawFile(path), _BUFFER)


def holes_in(file: Any, start: int, end: int) -> list[Hole]:
    """Return the unreadable parts between two positions of an open file that was read."""
    holes: list[Hole] = getattr(getattr(file, "raw", None), "holes", [])
    return [(max(first, start), min(last, end)) for first, last in holes if first < end and start < last]


def unreadable(file: Any) -> int:
    """Return the number of unreadable bytes of an open file so far."""
    holes: list[Hole] = getattr(getattr(file, "raw", None), "holes", [])
    return sum(last - first for first, last in holes)


# the other modules of this room import it from here
if sys.version_info >= (3, 14):
    from compression import zstd as zstd
else:
    from backports import zstd as zstd

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
STORAGE_SUFFIXES = (".mcap", ".db3", ".bag")


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag's, by its name only: a folder, or a file of a bag."""
    return path.is_dir() or path.suffix in STORAGE_SUFFIXES


# a compressed file that unpacks to more than this size and this multiple of its own is no recording
LARGEST_RATIO, SMALL_FILE = 100, 1 << 30

NewFolder = Callable[[], Path]
"""Creates a temporary folder, which lasts as long as its reader."""


def storage_suffix(path: Path) -> str:
    """Return the suffix of the storage format, also of a compressed file."""
    return Path(path.stem).suffix if path.suffix == ".zstd" else path.suffix


def files_of(folder: Path, notes: list[str]) -> list[Path]:
    """Return the recordings in a folder: those in its metadata.yaml, or all if that is missing or damaged."""
    files = sorted((file for file in folder.iterdir() if storage_suffix(file) in STORAGE_SUFFIXES), key=_natural_order)
    if not files:
        raise InputError(f"{folder}: no bag, there is no .mcap, .db3 or .bag file in it")
    if all(storage_suffix(file) == ".bag" for file in files):  # ROS 1 has no list
        return files
    listed = _files_in_metadata(folder, notes)
    if not listed:
        return files
    chosen = [file for file in files if file.name in listed or file.name.removesuffix(".zstd") in listed]
    names = {file.name.removesuffix(".zstd") for file in chosen}
    for name in listed:
        if name.removesuffix(".zstd") not in names:
            notes.append(f"{folder}: {name} is missing, which metadata.yaml lists; the rest is read")
    if not chosen:
        return files
    for file in files:
        if file not in chosen:
            notes.append(f"{file}: not read, metadata.yaml does not list it; name the file to read it")
    return chosen


def _files_in_metadata(folder: Path, notes: list[str]) -> list[str]:
    """Return the file names in metadata.yaml; none, with a note, if it is unusable."""
    try:
        metadata = load_yaml(folder / "metadata.yaml", "metadata file")
        return [PurePath(name).name for name in metadata["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (InputError, KeyError, TypeError):
        notes.append(f"{folder}: no usable metadata.yaml (recording cut off?); all its files are read")
        return []


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Return the sort key that puts bag_2 before bag_10."""
    parts = "".join(c if c.isdecimal() else f" {c} " for c in path.name).split()
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def decompressed(path: Path, new_folder: NewFolder, notes: list[str]) -> Path:
    """Decompress the readable part of a file."""
    target = new_folder() / (path.stem if path.suffix == ".zstd" else path.name)
    max_size = max(SMALL_FILE, LARGEST_RATIO * path.stat().st_size)
    try:
        with open_raw(path) as raw, zstd.open(raw, "rb") as packed, target.open("wb") as unpacked:
            # in small pieces: data before the damage must be written before the damage raises
            while piece := packed.read1():
                unpacked.write(piece)
                if unpacked.tell() > max_size:
                    raise EOFError(f"it unpacks to more than {max_size} bytes")
    except (zstd.ZstdError, EOFError) as error:
        notes.append(f"{path}: damaged ({error}); what could be unpacked is used")
    return target


def with_journal(path: Path, new_folder: NewFolder, notes: list[str]) -> Path:
    """Copy a dead recorder's database with its journal and return the copy; return `path` without a journal.

    SQLite writes the journal of a link next to the link's target, unless the journal is linked as well.
    """
    journals = {suffix: _journal(path, suffix) for suffix in ("-wal", "-journal")}
    if not any(journals.values()):
        return path
    folder = new_folder()
    copy = folder / path.name
    try:
        shutil.copyfile(path, copy)
        for suffix, journal in journals.items():
            if journal is not None:
                shutil.copyfile(journal, folder / f"{path.name}{suffix}")
        with closing(sqlite3.connect(copy)) as connection:
            connection.execute("PRAGMA journal_mode=DELETE").fetchall()
    except (sqlite3.Error, OSError) as error:
        notes.append(f"{path}: its journal is damaged ({error}) and not used")
        return path
    return copy


def _journal(path: Path, suffix: str) -> Path | None:
    """Return the non-empty journal of an SQLite file; None without one."""
    for database in (path, path.resolve()):
        journal = database.with_name(f"{database.name}{suffix}")
        if journal.is_file() and journal.stat().st_size:
            return journal
    return None
