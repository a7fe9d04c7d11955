"""Twins of recordings: what a simulated DVL measures on the recorded motion, without and with what was found."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array, cross
from ..calibration.samples import VelocityFrame
from ..effects.base import ActsOn, EffectInput
from ..effects.composition import at_dvl, late, traces, turns
from .closure import WORSE_THAN_CLAIMED, HeldOutResiduals, claimed_std, high_frequency_variance, only
from .composed import Hypothesis, Problem
from .noise import segments_of
from .recordings import Recording
from .selection import Selection
from .settings import SETTINGS
from .where import TURNING_RADPS

# Passes in which the true time of a late stamp is found, and the motion of which a reference makes what it says
_PASSES = 3
# Of equally many samples, in which the error is told
SPEED_BANDS = 3


@dataclass(frozen=True)
class Twin:
    """One recording and its twins. recording: its streams. time: (N,) s by the DVL's stamps, since its first. recorded,
    without, with_effects: (N, 3) m/s, DVL frame; without: the calibration alone.
    """

    recording: Recording
    time: Array
    recorded: Array
    without: Array
    with_effects: Array


def twins(selection: Selection) -> tuple[Twin, ...]:
    """Of every recording, on its own motion, at its DVL's stamps; without noise."""
    problem = selection.fitter.problem
    found = []
    for index, recording in enumerate(problem.recordings):
        without, with_effects = (simulated(problem, fit.hypothesis, index) for fit in (selection.base, selection.fit))
        dvl = recording.dvl
        found.append(Twin(recording, dvl.time, dvl.values, without, with_effects))
    return tuple(found)


@dataclass(frozen=True)
class HeldOutTwin:
    """What a recorded DVL measured, less what its twins did whose parameters had not seen it.

    name: of the recording. time: (N,) s by the DVL's stamps. segments: stretches without a gap. without, with_effects:
    (N, 3) m/s, ahead, to port and up; zero on an axis that is not measured. noise: (3,) m/s, what of it is noise, as
    the messages claim and high frequencies show. regimes: name -> (N,) bool, straight or turning, and bands of speed.
    """

    name: str
    time: Array
    segments: tuple[slice, ...]
    without: Array
    with_effects: Array
    noise: Array
    regimes: Mapping[str, NDArray[np.bool_]]


def held_out_twins(selection: Selection, residuals: HeldOutResiduals) -> tuple[HeldOutTwin, ...]:
    """Of every recording, where all its streams are known. residuals: with the hypotheses that make the twins."""
    problem = selection.fitter.problem
    claimed = claimed_std(problem)
    found = []
    for index, recording in enumerate(problem.recordings):
        pairs = residuals.hypotheses
        if len(problem.recordings) > 1:
            pairs, part, own = pairs[index : index + 1], only(problem, index), 0
        else:
            part, own = problem, index
        of_twins = [[simulated(part, hypothesis, own) for hypothesis in pair] for pair in pairs]
        stamped = recording.dvl.time
        true = stamped - late(selection.fit.hypothesis.injections(index), ActsOn.DVL_CLOCK, stamped)
        fold = np.floor(true / SETTINGS.block).astype(int) % len(pairs)
        known = recording.reference.covers(true)
        for oriented in (recording.attitude, recording.rates):
            known &= True if oriented is None else oriented.covers(true)
        projection = _to_compared(problem, recording, true)
        differences = []
        for which in range(2):
            twin = np.stack([pair[which] for pair in of_twins])[fold, np.arange(len(stamped))]
            body = (recording.dvl.values - twin) @ problem.rotation_dvl_from_body
            differences.append(np.einsum("nij,nj->ni", projection, body)[known])
        time = stamped[known]
        if len(time) < 2:
            continue
        noise, _ = high_frequency_variance(time, differences[1])
        if claimed is not None:
            noise = np.minimum(noise, (WORSE_THAN_CLAIMED * claimed[index]) ** 2)
        regimes = _regimes(recording, true[known], np.linalg.norm(of_twins[0][1], axis=1)[known])
        without, with_effects = differences
        twin_of = HeldOutTwin(recording.name, time, segments_of([time]), without, with_effects, np.sqrt(noise), regimes)
        found.append(twin_of)
    return tuple(found)


def _to_compared(problem: Problem, recording: Recording, at: Array) -> Array:
    """(N, 3, 3) from the body frame to the axes that are compared; rows of zeros for the others."""
    rotation = None if recording.attitude is None else recording.rotation_enu_from_body(at)
    made = np.zeros((len(at), 3, 3))
    made[:, list(problem.measured)] = problem.projection(recording, rotation)
    return made


def _regimes(recording: Recording, at: Array, speed: Array) -> dict[str, NDArray[np.bool_]]:
    found: dict[str, NDArray[np.bool_]] = {}
    if recording.attitude is not None or recording.rates is not None:
        turning = np.abs(recording.angular_velocity(at)[:, 2]) > TURNING_RADPS
        found = {"straight": ~turning, "turning": turning}
    edges = np.quantile(speed, np.linspace(0.0, 1.0, SPEED_BANDS + 1))
    if edges[-2] - edges[1] > 0.1 * edges[-2]:
        for low, high in itertools.pairwise(edges.tolist()):
            found[f"{low:.1f} to {high:.1f} m/s"] = (speed >= low) & (speed <= high)
    return {name: mask for name, mask in found.items() if mask.any()}


def with_quiet_reference(problem: Problem) -> Problem:
    """The problem with the noise of every reference taken off where there is no motion in it."""
    quiet = tuple(replace(one, reference=one.reference.quiet) for one in problem.recordings)
    return replace(problem, recordings=quiet)


def simulated(problem: Problem, hypothesis: Hypothesis, index: int) -> Array:
    """(N, 3) m/s: the composed model forwards, from the reference's motion to what the DVL measures."""
    recording, injections = problem.recordings[index], hypothesis.injections(index)
    time = recording.dvl.time
    for _ in range(_PASSES):
        time = recording.dvl.time - late(injections, ActsOn.DVL_CLOCK, time)
    oriented = time + late(injections, ActsOn.ATTITUDE_CLOCK, time)
    velocity = recording.reference(time + late(injections, ActsOn.REFERENCE_CLOCK, time))
    rotation = None if recording.attitude is None else recording.rotation_enu_from_body(oriented)
    if recording.frame is not VelocityFrame.BODY and rotation is not None:
        velocity = np.einsum("nji,nj->ni", rotation, velocity)
    has_rates = recording.attitude is not None or recording.rates is not None
    rates = recording.angular_velocity(oriented) if has_rates else None
    nominal = problem.rotation_dvl_from_body
    motion = EffectInput(time, velocity, nominal, rotation, rates, recording.frame, 0.0)
    for _ in range(_PASSES):  # the trace is that of the true motion, which is what is looked for
        motion = replace(motion, velocity_body=velocity + traces(injections, motion, ActsOn.REFERENCE))
    moved = at_dvl(injections, motion)
    if rates is not None:
        moved = replace(moved, velocity_body=moved.velocity_body + cross(rates, np.asarray(problem.lever_arm)))
    calibration = np.linalg.inv(hypothesis.body_from_measured(nominal, turns(injections, moved)))
    measured = np.einsum("...ij,...j->...i", calibration, moved.velocity_body)
    return np.asarray(measured + traces(injections, moved, ActsOn.DVL) @ nominal.T)
