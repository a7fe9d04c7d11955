"""Trajectories as CSV or NPY: a column of time and three of values.

Columns are identified by their order. A header is checked for the units (``Time [s]`` and m/s or rad) and the axes.
"""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bags.writer import BagWriter, Compression, Storage
from ..calibration.numerics.frames import FLU_FROM_FRD, Array
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from ..errors import InputError
from ..messages.encode import SampleWriter, SatelliteFix
from .column_map import column_map, read_table
from .csv_columns import EXPECTED, N_COLUMNS, SHOWN, _is_number, cells, numbers_of, stamps_ns
from .dvl_log import DvlLog, imu_samples
from .dvl_logs import is_dvl_log, read_dvl_log

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
            f"{path}: has {len(header)} columns, expected {EXPECTED}; of a DVL's table name them with --columns "
            f"time=NAME,vx=NAME,vy=NAME,vz=NAME; there are {names}"
        )
    units = [re.search(r"[\[(](.*)[\])]", cell) for cell in header]
    for cell, found, expected in zip(header, units, ["s", unit, unit, unit], strict=False):
        if found and found.group(1).strip().lower() != expected:
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
    time, velocity, left_out = read_columns(path, "m/s")
    notes += left_out
    covariance = np.eye(3) * std**2 if std else None
    rows = (velocity @ body_from(frame).T).tolist()
    return [
        DvlSample(at, (x, y, z), covariance)
        for at, (x, y, z) in zip(stamps_ns(path, time, start_ns), rows, strict=True)
    ]


def read_reference(path: Path, start_ns: int, frame: str, std: float, notes: list[str]) -> list[ReferenceSample]:
    """Read reference velocities, in the body (frame flu, frd) or the earth (enu, ned)."""
    time, velocity, left_out = read_columns(path, "m/s")
    notes += left_out
    covariance = np.eye(3) * std**2 if std else None
    earth = {"enu": VelocityFrame.ENU, "ned": VelocityFrame.NED}.get(frame, VelocityFrame.BODY)
    rows = (velocity @ body_from(frame).T).tolist()
    return [
        ReferenceSample(at, (x, y, z), covariance, earth)
        for at, (x, y, z) in zip(stamps_ns(path, time, start_ns), rows, strict=True)
    ]


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
        raise InputError("--gnss and --attitude go with a file; in a folder they are found by their names")
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
    fixes = [] if gnss is None else _fixes(gnss, start_ns, notes)
    if attitude is None:
        attitudes = list(log.attitudes)
        notes += log.notes
    else:
        attitudes = _attitudes(attitude, start_ns, notes)
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
    from .course_and_heading import names_columns, read_course  # imports this module
    from .nmea import is_nmea, read_rmc

    if is_nmea(path):
        return read_rmc(path, options.gnss_std, notes)
    if names_columns(path, "speed", "course"):
        return read_course(path, options.start_ns, options.gnss_std, notes)
    if names_columns(path, "latitude", "longitude"):
        return []
    return read_reference(path, options.start_ns, options.gnss_frame, options.gnss_std, notes)


def _fixes(path: Path, start_ns: int, notes: list[str]) -> list[SatelliteFix]:
    from .course_and_heading import names_columns, read_positions

    return read_positions(path, start_ns, notes) if names_columns(path, "latitude", "longitude") else []


def _attitudes(path: Path, start_ns: int, notes: list[str]) -> list[ImuSample]:
    from .course_and_heading import names_columns, read_heading

    return (read_heading if names_columns(path, "heading") else read_attitude)(path, start_ns, notes)


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
