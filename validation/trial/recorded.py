"""Real motion: the recorded sea trials of Snapir, told as a motion that is continuous in time.

They stay where they are and are found by the environment or beside the project; where they are not, the cases that need
them are left out.
"""

from __future__ import annotations

import csv
import os
from functools import cache
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from dvl_calib_ros.errors import InputError

from .motion import MARGIN_S, RATE_HZ, Floats, Motion, attitude, sampled_motion

DVL_FOLDER, INS_FOLDER, BOAT_FOLDER = "snapir", "snapir_ins", "caputh"
# T11 and T13 hardly turn
RECORDINGS = tuple(f"T{number:02d}" for number in range(1, 11))
# Velocity by the inertial system, whose noise is small; of the others there is that by the DVL only
WITH_INS = ("T01", "T03", "T05", "T09")
WITHOUT_INS = ("T02", "T04", "T06", "T07", "T08", "T10", "T12")
# A boat that goes at one speed, at 1 Hz as well; a third one is too short
BY_BOAT = ("20250117163514", "20250117164453")
# Recorded at 1 Hz: what changes faster than this is noise of the recording as much as motion
SMOOTHING_S = 1.5
# m/s, from what the boat usually does: such a sample is none
NO_BOAT_MPS = 5.0
NO_RECORDINGS = "no recorded sea trials; name the folder that has data/snapir and data/snapir_ins in DVL_CALIB_SHARED"


def recordings_folder() -> Path | None:
    """Folder of the recorded sea trials, if they are there.

    $DVL_CALIB_SHARED/data, else the folder of $DVL_CALIB_SNAPIR, else ../shared/data beside the project.
    """
    if shared := os.environ.get("DVL_CALIB_SHARED"):
        folder = Path(shared) / "data"
    elif snapir := os.environ.get("DVL_CALIB_SNAPIR"):
        folder = Path(snapir).parent
    else:
        folder = Path(__file__).resolve().parents[3] / "shared" / "data"
    return folder if (folder / DVL_FOLDER / "T01_attitude.csv").is_file() else None


def has_boat(folder: Path | None) -> bool:
    """Whether the recordings of the boat are there, too."""
    return folder is not None and (folder / BOAT_FOLDER / f"{BY_BOAT[0]}_dvl.csv").is_file()


def has_ins(folder: Path | None) -> bool:
    """Whether the recordings with the velocity of an inertial system are there, too."""
    return folder is not None and (folder / INS_FOLDER / "T01_gnss.csv").is_file()


@cache
def recorded(name: str, smoothing_s: float = SMOOTHING_S, by_ins: bool = False) -> Motion:
    """The motion of a recorded run of 400 s, less MARGIN_S at both ends. Raises InputError where it is not.

    smoothing_s: standard deviation of the Gaussian that takes out what is noise of the recording. by_ins: velocity of
    the inertial system, north, east, down; else that of the DVL, forward, right, down. A cubic spline of the result is
    the truth.
    """
    folder = recordings_folder()
    if folder is None or (by_ins and not has_ins(folder)):
        raise InputError(NO_RECORDINGS)
    seconds, rpy_ned = _columns(folder / DVL_FOLDER / f"{name}_attitude.csv")
    at, velocity = _columns(folder / (f"{INS_FOLDER}/{name}_gnss.csv" if by_ins else f"{DVL_FOLDER}/{name}_dvl.csv"))
    roll, pitch, yaw = np.unwrap(rpy_ned, axis=0).T
    angles = _spline(seconds, np.column_stack([np.pi / 2 - yaw, -pitch, roll]), smoothing_s)
    velocities = _spline(at, velocity[:, [1, 0, 2]] * [1.0, 1.0, -1.0] if by_ins else velocity * [1.0, -1.0, -1.0],
                         smoothing_s)  # fmt: skip
    start = max(seconds[0], at[0]) + MARGIN_S
    length = float(min(seconds[-1], at[-1]) - MARGIN_S - start)
    return _motion(angles, velocities, start, length, in_body=not by_ins)


@cache
def by_boat(name: str, smoothing_s: float = SMOOTHING_S) -> Motion:
    """The motion of a run of the boat, less MARGIN_S at both ends. Raises InputError where it is not there.

    Its compass is taken for the truth: what moves is real, where it points need not be.
    """
    folder = recordings_folder()
    if folder is None or not has_boat(folder):
        raise InputError(NO_RECORDINGS)
    seconds, angles_deg = _columns(folder / BOAT_FOLDER / f"{name}_attitude.csv")
    at, velocity = _columns(folder / BOAT_FOLDER / f"{name}_dvl.csv")
    measured = (np.abs(velocity - np.median(velocity, axis=0)) < NO_BOAT_MPS).all(axis=1)
    at, velocity = at[measured], velocity[measured]
    yaw, pitch, roll = np.unwrap(np.radians(angles_deg), axis=0).T
    start = max(seconds[0], at[0]) + MARGIN_S
    length = float(min(seconds[-1], at[-1]) - MARGIN_S - start)
    angles = _spline(seconds, np.column_stack([np.pi / 2 - yaw, -pitch, roll]), smoothing_s)
    return _motion(angles, _spline(at, velocity, smoothing_s), start, length, in_body=True)


def _motion(angles: CubicSpline, velocities: CubicSpline, start: float, length: float, in_body: bool) -> Motion:
    time = np.arange(-MARGIN_S, length + MARGIN_S, 1.0 / RATE_HZ)
    euler, moving = angles(time + start), velocities(time + start)
    return sampled_motion(length, time, attitude(euler).apply(moving) if in_body else moving, euler)


def _spline(seconds: Floats, columns: Floats, smoothing_s: float) -> CubicSpline:
    sigma = smoothing_s / float(np.median(np.diff(seconds)))
    return CubicSpline(seconds, gaussian_filter1d(columns, sigma, axis=0, mode="nearest") if sigma else columns)


def _columns(path: Path) -> tuple[Floats, Floats]:
    with path.open(newline="") as file:
        rows = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
    return rows[:, 0], rows[:, 1:]
