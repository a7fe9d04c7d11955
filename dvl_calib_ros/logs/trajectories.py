"""Trajectories as CSV or NPY: a column of time and three of values.

Columns are identified by their order. A header is checked for the units (``Time [s]`` and m/s or rad) and the axes.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bags.writer import BagWriter, Compression, Storage
from ..calibration.numerics.frames import FLU_FROM_FRD, Array, Vector, over_ground
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from ..errors import InputError
from ..messages.encode import SampleWriter, SatelliteFix
from .dvl_log import DvlLog, imu_samples
from .dvl_logs import is_dvl_log, read_dvl_log
from .text_logs import KNOT, is_nmea, read_rmc

# Columns of numbers and stamps in CSV files.

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
            excerpt = ",".join(row)[:SHOWN]
            raise InputError(f"{path}: data row {number} is not all numbers: {excerpt}; expected {EXPECTED}") from None
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


FRAMES = ("frd", "flu", "enu", "ned")  # the body's frames first
SUFFIXES = ("csv", "npy")
# words of a header that identify the axis of each of the three values
AXIS_NAMES = ({"x", "vx", "surge", "roll"}, {"y", "vy", "sway", "pitch"}, {"z", "vz", "heave", "yaw"})


class TimedRows(NamedTuple):
    """Time (N,) s, values (N, 3), and one sentence per omission from the file."""

    time: Array
    values: Array
    left_out: tuple[str, ...] = ()


def read_columns(path: Path, unit: str) -> TimedRows:
    """Read rows of a CSV or NPY file, values in `unit`. Raises InputError naming file and row.

    Rows without a finite number in every column are omitted with a note, like invalid samples of a bag; so is an
    unfinished last line of a CSV file, whose last number may be cut off.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    table, left_out = (_read_npy(path), []) if path.suffix == ".npy" else _read_csv(path, unit)
    if table.ndim != 2 or table.shape[1] != N_COLUMNS or not len(table):
        raise InputError(f"{path}: expected rows of time and three values, found shape {table.shape}")
    good = np.isfinite(table).all(axis=1)
    rows = np.flatnonzero(good) + 1
    if not len(rows):
        raise InputError(f"{path}: every row has a value that is not a finite number")
    if n_bad := len(table) - len(rows):
        first = f"the first is row {int(np.argmin(good)) + 1}"
        left_out.insert(0, f"{path}: {n_bad} of {len(table)} rows have a value that is not finite, left out; {first}")
    table = table[good]
    backwards = np.diff(table[:, 0]) <= 0.0
    if backwards.any():
        raise InputError(f"{path}: time does not increase at row {rows[int(np.argmax(backwards)) + 1]}")
    return TimedRows(table[:, 0], table[:, 1:], tuple(left_out))


def _read_npy(path: Path) -> Array:
    """Read an array from a NumPy file. Raises InputError."""
    try:
        return np.asarray(np.load(path, allow_pickle=False), dtype=float)
    except Exception as error:  # damaged files raise many types, MemoryError among them
        raise InputError(f"{path}: not a NumPy array file of numbers ({error})") from error


def _read_csv(path: Path, unit: str) -> tuple[Array, list[str]]:
    """Return rows of numbers, nan if missing, and notes on the file."""
    rows, left_out = cells(path)
    if rows and not _is_number(rows[0][0]):
        _check_header(path, rows.pop(0), unit)
    return numbers_of(path, rows, range(N_COLUMNS), N_COLUMNS), left_out


def _check_header(path: Path, header: list[str], unit: str) -> None:
    """Check number, units and order of columns, as far as their names indicate them. Raises InputError."""
    if len(header) != N_COLUMNS:
        names = ", ".join(cell.strip() for cell in header)[:SHOWN]
        raise InputError(
            f"{path}: has {len(header)} columns, expected {EXPECTED}; of a DVL's table name all four with --columns "
            f"time=NAME,vx=NAME,vy=NAME,vz=NAME; there are {names}"
        )
    units = [re.search(r"[\[(](.*)[\])]", cell) for cell in header]
    for cell, stated, expected in zip(header, units, ["s", unit, unit, unit], strict=False):
        if stated and stated.group(1).strip().lower() != expected:
            raise InputError(f"{path}: column {cell[:SHOWN]!r} is not in {expected}; convert it first")
    if "time" not in header[0].lower() and header[0].strip().lower() not in ("t", "s", "stamp", "t_s"):
        raise InputError(f"{path}: the first column is {header[0][:SHOWN]!r}, expected time")
    for position, cell in enumerate(header[1:]):
        words = set(re.findall("[a-z]+", re.sub(r"[\[(].*", "", cell.lower())))
        if any(words & names for axis, names in enumerate(AXIS_NAMES) if axis != position):
            raise InputError(
                f"{path}: column {cell[:SHOWN]!r} is at the place of {'xyz'[position]}; sort them: time, x, y, z"
            )


def body_from(frame: str) -> Array:
    """Return (3, 3) from a trajectory's body frame (flu or frd) to forward-left-up."""
    return FLU_FROM_FRD if frame == "frd" else np.eye(3)


def read_dvl(path: Path, start_ns: int, frame: str, std: float, notes: list[str]) -> list[DvlSample]:
    """Read velocities in `frame` (flu, frd) as DVL samples in forward-left-up; std (m/s) 0: covariance not given.

    notes: receives remarks on omitted data, here and in the other readers.
    """
    return [DvlSample(*each) for each in _velocities(path, start_ns, frame, std, notes)]


def read_reference(path: Path, start_ns: int, frame: str, std: float, notes: list[str]) -> list[ReferenceSample]:
    """Read reference velocities, in the body (frame flu, frd) or the earth (enu, ned)."""
    earth = {"enu": VelocityFrame.ENU, "ned": VelocityFrame.NED}.get(frame, VelocityFrame.BODY)
    return [ReferenceSample(*each, earth) for each in _velocities(path, start_ns, frame, std, notes)]


def _velocities(
    path: Path, start_ns: int, frame: str, std: float, notes: list[str]
) -> Iterator[tuple[int, Vector, Array | None]]:
    """Yield stamp, velocity and covariance of each row, in the body forward-left-up."""
    time, velocity, left_out = read_columns(path, "m/s")
    notes += left_out
    return _stamped(path, start_ns, time, velocity @ body_from(frame).T, std)


def _stamped(
    path: Path, start_ns: int, time: Array, velocity: Array, std: float
) -> Iterator[tuple[int, Vector, Array | None]]:
    """Yield stamp, velocity and covariance of velocities (N, 3) m/s at times (N,) s."""
    covariance = np.eye(3) * std**2 if std else None
    for at, (x, y, z) in zip(stamps_ns(path, time, start_ns), velocity.tolist(), strict=True):
        yield at, (x, y, z), covariance


def read_attitude(path: Path, start_ns: int, notes: list[str]) -> list[ImuSample]:
    """Read roll, pitch, yaw of a forward-right-down body in north-east-down, and derive the angular velocity.

    The angular velocity is the derivative of a smooth curve through the attitudes.
    """
    time, rpy, left_out = read_columns(path, "rad")
    notes += left_out
    return imu_samples(stamps_ns(path, time, start_ns), rpy)


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import: frames (flu, frd; enu, ned for GNSS), covariances to write (m/s, 0: not given).

    start: stamp of time 0, s since 1970. columns: of the DVL's file, by `column_map`. Raises InputError.
    """

    frame: str = "frd"
    gnss_frame: str = "frd"
    dvl_std: float = 0.0
    gnss_std: float = 0.0
    start: float = 1_600_000_000.0
    columns: str = ""
    storage: Storage = Storage.MCAP
    compression: Compression = Compression.NONE

    def __post_init__(self) -> None:
        """Check columns, start, frames and standard deviations. Raises InputError."""
        for name, std in (("--dvl-std", self.dvl_std), ("--gnss-std", self.gnss_std)):
            if not 0.0 <= std <= 100.0:
                raise InputError(f"{name}: {std:g} is outside 0 .. 100 m/s")
        if self.columns:
            column_map(self.columns)
        if not 0.0 <= self.start < 2.0**31:
            raise InputError("--start: give seconds since 1970, 0 .. 2147483647")
        for option, given, known in (("--frame", self.frame, FRAMES[:2]), ("--gnss-frame", self.gnss_frame, FRAMES)):
            if given not in known:
                raise InputError(f"{option}: {given!r} is none of {', '.join(known)}")

    @property
    def start_ns(self) -> int:
        """Stamp of time 0, ns."""
        return round(self.start * 1e9)


class Imported(NamedTuple):
    """Result of an import. counts: number of messages by topic, and of unusable reports by reason.

    notes: sentences on omitted data.
    """

    counts: dict[str, int]
    notes: tuple[str, ...] = ()


def import_files(
    dvl: Path, gnss: Path | None, attitude: Path | None, output: Path, options: ImportOptions
) -> dict[Path, Imported]:
    """Write one recording to a new bag, or each of a folder to its own bag in `output`. Raises InputError."""
    if not dvl.is_dir():
        return {output: import_recording(dvl, gnss, attitude, output, options)}
    if gnss is not None or attitude is not None:
        raise InputError("--gnss and --attitude need a file; in a folder they are found by their names")
    return import_folder(dvl, output, options)


def import_recording(
    dvl: Path, gnss: Path | None, attitude: Path | None, output: Path, options: ImportOptions
) -> Imported:
    """Write one recording to a new bag. Raises InputError, and then writes nothing."""
    if os.path.lexists(output):
        raise InputError(f"{output}: exists already; give another name, or remove it first")
    start_ns = options.start_ns
    notes: list[str] = []
    if options.columns:
        log = read_table(dvl, options.columns, start_ns, body_from(options.frame), options.dvl_std)
    elif dvl.is_file() and is_dvl_log(dvl):
        log = read_dvl_log(dvl)
    else:
        log = DvlLog(read_dvl(dvl, start_ns, options.frame, options.dvl_std, notes), Counter())
    references = list(log.references) if gnss is None else _references(gnss, options, notes)
    has_fixes = gnss is not None and names_columns(gnss, "latitude", "longitude")
    fixes = read_positions(gnss, start_ns, notes) if gnss is not None and has_fixes else []
    if attitude is None:
        attitudes = list(log.attitudes)
        notes += log.notes
    else:
        attitudes = (read_heading if names_columns(attitude, "heading") else read_attitude)(attitude, start_ns, notes)
    with BagWriter(output, options.storage, options.compression) as bag:
        writer = SampleWriter(bag)
        if log.nominal_yaw is not None and (attitude is None or log.nominal_yaw):
            writer.nominal_yaw(log.samples[0].stamp_ns, log.nominal_yaw)
        writer.recording(attitudes, references, fixes, log.samples)
        waters = writer.water(log.waters)
    written = {"dvl/twist": len(log.samples), "gnss/twist": len(references), "imu/data": len(attitudes)}
    written |= {"gnss/fix": len(fixes)} if fixes else {}
    written |= {"readings of the water": waters} if waters else {}
    written |= {f"reports {reason}, left out": count for reason, count in log.left_out.items()}
    return Imported(written, tuple(notes))


def _references(path: Path, options: ImportOptions, notes: list[str]) -> list[ReferenceSample]:
    """Read the reference velocities of a file by its kind; none from positions."""
    if is_nmea(path):
        return read_rmc(path, options.gnss_std, notes)
    if names_columns(path, "speed", "course"):
        return read_course(path, options.start_ns, options.gnss_std, notes)
    if names_columns(path, "latitude", "longitude"):
        return []
    return read_reference(path, options.start_ns, options.gnss_frame, options.gnss_std, notes)


def import_folder(folder: Path, output: Path, options: ImportOptions) -> dict[Path, Imported]:
    """Write every recording of a folder (NAME_dvl.csv or .npy, _gnss, _attitude) to output/NAME. Raises InputError."""
    names = sorted({path.stem.removesuffix("_dvl") for kind in SUFFIXES for path in folder.glob(f"*_dvl.{kind}")})
    if not names:
        raise InputError(f"{folder}: no recordings in it; they are named NAME_dvl.csv or NAME_dvl.npy")
    written: dict[Path, Imported] = {}
    try:
        for name in names:
            dvl, gnss, attitude = (_file(folder, f"{name}_{role}") for role in ("dvl", "gnss", "attitude"))
            assert dvl is not None
            written[output / name] = import_recording(dvl, gnss, attitude, output / name, options)
    except BaseException:  # all or nothing, so that the corrected folder can be imported again
        for bag in written:
            shutil.rmtree(bag, ignore_errors=True)
        raise
    return written


def _file(folder: Path, stem: str) -> Path | None:
    return next((path for kind in SUFFIXES if (path := folder / f"{stem}.{kind}").is_file()), None)


# Text tables of any layout, read by a map of their columns.
#
# The map is time=NAME,vx=NAME,vy=NAME,vz=NAME,valid=NAME. A column is given by its name in the header or by its number
# from 1. Time is in seconds, in ISO 8601, or a time of day with its date (``time=Date+Time``). The separator (comma,
# semicolon, tab) is detected.

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
        if missing == ["vz"] and not unknown:
            what += ", and two velocities show no mounting: import the DVL's own log, or log the vertical one as well"
        raise InputError(f"--columns: {what}; write time=NAME,vx=NAME,vy=NAME,vz=NAME,valid=NAME")
    return found


def read_table(path: Path, text: str, start_ns: int, rotation: Array, std: float) -> DvlLog:
    """Read the velocities of a table. Raises InputError naming file and column.

    text: the map.
    start_ns: stamp of time 0.
    rotation: (3, 3) to forward-left-up.
    std: m/s; 0: covariance not given.
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
    indices = {key: [_column_index(path, rows[:1], name) for name in names[key].split("+")] for key in names}
    covariance = np.eye(3) * std**2 if std else None
    samples: list[DvlSample] = []
    left_out: Counter[str] = Counter()
    for row in rows[_is_header(rows[:1], indices["vx"][0]) :]:
        try:
            stamp_ns = _stamp_ns(" ".join(row[index].strip() for index in indices["time"]), start_ns)
            velocity = rotation @ [float(row[indices[key][0]]) for key in _NEEDED[1:]]
        except (ValueError, IndexError, OverflowError):
            left_out["without a time or a velocity"] += 1
            continue
        if not np.isfinite(velocity).all() or not 0 < stamp_ns < 2**31 * 1_000_000_000:
            left_out["without a time or a velocity"] += 1
        elif "valid" in indices and row[indices["valid"][0]].strip().lower() in _FALSE:
            left_out["not valid"] += 1
        else:
            x, y, z = velocity.tolist()
            samples.append(DvlSample(stamp_ns, (x, y, z), covariance))
    if not samples:
        excerpt = repr(",".join(rows[-1])[:SHOWN]) if rows else "it is empty"
        raise InputError(f"{path}: no row with time and velocity in the columns of --columns; the last is {excerpt}")
    by_stamp = {sample.stamp_ns: sample for sample in samples}
    return DvlLog([by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp)], left_out)


def _is_header(rows: Sequence[Sequence[str]], place: int) -> bool:
    """Return whether the first row has no number in a column."""
    try:
        return bool(rows) and math.isnan(float(rows[0][place]))
    except (ValueError, IndexError):
        return True


def _column_index(path: Path, rows: Sequence[Sequence[str]], name: str) -> int:
    """Return the index of a column by its name, its name without the unit, or its number. Raises InputError."""
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    key = name.strip().lower()
    for names in (header, [cell.partition("(")[0].partition("[")[0].strip() for cell in header]):
        if key in names:
            return names.index(key)
    if key.isdecimal() and 0 < int(key) <= len(header):
        return int(key) - 1
    raise InputError(f"{path}: --columns: no column {name!r}; there are {', '.join(header)[:SHOWN] or 'none'}")


def _stamp_ns(text: str, start_ns: int) -> int:
    """Convert a time to a stamp. Raises ValueError if it is invalid."""
    try:
        seconds = float(text)
    except ValueError:
        at = _parse_time(text)
        at = at if at.tzinfo is not None else at.replace(tzinfo=timezone.utc)
        return int(at.replace(microsecond=0).timestamp()) * 1_000_000_000 + at.microsecond * 1000
    return round(seconds * 1e9) + (0 if seconds >= _SINCE_1970_S else start_ns)


def _parse_time(text: str) -> datetime:
    """Parse a date and time in one of the common formats. Raises ValueError."""
    for form in _FORMATS:
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    # Python 3.10 needs six digits of a second
    text = re.sub(r"\.(\d+)", lambda found: f".{found[1][:6]:0<6}", text.replace("Z", "+00:00"))
    return datetime.fromisoformat(text)


# Course and speed over ground, positions, and compass headings, read by the columns' names.
#
# A receiver's course and speed have no vertical component: it is set to exactly 0, which marks an axis as not measured.
# Units are in a column's name (`_deg`, `[rad]`, `_mps`, `knots`); the default is SI and radians.

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
    each_velocity = _stamped(path, start_ns, time, over_ground(*values.T), std)
    return [ReferenceSample(*each, VelocityFrame.ENU) for each in each_velocity]


def read_positions(path: Path, start_ns: int, notes: list[str]) -> list[SatelliteFix]:
    """Read latitude and longitude. Raises InputError."""
    time, values = _named(path, ("latitude", "longitude"), notes)
    return [*map(SatelliteFix, stamps_ns(path, time, start_ns), *np.degrees(values).T.tolist())]


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
        notes.append(f"{path}: {int((~good).sum())} of {len(table)} rows have a value that is not finite, left out")
    table = table[good]
    if (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError(f"{path}: time does not increase at row {int(np.argmax(np.diff(table[:, 0]) <= 0.0)) + 2}")
    return table[:, 0], table[:, 1:] * [_factor(header[i]) for i in at]


def _factor(cell: str) -> float:
    text = cell.lower()
    return next((factor for unit, factor in _UNITS.items() if unit in text), 1.0)
