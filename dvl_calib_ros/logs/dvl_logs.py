"""Logs of DVLs in the instruments' own formats: Water Linked's JSON reports, RDI's PD0 ensembles, Nortek's records.

`text_logs` has the text formats, and `ardupilot_logs` the logs of ArduPilot, which have DVL, GNSS and attitude of one
vehicle.

Water Linked: docs.waterlinked.com/dvl/dvl-json-protocol, reports of type velocity, axes forward-right-down, stamped by
time_of_validity (µs since 1970). RDI: "WorkHorse Commands and Output Data Format" and Pathfinder guide, bottom track of
PD0 (x starboard, y forward, z up). It is the bottom's motion relative to the DVL, so its sign is inverted. Velocities
are returned in instrument axes (y along beam 3): beam velocities are converted, ship and earth axes rotated back. By
default the attitude comes from the DVL's own sensors. EA is the angle of beam 3 clockwise from the ship's centre line,
and headings are the ship's (same document, EA): EA is the nominal yaw. Nortek (DVL 300 to 1000; .ad2cp or captured
from a port; "DVL Integrator's Guide"): bottom track of data format 21, records with the ID 1Bh, X forward, Y starboard,
Z down, m/s, stamped at the trigger; the bottom echo comes the time DT1 later. Two pairs of beams measure Z separately.
"""

from __future__ import annotations

import json
import math
import re
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
from .ardupilot_logs import is_dataflash, is_telemetry, read_ardupilot_log
from .dvl_log import DvlLog, imu_samples
from .text_logs import GENERAL_NMEA, Nmea, is_pd6, is_sentences, read_pd6, read_sentences

_SYNC, _NORTEK_BOTTOM_TRACK = 0xA5, 0x1B
# sync, size of the header, ID, family, size of the data, its checksum, the header's own
_HEADER = struct.Struct("<BBBBHHH")
_CHECKSUM_START = 0xB58C
# version, offset of data, serial, date and time, 100 µs, beams, error, status, sound speed, temperature, pressure
_LEADER = struct.Struct("<BBI6BHHII3f")
# six quantities by beam; then X, Y, Z1, Z2 of velocity, figure of merit, DT1
_BY_BEAM, _BY_AXIS = struct.Struct("<24f"), struct.Struct("<12f")
# status bits for valid velocities of X, Y, Z1, Z2
_VALID = (1 << 12, 1 << 13, 1 << 14, 1 << 15)
# a velocity that was not measured, m/s; upper limit of DT1, s
_NORTEK_BAD_VELOCITY, _LONGEST_DT_S = -32.0, 1.0


def is_nortek_log(start: bytes) -> bool:
    """Return whether a record of bottom track begins in the first bytes of a file."""
    return any(True for _ in _records(start))


def _read_nortek(_path: Path, content: bytes) -> DvlLog:
    """Read Nortek's records."""
    samples: list[DvlSample] = []
    waters: list[WaterReading] = []
    left_out: Counter[str] = Counter()
    for data in _records(content):
        try:
            sample = _sample(data)
        except (struct.error, ValueError, OverflowError):
            left_out["damaged"] += 1
            continue
        if sample is None:
            left_out["without bottom lock"] += 1
        else:
            samples.append(sample)
            used, temperature = _LEADER.unpack_from(data)[-3:-1]
            waters.append(WaterReading(sample.stamp_ns, used, temperature, math.nan))
    return DvlLog(samples, left_out, waters=waters)


def _records(content: bytes) -> Iterator[bytes]:
    """Yield the data of each bottom-track record with a sound header; nothing of it if damaged or cut off."""
    start = 0
    while (at := content.find(_SYNC, start)) >= 0:
        start = at + 1
        if at + _HEADER.size > len(content):
            return
        _, size, identity, _, length, checksum, own = _HEADER.unpack_from(content, at)
        if size != _HEADER.size or _sum(content[at : at + size - 2]) != own:
            continue
        data = content[at + size : at + size + length]
        if len(data) < length or _sum(data) != checksum:
            if identity == _NORTEK_BOTTOM_TRACK:
                yield b""
            continue
        start = at + size + length
        if identity == _NORTEK_BOTTOM_TRACK:
            yield data


def _sum(data: bytes) -> int:
    """Return Nortek's checksum: the sum of 16-bit words, modulo 2^16; an odd last byte is the high byte of a word."""
    even = data[: len(data) & ~1]
    total = _CHECKSUM_START + sum(struct.unpack(f"<{len(even) // 2}H", even))
    return (total + (data[-1] << 8 if len(data) % 2 else 0)) & 0xFFFF


def _sample(data: bytes) -> DvlSample | None:
    """Return a record's velocity, with the mean of its valid vertical velocities; None without bottom lock."""
    _, _, _, year, month, day, hour, minute, second, fraction, _, _, status, *_ = _LEADER.unpack_from(data)
    values = np.array(_BY_AXIS.unpack_from(data, _LEADER.size + _BY_BEAM.size), dtype=float).reshape(3, 4)
    velocity, noise, delay = values
    valid = np.array([bool(status & bit) for bit in _VALID]) & np.isfinite(velocity) & (velocity > _NORTEK_BAD_VELOCITY)
    if not (valid[0] and valid[1] and valid[2:].any()):
        return None
    # as in C's struct tm: years since 1900, months from 0
    whole_second = datetime(1900 + year, month + 1, day, hour, minute, second, tzinfo=timezone.utc)
    dt = float(delay[:2].mean())
    stamp_ns = int(whole_second.timestamp()) * 1_000_000_000 + fraction * 100_000
    stamp_ns += round(1e9 * dt) if 0.0 <= dt < _LONGEST_DT_S else 0
    weights = valid[2:] / valid[2:].sum()
    vertical = float(np.where(valid[2:], velocity[2:], 0.0) @ weights)
    stds = [*noise[:2].tolist(), float(np.where(valid[2:], noise[2:], 0.0) @ weights)]
    covariance = np.diag(np.square(stds)) if all(math.isfinite(std) and std > 0.0 for std in stds) else None
    x, y, z = (FLU_FROM_FRD @ [velocity[0], velocity[1], vertical] + 0.0).tolist()
    return DvlSample(stamp_ns, (x, y, z), covariance)


PD0_START = b"\x7f\x7f"
# number of bytes that identify a file's kind
_SNIFFED = 65536
_FIXED_LEADER, _VARIABLE_LEADER, _BOTTOM_TRACK = 0x0000, 0x0080, 0x0600
_AXES = ("beam", "instrument", "ship", "earth")
# beam angles from the vertical, degrees, by bits of the fixed leader; other angles have their own field there
_BEAM_ANGLES = {0: 15, 1: 20, 2: 30}
# bits of EZ: values that come from a sensor
_TEMPERATURE_SENSOR, _CONDUCTIVITY_SENSOR = 1, 2
# velocity of a beam or axis that was not measured, mm/s
_BAD_VELOCITY = -32768
# forward-left-up from RDI's starboard, forward, up
_FLU_FROM_RDI: Array = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def is_dvl_log(path: Path) -> bool:
    """Return whether a file's content looks like an instrument's log. Raises InputError if it cannot be read."""
    try:
        with path.open("rb") as file:
            start = file.read(_SNIFFED)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    kinds = (is_dataflash, is_telemetry, is_nortek_log, is_pd6, is_sentences)
    if any(is_kind(start) for is_kind in kinds):
        return True
    return (PD0_START in start[:4096] and _next_ensemble(start, 0) is not None) or _holds_json(start)


def read_dvl_log(path: Path) -> DvlLog:
    """Read a log of any kind. Raises InputError if it is none, or has no usable velocity."""
    with path.open("rb") as file:
        start = file.read(_SNIFFED)
    if is_dataflash(start) or is_telemetry(start):
        log = read_ardupilot_log(path, start)
    else:
        content = path.read_bytes()
        kinds = [kind for kind, (holds, _) in _KINDS.items() if holds(content)]
        log = (_KINDS[kinds[0]][1] if kinds else _read_pd0)(path, content)
        if len(kinds) > 1:
            others = " and ".join(kinds[1:])
            note = f"{path}: holds {others} as well as {kinds[0]}, which alone are imported; split it for the rest"
            log = log._replace(notes=(*log.notes, note))
    if not log.samples:
        why = ", ".join(f"{count} {reason}" for reason, count in log.left_out.items()) or "no report in it"
        raise InputError(f"{path}: no velocity that can be used ({why})")
    in_order = sorted({sample.stamp_ns: sample for sample in log.samples}.values(), key=lambda one: one.stamp_ns)
    log.left_out["of a time that was there already"] += len(log.samples) - len(in_order)
    return log._replace(samples=in_order, left_out=+log.left_out)


def _holds_json(content: bytes) -> bool:
    return re.search(rb'"vx"\s*:', content) is not None


def _read_json(path: Path, content: bytes) -> DvlLog:
    """Read Water Linked's JSON reports, one a line."""
    samples: list[DvlSample] = []
    left_out: Counter[str] = Counter()
    for line in content.decode("utf-8", "replace").splitlines():
        start = line.find("{")  # a logger may prepend its own time
        if start < 0:
            continue
        try:
            report = json.loads(line[start:])
        except (ValueError, RecursionError):  # no JSON, or a number with thousands of digits
            left_out["not valid JSON"] += 1
            continue
        if isinstance(report, dict) and "vx" in report:
            sample = _json_sample(path, report, left_out)
            if sample is not None:
                samples.append(sample)
    return DvlLog(samples, left_out)


def _json_sample(path: Path, report: dict[str, Any], left_out: Counter[str]) -> DvlSample | None:
    """Return a report's velocity, forward-left-up; None, counted, if unusable."""
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


def _next_ensemble(content: bytes, start: int) -> tuple[int, int] | None:
    """Return start and end of the next whole ensemble with a valid checksum; None if there is none."""
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
    """Yield ID and data of all parts of each whole ensemble."""
    start = 0
    while (found := _next_ensemble(content, start)) is not None:
        begin, start = found
        body = content[begin : start - 2]
        n_types = body[5]
        if 6 + 2 * n_types > len(body):
            continue
        offsets = struct.unpack_from(f"<{n_types}H", body, 6)
        yield [(struct.unpack_from("<H", body, part)[0], body[part:]) for part in offsets if part + 2 <= len(body)]


def _read_pd0(path: Path, content: bytes) -> DvlLog:
    """Read velocities, attitudes, NMEA and water properties from PD0 ensembles."""
    samples: list[DvlSample] = []
    attitudes: dict[int, tuple[float, float, float]] = {}
    left_out: Counter[str] = Counter()
    nmea = Nmea()
    waters: list[WaterReading] = []
    alignments: Counter[float] = Counter()
    for ensemble in _ensembles(content):
        data = dict(ensemble)
        try:
            stamp_ns = _pd0_stamp(data)
            for identity, message in ensemble:
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
    nominal_yaw = -alignment if alignment or (stamps and not nmea.headings()[0]) else None
    return DvlLog(samples, left_out + nmea.left_out, nmea.references(), imu, notes, waters, nominal_yaw)


def _pd0_attitudes(
    path: Path, attitudes: dict[int, tuple[float, float, float]], nmea: Nmea
) -> tuple[list[int], Array, tuple[str, ...]]:
    """Return stamps, roll, pitch, heading (N, 3) rad, and notes on their source."""
    dvl_stamps = sorted(attitudes)
    rpy = np.array([attitudes[stamp] for stamp in dvl_stamps]).reshape(-1, 3)
    stamps, headings = nmea.headings()
    if stamps and dvl_stamps:
        since_first, dvl_since_first = (np.array(ns, dtype=np.int64) - dvl_stamps[0] for ns in (stamps, dvl_stamps))
        tilts = [np.interp(since_first, dvl_since_first, rpy[:, axis]) for axis in (0, 1)]
        note = f"{path}: the heading is from its HDT sentences, pitch and roll are the DVL's own"
        return stamps, np.column_stack([*tilts, headings]), (note,)
    if not len(rpy) or not np.ptp(rpy, axis=0).any():  # no sensor: a constant setting
        return [], rpy[:0], ()
    note = (
        f"{path}: heading, pitch and roll are from the DVL's own sensors; the heading is magnetic unless the "
        "setting EB is the declination; give --attitude for another source"
    )
    return dvl_stamps, rpy, (note,)


def _pd0_attitude(data: dict[int, bytes]) -> tuple[float, float, float] | None:
    """Return roll, pitch, heading, rad; None if the ensemble is too short.

    Pitch of a sensor that tilts with the DVL: tan P = tan T1 · cos T2 (RDI, "ADCP Coordinate Transformation", 2008, eq.
    19).
    """
    try:
        heading, tilt_1, tilt_2 = struct.unpack_from("<H2h", data[_VARIABLE_LEADER], 18)
    except struct.error:
        return None
    roll = math.radians(0.01 * tilt_2)
    pitch = math.atan(math.tan(math.radians(0.01 * tilt_1)) * math.cos(roll))
    return roll, pitch, math.radians(0.01 * heading)


def _pd0_alignment(data: dict[int, bytes]) -> float:
    """Return EA, rad: the angle of beam 3 clockwise from the ship's centre line."""
    (hundredths,) = struct.unpack_from("<h", data[_FIXED_LEADER], 26)
    return math.radians(0.01 * hundredths)


def _ship_attitudes(rpy: Array, alignment: float) -> Array:
    """Return the ship's roll, pitch and heading (N, 3), rad, from its heading and the instrument's tilts."""
    from scipy.spatial.transform import Rotation

    instrument = Rotation.from_euler("ZYX", rpy[:, ::-1] + [alignment, 0.0, 0.0])
    ship: Array = (instrument * Rotation.from_euler("Z", -alignment)).as_euler("ZYX")
    return ship[:, ::-1]


def _pd0_water(stamp_ns: int, data: dict[int, bytes]) -> WaterReading | None:
    """Return the speed of sound used for the velocities (EC), and measured temperature and salinity.

    By EZ's bits, a temperature or salinity that was only configured is omitted.
    """
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
    """Return the stamp (ns) of an ensemble's clock, taken as UTC."""
    year, month, day, hour, minute, second, hundredths = data[_VARIABLE_LEADER][4:11]
    # RDI's year has two digits; no DVL before 2000 has this format
    at = datetime(2000 + year, month, day, hour, minute, second, tzinfo=timezone.utc)
    return int(at.timestamp()) * 1_000_000_000 + hundredths * 10_000_000


def _pd0_sample(path: Path, stamp_ns: int, data: dict[int, bytes], left_out: Counter[str]) -> DvlSample | None:
    """Return an ensemble's bottom-track velocity in the DVL's axes; None, counted, if unusable."""
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
        turned = _applied_rotation(roll, pitch, heading + _pd0_alignment(data), data[_FIXED_LEADER])
        instrument = turned.T @ measured[:3]
    x, y, z = (-0.001 * _FLU_FROM_RDI @ instrument + 0.0).tolist()
    return DvlSample(stamp_ns, (x, y, z), None)


def _instrument_from_beams(fixed: bytes) -> Array:
    """Return (3, 4) for four beams 90° apart (RDI, "ADCP Coordinate Transformation", 2008, eq. 2 to 4)."""
    angle = math.radians(_BEAM_ANGLES.get(fixed[5] & 3, fixed[58] if len(fixed) > 58 else 0))
    convex = 1.0 if fixed[4] & 8 else -1.0
    a, b = convex / (2.0 * math.sin(angle)), 1.0 / (4.0 * math.cos(angle))
    return np.array([[a, -a, 0.0, 0.0], [0.0, 0.0, -a, a], [b, b, b, b]])


def _applied_rotation(roll: float, pitch: float, heading: float, fixed: bytes) -> Array:
    """Return the rotation (3, 3) that the instrument applied: heading of beam 3 and, if configured, tilts.

    fixed: fixed leader. (Same document, eq. 18.) The transpose undoes the rotation exactly, even if the heading is
    inaccurate.
    """
    from scipy.spatial.transform import Rotation

    tilts = [pitch, roll] if fixed[25] & 4 else [0.0, 0.0]
    return np.asarray(Rotation.from_euler("ZXY", [-heading, *tilts]).as_matrix())


# content kinds: test and reader; the first that matches is used
_KINDS: dict[str, tuple[Callable[[bytes], bool], Callable[[Path, bytes], DvlLog]]] = {
    "Nortek's records": (is_nortek_log, _read_nortek),
    "Water Linked's reports": (_holds_json, _read_json),
    "RDI's ensembles": (lambda content: _next_ensemble(content, 0) is not None, _read_pd0),
    "PD6 text": (is_pd6, read_pd6),
    "sentences of a DVL": (is_sentences, read_sentences),
}
