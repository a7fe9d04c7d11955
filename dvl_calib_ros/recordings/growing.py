"""Rows that come piece by piece, on disk once there are many."""

from __future__ import annotations

import math
import tempfile
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

# A column that is larger than this (bytes) is kept on disk: an ordinary recording's are not.
IN_MEMORY = 128 << 20


class GrowingRows:
    """Rows of one shape and type."""

    def __init__(self, dtype: Any, shape: tuple[int, ...] = (), expected: int = 0) -> None:
        """shape: of a row. expected: how many there will be, as far as that is known: more are taken as well."""
        self._file: BinaryIO | None = None
        row = np.dtype(dtype).itemsize * max(1, math.prod(shape))
        self._rows = np.empty((max(1, min(expected, IN_MEMORY // row)), *shape), dtype)
        self._n = 0

    def add(self, rows: Any) -> None:
        """Take further rows (N, ...)."""
        if self._n + len(rows) > len(self._rows):
            if self._rows.nbytes >= IN_MEMORY:
                self._spill()
            # grown where it is, not copied: there is no second one at any time
            wanted = max(self._n + len(rows), 2 * self._n)
            self._rows.resize((max(wanted, len(self._rows)), *self._rows.shape[1:]), refcheck=False)
        self._rows[self._n : self._n + len(rows)] = rows
        self._n += len(rows)

    def _spill(self) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115  # until its rows are mapped
        self._file.write(self._rows[: self._n].tobytes())
        self._n = 0

    def array(self) -> NDArray[Any]:
        """All rows; they are given once."""
        if self._file is None:
            self._rows.resize((self._n, *self._rows.shape[1:]), refcheck=False)
            return self._rows
        self._spill()
        self._file.flush()
        rows = np.asarray(np.memmap(self._file, dtype=self._rows.dtype, mode="r"))
        self._file.close()  # the map holds it
        return rows.reshape(-1, *self._rows.shape[1:])
