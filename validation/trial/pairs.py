"""Pairs of logs for the comparison with a simulator: one of a vehicle, one of a simulator, from other motions.

As for the rest of the trial, nothing here is shared with the effects. The vehicle is that of the trial, with faults of
a strength wanted; the simulator's reference is its truth, and its DVL has the noise that its row of a table of
simulators says: on beams or on axes, constant or in proportion to the (signed) velocity, with zeros on dropout.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.stats import norm

from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.errors import InputError

from .generator import BETWEEN_RECORDINGS_NS, START_NS, Noise, Sample, _dvl, _gnss, _imu, _write
from .motion import HELD_OUT_KINDS, RECORDED, TUNING_KINDS, Floats, manoeuvre
from .simulated import vehicle as drawn_vehicle
from .sizes import direction, log_uniform, sized
from .strength import Scene, Yardstick
from .vehicle import (
    Faults,
    Vehicle,
    attitude_state,
    dvl_stamps,
    dvl_velocity,
    of_one_recording,
    recorded_attitude,
    reference_velocity,
)

SECONDS, RATE_HZ, TRUTH_HZ = (180.0, 300.0), 5.0, 10.0
KINDS = tuple(kind for kind in (*TUNING_KINDS, *HELD_OUT_KINDS) if kind != RECORDED)
STRENGTHS = (12.0, 20.0, 40.0)
# A fault that another could be taken for more often than this, whatever the test, is drawn again
CONFUSED = 0.02
# The simulator's motion would show the fault at this strength
SHOWS = 8.0
MAX_DRAWS = 60
# Faults that are of the run and not of the vehicle are not the same on another day
OF_A_RUN = ("time_offset_jump", "clock_drift", "scale_drift", "misalignment_drift", "water_lock")
# What is there on which side
WHAT = ("missing",) * 5 + ("missing_beside_shared",) * 2 + ("missing_two", "same", "same", "other_size", "other_size",
        "only_simulator", "only_simulator", "none")  # fmt: skip


@dataclass(frozen=True)
class Row:
    """The noise of a simulator's DVL. std: m/s on beams or axes; per_speed: of each beam's signed velocity.

    slow_std, slow_s: Gauss-Markov bias of the beams. resolution: m/s. zeros: share of the samples. has_pose: the DVL
    can sit elsewhere than at the reference point, turned.
    """

    on_beams: bool = True
    std: tuple[float, float] = (0.003, 0.02)
    per_speed: tuple[float, float] = (0.0, 0.0)
    slow_std: float = 0.0
    slow_s: float = 20.0
    resolution: float = 0.0
    zeros: float = 0.0
    has_pose: bool = True


ROWS: Mapping[str, Row] = {
    "dvl_simulator": Row(per_speed=(0.002, 0.005), slow_std=0.0008, resolution=0.001),
    "stonefish": Row(std=(0.002, 0.005), per_speed=(0.005, 0.02)),
    "gazebo": Row(),
    "holoocean": Row(),
    "uuv": Row(on_beams=False, has_pose=False),
    "dave": Row(),
    "oceansim": Row(on_beams=False, zeros=0.01, has_pose=False),
}


@dataclass(frozen=True)
class PairTruth:
    """What is true of a pair. vehicle, simulator: faults. q: of those that the vehicle has beyond the simulator.

    noise: per side, property -> value, where a property that differs may be claimed to differ.
    """

    id: str
    what: str
    row: str
    kinds: tuple[str, str]
    vehicle: Faults
    simulator: Faults
    q: Mapping[str, float]
    noise: Mapping[str, Mapping[str, float]]
    mounting_rpy: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass(frozen=True)
class Pair:
    """Two bags and their truth."""

    vehicle: Path
    simulator: Path
    truth: PairTruth


def pair_id(number: int, seed: int) -> str:
    """Says nothing of what is in it."""
    return hashlib.sha256(f"pair {number} of {seed}".encode()).hexdigest()[:12]


def make_pair(number: int, seed: int, folder: Path) -> Pair:
    """Draw pair `number` and write its bags. Raises InputError where no draw is as it should be."""
    rng = np.random.default_rng([seed, number, 20261122])
    what, row = WHAT[number % len(WHAT)], list(ROWS)[number % len(ROWS)]
    for _ in range(MAX_DRAWS):
        scenes = _scenes(row, rng)
        faults = _faults(what, row, scenes, rng)
        if faults is not None:
            return _recorded(pair_id(number, seed), what, row, scenes, faults, folder, rng)
    raise InputError(f"pair {number} of seed {seed}: none of {MAX_DRAWS} draws is as it should be; use another --seed")


@dataclass(frozen=True)
class _Scenes:
    kinds: tuple[str, str]
    vehicle: Scene
    simulator: Scene
    row_std: float
    per_speed: float


def _scenes(row: str, rng: np.random.Generator) -> _Scenes:
    kinds = tuple(str(kind) for kind in rng.choice(KINDS, 2, replace=False))
    body = drawn_vehicle(rng)
    std, per_speed = log_uniform(rng, *ROWS[row].std), float(rng.uniform(*ROWS[row].per_speed))
    made = replace(body, misalignment=(0.0, 0.0, 0.0), sound_speed_error=0.0, beam_angle_error=0.0)
    if not ROWS[row].has_pose:
        made = replace(made, mounting_rpy=(0.0, 0.0, 0.0))
    vehicle, simulator = (
        Scene(
            motions=(manoeuvre(kind, float(rng.uniform(*SECONDS)), rng),),
            vehicle=vehicle,
            dvl_rate=RATE_HZ,
            gnss_rate=rate,
            beam_std=beam_std,
            gnss_std=gnss_std,
            in_body=False,
            gnss_phase_s=float(rng.uniform(0.0, 1.0 / rate)),
        )
        for kind, vehicle, rate, beam_std, gnss_std in (
            (kinds[0], body, RATE_HZ, log_uniform(rng, 0.002, 0.02), log_uniform(rng, 0.01, 0.05)),
            (kinds[1], made, TRUTH_HZ, std, 1e-3),
        )
    )
    return _Scenes((kinds[0], kinds[1]), vehicle, simulator, std, per_speed)


# ------------------------------------------------------------------ faults

Drawn = tuple[dict[str, Any], dict[str, Any], dict[str, float]]


def _faults(what: str, row: str, scenes: _Scenes, rng: np.random.Generator) -> Drawn | None:
    """Faults of vehicle and simulator, and q of what the vehicle has beyond."""
    if what == "none":
        return {}, {}, {}
    real, made = Yardstick(scenes.vehicle), Yardstick(scenes.simulator)
    names = [name for name in of_one_recording(in_body=False)]
    both = [n for n in names if n not in OF_A_RUN and (ROWS[row].has_pose or n != "lever_arm")]
    q = float(rng.choice(STRENGTHS))
    if what in ("missing", "missing_beside_shared", "missing_two"):
        chosen = [str(n) for n in rng.choice(names, 2 if what == "missing_two" else 1, replace=False)]
        shared = [str(rng.choice([n for n in both if n not in chosen]))] if what == "missing_beside_shared" else []
        vehicle: dict[str, Any] = {}
        for name in (*chosen, *shared):
            values = sized(real, name, q, direction(name, scenes.vehicle, rng), vehicle)
            if not values:
                return None
            vehicle[name] = dict(values)
        simulator = {name: vehicle[name] for name in shared}
        if not _told_apart(real, vehicle) or not all(_shows(made, name, vehicle[name]) for name in vehicle):
            return None
        return vehicle, simulator, {name: real.q_beside(name, vehicle) for name in chosen}
    name = str(rng.choice(both))
    values = dict(sized(real, name, q, direction(name, scenes.vehicle, rng)))
    if not values or not _told_apart(real, {name: values}) or not _shows(made, name, values):
        return None
    if what == "only_simulator":
        return ({}, {name: values}, {}) if _told_apart(made, {name: values}) else None
    other = values if what == "same" else {key: 0.4 * value for key, value in values.items()}
    if not _told_apart(made, {name: other}) or not _shows(made, name, other):
        return None
    return {name: values}, {name: other}, {name: 0.6 * q} if what == "other_size" else {}


def _shows(yardstick: Yardstick, name: str, values: Mapping[str, float]) -> bool:
    """Whether a motion would show a fault of such a size."""
    always = {key: (0.0 if key in ("from_s", "at_s") else value) for key, value in values.items()}
    return yardstick.q({name: values}) > SHOWS or yardstick.q({name: always}) > SHOWS


def _told_apart(yardstick: Yardstick, faults: Faults) -> bool:
    """Whether the likelihood could tell every fault from whatever else the library has in its place."""
    least = 2.0 * float(norm.isf(CONFUSED))
    return all(min(each.distances.values()) > least for each in yardstick.apart(faults).values())


# ------------------------------------------------------------------ recording


@dataclass(frozen=True)
class _Habits:
    """What the vehicle's DVL does beside white noise."""

    outliers: float = 0.0
    repeats: float = 0.0
    dropouts: int = 0
    jitter_s: float = 0.0

    @staticmethod
    def drawn(rng: np.random.Generator) -> _Habits:
        """Each in one of four vehicles."""
        has = rng.uniform(size=4) < 0.25
        return _Habits(0.01 * has[0], 0.03 * has[1], int(12 * has[2]), 0.012 * has[3])


def _recorded(
    name: str, what: str, row: str, scenes: _Scenes, faults: Drawn, folder: Path, rng: np.random.Generator
) -> Pair:
    folder.mkdir(parents=True)
    habits = _Habits.drawn(rng)
    bags = folder / "vehicle", folder / "simulator"
    _write(bags[0], _of_vehicle(scenes.vehicle, faults[0], habits, rng))
    _write(bags[1], _of_simulator(row, scenes, faults[1], rng))
    levels = _levels(row, scenes)
    noise = {
        "vehicle": levels[0] | {"outliers": habits.outliers, "repeats": habits.repeats, "jitter": habits.jitter_s,
                                "dropouts": float(habits.dropouts > 0)},
        "simulator": levels[1] | {"outliers": 0.0, "repeats": 0.0, "jitter": 0.0, "dropouts": 0.0,
                                  "zeros_on_dropout": ROWS[row].zeros},
    }  # fmt: skip
    truth = PairTruth(
        name, what, row, scenes.kinds, faults[0], faults[1], faults[2], noise,
        {"vehicle": scenes.vehicle.vehicle.mounting_rpy, "simulator": scenes.simulator.vehicle.mounting_rpy},
    )  # fmt: skip
    return Pair(bags[0], bags[1], truth)


def _levels(row: str, scenes: _Scenes) -> tuple[dict[str, float], dict[str, float]]:
    """White noise of each side's axes, m/s; of noise that grows with speed, whether it does."""
    kind = ROWS[row]
    of_beams = np.linalg.norm(scenes.simulator.vehicle.axes_from_beams, axis=1)
    std = scenes.row_std * (of_beams if kind.on_beams else np.ones(3))
    real = {f"level_{axis}": float(s) for axis, s in zip("xyz", scenes.vehicle.dvl_std, strict=True)}
    made = {f"level_{axis}": float(s) for axis, s in zip("xyz", std, strict=True)}
    made |= {"growth": scenes.per_speed, "colour": kind.slow_std}
    return real, made


def _of_vehicle(scene: Scene, faults: Faults, habits: _Habits, rng: np.random.Generator) -> list[list[Sample]]:
    motion, noise = scene.motions[0], Noise(rng, outlier_share=habits.outliers)
    dvl = [each for each in _dvl(scene, motion, faults, noise, START_NS) if isinstance(each, DvlSample)]
    stale = rng.uniform(size=len(dvl)) < habits.repeats
    for i in range(1, len(dvl)):
        if stale[i]:
            dvl[i] = dvl[i]._replace(velocity=dvl[i - 1].velocity)
    lost: set[int] = set()
    for start in rng.integers(5, len(dvl) - 10, habits.dropouts).tolist():
        lost.update(range(start, start + int(rng.integers(1, 4))))
    late = rng.normal(0.0, habits.jitter_s, len(dvl)) if habits.jitter_s else np.zeros(len(dvl))
    jittered = [
        each._replace(stamp_ns=each.stamp_ns + round(1e9 * float(np.clip(off, -0.05, 0.05))))
        for i, (each, off) in enumerate(zip(dvl, late.tolist(), strict=True))
        if i not in lost
    ]
    return [list(jittered), _gnss(scene, motion, faults, noise, START_NS), _imu(scene, motion, faults, noise, START_NS)]


def _of_simulator(row: str, scenes: _Scenes, faults: Faults, rng: np.random.Generator) -> list[list[Sample]]:
    """The truth as reference and attitude, and the DVL with the noise of its row."""
    scene, kind = scenes.simulator, ROWS[row]
    motion, vehicle = scene.motions[0], scene.vehicle
    start_ns = START_NS + BETWEEN_RECORDINGS_NS
    times = scene.dvl_times(motion)
    velocity = dvl_velocity(motion, vehicle, faults, times)
    velocity = velocity + _row_noise(kind, scenes, vehicle, velocity, rng)
    if kind.resolution:
        velocity = np.round(velocity / kind.resolution) * kind.resolution
    velocity[rng.uniform(size=len(times)) < kind.zeros] = 0.0
    stamps = dvl_stamps(times, faults)
    dvl: list[Sample] = [
        DvlSample(start_ns + round(1e9 * stamp), (x, y, z))
        for stamp, (x, y, z) in zip(stamps.tolist(), velocity.tolist(), strict=True)
    ]
    return [dvl, _truth(scene, faults, start_ns), _true_attitude(scene, faults, start_ns)]


def _row_noise(kind: Row, scenes: _Scenes, vehicle: Vehicle, velocity: Floats, rng: np.random.Generator) -> Floats:
    n = len(velocity)
    if not kind.on_beams:
        return scenes.row_std * rng.normal(size=(n, 3))
    along = velocity @ vehicle.beams().T
    beams = (scenes.row_std + scenes.per_speed * along) * rng.normal(size=(n, 4))
    if kind.slow_std:
        keep = np.exp(-1.0 / (RATE_HZ * kind.slow_s))
        fresh = kind.slow_std * np.sqrt(1.0 - keep**2) * rng.normal(size=(n, 4))
        beams = beams + lfilter([1.0], [1.0, -keep], fresh, axis=0)
    return np.asarray(beams @ vehicle.axes_from_beams.T)


def _truth(scene: Scene, faults: Faults, start_ns: int) -> list[Sample]:
    motion = scene.motions[0]
    times = scene.gnss_stamps(motion)
    velocity = reference_velocity(motion, faults, times, in_body=False)
    return [
        ReferenceSample(start_ns + round(1e9 * time), (x, y, z), None, VelocityFrame.ENU)
        for time, (x, y, z) in zip(times.tolist(), velocity.tolist(), strict=True)
    ]


def _true_attitude(scene: Scene, faults: Faults, start_ns: int) -> list[Sample]:
    motion = scene.motions[0]
    times = scene.imu_stamps(motion)
    state = attitude_state(motion, faults, times)
    quaternions = recorded_attitude(state, faults).as_quat()
    return [
        ImuSample(start_ns + round(1e9 * time), (x, y, z, w), (p, q, r))
        for time, (x, y, z, w), (p, q, r) in zip(
            times.tolist(), quaternions.tolist(), state.rates.tolist(), strict=True
        )
    ]
