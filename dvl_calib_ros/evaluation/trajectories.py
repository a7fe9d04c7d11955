"""The trajectories of the procedure: a folder of recorded ones, or fifteen from the project's own generator.

Layout of a folder, one recording a name ``T01`` .. ``T15``:

    Txx_dvl.csv       time s; velocity over ground m/s, body frame: surge (forward), sway (starboard), heave (down)
    Txx_attitude.csv  optional: time s, the same stamps; roll, pitch, yaw rad of that body in north-east-down, Z-Y-X

The recorded velocities are public: T01-T13 in github.com/ansfl/A-KIT (its runs 1-10, 13, 11, 12), T14 and T15 in
github.com/ansfl/BeamsNet (windows of its training velocities, turned by -44.4° about z into the body). Neither names
a licence, so they are fetched by who needs them and no part of this project.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import FLU_FROM_FRD, Array, attitude_enu_flu_from_ned_frd
from ..errors import InputError
from ..logs.dvl_log import angular_velocities
from ..logs.trajectories import read_columns
from ..simulation.trajectories import make_motion
from .protocol import SETS, TRAJECTORIES, WINDOWS_S

LONGEST_WINDOW_S = max(window for window in WINDOWS_S if window is not None)
SHORTEST_S = 60.0  # of a trajectory that is only evaluated on
MIN_OTHERS = 2
# Faster than any vehicle with a DVL: the file is in other units
MAX_SPEED = 10.0
LARGEST_ANGLES = np.array([np.pi, np.pi / 2, 2 * np.pi])


@dataclass(frozen=True)
class Trajectory:
    """A recorded run. Body frame forward-left-up.

    time: (N,) s. velocity: (N, 3) m/s over ground, taken for the truth. rotation_enu_from_body: (N, 3, 3),
    angular_velocity: (N, 3) rad/s in the body frame, None without attitude.
    """

    name: str
    time: Array
    velocity: Array
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None

    @cached_property
    def quaternions(self) -> Array:
        """(N, 4) x, y, z, w of the attitude, which the run has."""
        quaternions: Array = Rotation.from_matrix(self.rotation_enu_from_body).as_quat()
        return quaternions

    @property
    def seconds(self) -> float:
        """Length: as many sample intervals as samples, so 400 samples at 1 Hz are 400 s."""
        return float((self.time[-1] - self.time[0]) * len(self.time) / (len(self.time) - 1))

    def first(self, window_s: float | None) -> int:
        """Number of samples in the first window_s (None: all)."""
        if window_s is None:
            return len(self.time)
        return int(np.searchsorted(self.time, self.time[0] + window_s))

    def part(self, start: int, end: int) -> Trajectory:
        """Samples start .. end - 1."""
        rotation, rates = self.rotation_enu_from_body, self.angular_velocity
        return Trajectory(
            self.name,
            self.time[start:end],
            self.velocity[start:end],
            None if rotation is None else rotation[start:end],
            None if rates is None else rates[start:end],
        )


def load_folder(folder: Path, partial: bool = False) -> tuple[dict[str, Trajectory], tuple[str, ...]]:
    """The trajectories of a folder by name, and what is to be known about them.

    partial: go on without those that are missing, as long as the procedure makes sense at all. Raises InputError naming
    the file, and the row where there is one.
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
    files = ", ".join(f"{name}_dvl.csv" for name in missing)
    needed = [each.calibration_run for each in SETS]
    enough = not set(needed) & set(missing) and len(TRAJECTORIES) - len(missing) >= len(needed) + MIN_OTHERS
    if missing and not enough:
        raise InputError(f"{folder}: {files} missing; it takes {', '.join(needed)} and {MIN_OTHERS} others at least")
    if missing and not partial:
        raise InputError(f"{folder}: {files} missing; fetch what is missing, or go on without it by --partial")


def _load(folder: Path, name: str, shortest_s: float) -> Trajectory:
    path = folder / f"{name}_dvl.csv"
    time, velocity = _whole(path, "m/s")
    fast = np.linalg.norm(velocity, axis=1) > MAX_SPEED
    if fast.any():
        row = int(np.argmax(fast))
        speed = float(np.linalg.norm(velocity[row]))
        raise InputError(f"{path}: row {row + 1}: {speed:.4g} m/s is too fast; convert the file to m/s")
    run = Trajectory(name, time, velocity @ FLU_FROM_FRD)
    if len(time) < 2 or run.seconds < shortest_s:
        length = run.seconds if len(time) > 1 else 0.0
        raise InputError(
            f"{path}: ends at row {len(time)} after {length:.0f} s, needs {shortest_s:.0f} s; fetch it whole"
        )
    attitude = folder / f"{name}_attitude.csv"
    return _with_attitude(run, attitude) if attitude.is_file() else run


def _whole(path: Path, unit: str) -> tuple[Array, Array]:
    """Time and values of a file of which nothing is missing, or averages would not be those of the procedure."""
    time, values, left_out = read_columns(path, unit)
    if left_out:
        raise InputError(f"{left_out[0]}; the procedure takes whole files, fetch it again")
    return time, values


def _with_attitude(run: Trajectory, path: Path) -> Trajectory:
    time, rpy = _whole(path, "rad")
    wide = (np.abs(rpy) > LARGEST_ANGLES + 1e-9).any(axis=1)
    if wide.any():
        raise InputError(f"{path}: row {int(np.argmax(wide)) + 1} holds no roll, pitch, yaw in rad; convert the file")
    common = min(len(time), len(run.time))
    apart = np.abs(time[:common] - run.time[:common]) > 1e-6
    if apart.any() or len(time) != len(run.time):
        row = int(np.argmax(apart)) if apart.any() else common
        raise InputError(f"{path}: row {row + 1}: its time is not that of {run.name}_dvl.csv; resample it to that")
    rotation = attitude_enu_flu_from_ned_frd(rpy)
    return Trajectory(run.name, run.time, run.velocity, rotation, angular_velocities(time, rotation))


# Own trajectories: kind of motion, length (s), whether attitude is recorded; lengths and rate as the published ones
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
_CURRENT_STD = 0.1  # m/s, east and north, another one on every trajectory
_SEED = 2026


def own_trajectories() -> dict[str, Trajectory]:
    """Fifteen trajectories from the project's generator, of the lengths and kinds of the published ones."""
    return {name: _simulated(name, *kind) for name, kind in _OWN.items()}


def _simulated(name: str, kind: str, seconds: float, with_attitude: bool) -> Trajectory:
    rng = np.random.default_rng([_SEED, *name.encode()])
    skipped_s = float(np.floor(rng.uniform(0.0, 100.0)))  # so that two of one kind are not the same run
    motion = make_motion(kind, skipped_s + seconds, _MOTION_RATE_HZ)
    at = slice(int(skipped_s * _MOTION_RATE_HZ), None, int(_MOTION_RATE_HZ / _RATE_HZ))
    rotation = motion.rotation_enu_from_body[at]
    current_enu = np.array([*rng.normal(0.0, _CURRENT_STD, 2), 0.0])
    velocity = motion.velocity_body[at] + current_enu @ rotation
    time = motion.time[at] - motion.time[at][0]
    if not with_attitude:
        return Trajectory(name, time, velocity)
    return Trajectory(name, time, velocity, rotation, angular_velocities(time, rotation))
