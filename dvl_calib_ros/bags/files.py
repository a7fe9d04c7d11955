"""The files of recordings: which of a folder belong to it, unpacked, with the journal that a dead recorder left."""

from __future__ import annotations

import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path, PurePath

from ..disk.yaml_files import load_yaml
from ..errors import InputError
from .raw_file import open_raw

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
STORAGE_SUFFIXES = (".mcap", ".db3", ".bag")


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag, by its name alone: a folder, or a file of one."""
    return path.is_dir() or path.suffix in STORAGE_SUFFIXES


# A compressed file that unpacks to more than this and so many times its size is no recording.
LARGEST_RATIO, SMALL_FILE = 100, 1 << 30

NewFolder = Callable[[], Path]
"""Makes a temporary folder, which lasts as long as its reader."""


def storage_suffix(path: Path) -> str:
    """The suffix that says in which storage a file is, compressed or not."""
    return Path(path.stem).suffix if path.suffix == ".zstd" else path.suffix


def files_of(folder: Path, notes: list[str]) -> list[Path]:
    """The recordings in a folder: those that its metadata.yaml lists, or all if that is missing or damaged."""
    files = sorted((file for file in folder.iterdir() if storage_suffix(file) in STORAGE_SUFFIXES), key=_natural_order)
    if not files:
        raise InputError(f"{folder}: no bag, there is no .mcap, .db3 or .bag file in it")
    if all(storage_suffix(file) == ".bag" for file in files):  # ROS 1 lists nothing
        return files
    listed = _listed(folder, notes)
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


def _listed(folder: Path, notes: list[str]) -> list[str]:
    """Names of the files that metadata.yaml lists; none, with a note, if there is nothing to go by."""
    try:
        metadata = load_yaml(folder / "metadata.yaml", "metadata file")
        return [PurePath(name).name for name in metadata["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (InputError, KeyError, TypeError):
        notes.append(f"{folder}: no usable metadata.yaml (recording cut off?); all its files are read")
        return []


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """bag_2 before bag_10."""
    parts = "".join(c if c.isdecimal() else f" {c} " for c in path.name).split()
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def decompressed(path: Path, new_folder: NewFolder, notes: list[str]) -> Path:
    """A compressed file, unpacked as far as that goes."""
    target = new_folder() / (path.stem if path.suffix == ".zstd" else path.name)
    most = max(SMALL_FILE, LARGEST_RATIO * path.stat().st_size)
    try:
        with open_raw(path) as raw, zstd.open(raw, "rb") as packed, target.open("wb") as unpacked:
            while piece := packed.read1():  # as it comes: what precedes damage must be out before the damage
                unpacked.write(piece)
                if unpacked.tell() > most:
                    raise EOFError(f"it unpacks to more than {most} bytes")
    except (zstd.ZstdError, EOFError) as error:
        notes.append(f"{path}: damaged ({error}); what could be unpacked is used")
    return target


def with_journal(path: Path, new_folder: NewFolder, notes: list[str]) -> Path:
    """A database whose recorder died, with what lies in the journal beside it; `path` itself if there is none.

    The journal of a link lies where the link leads, which is where SQLite wrote it, unless it is linked as well.
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
    for beside in (path, path.resolve()):
        journal = beside.with_name(f"{beside.name}{suffix}")
        if journal.is_file() and journal.stat().st_size:
            return journal
    return None
