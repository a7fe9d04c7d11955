"""Simulation of a run, from a trajectory and errors to a bag."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..bags.writer import BagWriter, Compression, Storage
from ..calibration.numerics.frames import Array, quaternion_from_rotation, rotation_from_rpy
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from ..calibration.streams.interpolation import linear_at
from ..effects.base import ActsOn, EffectInput, Injection, at_dvl, depth_of, late, traces, turns
from ..messages.encode import SampleWriter
from ..version import __version__
from .injection import disturbed, injection_document
from .recorded_motion import MotionSource, recorded_motion
from .sensors import (
    DvlErrors,
    ImuErrors,
    axis_covariance,
    equivalent_error_terms,
    measure_dvl,
    measure_gnss,
    measure_imu,
)
from .trajectories import Motion, Waves, add_waves, make_motion

MOTION_RATE_HZ = 100.0
DEFAULT_SECONDS = 600.0
TRUTH_NAME = "truth.json"
START_NS = 1_760_000_000_000_000_000
# GNSS and DVL do not measure at the same instant
GNSS_PHASE_S = 0.037


@dataclass(frozen=True)
class Scenario:
    """Configuration of a simulated run. Rates in Hz, standard deviations in m/s, times in s from the start.

    recording: a bag that gives the motion instead of a trajectory.
    seconds: None is 600, or all of the recording.
    outages: (from, to) without GNSS.
    gnss_frame: BODY or ENU.
    effects: in addition to the errors.
    """

    trajectory: str = "box"
    seconds: float | None = None
    seed: int = 0
    errors: DvlErrors = field(default_factory=DvlErrors)
    mounting_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dvl_rate: float = 5.0
    gnss_rate: float = 5.0
    imu_rate: float = 20.0
    gnss_std: float = 0.1
    gnss_frame: VelocityFrame = VelocityFrame.ENU
    outages: tuple[tuple[float, float], ...] = ()
    imu_errors: ImuErrors = field(default_factory=ImuErrors)
    recording: MotionSource | None = None
    waves: Waves | None = None
    effects: tuple[Injection, ...] = ()


@dataclass(frozen=True)
class Run:
    """Samples of a simulated run; gnss and imu are empty at rate 0."""

    dvl: list[DvlSample]
    gnss: list[ReferenceSample]
    imu: list[ImuSample]


@dataclass(frozen=True)
class World:
    """Common input of all sensors, from `world_of`.

    motion: the known motion.
    input: the same for effects.
    disturbed: applies the noise effects to a sensor's samples.
    """

    motion: Motion
    input: EffectInput
    disturbed: Callable[[Array, EffectInput, ActsOn], Array]


@dataclass(frozen=True)
class Seeds:
    """Seeds of random numbers: one per sensor, for the motion and per effect."""

    dvl: np.random.SeedSequence
    gnss: np.random.SeedSequence
    imu: np.random.SeedSequence
    motion: np.random.SeedSequence
    effects: tuple[np.random.SeedSequence, ...]

    @classmethod
    def of(cls, scenario: Scenario) -> Seeds:
        """Derive an independent random stream per kind of noise, so that adding one does not change the others."""
        dvl, gnss, imu, motion, *effects = np.random.SeedSequence(scenario.seed).spawn(4 + len(scenario.effects))
        return cls(dvl, gnss, imu, motion, tuple(effects))


def simulate(scenario: Scenario) -> Run:
    """Simulate a run. The same scenario gives the same run. Raises InputError for a recording without motion."""
    motion, seconds = motion_of(scenario)
    seeds = Seeds.of(scenario)
    seeded = list(zip(scenario.effects, seeds.effects, strict=True))

    def all_at_once(velocity: Array, at: EffectInput, acts_on: ActsOn) -> Array:
        return disturbed(velocity, seeded, at, acts_on)

    world = world_of(scenario, motion, all_at_once)
    imu_times = motion.time[:: max(1, round(MOTION_RATE_HZ / scenario.imu_rate))] if scenario.imu_rate else np.zeros(0)
    gnss_times = _times(seconds, scenario.gnss_rate, GNSS_PHASE_S) if scenario.gnss_rate else np.zeros(0)
    return Run(
        dvl_at(scenario, world, _times(seconds, scenario.dvl_rate, 0.0), np.random.default_rng(seeds.dvl)),
        gnss_at(scenario, world, gnss_times, np.random.default_rng(seeds.gnss)),
        imu_at(scenario, world, imu_times, np.random.default_rng(seeds.imu)),
    )


def motion_of(scenario: Scenario) -> tuple[Motion, float]:
    """Return a scenario's motion and its length in s. Raises InputError for a recording without one."""
    return _motion(scenario, Seeds.of(scenario).motion)


def _motion(scenario: Scenario, seed: np.random.SeedSequence) -> tuple[Motion, float]:
    """Return the motion and its length in s."""
    free_seed, wave_seed = seed.spawn(2)
    if scenario.recording:
        motion = recorded_motion(scenario.recording, MOTION_RATE_HZ, scenario.seconds)
        seconds = len(motion.time) / MOTION_RATE_HZ
    else:
        seconds = scenario.seconds or DEFAULT_SECONDS
        motion = make_motion(scenario.trajectory, seconds, MOTION_RATE_HZ, np.random.default_rng(free_seed))
    if scenario.waves:
        motion = add_waves(motion, scenario.waves, np.random.default_rng(wave_seed))
    return motion, seconds


def world_of(
    scenario: Scenario,
    motion: Motion,
    disturbed_by: Callable[[Array, EffectInput, ActsOn], Array],
    first_depth: float = 0.0,
) -> World:
    """Return the sensors' input for a motion, whose times are since the beginning of the run.

    first_depth: m below the start, at the motion's first time.
    """
    seen = EffectInput(
        motion.time,
        motion.velocity_body,
        rotation_from_rpy(scenario.mounting_rpy).T,
        motion.rotation_enu_from_body,
        motion.angular_velocity,
        scenario.gnss_frame,
        start=0.0,
        depth_below_start=depth_of(motion.time, motion.upwards, first_depth),
    )
    return World(motion, seen, disturbed_by)


def write_bag(
    scenario: Scenario, path: Path, storage: Storage, compression: Compression, with_truth: bool = False
) -> None:
    """Simulate a run into a new bag, optionally with the truth attached. Raises InputError."""
    writer = BagWriter(path, storage, compression)
    if with_truth:
        text = json.dumps(truth_document(scenario), indent=1, allow_nan=False)
        writer.attachment(TRUTH_NAME, "application/json", text.encode())
    run = simulate(scenario)
    with writer as bag:
        SampleWriter(bag).recording(run.imu, run.gnss, run.dvl)


def truth_document(scenario: Scenario) -> dict[str, Any]:
    """Return the simulated truth as plain data: options, errors in the calibration's terms, effects."""
    phi, delta_k = equivalent_error_terms(scenario.errors)
    document = asdict(replace(scenario, effects=()))
    document["gnss_frame"] = scenario.gnss_frame.value
    if scenario.recording:
        document["recording"]["path"] = str(scenario.recording.path)
        del document["trajectory"]
    return document | {
        "phi_rad": phi.tolist(),
        "delta_k": delta_k.tolist(),
        "effects": [injection_document(effect) for effect in scenario.effects],
        "version": __version__,
    }


def dvl_at(scenario: Scenario, world: World, at: Array, rng: np.random.Generator) -> list[DvlSample]:
    """Simulate the DVL at times (N,) s."""
    moved = at_dvl(scenario.effects, world.input)
    velocity = linear_at(moved.time, moved.velocity_body, at)
    turn = turns(scenario.effects, moved)
    turn = turn if turn.ndim == 1 else linear_at(moved.time, turn, at)
    measured = measure_dvl(velocity, scenario.errors, moved.rotation_dvl_from_body, rng, turn)
    added = traces(scenario.effects, moved, ActsOn.DVL) @ moved.rotation_dvl_from_body.T
    measured = measured + linear_at(moved.time, added, at)
    measured = world.disturbed(measured, _input_at(world, at), ActsOn.DVL)
    covariance = axis_covariance(scenario.errors.beam_std) if scenario.errors.beam_std else None
    stamped = at + late(scenario.effects, ActsOn.DVL_CLOCK, at)
    return [DvlSample(stamp, (x, y, z), covariance) for stamp, (x, y, z) in _stamped(stamped, measured)]


def gnss_at(scenario: Scenario, world: World, at: Array, rng: np.random.Generator) -> list[ReferenceSample]:
    """Simulate the receiver at times (N,) s, without outages."""
    if not len(at):
        return []
    motion = world.motion
    velocity = motion.velocity_body - traces(scenario.effects, world.input, ActsOn.REFERENCE)
    if scenario.gnss_frame is VelocityFrame.ENU:
        velocity = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, velocity)
    measured = measure_gnss(linear_at(motion.time, velocity, at), scenario.gnss_std, rng)
    measured = world.disturbed(measured, _input_at(world, at), ActsOn.REFERENCE)
    covariance = np.eye(3) * scenario.gnss_std**2 if scenario.gnss_std else None
    stamped = at + late(scenario.effects, ActsOn.REFERENCE_CLOCK, at)
    return [
        ReferenceSample(stamp, (x, y, z), covariance, scenario.gnss_frame)
        for (stamp, (x, y, z)), t in zip(_stamped(stamped, measured), at, strict=True)
        if not any(start <= t < end for start, end in scenario.outages)
    ]


def imu_at(scenario: Scenario, world: World, at: Array, rng: np.random.Generator) -> list[ImuSample]:
    """Simulate the IMU at times (N,) s."""
    if not len(at):
        return []
    motion = world.motion
    nearest = _nearest(motion.time, at)
    attitudes, rates = motion.rotation_enu_from_body[nearest], motion.angular_velocity[nearest]
    if not np.allclose(motion.time[nearest], at, rtol=0.0, atol=1e-9):
        attitudes = Slerp(motion.time, Rotation.from_matrix(motion.rotation_enu_from_body))(at).as_matrix()
        rates = linear_at(motion.time, motion.angular_velocity, at)
    if scenario.imu_errors != ImuErrors():
        attitudes, rates = measure_imu(attitudes, rates, scenario.imu_errors, rng)
    stamped = at + late(scenario.effects, ActsOn.ATTITUDE_CLOCK, at)
    return [
        ImuSample(stamp, quaternion_from_rotation(rotation), (x, y, z))
        for (stamp, (x, y, z)), rotation in zip(_stamped(stamped, rates), attitudes, strict=True)
    ]


def _input_at(world: World, at: Array) -> EffectInput:
    """Return the motion at a sensor's times, by the nearest sample, for effects on the noise."""
    motion = world.motion
    nearest = _nearest(motion.time, at)
    return replace(
        world.input,
        time=at,
        velocity_body=motion.velocity_body[nearest],
        rotation_enu_from_body=motion.rotation_enu_from_body[nearest],
        angular_velocity=motion.angular_velocity[nearest],
    )


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    """Return the index of the nearest time for each of `at` (N,), the earlier of two."""
    after = np.clip(np.searchsorted(time, at), 1, max(len(time) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(time) - 1)
    return np.where(np.abs(time[after] - at) < np.abs(at - time[before]), after, before)


def _times(seconds: float, rate: float, phase: float) -> Array:
    return np.arange(phase, seconds - 1.0 / MOTION_RATE_HZ, 1.0 / rate)


def _stamped(at: Array, values: Array) -> list[tuple[int, list[float]]]:
    return [(START_NS + round(t * 1e9), row) for t, row in zip(at.tolist(), values.tolist(), strict=True)]
