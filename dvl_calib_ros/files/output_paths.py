"""Check that no output of a command is also its input or another output."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

from ..disk.atomic import backups_of, own_stream
from ..errors import InputError

# files that SQLite keeps next to a recording
_SQLITE_SUFFIXES = ("-wal", "-shm", "-journal")
_RECORDED = (".mcap", ".db3", ".bag", ".mcap.zstd", ".db3.zstd")


def check_outputs(files: Mapping[str, Path], inputs: Iterable[Path], folders: Mapping[str, Path] | None = None) -> None:
    """Raise InputError if an output, or its backup, is an input or another output.

    Links and multiple mounts of a folder are resolved. An output must not lie in an input folder; a new folder may, if
    the input folder is no recording.

    Parameters
    ----------
    files: Option -> file to write.
    inputs: Files and folders that are read.
    folders: Option -> folder to create.
    """
    written = {option: _Written(path) for option, path in files.items()}
    written |= {option: _Written(path, is_folder=True) for option, path in (folders or {}).items()}
    for option, output in written.items():
        for path in inputs:
            if output.hits(path):
                raise InputError(f"{option} {output.path}: would write over the input {path}, or into it; name another")
    for (one, a), (other, b) in combinations(written.items(), 2):
        if a.meets(b):
            raise InputError(f"{one} and {other}: both write {b.path} or its backup; give each a name of its own")


def check_report_name(path: Path, *further: str) -> None:
    """Raise InputError for a report whose name ends as another kind of file. further: endings other than .html."""
    kinds = (".html", *further)
    if path.suffix and path.suffix.lower() not in (".htm", *kinds):
        raise InputError(f"{path}: a report is a page (HTML); give a name that ends in {' or '.join(kinds)}")


@dataclass(frozen=True)
class _Written:
    """An output, and the other paths that change with it."""

    path: Path
    is_folder: bool = False

    @cached_property
    def places(self) -> list[str]:
        """Full paths without links, the output itself first."""
        stream = own_stream(self.path)
        if stream is not None:
            return [f"/proc/self/fd/{stream}"] if stream >= 0 else []
        backups = [] if self.is_folder else map(os.fspath, backups_of(self.path))
        return [os.path.realpath(self.path), *backups]

    @cached_property
    def files(self) -> set[_Identity]:
        """Identities of the existing files at these paths."""
        return {identity for place in self.places if (identity := _identity(place)) is not None}

    def hits(self, path: Path) -> bool:
        """Return whether this output would change an input."""
        real = os.path.realpath(path)
        read = {os.path.realpath(f"{name}{end}") for name in (path, real) for end in ("", *_SQLITE_SUFFIXES)}
        if not {_entry(name) for name in read}.isdisjoint(map(_entry, self.places)):
            return True
        if self.files and not self.files.isdisjoint(_identities(read)):
            return True
        return os.path.isdir(real) and any(self._is_in(place, real) for place in self.places[:1])

    def _is_in(self, place: str, folder: str) -> bool:
        if _identity(folder) not in set(map(_identity, Path(place).parents)):
            return False
        return not self.is_folder or os.path.lexists(place) or _is_recording(folder)

    def meets(self, other: _Written) -> bool:
        """Return whether both would change one file, or one is inside the other.

        Many file systems do not distinguish upper and lower case, or two forms of an accented letter.
        """
        mine, others = ([_entry(_folded(path)) for path in written.places] for written in (self, other))
        if not set(mine).isdisjoint(others) or not self.files.isdisjoint(other.files):
            return True
        if not mine or not others:
            return False
        above_mine, above_others = (
            {_entry(_folded(str(above))) for above in Path(one.places[0]).parents} for one in (self, other)
        )
        return mine[0] in above_others or others[0] in above_mine


_Identity = tuple[int, int]


def _entry(path: str) -> tuple[_Identity | str, str]:
    """Identify a name by its folder's identity, because a folder can be mounted at several paths."""
    folder, name = os.path.split(path)
    return _identity(folder) or folder, name


def _folded(path: str) -> str:
    folder, name = os.path.split(path)
    return os.path.join(folder, unicodedata.normalize("NFC", name).casefold())


def _identity(path: str | Path) -> _Identity | None:
    """Return device and inode of a path; None if it does not exist."""
    with suppress(OSError, ValueError):
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


def _identities(paths: Iterable[str]) -> Iterator[_Identity]:
    """Yield the identities of files, and of folders with everything in them; links to folders are not followed."""
    for path in paths:
        inside = (os.path.join(folder, name) for folder, _, names in os.walk(path) for name in names)
        for each in (path, *inside):
            identity = _identity(each)
            if identity is not None:
                yield identity


def _is_recording(folder: str) -> bool:
    with suppress(OSError):
        return any(name == "metadata.yaml" or name.endswith(_RECORDED) for name in os.listdir(folder))
    return True
