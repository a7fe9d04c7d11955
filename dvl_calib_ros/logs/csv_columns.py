"""Columns of numbers and stamps in CSV files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..calibration.numerics.frames import Array
from ..errors import InputError

N_COLUMNS = 4
# cells that mean a missing value, in addition to nan
NO_VALUE = ("", "na", "n/a", "null", "none", "-")
EXPECTED = "time and three values, separated by commas, with decimal points"
# number of characters shown of a bad row
SHOWN = 200


def cells(path: Path) -> tuple[list[list[str]], list[str]]:
    """Return the non-empty rows of a CSV file, and notes on the file. Raises InputError."""
    try:
        text = path.read_text(encoding="utf-8-sig").rstrip("\0")  # a file cut by a power failure may end in zeros
        rows = [row for row in csv.reader(io.StringIO(text)) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error}); save it as such, in UTF-8") from error
    left_out = []
    if len(rows) > 1 and not text.endswith("\n"):
        left_out.append(f"{path}: its last line is not finished, and left out: {','.join(rows.pop())[:SHOWN]}")
    return rows, left_out


def numbers_of(path: Path, rows: Sequence[Sequence[str]], at: Sequence[int], n_columns: int) -> Array:
    """Return columns `at` of rows (N, k), nan for missing values. Raises InputError naming file and row."""
    values = []
    for number, row in enumerate(rows, start=1):
        if len(row) != n_columns:
            expected = EXPECTED if n_columns == N_COLUMNS else f"{n_columns}, as the header has"
            raise InputError(f"{path}: data row {number} has {len(row)} columns, expected {expected}")
        try:
            values.append([math.nan if row[i].strip().lower() in NO_VALUE else _number(row[i]) for i in at])
        except ValueError:
            shown = ",".join(row)[:SHOWN]
            raise InputError(f"{path}: data row {number} is not all numbers: {shown}; expected {EXPECTED}") from None
    return np.array(values, dtype=float).reshape(-1, len(at))


def _number(text: str) -> float:
    """Parse a number. Raises ValueError if invalid, also for 1_0, which Python reads as ten."""
    if "_" in text:
        raise ValueError
    return float(text)


def _is_number(text: str) -> bool:
    try:
        _number(text)
    except ValueError:
        return False
    return True


def stamps_ns(path: Path, time: Array, start_ns: int) -> list[int]:
    """Convert times (N,) s after a start to integer nanoseconds. Raises InputError if a stamp cannot represent them."""
    stamps = [start_ns + round(float(t) * 1e9) for t in time]
    if stamps[0] < 0 or stamps[-1] >= 2**31 * 1_000_000_000:
        raise InputError(
            f"{path}: from {time[0]:.12g} to {time[-1]:.12g} s, after --start, is not in 1970 .. 2038; times are "
            "seconds, and those since 1970 need --start 0"
        )
    return stamps
