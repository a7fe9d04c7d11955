"""What is written is neither read by the same command nor written twice, whatever it is called."""

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

# What SQLite keeps beside a recording, and reads with it
_BESIDE = ("-wal", "-shm", "-journal")
_RECORDED = (".mcap", ".db3", ".bag", ".mcap.zstd", ".db3.zstd")


def check_outputs(files: Mapping[str, Path], inputs: Iterable[Path], folders: Mapping[str, Path] | None = None) -> None:
    """Raise InputError if an output, or the backup of what it replaces, is an input or another output.

    Links of every kind are seen through, and folders that are mounted in two places. Nor may an output lie in a folder
    that is read; a new folder may, in one that is no recording.

    Parameters
    ----------
    files: Option -> file that is written.
    inputs: Files and folders that are read.
    folders: Option -> folder that is made.

    """
    written = {option: _Written(path) for option, path in files.items()}
    written |= {option: _Written(path, is_folder=True) for option, path in (folders or {}).items()}
    for option, output in written.items():
        for path in inputs:
            if output.hits(path):
                raise InputError(f"{option} {output.path}: would write over the input {path}, or into it; name another")
    for (one, a), (other, b) in combinations(written.items(), 2):
        if a.meets(b):
            raise InputError(f"{one} and {other}: both name {b.path}, or its backup; give them names of their own")


@dataclass(frozen=True)
class _Written:
    """An output, and the places that change with it."""

    path: Path
    is_folder: bool = False

    @cached_property
    def places(self) -> list[str]:
        """Full paths without links, of the output itself first."""
        stream = own_stream(self.path)
        if stream is not None:
            return [f"/proc/self/fd/{stream}"] if stream >= 0 else []
        backups = [] if self.is_folder else map(os.fspath, backups_of(self.path))
        return [os.path.realpath(self.path), *backups]

    @cached_property
    def files(self) -> set[_Identity]:
        """Identities of what is in these places now."""
        return {identity for place in self.places if (identity := _identity(place)) is not None}

    def hits(self, path: Path) -> bool:
        """Whether an input would be changed."""
        real = os.path.realpath(path)
        read = {os.path.realpath(f"{name}{end}") for name in (path, real) for end in ("", *_BESIDE)}
        if not {_slot(name) for name in read}.isdisjoint(map(_slot, self.places)):
            return True
        if self.files and not self.files.isdisjoint(_identities(read)):
            return True
        return os.path.isdir(real) and any(self._is_in(place, real) for place in self.places[:1])

    def _is_in(self, place: str, folder: str) -> bool:
        if _identity(folder) not in {_identity(above) for above in _above(place)}:
            return False
        return not self.is_folder or os.path.lexists(place) or _is_recording(folder)

    def meets(self, other: _Written) -> bool:
        """Whether both would change one file, or one be in the other.

        Names that differ in case only are one to many file systems, and so are two forms of an accented letter.
        """
        mine, others = ([_slot(_folded(place)) for place in each.places] for each in (self, other))
        if not set(mine).isdisjoint(others) or not self.files.isdisjoint(other.files):
            return True
        below = [{_slot(_folded(above)) for above in _above(each.places[0])} for each in (self, other) if each.places]
        return len(below) == 2 and (mine[0] in below[1] or others[0] in below[0])


_Identity = tuple[int, int]


def _slot(path: str) -> tuple[_Identity | str, str]:
    """A name in its folder, whichever of the folder's names led there: mounted elsewhere it has another."""
    folder, name = os.path.split(path)
    return _identity(folder) or folder, name


def _folded(path: str) -> str:
    folder, name = os.path.split(path)
    return os.path.join(folder, unicodedata.normalize("NFC", name).casefold())


def _above(path: str) -> Iterator[str]:
    """The folders that a path lies in, the nearest first."""
    while (folder := os.path.dirname(path)) != path:
        yield folder
        path = folder


def _identity(path: str) -> _Identity | None:
    with suppress(OSError, ValueError):
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


def _identities(paths: Iterable[str]) -> Iterator[_Identity]:
    """Of files, and of folders and all that is in them, links followed to files and not to folders."""
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
