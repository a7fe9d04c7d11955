"""Twins of recordings: what a simulated DVL measures on the recorded motion, without and with what was found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..calibration.numerics.frames import Array, cross
from ..calibration.numerics.samples import VelocityFrame
from ..effects.base import ActsOn, EffectInput
from ..effects.composition import at_dvl, late, traces, turns
from .composed import Hypothesis, Problem
from .recordings import RecordedStreams
from .selection import EffectSelection

# Passes in which the true time of a late stamp is found, and the motion of which a reference makes what it says
_PASSES = 3


@dataclass(frozen=True)
class Twin:
    """One recording and its twins. recording: its streams. time: (N,) s by the DVL's stamps, since its first. recorded,
    without, with_effects: (N, 3) m/s, DVL frame; without: the calibration alone.
    """

    recording: RecordedStreams
    time: Array
    recorded: Array
    without: Array
    with_effects: Array


def twins(selection: EffectSelection) -> tuple[Twin, ...]:
    """Of every recording, on its own motion, at its DVL's stamps; without noise."""
    problem = selection.fitter.problem
    found = []
    for index, recording in enumerate(problem.recordings):
        without, with_effects = (simulated(problem, fit.hypothesis, index) for fit in (selection.base, selection.fit))
        dvl = recording.dvl
        found.append(Twin(recording, dvl.time, dvl.values, without, with_effects))
    return tuple(found)


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
