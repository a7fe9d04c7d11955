"""Velocities from a GNSS receiver's NMEA 0183 RMC sentences, which have time, date, speed and course.

Loggers may prepend any text to a sentence; a sentence with a wrong checksum is skipped.
"""

from __future__ import annotations

import math
import re
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ..calibration.numerics.frames import over_ground
from ..calibration.numerics.samples import ReferenceSample, VelocityFrame
from ..errors import InputError

_RMC = re.compile(rb"\$(\w{2}RMC,[^*\r\n]*)\*([0-9A-Fa-f]{2})")
_SNIFFED = 65536
KNOT = 1852.0 / 3600.0
# a slower receiver gives no course, which does not matter, m/s
STANDING = 0.05


def is_nmea(path: Path) -> bool:
    """Return whether the beginning of a file has RMC sentences."""
    if not path.is_file():  # a pipe would block
        return False
    try:
        with path.open("rb") as file:
            return _RMC.search(file.read(_SNIFFED)) is not None
    except OSError:
        return False  # the reader reports the error


def read_rmc(path: Path, std: float, notes: list[str]) -> list[ReferenceSample]:
    """Read horizontal velocities in ENU (vertical exactly 0), stamped by UTC; std (m/s) 0: covariance not given.

    notes: receives remarks on skipped data. Raises InputError if there is no usable sentence.
    """
    covariance = np.eye(3) * std**2 if std else None
    found: dict[int, ReferenceSample] = {}
    damaged = without = 0
    for text, checksum in _RMC.findall(path.read_bytes()):
        if xor(text) != int(checksum, 16):
            damaged += 1
            continue
        try:
            fields = text.decode("ascii").split(",")
            speed = float(fields[7]) * KNOT
            course = math.radians(float(fields[8])) if fields[8] or speed > STANDING else 0.0
            at = datetime.strptime(fields[9] + fields[1].partition(".")[0], "%d%m%y%H%M%S").replace(tzinfo=timezone.utc)
            fraction = float("0." + (fields[1].partition(".")[2] or "0"))
            if fields[2] != "A" or not 0.0 <= speed < 100.0:
                raise ValueError
        except (ValueError, IndexError):
            without += 1
            continue
        stamp_ns = int(at.timestamp()) * 1_000_000_000 + round(fraction * 1e9)
        east, north, up = over_ground(speed, course).tolist()
        found[stamp_ns] = ReferenceSample(stamp_ns, (east, north, up), covariance, VelocityFrame.ENU)
    if not found:
        raise InputError(f"{path}: no RMC sentence with a fix, time, date, speed and course in it")
    for count, why in ((damaged, "have a wrong checksum"), (without, "have no fix, time, speed or course")):
        if count:
            notes.append(f"{path}: {count} RMC sentences {why}, left out")
    return [found[at] for at in sorted(found)]


def xor(text: bytes) -> int:
    """Return a sentence's checksum: of the bytes between $ and *."""
    value = 0
    for byte in text:
        value ^= byte
    return value
