"""Course and speed over ground, positions, and compass headings, read by the columns' names.

A receiver's course and speed have no vertical component: it is set to exactly 0, which marks an axis as not measured.
Units are in a column's name (`_deg`, `[rad]`, `_mps`, `knots`); the default is SI and radians.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..calibration.numerics.frames import Array, over_ground
from ..calibration.numerics.samples import ImuSample, ReferenceSample, VelocityFrame
from ..errors import InputError
from ..messages.encode import SatelliteFix
from .csv_columns import cells, numbers_of, stamps_ns
from .dvl_log import imu_samples
from .nmea import KNOT

# units in column names, with their factors to SI
_UNITS = {"deg": math.pi / 180.0, "rad": 1.0, "mps": 1.0, "m/s": 1.0, "knots": KNOT, "kn": KNOT, "km/h": 1.0 / 3.6}


def names_columns(path: Path, *wanted: str) -> bool:
    """Return whether a file is a CSV with a header that has columns for all these words."""
    if not path.is_file() or path.suffix == ".npy":
        return False
    header = _header(path)
    return all(any(word in _words(cell) for cell in header) for word in wanted)


def read_course(path: Path, start_ns: int, std: float, notes: list[str]) -> list[ReferenceSample]:
    """Read speed m/s and course (from true north, clockwise) as horizontal velocities in ENU. Raises InputError."""
    time, values = _named(path, ("speed", "course"), notes)
    velocities = over_ground(*values.T).tolist()
    covariance = np.eye(3) * std**2 if std else None
    return [
        ReferenceSample(at, (x, y, z), covariance, VelocityFrame.ENU)
        for at, (x, y, z) in zip(stamps_ns(path, time, start_ns), velocities, strict=True)
    ]


def read_positions(path: Path, start_ns: int, notes: list[str]) -> list[SatelliteFix]:
    """Read latitude and longitude. Raises InputError."""
    time, values = _named(path, ("latitude", "longitude"), notes)
    rows = np.degrees(values).tolist()
    return [
        SatelliteFix(at, latitude, longitude)
        for at, (latitude, longitude) in zip(stamps_ns(path, time, start_ns), rows, strict=True)
    ]


def read_heading(path: Path, start_ns: int, notes: list[str]) -> list[ImuSample]:
    """Read headings (from true north, clockwise), with pitch and roll of a forward-right-down body if present."""
    header = _header(path)
    tilt = [name for name in ("pitch", "roll") if any(name in _words(cell) for cell in header)]
    time, values = _named(path, ("heading", *tilt), notes)
    rpy = np.zeros((len(time), 3))
    rpy[:, 2] = values[:, 0]
    for place, name in enumerate(tilt, start=1):
        rpy[:, ("roll", "pitch").index(name)] = values[:, place]
    return imu_samples(stamps_ns(path, time, start_ns), rpy)


def _header(path: Path) -> list[str]:
    rows, _ = cells(path)
    return rows[0] if rows else []


def _words(cell: str) -> set[str]:
    return set(re.findall(r"[a-z]+", cell.lower()))


def _named(path: Path, names: Sequence[str], notes: list[str]) -> tuple[Array, Array]:
    """Return time (N,) s and columns (N, k) in SI, without rows that have a missing number."""
    (header, *rows), left_out = cells(path)
    notes += left_out
    at = [next(i for i, cell in enumerate(header) if name in _words(cell)) for name in names]
    table = numbers_of(path, rows, [0, *at], len(header))
    good = np.isfinite(table).all(axis=1)
    if not good.any():
        raise InputError(f"{path}: no row with a number in every column")
    if not good.all():
        notes.append(f"{path}: {int((~good).sum())} of {len(table)} rows hold no finite number somewhere, left out")
    table = table[good]
    if (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError(f"{path}: time does not increase at row {int(np.argmax(np.diff(table[:, 0]) <= 0.0)) + 2}")
    return table[:, 0], table[:, 1:] * [_factor(header[i]) for i in at]


def _factor(cell: str) -> float:
    text = cell.lower()
    return next((factor for unit, factor in _UNITS.items() if unit in text), 1.0)
