"""Search for recordings below folders and object stores: their files and vehicles.

A recording is an input of `replay`: a folder with metadata.yaml, a folder whose files have its own name and numbers,
else each single .mcap, .db3, .bag. Object stores are read by fsspec; their files are copied while they are read.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ..bags.files import STORAGE_SUFFIXES, storage_suffix
from ..errors import InputError

METADATA = "metadata.yaml"
# next to a database whose recorder died
_JOURNALS = ("-wal", "-journal")
# fields by which object stores distinguish versions of a file; the first existing one is used
_VERSIONS = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated", "created")


@dataclass(frozen=True)
class StoredFile:
    """A file of a recording. where: absolute path, or URL. stamp: changes with its content (mtime, etag)."""

    where: str
    size: int
    stamp: str


@dataclass(frozen=True)
class StoredRecording:
    """A recording below a place.

    where: absolute path or URL of the folder or the one file. inside: path below the place.
    """

    where: str
    inside: str
    place: str
    files: tuple[StoredFile, ...]

    @property
    def name(self) -> str:
        """`where` as printable text."""
        return as_text(self.where)

    @property
    def is_remote(self) -> bool:
        """Whether it must be copied for reading."""
        return "://" in self.where

    def vehicle(self, pattern: re.Pattern[str] | None) -> str:
        """Return its vehicle: the pattern's match in its path, else the first folder below the place, or the place."""
        if pattern is not None:
            found = pattern.search(self.name)
            if found is None:
                return "unknown"
            return next((group for group in found.groups() if group), found[0])
        folders = PurePosixPath(self.inside).parts
        return as_text(folders[0] if len(folders) > 1 else PurePosixPath(self.place).name or self.place)

    @contextmanager
    def at_hand(self) -> Iterator[Path]:
        """Yield a local path of the recording."""
        if not self.is_remote:
            if not os.path.exists(self.where):  # missing on another worker's machine; the recording itself has no fault
                raise FileNotFoundError(f"{self.where} is not there on {os.uname().nodename}")
            yield Path(self.where)
            return
        with tempfile.TemporaryDirectory(prefix="dvl_calib_fleet_") as folder:
            store = _store(self.where)[0]
            target = Path(folder) / PurePosixPath(self.where).name
            is_folder = [each.where for each in self.files] != [self.where]
            if is_folder:
                target.mkdir()
            for each in self.files:
                store.get_file(each.where, str(target / PurePosixPath(each.where).name if is_folder else target))
            yield target


def as_text(name: str) -> str:
    """Return a file name with invalid UTF-8 as escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def vehicle_pattern(text: str | None) -> re.Pattern[str] | None:
    """Compile ``--vehicle-from``. Raises InputError for an invalid regular expression."""
    if not text:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise InputError(
            f"--vehicle-from: {text!r} is no regular expression ({error}); such as '/(auv\\d+)/', or leave it out"
        ) from error


def recordings_in(places: Sequence[str]) -> tuple[list[StoredRecording], list[str]]:
    """Return all recordings below places, each once, in order of their paths; and notes on unreadable files.

    places: folders, files or URLs. Raises InputError for an invalid place, and if there is no recording.
    """
    found: dict[str, StoredRecording] = {}
    unread: list[str] = []
    for place in places:
        files = _local_files(place, unread) if "://" not in place or place.startswith("file://") else _stored(place)
        for each in _grouped(*files):
            found.setdefault(each.where, each)
    if not found:
        raise InputError(f"{', '.join(places)}: no recording (.mcap, .db3, .bag) there or below; name another place")
    return [found[where] for where in sorted(found)], unread


def _is_of_a_recording(name: str) -> bool:
    plain = next((name.removesuffix(end) for end in _JOURNALS if name.endswith(end)), name)
    return name == METADATA or storage_suffix(Path(plain)) in STORAGE_SUFFIXES


# a place, and its files by their folders
_Files = tuple[str, dict[str, list[StoredFile]]]


def _local_files(place: str, unread: list[str]) -> _Files:
    root = os.path.abspath(place.removeprefix("file://"))
    if os.path.isfile(root):
        folder, name = os.path.split(root)
        return folder, {folder: [_local_file(root)] if _is_of_a_recording(name) else []}
    if not os.path.isdir(root):
        raise InputError(f"{place}: no such folder or file; name where recordings are")
    files: dict[str, list[StoredFile]] = {}
    seen = set()
    for folder, folders, names in os.walk(
        root,
        followlinks=True,
        onerror=lambda error: unread.append(f"{error.filename}: {error.strerror}; not looked into"),
    ):
        real = os.path.realpath(folder)
        if real in seen:  # a circular link
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        own = [name for name in sorted(names) if _is_of_a_recording(name) and not name.startswith(".")]
        for name in own:
            try:
                files.setdefault(folder, []).append(_local_file(os.path.join(folder, name)))
            except OSError as error:  # a dangling link
                unread.append(f"{os.path.join(folder, name)}: {error.strerror}; not read")
    return root, files


def _local_file(path: str) -> StoredFile:
    told = os.stat(path)
    if not stat.S_ISREG(told.st_mode):
        raise OSError(errno.EINVAL, "is no file")  # a pipe would block
    return StoredFile(path, told.st_size, str(told.st_mtime_ns))


def _stored(place: str) -> _Files:
    store, root = _store(place)
    try:
        found: Mapping[str, Mapping[str, Any]] = store.find(root, detail=True)
    except Exception as error:  # each store has its own errors
        raise InputError(
            f"{place}: cannot be listed ({type(error).__name__}: {error}); see to address and access"
        ) from error
    files: dict[str, list[StoredFile]] = {}
    for path, told in sorted(found.items()):
        where = store.unstrip_protocol(path)
        folder, _, name = where.rpartition("/")
        if _is_of_a_recording(name) and not name.startswith("."):
            stamp = next((str(told[key]) for key in _VERSIONS if told.get(key) is not None), "")
            files.setdefault(folder, []).append(StoredFile(where, int(told.get("size") or 0), stamp))
    is_file = list(found) == [root]
    place = store.unstrip_protocol(root)
    return place.rpartition("/")[0] if is_file else place.rstrip("/"), files


def _store(place: str) -> tuple[Any, str]:
    """Return the store of a URL, and the path in it. Raises InputError."""
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise InputError(f"{place}: object stores need fsspec ({error}); pip install 'dvl_calib_ros[fleet]'") from error
    try:
        store, root = url_to_fs(place)
    except (ImportError, ValueError) as error:  # fsspec's message names the missing package
        raise InputError(f"{place}: {error}") from error
    return store, root


def _grouped(place: str, folders: Mapping[str, Sequence[StoredFile]]) -> Iterator[StoredRecording]:
    bags: list[str] = []
    for folder, files in sorted(folders.items()):
        if any(folder.startswith(f"{bag}/") for bag in bags[-1:]):
            continue  # a folder inside a bag is part of it
        storage = [each for each in files if storage_suffix(Path(each.where)) in STORAGE_SUFFIXES]
        if not storage:
            continue
        inside = folder[len(place) :].strip("/")
        if _is_bag(folder, files, storage):
            bags.append(folder)
            yield StoredRecording(folder, inside, place, tuple(files))
            continue
        for each in storage:
            name = each.where.rpartition("/")[2]
            own = [file for file in files if file.where in (each.where, *(each.where + end for end in _JOURNALS))]
            yield StoredRecording(each.where, f"{inside}/{name}".strip("/"), place, tuple(own))


def _is_bag(folder: str, files: Sequence[StoredFile], storage: Sequence[StoredFile]) -> bool:
    if any(each.where.endswith(f"/{METADATA}") for each in files):
        return True
    own = re.compile(re.escape(folder.rpartition("/")[2]) + r"_\d+\.")  # rosbag2's numbering of files
    return all(own.match(each.where.rpartition("/")[2]) for each in storage)
