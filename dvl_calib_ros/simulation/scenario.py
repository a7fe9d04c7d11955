"""A simulated run, from a trajectory and errors to a bag."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..calibration.frames import Array, quaternion_from_rotation, rotation_from_rpy
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from ..io.bags import BagWriter, Compression, Storage
from .sensors import DvlErrors, axis_covariance, measure_dvl, measure_gnss
from .trajectories import Motion, make_motion

MOTION_RATE_HZ = 100.0
START_NS = 1_760_000_000_000_000_000
# GNSS and DVL do not measure at the same instant
GNSS_PHASE_S = 0.037


@dataclass(frozen=True)
class Scenario:
    """Everything about a simulated run. Rates in Hz, standard deviations in m/s, times in s from the start.

    outages: (from, to) without GNSS. gnss_frame: BODY or ENU.
    """

    trajectory: str = "box"
    seconds: float = 600.0
    seed: int = 0
    errors: DvlErrors = field(default_factory=DvlErrors)
    mounting_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dvl_rate: float = 5.0
    gnss_rate: float = 5.0
    imu_rate: float = 20.0
    gnss_std: float = 0.1
    gnss_frame: VelocityFrame = VelocityFrame.ENU
    outages: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Run:
    """Samples of a simulated run; gnss and imu are empty at rate 0."""

    dvl: list[DvlSample]
    gnss: list[ReferenceSample]
    imu: list[ImuSample]


def simulate(scenario: Scenario) -> Run:
    """Simulate a run. The same scenario gives the same run; noise of DVL and GNSS has random streams of its own."""
    motion = make_motion(scenario.trajectory, scenario.seconds, MOTION_RATE_HZ)
    dvl_seed, gnss_seed = np.random.SeedSequence(scenario.seed).spawn(2)
    return Run(
        _simulate_dvl(scenario, motion, np.random.default_rng(dvl_seed)),
        _simulate_gnss(scenario, motion, np.random.default_rng(gnss_seed)),
        _simulate_imu(scenario, motion),
    )


def write_bag(scenario: Scenario, path: Path, storage: Storage, compression: Compression) -> None:
    """Simulate a run into a new bag. Raises InputError."""
    run = simulate(scenario)
    with BagWriter(path, storage, compression) as bag:
        samples: Iterable[DvlSample | ReferenceSample | ImuSample] = heapq.merge(
            run.imu, run.gnss, run.dvl, key=lambda sample: sample.stamp_ns
        )
        for sample in samples:
            if isinstance(sample, DvlSample):
                bag.dvl("dvl/twist", sample)
            elif isinstance(sample, ReferenceSample):
                bag.reference("gnss/twist", sample, "base_link" if sample.frame is VelocityFrame.BODY else "map")
            else:
                bag.imu("imu/data", sample)


def _simulate_dvl(scenario: Scenario, motion: Motion, rng: np.random.Generator) -> list[DvlSample]:
    at = _times(scenario.seconds, scenario.dvl_rate, 0.0)
    rotation_dvl_from_body = rotation_from_rpy(scenario.mounting_rpy).T
    velocity = _interpolate(at, motion.time, motion.velocity_body)
    measured = measure_dvl(velocity, scenario.errors, rotation_dvl_from_body, rng)
    covariance = axis_covariance(scenario.errors.beam_std) if scenario.errors.beam_std else None
    return [DvlSample(stamp, (x, y, z), covariance) for stamp, (x, y, z) in _stamped(at, measured)]


def _simulate_gnss(scenario: Scenario, motion: Motion, rng: np.random.Generator) -> list[ReferenceSample]:
    if not scenario.gnss_rate:
        return []
    at = _times(scenario.seconds, scenario.gnss_rate, GNSS_PHASE_S)
    velocity = motion.velocity_body
    if scenario.gnss_frame is VelocityFrame.ENU:
        velocity = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, velocity)
    measured = measure_gnss(_interpolate(at, motion.time, velocity), scenario.gnss_std, rng)
    covariance = np.eye(3) * scenario.gnss_std**2 if scenario.gnss_std else None
    return [
        ReferenceSample(stamp, (x, y, z), covariance, scenario.gnss_frame)
        for (stamp, (x, y, z)), t in zip(_stamped(at, measured), at, strict=True)
        if not any(start <= t < end for start, end in scenario.outages)
    ]


def _simulate_imu(scenario: Scenario, motion: Motion) -> list[ImuSample]:
    if not scenario.imu_rate:
        return []
    every = max(1, round(MOTION_RATE_HZ / scenario.imu_rate))
    rates = _stamped(motion.time[::every], motion.angular_velocity[::every])
    return [
        ImuSample(stamp, quaternion_from_rotation(rotation), (x, y, z))
        for (stamp, (x, y, z)), rotation in zip(rates, motion.rotation_enu_from_body[::every], strict=True)
    ]


def _times(seconds: float, rate: float, phase: float) -> Array:
    return np.arange(phase, seconds - 1.0 / MOTION_RATE_HZ, 1.0 / rate)


def _interpolate(at: Array, time: Array, values: Array) -> Array:
    return np.column_stack([np.interp(at, time, column) for column in values.T])


def _stamped(at: Array, values: Array) -> list[tuple[int, list[float]]]:
    return [(START_NS + round(t * 1e9), row) for t, row in zip(at.tolist(), values.tolist(), strict=True)]
