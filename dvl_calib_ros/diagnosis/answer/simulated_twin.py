"""Simulated twins of recordings, without and with the effects, and their bags."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...bags.writer import BagWriter, Compression, Storage
from ...calibration.numerics.frames import Array, cross
from ...calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from ...effects.base import PASSES, ActsOn, EffectInput, at_dvl, late, traces, true_times, turns
from ...messages.encode import SampleWriter
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..model.recorded_streams import RecordedStreams
from ..search.effect_selection import EffectSelection


@dataclass(frozen=True)
class Twin:
    """One recording and its twins. time: (N,) s by the DVL's stamps, since its first. recorded, without, with_effects:
    (N, 3) m/s, DVL frame; without: the calibration alone."""

    recording: RecordedStreams
    time: Array
    recorded: Array
    without: Array
    with_effects: Array


def twins(selection: EffectSelection) -> tuple[Twin, ...]:
    """Simulate every recording without noise, on its own motion, at its DVL's stamps."""
    problem = selection.fitter.problem
    found = []
    for index, recording in enumerate(problem.recordings):
        without, with_effects = (simulated(problem, fit.hypothesis, index) for fit in (selection.base, selection.fit))
        dvl = recording.dvl
        found.append(Twin(recording, dvl.time, dvl.values, without, with_effects))
    return tuple(found)


def with_denoised_reference(problem: Problem) -> Problem:
    """Remove the noise of every reference at frequencies without motion."""
    denoised = tuple(replace(one, reference=one.reference.denoised) for one in problem.recordings)
    return replace(problem, recordings=denoised)


def simulated(problem: Problem, hypothesis: Hypothesis, index: int) -> Array:
    """Simulate the DVL velocity (N, 3) m/s from the reference's motion by the composed model."""
    recording, injections = problem.recordings[index], hypothesis.injections(index)
    time = true_times(injections, ActsOn.DVL_CLOCK, recording.dvl.time)
    oriented = time + late(injections, ActsOn.ATTITUDE_CLOCK, time)
    velocity = recording.reference(time + late(injections, ActsOn.REFERENCE_CLOCK, time))
    rotation = None if recording.attitude is None else recording.rotation_enu_from_body(oriented)
    if recording.frame is not VelocityFrame.BODY and rotation is not None:
        velocity = np.einsum("nji,nj->ni", rotation, velocity)
    has_rates = recording.attitude is not None or recording.rates is not None
    rates = recording.angular_velocity(oriented) if has_rates else None
    nominal = problem.rotation_dvl_from_body
    motion = EffectInput(time, velocity, nominal, rotation, rates, recording.frame, 0.0, recording.depth(time))
    for _ in range(PASSES):  # the trace depends on the true motion
        motion = replace(motion, velocity_body=velocity + traces(injections, motion, ActsOn.REFERENCE))
    moved = at_dvl(injections, motion)
    if rates is not None:
        moved = replace(moved, velocity_body=moved.velocity_body + cross(rates, np.asarray(problem.lever_arm)))
    calibration = np.linalg.inv(hypothesis.body_from_measured(nominal, turns(injections, moved)))
    measured = np.einsum("...ij,...j->...i", calibration, moved.velocity_body)
    return np.asarray(measured + traces(injections, moved, ActsOn.DVL) @ nominal.T)


def twin_paths(folder: Path, name: str) -> tuple[Path, Path]:
    """Return the paths of a recording's twins, without and with the effects."""
    return folder / f"{name}_without", folder / f"{name}_with"


def write_twins(folder: Path, twin: Twin) -> None:
    """Write NAME_without and NAME_with: DVL simulated without noise, reference and IMU as recorded. Raises InputError.

    Stamps are the recording's, corrected by the clock parameters.
    """
    for path, velocity in zip(twin_paths(folder, twin.recording.name), (twin.without, twin.with_effects), strict=True):
        with BagWriter(path, Storage.MCAP, Compression.NONE) as bag:
            SampleWriter(bag).recording(*_streams(twin, velocity))


def _streams(twin: Twin, velocity: Array) -> tuple[list[ImuSample], list[ReferenceSample], list[DvlSample]]:
    """Return IMU, reference and simulated DVL samples of a twin. velocity: (N, 3) m/s, DVL frame."""
    recording = twin.recording

    def stamps(time: Array) -> list[int]:
        return [recording.first_ns + round(1e9 * each) for each in time.tolist()]

    dvl = [DvlSample(at, (x, y, z)) for at, (x, y, z) in zip(stamps(twin.time), velocity.tolist(), strict=True)]
    reference = [
        ReferenceSample(at, (x, y, z), None, recording.frame)
        for at, (x, y, z) in zip(stamps(recording.reference.time), recording.reference.values.tolist(), strict=True)
    ]
    imu: list[ImuSample] = []
    oriented = recording.attitude or recording.rates
    if oriented is not None:
        time = oriented.time
        rates = recording.angular_velocity(time).tolist()
        quaternions: list[list[float]] = []
        if recording.attitude is not None:
            values = recording.attitude(time)
            quaternions = (values / np.linalg.norm(values, axis=1)[:, None]).tolist()
        for i, at in enumerate(stamps(time)):
            x, y, z = rates[i]
            imu.append(ImuSample(at, tuple(quaternions[i]) if quaternions else None, (x, y, z)))  # type: ignore[arg-type]
    return imu, reference, dvl
