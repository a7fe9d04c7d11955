"""Samples of slow streams that are far off, left out before they bend what they are held against.

Of a fast stream, neighbours tell a sample that is far off. Between the samples of a slow one a vehicle can turn; there
the other stream has to say the same: that it is off, by as much and in the same direction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...calibration.numerics.samples import VelocityFrame
from ...effects.base import ActsOn
from ...effects.composition import late
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..model.recorded_streams import RecordedStreams
from ..model.stream_curve import FAST_ENOUGH_S

# Scatter about neighbours and about the other stream, beyond which both contradict
FROM_NEIGHBOURS, FROM_OTHER = 6.0, 4.0
# Share of the one that the other must say, along it: an effect in a turn of two samples differs from both less alike
ALIKE = (0.6, 1.7)
# Samples of which a scatter is known
FEWEST = 30
_PASSES = 3


def without_contradicted(problem: Problem, hypothesis: Hypothesis) -> tuple[RecordedStreams, ...] | None:
    """The recordings without samples of slow streams that neighbours and the other stream contradict; None if none is.

    Parameters
    ----------
    problem: Of the recordings.
    hypothesis: Robustly fitted, so that lever arm and delays do not look like errors of single samples.

    """
    found = [_without(problem, hypothesis, index) for index in range(len(problem.recordings))]
    return None if all(one is two for one, two in zip(found, problem.recordings, strict=True)) else tuple(found)


def _without(problem: Problem, hypothesis: Hypothesis, index: int) -> RecordedStreams:
    recording = problem.recordings[index]
    dvl = _kept(problem, hypothesis, index, ActsOn.DVL_CLOCK)
    reference = _kept(problem, hypothesis, index, ActsOn.REFERENCE_CLOCK)
    if dvl.all() and reference.all():
        return recording
    return replace(
        recording,
        dvl=recording.dvl.part(dvl),
        reference=recording.reference.part(reference),
        spikes=recording.spikes + int(np.count_nonzero(~dvl)),
    )


def _kept(problem: Problem, hypothesis: Hypothesis, index: int, clock: ActsOn) -> NDArray[np.bool_]:
    """(N,) samples of one stream that are not contradicted."""
    recording = problem.recordings[index]
    of_dvl = clock is ActsOn.DVL_CLOCK
    curve, other = (recording.dvl, recording.reference) if of_dvl else (recording.reference, recording.dvl)
    kept = np.ones(len(curve.time), dtype=bool)
    if curve.interval <= FAST_ENOUGH_S or len(curve.time) < FEWEST:
        return kept
    injections = hypothesis.injections(index)
    true = curve.time
    for _ in range(_PASSES):
        true = curve.time - late(injections, clock, true)
    seen = problem.seen(hypothesis, index, true)
    measured = np.array(problem.measured)
    error = (seen.error if of_dvl else -seen.error) * measured
    suspicious = other.covers(seen.reference_stamps if of_dvl else seen.dvl_stamps)
    suspicious &= np.abs(error / _scatter(error)).max(axis=1) > FROM_OTHER
    others = curve.part(~suspicious)  # two that are off side by side would bear each other out
    if not suspicious.any() or len(others.time) < FEWEST:
        return kept

    def in_body(values: Array) -> Array:
        if of_dvl:
            return np.asarray(values @ hypothesis.body_from_measured(problem.rotation_dvl_from_body).T) * measured
        if recording.frame is VelocityFrame.BODY:
            return values * measured
        return np.asarray(np.einsum("nji,nj->ni", recording.rotation_enu_from_body(true), values)) * measured

    usual = _scatter(in_body(curve.from_neighbours))
    off = in_body((curve.values - others(curve.time)) / curve.loudness)
    along = (off * error).sum(axis=1) / np.maximum((off**2).sum(axis=1), 1e-300) / curve.loudness.mean(axis=1)
    bad = suspicious & others.covers(curve.time) & (np.abs(off / usual).max(axis=1) > FROM_NEIGHBOURS)
    bad &= (along > ALIKE[0]) & (along < ALIKE[1])
    return ~bad


def _scatter(values: Array) -> Array:
    """(3,) standard deviation of values (N, 3), robustly."""
    return np.maximum(robust_std(values), 1e-9)
