"""The published validation procedure: injected errors, data sets, published figures, trajectories.

Source: Yampolsky and Klein, "Information-Aided DVL Calibration". The paper publishes neither P0, R nor its noise seeds.
Errors and beams use the recorded frame (forward-right-down); results are forward-left-up.

    Txx_dvl.csv       time s; velocity over ground m/s, body frame: surge (forward), sway (starboard), heave (down)
    Txx_attitude.csv  optional: time s, the same stamps; roll, pitch, yaw rad of that body in north-east-down, Z-Y-X

The recorded velocities are public: T01-T13 in github.com/ansfl/A-KIT (its runs 1-10, 13, 11, 12), T14 and T15 in
github.com/ansfl/BeamsNet (windows of its training velocities, rotated by -44.4° about z to the body). Neither has a
licence, so users download them, and this project does not include them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from zlib import crc32

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import FLU_FROM_FRD, Array, attitude_enu_flu_from_ned_frd
from ..errors import InputError
from ..logs.dvl_log import angular_velocities
from ..logs.trajectories import read_columns
from ..simulation.sensors import DvlErrors, equivalent_error_terms
from ..simulation.trajectories import make_motion
from .results import UNCALIBRATED, CalibrationSet

MISALIGNMENTS_DEG = ((5.0, -0.5, 2.5), (0.5, 1.0, -1.5), (-2.5, 1.8, 4.0), (-1.0, -2.5, -3.0), (2.0, 0.5, 4.2))
SCALES_PERCENT = ((0.5, 0.3, 0.7), (0.2, 0.7, 0.6), (0.9, 0.5, 0.1))
BEAM_BIAS = (0.007, 0.001, 0.003, 0.009)
BEAM_STD = 0.005
GNSS_STD = 0.2

SETS = (
    CalibrationSet("E1", "T12", 200.0),
    CalibrationSet("E2", "T13", None),
    CalibrationSet("E3", "T14", None),
    CalibrationSet("E4", "T15", None),
)
WINDOWS_S: tuple[float | None, ...] = (50.0, 100.0, 120.0, 140.0, 160.0, 180.0, 200.0, None)
# runs to evaluate models with attitude: manoeuvres, none of them a calibration run of the paper
MANOEUVRING = tuple(f"T{number:02d}" for number in range(1, 11))
TRAJECTORIES = tuple(f"T{number:02d}" for number in range(1, 16))

_COLUMNS = (UNCALIBRATED, "M1", "M2", "M3", "M4", "M5", "M6", "M7")
_ROWS = {
    "E1": (0.1185, 0.0522, 0.0421, 0.0342, 0.0400, 0.0665, 0.0646, 0.0625),
    "E2": (0.1173, 0.0416, 0.0396, 0.0294, 0.0371, 0.0893, 0.0945, 0.0739),
    "E3": (0.1197, 0.0550, 0.0391, 0.0304, 0.0328, 0.0634, 0.0625, 0.0798),
    "E4": (0.1197, 0.0529, 0.0411, 0.0564, 0.0413, 0.1058, 0.1229, 0.0888),
}
PUBLISHED: Mapping[str, Mapping[str, float]] = {
    name: dict(zip(_COLUMNS, row, strict=True)) for name, row in _ROWS.items()
}


def _errors(angles_deg: tuple[float, float, float], percent: tuple[float, float, float]) -> DvlErrors:
    roll, pitch, yaw = np.deg2rad(angles_deg).tolist()
    x, y, z = (0.01 * value for value in percent)
    return DvlErrors((roll, pitch, yaw), (x, y, z), BEAM_BIAS, BEAM_STD)


COMBINATIONS: tuple[DvlErrors, ...] = tuple(
    _errors(angles, percent) for angles, percent in product(MISALIGNMENTS_DEG, SCALES_PERCENT)
)


@cache
def truth() -> Array:
    """Return φ (rad) and δk (B, 6) of every combination, as estimates in forward-left-up.

    The beam biases are not part of any model.
    """
    pairs = [equivalent_error_terms(errors) for errors in COMBINATIONS]
    return np.array([[*FLU_FROM_FRD @ misalignment, *scale] for misalignment, scale in pairs])


def random_stream(sensor: str, seed: int, trajectory: str, combination: int) -> np.random.Generator:
    """Return the generator of one sensor's noise.

    It depends only on its purpose, so that results do not depend on the order or number of workers.
    """
    return np.random.default_rng([seed, combination, crc32(f"{sensor} {trajectory}".encode())])


LONGEST_WINDOW_S = max(window for window in WINDOWS_S if window is not None)
SHORTEST_S = 60.0  # of a trajectory used only for evaluation
MIN_OTHERS = 2
# faster than any vehicle with a DVL: wrong units
MAX_SPEED = 10.0
LARGEST_ANGLES = np.array([np.pi, np.pi / 2, 2 * np.pi])


@dataclass(frozen=True)
class Trajectory:
    """A recorded run. Body frame forward-left-up.

    time: (N,) s.
    velocity: (N, 3) m/s over ground, used as truth.
    rotation_enu_from_body: (N, 3, 3), angular_velocity: (N, 3) rad/s in the body frame, None without attitude.
    """

    name: str
    time: Array
    velocity: Array
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None

    @cached_property
    def quaternions(self) -> Array:
        """Quaternions (N, 4) x, y, z, w of the attitude, which the run must have."""
        quaternions: Array = Rotation.from_matrix(self.rotation_enu_from_body).as_quat()
        return quaternions

    @property
    def seconds(self) -> float:
        """Length: as many sample intervals as samples, so 400 samples at 1 Hz are 400 s."""
        return float((self.time[-1] - self.time[0]) * len(self.time) / (len(self.time) - 1))

    def first(self, window_s: float | None) -> int:
        """Return the number of samples in the first window_s (None: all)."""
        if window_s is None:
            return len(self.time)
        return int(np.searchsorted(self.time, self.time[0] + window_s))

    def part(self, start: int, end: int) -> Trajectory:
        """Return the samples start .. end - 1."""
        columns = ("time", "velocity", "rotation_enu_from_body", "angular_velocity")
        given = ((name, getattr(self, name)) for name in columns)
        return replace(self, **{name: values[start:end] for name, values in given if values is not None})


def load_folder(folder: Path, partial: bool = False) -> tuple[dict[str, Trajectory], tuple[str, ...]]:
    """Load the trajectories of a folder by name; also return notes.

    partial: continue without missing trajectories, if the procedure remains meaningful. Raises InputError with file and
    row.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give one with T01_dvl.csv .. T15_dvl.csv, or none")
    missing = [name for name in TRAJECTORIES if not (folder / f"{name}_dvl.csv").is_file()]
    _check_missing(folder, missing, partial)
    notes = [f"{', '.join(missing)} missing: averages are over the others, not as published"] if missing else []
    needed = {each.calibration_run for each in SETS}
    runs: dict[str, Trajectory] = {}
    for name in TRAJECTORIES:
        if name not in missing:
            runs[name] = _load(folder, name, LONGEST_WINDOW_S if name in needed else SHORTEST_S)
    return runs, tuple(notes)


def _check_missing(folder: Path, missing: list[str], partial: bool) -> None:
    """Raise InputError for missing trajectories, unless `partial` and enough others."""
    files = ", ".join(f"{name}_dvl.csv" for name in missing[:3]) + (" and more" if len(missing) > 3 else "")
    needed = [each.calibration_run for each in SETS]
    enough = not set(needed) & set(missing) and len(TRAJECTORIES) - len(missing) >= len(needed) + MIN_OTHERS
    if missing and not enough:
        raise InputError(f"{folder}: {files} missing; needs {', '.join(needed)} and {MIN_OTHERS} others, or two bags")
    if missing and not partial:
        raise InputError(f"{folder}: {files} missing; fetch these files, or continue without them by --partial")


def _load(folder: Path, name: str, shortest_s: float) -> Trajectory:
    """Load a trajectory, at least this long. Raises InputError for implausible speeds or a short file."""
    path = folder / f"{name}_dvl.csv"
    time, velocity = _read_whole_file(path, "m/s")
    fast = np.linalg.norm(velocity, axis=1) > MAX_SPEED
    if fast.any():
        row = int(np.argmax(fast))
        speed = float(np.linalg.norm(velocity[row]))
        raise InputError(f"{path}: row {row + 1}: {speed:.4g} m/s is too fast; convert the file to m/s")
    run = Trajectory(name, time, velocity @ FLU_FROM_FRD)
    if len(time) < 2 or run.seconds < shortest_s:
        length = run.seconds if len(time) > 1 else 0.0
        raise InputError(
            f"{path}: ends at row {len(time)} after {length:.0f} s, needs {shortest_s:.0f} s; download the whole file"
        )
    attitude = folder / f"{name}_attitude.csv"
    return _with_attitude(run, attitude) if attitude.is_file() else run


def _read_whole_file(path: Path, unit: str) -> tuple[Array, Array]:
    """Return time and values of a file without omissions, because the procedure averages over whole files."""
    time, values, left_out = read_columns(path, unit)
    if left_out:
        raise InputError(f"{left_out[0]}; the procedure needs whole files; download it again")
    return time, values


def _with_attitude(run: Trajectory, path: Path) -> Trajectory:
    """Add the attitude of a file to a run. Raises InputError for implausible angles or other times."""
    time, rpy = _read_whole_file(path, "rad")
    wide = (np.abs(rpy) > LARGEST_ANGLES + 1e-9).any(axis=1)
    if wide.any():
        raise InputError(f"{path}: row {int(np.argmax(wide)) + 1} holds no roll, pitch, yaw in rad; convert the file")
    common = min(len(time), len(run.time))
    differs = np.abs(time[:common] - run.time[:common]) > 1e-6
    if differs.any() or len(time) != len(run.time):
        row = int(np.argmax(differs)) if differs.any() else common
        raise InputError(f"{path}: row {row + 1}: its time differs from {run.name}_dvl.csv; resample it")
    rotation = attitude_enu_flu_from_ned_frd(rpy)
    return Trajectory(run.name, run.time, run.velocity, rotation, angular_velocities(time, rotation))


# simulated trajectories: kind of motion, length (s), whether attitude is recorded; lengths and rate as published
_MANOEUVRES = ("box", "lawnmower", "figure8")
_OWN: Mapping[str, tuple[str, float, bool]] = {
    **{f"T{number:02d}": (_MANOEUVRES[number % 3], 400.0, True) for number in range(1, 12)},
    "T12": ("straight", 400.0, True),
    "T13": ("straight", 400.0, True),
    "T14": ("straight", 500.0, False),
    "T15": ("straight", 600.0, False),
}
_RATE_HZ = 1.0
_MOTION_RATE_HZ = 20.0
_CURRENT_STD = 0.1  # m/s, east and north, different on every trajectory
_SEED = 2026


def own_trajectories() -> dict[str, Trajectory]:
    """Return fifteen simulated trajectories with the lengths and kinds of the published ones."""
    return {name: _simulated(name, *kind) for name, kind in _OWN.items()}


def _simulated(name: str, kind: str, seconds: float, with_attitude: bool) -> Trajectory:
    """Simulate a trajectory of this kind and length, with its own seed."""
    rng = np.random.default_rng([_SEED, *name.encode()])
    skipped_s = float(np.floor(rng.uniform(0.0, 100.0)))  # so that two of one kind differ
    motion = make_motion(kind, skipped_s + seconds, _MOTION_RATE_HZ)
    at = slice(int(skipped_s * _MOTION_RATE_HZ), None, int(_MOTION_RATE_HZ / _RATE_HZ))
    rotation = motion.rotation_enu_from_body[at]
    current_enu = np.array([*rng.normal(0.0, _CURRENT_STD, 2), 0.0])
    velocity = motion.velocity_body[at] + current_enu @ rotation
    time = motion.time[at] - motion.time[at][0]
    if not with_attitude:
        return Trajectory(name, time, velocity)
    return Trajectory(name, time, velocity, rotation, angular_velocities(time, rotation))
