"""A well configured recording of the traps' physics with one thing at a time that a vehicle's has: drawn at random."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..stacks import shared_folder

SEED_OF_ALL = 90_000
MANOEUVRES = ("survey", "survey", "survey", "legs", "eight", "eight", "leg", "circle")
NOMINAL_DEG = ((0, 0, 0), (0, 0, 0), (0, 0, 45), (0, 0, -90), (180, 0, 0), (180, 0, 45), (0, 0, 30))
LATE_S = (0.1, 0.3, 0.8, 2.0, 5.0)
KNOT_MPS = 1.0 / 1.9438

Streams = dict[str, Any]
Random = np.random.Generator
Size = float | tuple[float, ...] | None


class Recording(NamedTuple):
    """What a defect is put into: the physics, its motion, the streams that it built, and with what."""

    physics: Any
    motion: Any
    streams: Streams
    given: Mapping[str, Any]


def physics_path() -> Path:
    """Where the physics is looked for."""
    return shared_folder() / "cases" / "traps" / "phys.py"


@cache
def load_physics() -> Any:
    """The shared folder's module."""
    spec = importlib.util.spec_from_file_location("traps_phys", physics_path())
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _late(**late_s: float) -> Callable[[str, float], float]:
    return lambda which, time: time + late_s.get(which, 0.0)


def _dvl_late(of: Recording, rng: Random) -> Size:
    late = float(rng.choice(LATE_S))
    of.streams["stamps"] = _late(dvl=late)
    return late


def _gnss_late(of: Recording, rng: Random) -> Size:
    late = float(rng.choice(LATE_S))
    of.streams["stamps"] = _late(gnss=late)
    return late


def _both_late(of: Recording, rng: Random) -> Size:
    gnss, dvl = float(rng.uniform(0.1, 1)), float(rng.uniform(0.1, 2))
    of.streams["stamps"] = _late(gnss=gnss, dvl=dvl)
    return gnss, dvl


def _imu_late(of: Recording, rng: Random) -> Size:
    late = float(rng.choice([0.1, 0.2, 0.5]))
    of.streams["stamps"] = _late(imu=late)
    return late


def _lasting(of: Recording, rng: Random) -> Size:
    """Noise that lasts for seconds, as a receiver's."""
    gnss, step = of.streams["gnss"], 1.0 / of.given["gnss_hz"]
    noise = of.physics.lp(rng.normal(0, 1, gnss.shape), step, float(rng.choice([5, 20, 60])))
    size = float(rng.choice([0.03, 0.1]))
    of.streams["gnss"] = gnss + size * noise / noise.std(0)
    return size


def _outliers(of: Recording, rng: Random) -> Size:
    for name, time, rate, std in (("dvl", "td", 0.03, 1.0), ("gnss", "tg", 0.02, 2.0)):
        wild = rng.random(len(of.streams[time])) < rate
        of.streams[name][wild] += rng.normal(0, std, (wild.sum(), 3))
    return None


def _antenna_tf(of: Recording, rng: Random) -> Size:
    """The reference is an antenna's, whose transform is there."""
    at, time, motion = rng.uniform(-1.5, 1.5, 3), of.streams["tg"], of.motion
    turning = motion.rot_at(time).apply(np.cross(motion.at("omega", time), at))
    noise = rng.normal(0, of.given["gnss_std"], (len(time), 3))
    of.streams["gnss"], of.streams["gnss_frame"] = motion.at("v_enu", time) + turning + noise, "gps_antenna"
    of.streams["tf"].append(("base_link", "gps_antenna", at, Rotation.identity()))
    return None


def _smoothed(of: Recording, rng: Random) -> Size:
    seconds = float(rng.choice([0.3, 1, 2]))
    of.streams["gnss"] = of.physics.lp(of.streams["gnss"], 1.0 / of.given["gnss_hz"], seconds)
    return seconds


def _vtg(of: Recording, rng: Random) -> Size:
    """Course in whole degrees and speed in tenths of a knot, as NMEA's VTG."""
    east, north, _ = of.streams["gnss"].T
    speed = np.round(np.hypot(east, north) / KNOT_MPS * 10) / 10 * KNOT_MPS
    course = np.radians(np.round(np.degrees(np.arctan2(east, north))))
    of.streams["gnss"] = np.stack([speed * np.sin(course), speed * np.cos(course), 0 * speed], 1)
    return None


def _no_vertical(of: Recording, rng: Random) -> Size:
    of.streams["gnss"][:, 2] = 0
    return None


def _compass_dev(of: Recording, rng: Random) -> Size:
    size = float(rng.choice([0.5, 1, 2, 4]))
    _turn_heading(of.streams, size * np.sin(np.interp(of.streams["ti"], of.motion.t, of.motion.psi) + 1.0))
    return size


def _drift_heading(of: Recording, rng: Random) -> Size:
    size, seconds = float(rng.choice([0.5, 1, 2, 4])), len(of.motion.t) * of.motion.dt
    _turn_heading(of.streams, size * (of.streams["ti"] / seconds - 0.5))
    return size


def _turn_heading(streams: Streams, degrees: np.ndarray) -> None:
    streams["q"] = Rotation.from_rotvec(np.outer(np.radians(degrees), [0, 0, 1.0])) * streams["q"]


def _dvl_bias(of: Recording, rng: Random) -> Size:
    size = float(rng.choice([0.005, 0.02]))
    of.streams["dvl"] = of.streams["dvl"] + size * rng.choice([-1, 1], 3)
    return size


def _positions(of: Recording, rng: Random) -> Size:
    """Velocities that are differences of positions."""
    motion, time = of.motion, of.streams["tg"]
    path = np.cumsum(motion.v_enu, 0) * motion.dt
    at = np.stack([np.interp(time, motion.t, each) for each in path.T], 1) + rng.normal(0, 0.02, (len(time), 3))
    of.streams["gnss"] = np.gradient(at, time, axis=0)
    return None


def _stamps_jitter(of: Recording, rng: Random) -> Size:
    late = rng.uniform(0, 0.1, 100_000)
    of.streams["stamps"] = lambda which, time: time + (late[int(time * 50) % len(late)] if which != "imu" else 0.0)
    return None


def _gaps(of: Recording, rng: Random) -> Size:
    keep = np.sin(of.streams["tg"] / 20 + 1) > -0.6
    for name in ("tg", "gnss", "gnss_cov"):
        of.streams[name] = of.streams[name][keep]
    return None


def _nothing(of: Recording, rng: Random) -> Size:
    return None


DEFECTS: tuple[tuple[str, Callable[[Recording, Random], Size]], ...] = (
    ("none", _nothing), ("none", _nothing), ("none", _nothing), ("dvl_late", _dvl_late), ("gnss_late", _gnss_late),
    ("both_late", _both_late), ("imu_late", _imu_late), ("lasting", _lasting), ("outliers", _outliers),
    ("antenna_tf", _antenna_tf), ("smoothed", _smoothed), ("vtg", _vtg), ("no_vertical", _no_vertical),
    ("arm_untold", _nothing), ("compass_dev", _compass_dev), ("drift_heading", _drift_heading),
    ("dvl_bias", _dvl_bias), ("big_mis", _nothing), ("positions", _positions), ("stamps_jitter", _stamps_jitter),
    ("none", _nothing), ("gaps", _gaps), ("rates_low", _nothing),
)  # fmt: skip


def write_combination(seed: int, path: Path) -> dict[str, Any]:
    """Write the bag of a seed to a new folder; returns its truth in degrees and percent, and what was drawn."""
    rng, physics = np.random.default_rng(SEED_OF_ALL + seed), load_physics()

    def one_of(*values: float) -> float:
        return float(rng.choice(values))

    manoeuvre, seconds = str(rng.choice(MANOEUVRES)), one_of(180, 300, 400, 600, 900)
    moved = {
        "heading0": float(rng.uniform(0, 360)), "speed": float(rng.uniform(0.6, 2.5)),
        "waves": one_of(0.0, 0.03, 0.05, 0.2), "tilt_deg": one_of(0.5, 1.5, 3.0), "trim_deg": one_of(0, 0, 2, -4),
        "slip": float(rng.uniform(0, 0.5)),
    }  # fmt: skip
    nominal = NOMINAL_DEG[rng.integers(len(NOMINAL_DEG))]
    given: dict[str, Any] = {
        "nominal": nominal, "arm": tuple(rng.uniform(-1, 1, 3) * [1.2, 0.4, 0.6]), "rpy": tuple(rng.normal(0, 1.2, 3)),
        "scale": float(rng.normal(0, 0.006)), "dvl_hz": one_of(1, 2, 5, 8), "gnss_hz": one_of(1, 5, 10),
        "imu_hz": one_of(10, 20, 50), "dvl_std": one_of(0.004, 0.01, 0.03), "gnss_std": one_of(0.01, 0.03, 0.06),
        "yaw_std": one_of(0.05, 0.1, 0.3),
    }  # fmt: skip
    motion = physics.Motion(manoeuvre, seconds, seed=seed, **moved)
    defect, put_in = DEFECTS[rng.integers(len(DEFECTS))]
    if defect == "arm_untold":
        given["arm_told"] = (0, 0, 0)
    if defect == "big_mis":
        given["rpy"] = tuple(rng.normal(0, 4, 3))
    if defect == "rates_low":
        given |= {"dvl_hz": 1.0, "gnss_hz": 1.0, "imu_hz": 5.0}
    streams = physics.build(motion, seed=seed, **given)
    size = put_in(Recording(physics, motion, streams, given), rng)
    physics.write(path, streams)
    mounted, scale = physics.truth(streams)
    off = mounted * streams["nominal"].inv()
    return {
        "rpy_deg": mounted.as_euler("xyz", degrees=True).tolist(),
        "misalignment_deg": float(np.degrees(off.magnitude())),
        "scale": scale,
        "drawn": {"manoeuvre": manoeuvre, "seconds": seconds, "defect": defect, "size": size, **moved, **given},
    }
