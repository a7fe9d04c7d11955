"""Text tables of any layout, read by a map of their columns.

The map is time=NAME,vx=NAME,vy=NAME,vz=NAME,valid=NAME. A column is given by its name in the header or by its number
from 1. Time is in seconds, in ISO 8601, or a time of day with its date (``time=Date+Time``). The separator (comma,
semicolon, tab) is detected.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import DvlSample
from ..errors import InputError
from .csv_columns import SHOWN
from .dvl_log import DvlLog

_NEEDED, _KEYS = ("time", "vx", "vy", "vz"), ("time", "vx", "vy", "vz", "valid")
_SEPARATORS = ",;\t"
# from here on numbers are seconds since 1970 (this is 2001); smaller ones count from a start
_SINCE_1970_S = 1e9
_FALSE = ("", "0", "false", "f", "no", "invalid", "v", "nan")
# formats of loggers for a date and a time of day
_FORMATS = ("%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S", "%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S")


def column_map(text: str) -> Mapping[str, str]:
    """Return the column's name of each key. Raises InputError."""
    pairs = [part.partition("=")[::2] for part in text.split(",")]
    found = {key.strip(): name.strip() for key, name in pairs}
    missing = [key for key in _NEEDED if not found.get(key)]
    unknown = [key for key in found if key not in _KEYS]
    if missing or unknown:
        what = f"{unknown[0]!r} is none of {', '.join(_KEYS)}" if unknown else f"{missing[0]} is missing"
        raise InputError(f"--columns: {what}; write time=NAME,vx=NAME,vy=NAME,vz=NAME,valid=NAME")
    return found


def read_table(path: Path, text: str, start_ns: int, rotation: Array, std: float) -> DvlLog:
    """Read the velocities of a table. Raises InputError naming file and column.

    text: the map. start_ns: stamp of time 0. rotation: (3, 3) to forward-left-up. std: m/s; 0: covariance not given.
    """
    names = column_map(text)
    if not path.is_file():  # a pipe would block
        raise InputError(f"{path}: no such file")
    try:
        lines = path.read_text(encoding="utf-8-sig").rstrip("\0").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error}); save it in UTF-8") from error
    first = next((line for line in lines if line.strip()), "")
    rows = [row for row in csv.reader(lines, delimiter=max(_SEPARATORS, key=first.count)) if row]
    at = {key: [_place(path, rows[:1], name) for name in names[key].split("+")] for key in names}
    covariance = np.eye(3) * std**2 if std else None
    samples: list[DvlSample] = []
    left_out: Counter[str] = Counter()
    for row in rows[_is_header(rows[:1], at["vx"][0]) :]:
        try:
            stamp_ns = _stamp_ns(" ".join(row[place].strip() for place in at["time"]), start_ns)
            velocity = rotation @ [float(row[at[key][0]]) for key in _NEEDED[1:]]
        except (ValueError, IndexError, OverflowError):
            left_out["without a time or a velocity"] += 1
            continue
        if not np.isfinite(velocity).all() or not 0 < stamp_ns < 2**31 * 1_000_000_000:
            left_out["without a time or a velocity"] += 1
        elif "valid" in at and row[at["valid"][0]].strip().lower() in _FALSE:
            left_out["not valid"] += 1
        else:
            x, y, z = velocity.tolist()
            samples.append(DvlSample(stamp_ns, (x, y, z), covariance))
    if not samples:
        shown = _shown(rows[-1]) if rows else "it is empty"
        raise InputError(f"{path}: no row with time and velocity in the columns of --columns; the last is {shown}")
    return DvlLog(sorted({each.stamp_ns: each for each in samples}.values(), key=lambda each: each.stamp_ns), left_out)


def _shown(row: Sequence[str]) -> str:
    return repr(",".join(row)[:SHOWN])


def _is_header(rows: Sequence[Sequence[str]], place: int) -> bool:
    """Return whether the first row has no number in a column."""
    try:
        return bool(rows) and math.isnan(float(rows[0][place]))
    except (ValueError, IndexError):
        return True


def _place(path: Path, rows: Sequence[Sequence[str]], name: str) -> int:
    """Return the index of a column by its name, its name without the unit, or its number. Raises InputError."""
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    wanted = name.strip().lower()
    for each in (header, [cell.partition("(")[0].partition("[")[0].strip() for cell in header]):
        if wanted in each:
            return each.index(wanted)
    if wanted.isdecimal() and 0 < int(wanted) <= len(header):
        return int(wanted) - 1
    raise InputError(f"{path}: --columns: no column {name!r}; there are {', '.join(header)[:SHOWN] or 'none'}")


def _stamp_ns(text: str, start_ns: int) -> int:
    """Convert a time to a stamp. Raises ValueError if it is invalid."""
    try:
        seconds = float(text)
    except ValueError:
        at = _moment(text)
        at = at if at.tzinfo is not None else at.replace(tzinfo=timezone.utc)
        return int(at.replace(microsecond=0).timestamp()) * 1_000_000_000 + at.microsecond * 1000
    return round(seconds * 1e9) + (0 if seconds >= _SINCE_1970_S else start_ns)


def _moment(text: str) -> datetime:
    for form in _FORMATS:
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    # Python 3.10 needs six digits of a second
    text = re.sub(r"\.(\d+)", lambda found: f".{found[1][:6]:0<6}", text.replace("Z", "+00:00"))
    return datetime.fromisoformat(text)
