"""A recording's bytes from a disk that may not give all of them."""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path
from typing import Any

# What the system reads at once from a disk, and so the least that one bad sector takes with it.
SECTOR = 4096
# Heads of records are read one by one
_BUFFER = 1 << 16

Hole = tuple[int, int]
"""First byte and the one after the last of what cannot be read."""


class _RawFile(io.RawIOBase):
    """Zeros stand where the disk reports an error; `holes` says where, in order, as far as has been read."""

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
        except OSError:  # in pieces, and it is said what is wrong
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
        """What is there; after an error once more in halves, for a bad sector to cost no more than itself."""
        data = self._attempt(size, at)
        if data is not None:
            return data
        size = min(size, os.fstat(self._descriptor).st_size - at)
        next_sector = (at // SECTOR + 1) * SECTOR
        if at + size <= next_sector:
            data = self._attempt(size, at)  # what fails once may be anything
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
            if at >= os.fstat(self._descriptor).st_size:  # a damaged index leads to places that no file has
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
    """Open a file to be read past unreadable places, which `holes_in` tells. Raises OSError."""
    return io.BufferedReader(_RawFile(path), _BUFFER)


def holes_in(file: Any, start: int, end: int) -> list[Hole]:
    """What between two places of an open file, which has been read, is not its content but zeros for want of it."""
    holes: list[Hole] = getattr(getattr(file, "raw", None), "holes", [])
    return [(max(first, start), min(last, end)) for first, last in holes if first < end and start < last]


def unreadable(file: Any) -> int:
    """Bytes of an open file that could not be read so far."""
    holes: list[Hole] = getattr(getattr(file, "raw", None), "holes", [])
    return sum(last - first for first, last in holes)
