"""Whether recordings changed while a command read them, as those do that are still being written.

Commands read a recording several times: what is found the first time is used the second. All of that must be of one
recording.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

State = tuple[int, int, int]
"""Of a file: which it is, its size, and when it was last written."""
# Of recordings, and of what their recorder keeps beside
_SUFFIXES = (".mcap", ".db3", ".db3-wal", ".db3-journal", ".zstd")


def recordings_now(arguments: argparse.Namespace) -> dict[Path, State]:
    """Files of recordings that a command's arguments lead to, as they are now."""
    files: dict[Path, State] = {}
    for path in paths_in(arguments):
        with suppress(OSError, ValueError):  # what cannot be read is for the command to say
            for file in _files(path):
                status = file.stat()
                files[file] = (status.st_ino, status.st_size, status.st_mtime_ns)
    return files


def changed(before: Mapping[Path, State], after: Mapping[Path, State]) -> list[str]:
    """Sentences on recordings that are not what they were."""
    return [
        f"{path}: changed while it was read, so the answer may be of a part of it, or of two recordings; run this "
        "again when nothing writes to it any more"
        for path, state in before.items()
        if after.get(path) != state
    ]


def paths_in(arguments: argparse.Namespace) -> Iterator[Path]:
    """Every path that a command's arguments name."""
    for value in vars(arguments).values():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, Path):
                yield each


def _files(path: Path) -> list[Path]:
    """A folder's recordings, or a recording with the journal that may lie beside it."""
    if path.is_dir():
        return [path / name for name in sorted(os.listdir(path)) if name.endswith(_SUFFIXES)]
    beside = [path, *(path.with_name(path.name + journal) for journal in ("-wal", "-journal"))]
    return [file for file in beside if file.name.endswith(_SUFFIXES) and file.exists()]
