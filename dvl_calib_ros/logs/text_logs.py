"""Text formats of DVLs: Teledyne's PD6, Nortek's PNORBT and Cerulean's DVPDL sentences.

PD6 (Pathfinder and Wayfinder guides): ``:TS`` time, ``:SA`` pitch, roll, heading, ``:BI`` the instrument's motion over
the bottom in mm/s, starboard, forward, up. PNORBT (Nortek, "DVL Integrator's Guide"): forward, starboard, down, stamped
by a preceding beam's sentence or by themselves. DVPDL (Cerulean, DVL-75 and Tracker 650): displacement forward,
starboard, down over an interval, stamped since boot, which is converted to time since 1970.

Also NMEA: RMC of a receiver, and VTG, GGA and HDT in PD0 ensembles (data ID 2022h) by WinRiver II or RDI's receivers.
Text: "RiverPro and RioPro ADCP Guide" (Teledyne RDI, 2017), table 42; binary: "WinRiver II User's Guide", General NMEA
Data Format. The time of a sentence is the ensemble's plus or minus a time difference. The sign is undocumented, so the
one with more even intervals is used.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter, defaultdict
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from ..calibration.numerics.frames import Array, over_ground
from ..calibration.numerics.samples import DvlSample, ReferenceSample, VelocityFrame
from ..errors import InputError
from ..messages.positions import FixDifference
from .dvl_log import DvlLog, imu_samples

_SECOND_NS = 1_000_000_000
_SENTENCE = re.compile(rb"\$((?:PNORBT|DVPDL)[^*\r\n]*)\*([0-9A-Fa-f]{2})")
_PD6 = re.compile(rb":(TS|SA|BI),([^:\r\n]*)")
# sentences with a velocity or its stamp
_BEAM_TIME, _VELOCITY, _STAMPED, _DISPLACEMENT = "PNORBT1", "PNORBT4", "PNORBT7", "DVPDL"
_FASTEST_MPS = 30.0  # instruments write ±32.767 without bottom lock


def is_pd6(content: bytes) -> bool:
    """Return whether there are bottom-track lines of PD6."""
    return {b"TS", b"BI"} <= {kind for kind, _ in _PD6.findall(content)}


def is_sentences(content: bytes) -> bool:
    """Return whether there is a sentence with a DVL's velocity."""
    return re.search(rb"\$(PNORBT[47]|DVPDL),", content) is not None


def read_pd6(path: Path, content: bytes) -> DvlLog:
    """Read PD6, with heading, pitch and roll from the DVL's own sensors."""
    samples: list[DvlSample] = []
    attitudes: dict[int, tuple[float, ...]] = {}
    left_out: Counter[str] = Counter()
    stamp_ns = 0
    tilt: tuple[float, ...] | None = None
    for kind, text in _PD6.findall(content):
        fields = text.decode("ascii", "replace").split(",")
        try:
            if kind == b"TS":
                second = datetime.strptime(fields[0][:12], "%y%m%d%H%M%S").replace(tzinfo=timezone.utc)
                stamp_ns = int(second.timestamp()) * _SECOND_NS + int(fields[0][12:14]) * 10_000_000
                if tilt is not None:  # the tilt precedes its time
                    attitudes[stamp_ns] = tilt
            elif kind == b"SA":
                pitch, roll, heading = (math.radians(float(field)) for field in fields[:3])
                tilt = roll, pitch, heading
            else:
                starboard, forward, up = (0.001 * float(field) for field in fields[:3])
                _add(samples, left_out, stamp_ns, (forward, -starboard, up), fields[4].strip() == "A")
        except (ValueError, IndexError):
            left_out["damaged"] += 1
    stamps = sorted(attitudes)
    rpy = np.array([attitudes[stamp] for stamp in stamps]).reshape(-1, 3)
    note = f"{path}: heading, pitch and roll are from the DVL's own sensors; give --attitude for another source"
    attitude = imu_samples(stamps, rpy) if len(rpy) and np.ptp(rpy, axis=0).any() else []
    return DvlLog(samples, left_out, (), attitude, (note,) if attitude else (), nominal_yaw=0.0 if attitude else None)


def read_sentences(_: Path, content: bytes) -> DvlLog:
    """Read sentences of Nortek or Cerulean; those with a wrong checksum are skipped."""
    samples: list[DvlSample] = []
    left_out: Counter[str] = Counter()
    beam_ns = 0
    for text, checksum in _SENTENCE.findall(content):
        name, *fields = text.decode("ascii", "replace").split(",")
        if checksum_of(text) != int(checksum, 16):
            left_out["with a wrong checksum"] += 1
            continue
        try:
            if name == _BEAM_TIME:
                named = dict(field.split("=") for field in fields)
                time, _, decimals = named["TIME"].partition(".")
                second = datetime.strptime(named["DATE"] + time, "%m%d%y%H%M%S").replace(tzinfo=timezone.utc)
                beam_ns = int(second.timestamp()) * _SECOND_NS + round(float(f"0.{decimals or 0}") * 1e9)
            elif name == _VELOCITY:
                x, y, _fom, z1, z2 = map(float, fields[2:7])
                _add(samples, left_out, beam_ns, (x, -y, -0.5 * (z1 + z2)))
            elif name == _STAMPED:
                x, y, z = map(float, fields[3:6])
                _add(samples, left_out, round(float(fields[0]) * 1e9), (x, -y, -z))
            elif name == _DISPLACEMENT:
                seconds = 1e-6 * float(fields[1])
                x, y, z = (float(field) / seconds for field in fields[5:8])
                # over the interval that ends at the stamp
                middle_ns = round(1e3 * float(fields[0]) - 0.5e9 * seconds)
                _add(samples, left_out, _SECOND_NS + middle_ns, (x, -y, -z), float(fields[8]) > 0.0)
        except (ValueError, KeyError, IndexError, ZeroDivisionError):
            left_out["damaged"] += 1
    return DvlLog(samples, left_out)


def _add(
    samples: list[DvlSample],
    left_out: Counter[str],
    stamp_ns: int,
    velocity: tuple[float, float, float],
    is_valid: bool = True,
) -> None:
    """Add a velocity (forward-left-up, m/s), or count the reason why it is invalid."""
    if not is_valid or not max(map(abs, velocity)) < _FASTEST_MPS:
        left_out["without bottom lock"] += 1
    elif stamp_ns <= 0:
        left_out["without a time"] += 1
    else:
        samples.append(DvlSample(stamp_ns, velocity, None))


# NMEA sentences

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
    samples: dict[int, ReferenceSample] = {}  # by stamp
    n_damaged = n_incomplete = 0
    for text, checksum in _RMC.findall(path.read_bytes()):
        if checksum_of(text) != int(checksum, 16):
            n_damaged += 1
            continue
        try:
            fields = text.decode("ascii").split(",")
            speed = float(fields[7]) * KNOT
            course = math.radians(float(fields[8])) if fields[8] or speed > STANDING else 0.0
            time, _, decimals = fields[1].partition(".")
            second = datetime.strptime(fields[9] + time, "%d%m%y%H%M%S").replace(tzinfo=timezone.utc)
            fraction = float("0." + (decimals or "0"))
            if fields[2] != "A" or not 0.0 <= speed < 100.0:
                raise ValueError
        except (ValueError, IndexError):
            n_incomplete += 1
            continue
        stamp_ns = int(second.timestamp()) * 1_000_000_000 + round(fraction * 1e9)
        east, north, up = over_ground(speed, course).tolist()
        samples[stamp_ns] = ReferenceSample(stamp_ns, (east, north, up), covariance, VelocityFrame.ENU)
    if not samples:
        raise InputError(f"{path}: no RMC sentence with a fix, time, date, speed and course in it")
    for count, why in ((n_damaged, "have a wrong checksum"), (n_incomplete, "have no fix, time, speed or course")):
        if count:
            notes.append(f"{path}: {count} RMC sentences {why}, left out")
    return [samples[stamp_ns] for stamp_ns in sorted(samples)]


def checksum_of(text: bytes) -> int:
    """Return a sentence's checksum: of the bytes between $ and *."""
    return reduce(xor, text, 0)


GENERAL_NMEA = 0x2022
_HEAD = struct.Struct("<HHHd")  # data ID, specific ID, size of the message, time difference
# A sentence belongs to the ensemble that holds it, so a larger time difference is no time, s.
MAX_OFFSET_S = 3600.0
_GGA, _VTG, _HDT = "GGA", "VTG", "HDT"
_KINDS = {
    4: _GGA, 5: _VTG, 100: _GGA, 101: _VTG, 103: _HDT, 104: _GGA, 105: _VTG, 107: _HDT, 204: _GGA, 205: _VTG, 207: _HDT
}  # fmt: skip
# binary messages: content after a header of 10 characters (IDs below 104) or 7
_BINARY = {_GGA: struct.Struct("<10sdcdcB"), _VTG: struct.Struct("<fcfcf"), _HDT: struct.Struct("<d")}
_NMEA_SENTENCE = re.compile(rb"\$\w{2}(GGA|VTG|HDT),([^*\r\n\0]*)(?:\*([0-9A-Fa-f]{2}))?")


class Nmea:
    """NMEA of a file so far. left_out: unusable sentences by reason."""

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self._found: dict[str, list[tuple[int, float, list[float]]]] = defaultdict(list)

    def take(self, stamp_ns: int, data: bytes) -> None:
        """Add a message of an ensemble with this stamp."""
        try:
            _, specific, size, delta = _HEAD.unpack_from(data)
            kind = _KINDS.get(specific)
            if kind is None:
                return
            values = _values(kind, specific, data[_HEAD.size : _HEAD.size + size])
        except (struct.error, ValueError, IndexError):
            self.left_out["with NMEA that is damaged or empty"] += 1
            return
        if not np.isfinite([delta, *values]).all():
            self.left_out["with NMEA that is damaged or empty"] += 1
        elif abs(delta) >= MAX_OFFSET_S:
            self.left_out["with NMEA an hour or more from the ensemble"] += 1
        else:
            self._found[kind].append((stamp_ns, delta, values))

    def references(self) -> list[ReferenceSample]:
        """Return horizontal velocities: from VTG, else from differences of GGA's positions."""
        if self._found[_VTG]:
            stamps, values = self._in_order(_VTG)
            velocities = over_ground(values[:, 0], values[:, 1])
        else:
            stamps, velocities = _differences(*self._in_order(_GGA))
        return [
            ReferenceSample(at, (east, north, 0.0), None, VelocityFrame.ENU)
            for at, (east, north, _) in zip(stamps, velocities.tolist(), strict=True)
        ]

    def headings(self) -> tuple[list[int], Array]:
        """Return stamps and headings (N,) rad, from true north, clockwise."""
        stamps, values = self._in_order(_HDT)
        return stamps, values[:, 0]

    def _in_order(self, kind: str) -> tuple[list[int], Array]:
        """Return stamps (ns) and values of one kind of sentence, in order.

        The sign of the time difference to the ensemble is the one that spaces the stamps most evenly.
        """
        if not self._found[kind]:
            return [], np.zeros((0, 2))
        ensemble_ns, differences_s, values = zip(*self._found[kind], strict=True)
        difference_ns = np.array([round(1e9 * seconds) for seconds in differences_s])
        stamps = min((np.array(ensemble_ns) - difference_ns, np.array(ensemble_ns) + difference_ns), key=_unevenness)
        stamps, index = np.unique(stamps, return_index=True)
        return stamps.tolist(), np.array([values[i] for i in index])


def _unevenness(stamps: np.ndarray) -> float:
    steps = np.diff(np.sort(stamps))
    return float(np.abs(steps - np.median(steps)).mean()) if len(steps) else 0.0


def _values(kind: str, specific: int, body: bytes) -> list[float]:
    """Return speed m/s, course rad (VTG); latitude, longitude, degrees (GGA); heading rad (HDT). Raises ValueError."""
    text = body.rstrip(b"\0\r\n ")
    sentence = _NMEA_SENTENCE.match(text) if text.isascii() and b"\0" not in text else None
    if sentence is not None:
        return _parse_text_sentence(kind, sentence)
    header = 10 if 100 <= specific < 104 else 7
    fields = _BINARY[kind].unpack_from(body, header)
    if kind == _VTG:
        course, _, _, _, knots = fields
        return _over_ground(course, knots)
    if kind == _HDT:
        return [math.radians(fields[0])]
    _, latitude, south, longitude, west, quality = fields
    return _position(latitude, south, longitude, west, quality)


def _parse_text_sentence(kind: str, sentence: re.Match[bytes]) -> list[float]:
    """Parse the values of a sentence in text, see `_values`. Raises ValueError for another kind or a wrong checksum."""
    name, text, checksum = sentence.groups()
    fields = text.decode("ascii").split(",")
    checked = sentence[0][1:].partition(b"*")[0]
    if name.decode() != kind or (checksum is not None and checksum_of(checked) != int(checksum, 16)):
        raise ValueError
    if kind == _HDT:
        return [math.radians(float(fields[0]))]
    if kind == _VTG:
        knots = float(fields[4])
        return _over_ground(float(fields[0]) if fields[0] or knots * KNOT > STANDING else 0.0, knots)
    latitude, longitude = (_degrees(fields[place]) for place in (1, 3))
    return _position(latitude, fields[2].encode(), longitude, fields[4].encode(), int(fields[5]))


def _degrees(text: str) -> float:
    """Convert NMEA's degrees and minutes (dddmm.mm) to degrees."""
    whole, minutes = divmod(float(text), 100.0)
    return whole + minutes / 60.0


def _over_ground(course_deg: float, knots: float) -> list[float]:
    if not (0.0 <= knots * KNOT < 100.0 and 0.0 <= course_deg <= 360.0):
        raise ValueError
    return [knots * KNOT, math.radians(course_deg)]


def _position(latitude: float, south: bytes, longitude: float, west: bytes, quality: int) -> list[float]:
    if not quality or abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise ValueError
    return [-latitude if south == b"S" else latitude, -longitude if west == b"W" else longitude]


def _differences(stamps: Sequence[int], positions: Array) -> tuple[list[int], Array]:
    """Return stamps and velocities (M, 3) from differences of positions (N, 2)."""
    difference = FixDifference()
    fixes = zip(stamps, positions.tolist(), strict=True)
    tried = (difference(stamp_ns, latitude, longitude, 0.0, None) for stamp_ns, (latitude, longitude) in fixes)
    means = [mean for mean in tried if mean is not None]
    return [mean.stamp_ns for mean in means], np.array([mean.velocity for mean in means]).reshape(-1, 3)
