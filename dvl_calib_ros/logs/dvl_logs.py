"""Logs of DVLs as the instruments write them: Water Linked's JSON reports and Teledyne RDI's PD0 ensembles.

Those of Nortek are in `nortek_logs`, those in text in `text_logs`, those of ArduPilot, which hold DVL, GNSS and
attitude of one vehicle, in `ardupilot_logs`.

Water Linked: docs.waterlinked.com/dvl/dvl-json-protocol, reports of type velocity, axes forward-right-down, stamped by
time_of_validity (µs since 1970). RDI: "WorkHorse Commands and Output Data Format" and Pathfinder guide, bottom track of
PD0 (x starboard, y forward, z up), which is the bottom's motion past the DVL: its sign is turned. Velocities are those
in instrument axes (y along beam 3): beams are resolved, and ship or earth axes are turned back. The attitude, where
there is no other, is that of its own sensors. EA is how far clockwise of the ship's centre line beam 3 is, and headings
are the ship's ("WorkHorse Commands and Output Data Format", EA): it is the nominal yaw.
"""

from __future__ import annotations

import json
import math
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.numerics.frames import FLU_FROM_FRD, Array
from ..calibration.numerics.samples import DvlSample
from ..errors import InputError
from ..messages.encode import WaterReading
from .dvl_log import DvlLog, imu_samples
from .nortek_logs import is_nortek_log, read_nortek_log
from .pd0_nmea import GENERAL_NMEA, Nmea
from .text_logs import is_pd6, is_sentences, read_pd6, read_sentences

PD0_START = b"\x7f\x7f"
_DATAFLASH_START, _MAVLINK_STARTS = b"\xa3\x95", (b"\xfe", b"\xfd")
# Of a file so much is looked at to tell what it is.
_SNIFFED = 65536
_FIXED_LEADER, _VARIABLE_LEADER, _BOTTOM_TRACK = 0x0000, 0x0080, 0x0600
_AXES = ("beam", "instrument", "ship", "earth")
# Of the beams with the vertical, degrees, by the fixed leader's bits; of others it is said elsewhere in it
_BEAM_ANGLES = {0: 15, 1: 20, 2: 30}
# Bits of EZ: what comes from a sensor
_TEMPERATURE_SENSOR, _CONDUCTIVITY_SENSOR = 1, 2
# A velocity of a beam or axis that could not be measured, mm/s
_BAD_VELOCITY = -32768
# forward-left-up from RDI's starboard, forward, up
_FLU_FROM_RDI: Array = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def is_dvl_log(path: Path) -> bool:
    """Whether a file looks like a log of an instrument, by its content. Raises InputError if it cannot be read."""
    try:
        with path.open("rb") as file:
            start = file.read(_SNIFFED)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if _is_ardupilot_log(path, start) or is_nortek_log(start) or is_pd6(start) or is_sentences(start):
        return True
    return (PD0_START in start[:4096] and _next_ensemble(start, 0) is not None) or _holds_json(start)


def _is_ardupilot_log(path: Path, start: bytes) -> bool:
    """By its first bytes; a telemetry log, whose messages have 8 bytes of time before, by its name as well."""
    is_telemetry = path.suffix.lower() == ".tlog" and start[8:9] in _MAVLINK_STARTS
    return is_telemetry or start.startswith(_DATAFLASH_START)


def read_dvl_log(path: Path) -> DvlLog:
    """Read a log of any kind. Raises InputError for what is none, or holds no velocity that can be used."""
    with path.open("rb") as file:
        start = file.read(_SNIFFED)
    if _is_ardupilot_log(path, start):
        from .ardupilot_logs import read_ardupilot_log  # which gives this module's log

        log = read_ardupilot_log(path)
    else:
        content = path.read_bytes()
        held = [kind for kind, (holds, _) in _KINDS.items() if holds(content)]
        log = (_KINDS[held[0]][1] if held else _read_pd0)(path, content)
        if len(held) > 1:
            others = " and ".join(held[1:])
            note = f"{path}: holds {others} as well as {held[0]}, which alone are imported; split it for the rest"
            log = log._replace(notes=(*log.notes, note))
    if not log.samples:
        why = ", ".join(f"{count} {reason}" for reason, count in log.left_out.items()) or "no report in it"
        raise InputError(f"{path}: no velocity that can be used ({why})")
    in_order = sorted({sample.stamp_ns: sample for sample in log.samples}.values(), key=lambda each: each.stamp_ns)
    log.left_out["of a time that was there already"] += len(log.samples) - len(in_order)
    return log._replace(samples=in_order, left_out=+log.left_out)


# ---------------------------------------------------------------------- Nortek


def _read_nortek(_: Path, content: bytes) -> DvlLog:
    samples, left_out, waters = read_nortek_log(content)
    return DvlLog(samples, left_out, waters=waters)


# ---------------------------------------------------------------------- Water Linked


def _holds_json(content: bytes) -> bool:
    return b'"vx"' in content


def _read_json(path: Path, content: bytes) -> DvlLog:
    samples: list[DvlSample] = []
    left_out: Counter[str] = Counter()
    for line in content.decode("utf-8", "replace").splitlines():
        start = line.find("{")  # a logger may write its own time before
        if start < 0:
            continue
        try:
            report = json.loads(line[start:])
        except (ValueError, RecursionError):  # no JSON, or a number of thousands of digits
            left_out["not valid JSON"] += 1
            continue
        if isinstance(report, dict) and "vx" in report:
            sample = _json_sample(path, report, left_out)
            if sample is not None:
                samples.append(sample)
    return DvlLog(samples, left_out)


def _json_sample(path: Path, report: dict[str, Any], left_out: Counter[str]) -> DvlSample | None:
    if report.get("velocity_valid") is not True:
        left_out["without bottom lock"] += 1
        return None
    if "time_of_validity" not in report:
        raise InputError(f"{path}: reports have no time_of_validity; it comes with the DVL's software 2.2 and later")
    try:
        velocity = np.array([float(report[name]) for name in ("vx", "vy", "vz")])
        stamp_ns = int(report["time_of_validity"]) * 1000
        given = report.get("covariance")
        covariance = np.array(given, dtype=float).reshape(3, 3) if given else float(report["fom"]) ** 2 * np.eye(3)
    except (KeyError, TypeError, ValueError, OverflowError):
        left_out["damaged"] += 1
        return None
    is_finite = np.isfinite(velocity).all() and np.isfinite(covariance).all()
    if not is_finite or not 0 < stamp_ns < 2**31 * 1_000_000_000:
        left_out["damaged"] += 1
        return None
    x, y, z = (FLU_FROM_FRD @ velocity).tolist()
    return DvlSample(stamp_ns, (x, y, z), FLU_FROM_FRD @ covariance @ FLU_FROM_FRD)


# ---------------------------------------------------------------------- RDI


def _next_ensemble(content: bytes, start: int) -> tuple[int, int] | None:
    """Where the next whole ensemble begins and ends, its checksum right; None if there is none."""
    while (at := content.find(PD0_START, start)) >= 0:
        if at + 6 <= len(content):
            (length,) = struct.unpack_from("<H", content, at + 2)
            end = at + length + 2
            if length >= 6 and end <= len(content):
                (checksum,) = struct.unpack_from("<H", content, end - 2)
                if sum(content[at : end - 2]) & 0xFFFF == checksum:
                    return at, end
        start = at + 1
    return None


def _ensembles(content: bytes) -> Iterator[list[tuple[int, bytes]]]:
    """ID and data of all that is in each whole ensemble."""
    start = 0
    while (found := _next_ensemble(content, start)) is not None:
        at, start = found
        body = content[at : start - 2]
        n_types = body[5]
        if 6 + 2 * n_types > len(body):
            continue
        offsets = struct.unpack_from(f"<{n_types}H", body, 6)
        yield [(struct.unpack_from("<H", body, each)[0], body[each:]) for each in offsets if each + 2 <= len(body)]


def _read_pd0(path: Path, content: bytes) -> DvlLog:
    samples: list[DvlSample] = []
    attitudes: dict[int, tuple[float, float, float]] = {}
    left_out: Counter[str] = Counter()
    nmea = Nmea()
    waters: list[WaterReading] = []
    alignments: Counter[float] = Counter()
    for each in _ensembles(content):
        data = dict(each)
        try:
            stamp_ns = _pd0_stamp(data)
            for identity, message in each:
                if identity == GENERAL_NMEA:
                    nmea.take(stamp_ns, message)
            sample = _pd0_sample(path, stamp_ns, data, left_out)
            alignments[_pd0_alignment(data)] += 1
        except (struct.error, IndexError, KeyError, ValueError, ZeroDivisionError):
            left_out["damaged"] += 1
            continue
        attitude = _pd0_attitude(data)
        if attitude is not None:
            attitudes[stamp_ns] = attitude
        if sample is not None:
            samples.append(sample)
        if (water := _pd0_water(stamp_ns, data)) is not None:
            waters.append(water)
    alignment = max(alignments, key=alignments.__getitem__, default=0.0)
    stamps, rpy, notes = _pd0_attitudes(path, attitudes, nmea)
    if alignment:
        rpy = _ship_attitudes(rpy, alignment) if len(rpy) else rpy
        degrees = math.degrees(alignment)
        notes += (
            f"{path}: EA (heading alignment) is {degrees:+.2f}°: beam 3 is so far clockwise of the ship's centre line, "
            f"and {-degrees:+.2f}° is the nominal yaw of the DVL",
        )
    imu = imu_samples(stamps, rpy)
    return DvlLog(samples, left_out + nmea.left_out, nmea.references(), imu, notes, waters, -alignment)


def _pd0_attitudes(
    path: Path, attitudes: dict[int, tuple[float, float, float]], nmea: Nmea
) -> tuple[list[int], Array, tuple[str, ...]]:
    """Stamps, roll, pitch, heading (N, 3) rad, and where they come from."""
    own = sorted(attitudes)
    rpy = np.array([attitudes[at] for at in own]).reshape(-1, 3)
    stamps, headings = nmea.headings()
    if stamps and own:
        at = np.array(stamps, dtype=np.int64) - own[0]
        tilts = [np.interp(at, np.array(own, dtype=np.int64) - own[0], rpy[:, place]) for place in (0, 1)]
        note = f"{path}: the heading is that of its HDT sentences, pitch and roll are the DVL's own"
        return stamps, np.column_stack([*tilts, headings]), (note,)
    if not len(rpy) or not np.ptp(rpy, axis=0).any():  # no sensor: what was typed in, or 0
        return [], rpy[:0], ()
    note = (
        f"{path}: heading, pitch and roll are those of the DVL's own sensors, the heading magnetic but for what "
        "was set (EB); give --attitude for another's"
    )
    return own, rpy, (note,)


def _pd0_attitude(data: dict[int, bytes]) -> tuple[float, float, float] | None:
    """Roll, pitch, heading, rad; None where the ensemble ends before. Pitch of a sensor that tilts with the DVL:
    tan P = tan T1 · cos T2 (RDI, "ADCP Coordinate Transformation", 2008, eq. 19)."""
    try:
        heading, tilt_1, tilt_2 = struct.unpack_from("<H2h", data[_VARIABLE_LEADER], 18)
    except struct.error:
        return None
    roll = math.radians(0.01 * tilt_2)
    pitch = math.atan(math.tan(math.radians(0.01 * tilt_1)) * math.cos(roll))
    return roll, pitch, math.radians(0.01 * heading)


def _pd0_alignment(data: dict[int, bytes]) -> float:
    """Return EA, rad: how far clockwise of the ship's centre line beam 3 is."""
    (hundredths,) = struct.unpack_from("<h", data[_FIXED_LEADER], 26)
    return math.radians(0.01 * hundredths)


def _ship_attitudes(rpy: Array, alignment: float) -> Array:
    """Return the ship's roll, pitch and heading (N, 3), rad, by its own heading and the tilts of the instrument."""
    from scipy.spatial.transform import Rotation

    instrument = Rotation.from_euler("ZYX", rpy[:, ::-1] + [alignment, 0.0, 0.0])
    ship: Array = (instrument * Rotation.from_euler("Z", -alignment)).as_euler("ZYX")
    return ship[:, ::-1]


def _pd0_water(stamp_ns: int, data: dict[int, bytes]) -> WaterReading | None:
    """The speed of sound (EC) that velocities were counted with; temperature and salinity where sensors measured them
    (EZ's bits), for what was typed in says nothing of the water."""
    try:
        fixed, variable = data[_FIXED_LEADER], data[_VARIABLE_LEADER]
        (used,) = struct.unpack_from("<H", variable, 14)
        salinity, temperature = struct.unpack_from("<Hh", variable, 24)
        sources = fixed[30] & fixed[31]
    except (struct.error, IndexError, KeyError):
        return None
    if not used:
        return None
    return WaterReading(
        stamp_ns,
        float(used),
        0.01 * temperature if sources & _TEMPERATURE_SENSOR else math.nan,
        float(salinity) if sources & _CONDUCTIVITY_SENSOR else math.nan,
    )


def _pd0_stamp(data: dict[int, bytes]) -> int:
    year, month, day, hour, minute, second, hundredths = data[_VARIABLE_LEADER][4:11]
    # RDI's year has two digits; no DVL of before 2000 writes these
    at = datetime(2000 + year, month, day, hour, minute, second, tzinfo=timezone.utc)
    return int(at.timestamp()) * 1_000_000_000 + hundredths * 10_000_000


def _pd0_sample(path: Path, stamp_ns: int, data: dict[int, bytes], left_out: Counter[str]) -> DvlSample | None:
    if _BOTTOM_TRACK not in data:
        left_out["without bottom track"] += 1
        return None
    axes = _AXES[data[_FIXED_LEADER][25] >> 3 & 3]
    millimetres = struct.unpack_from("<4h", data[_BOTTOM_TRACK], 24)
    if _BAD_VELOCITY in (millimetres if axes == "beam" else millimetres[:3]):
        left_out["without bottom lock"] += 1
        return None
    measured = np.array(millimetres, dtype=float)
    if axes == "beam":
        instrument = _instrument_from_beams(data[_FIXED_LEADER]) @ measured
    elif axes == "instrument":
        instrument = measured[:3]
    else:
        attitude = _pd0_attitude(data) if axes == "earth" else (0.0, 0.0, 0.0)
        if attitude is None:
            left_out["in earth axes without a heading"] += 1
            return None
        roll, pitch, heading = attitude
        turned = _turned_by(roll, pitch, heading + _pd0_alignment(data), data[_FIXED_LEADER])
        instrument = turned.T @ measured[:3]
    x, y, z = (-0.001 * _FLU_FROM_RDI @ instrument + 0.0).tolist()
    return DvlSample(stamp_ns, (x, y, z), None)


def _instrument_from_beams(fixed: bytes) -> Array:
    """(3, 4), of four beams 90° apart (RDI, "ADCP Coordinate Transformation", 2008, eq. 2 to 4)."""
    angle = math.radians(_BEAM_ANGLES.get(fixed[5] & 3, fixed[58] if len(fixed) > 58 else 0))
    convex = 1.0 if fixed[4] & 8 else -1.0
    a, b = convex / (2.0 * math.sin(angle)), 1.0 / (4.0 * math.cos(angle))
    return np.array([[a, -a, 0.0, 0.0], [0.0, 0.0, -a, a], [b, b, b, b]])


def _turned_by(roll: float, pitch: float, heading: float, fixed: bytes) -> Array:
    """Return the rotation (3, 3) by which the instrument turned its velocities: by beam 3's heading, and by its tilts
    where it was set to (the same, eq. 18). Its transpose undoes that whatever the heading is worth."""
    if not fixed[25] & 4:
        roll = pitch = 0.0
    sh, ch, sp, cp, sr, cr = (
        math.sin(heading), math.cos(heading), math.sin(pitch), math.cos(pitch), math.sin(roll), math.cos(roll),
    )  # fmt: skip
    return np.array(
        [
            [ch * cr + sh * sp * sr, sh * cp, ch * sr - sh * sp * cr],
            [-sh * cr + ch * sp * sr, ch * cp, -sh * sr - ch * sp * cr],
            [-cp * sr, sp, cp * cr],
        ]
    )


# What a file may hold: how to tell, and the reader. Of several the first is read.
_KINDS: dict[str, tuple[Callable[[bytes], bool], Callable[[Path, bytes], DvlLog]]] = {
    "Nortek's records": (is_nortek_log, _read_nortek),
    "Water Linked's reports": (_holds_json, _read_json),
    "RDI's ensembles": (lambda content: _next_ensemble(content, 0) is not None, _read_pd0),
    "PD6 text": (is_pd6, read_pd6),
    "sentences of a DVL": (is_sentences, read_sentences),
}
