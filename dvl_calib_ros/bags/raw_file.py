"""Reading of a file from a disk with unreadable sectors."""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path
from typing import Any

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
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: os.fstat(self._descriptor).st_size}[whence]
        if start + offset < 0:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self._at = start + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
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
        data = self._attempt(size, at)
        if data is not None:
            return data
        size = min(size, os.fstat(self._descriptor).st_size - at)
        next_sector = (at // SECTOR + 1) * SECTOR
        if at + size <= next_sector:
            data = self._attempt(size, at)  # a single failure may be transient
            if data is None:
                self._note(at, at + size)
                return bytes(size)
            return data
        middle = max((at + size // 2) // SECTOR * SECTOR, next_sector)
        return self._read(middle - at, at) + self._read(at + size - middle, middle)

    def _attempt(self, size: int, at: int) -> bytes | None:
        try:
            return os.pread(self._descriptor, size, at)
        except OSError as error:
            if at >= os.fstat(self._descriptor).st_size:  # a damaged index has positions beyond the end of any file
                return b""
            if error.errno != errno.EIO:
                raise
            return None

    def _note(self, start: int, end: int) -> None:
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
