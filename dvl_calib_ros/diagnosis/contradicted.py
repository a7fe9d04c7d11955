"""Samples of slow streams that are far off, left out before they bend what they are held against.

Of a fast stream, neighbours tell a sample that is far off. Between the samples of a slow one a vehicle can turn; there
the other stream has to say the same: that it is off, by as much and in the same direction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from ..calibration.frames import Array
from ..calibration.samples import VelocityFrame
from ..effects.base import ActsOn
from ..effects.composition import late
from .composed import Hypothesis, Problem
from .recordings import FAST_ENOUGH_S, SPIKE_PASSES, Curve, Recording

# Scatter about neighbours and about the other stream, beyond which both contradict
FROM_NEIGHBOURS, FROM_OTHER = 6.0, 4.0
# Share of the one that the other must say, along it: an effect in a turn of two samples differs from both less alike
ALIKE = (0.6, 1.7)
# Samples of which a scatter is known
FEWEST = 30
_PASSES = 3


def without_contradicted(problem: Problem, hypothesis: Hypothesis) -> tuple[Recording, ...] | None:
    """The recordings without samples of slow streams that neighbours and the other stream contradict; None if none is.

    Parameters
    ----------
    problem: Of the recordings.
    hypothesis: Robustly fitted, so that lever arm and delays do not look like errors of single samples.

    """
    found = [_without(problem, hypothesis, index) for index in range(len(problem.recordings))]
    return None if all(one is two for one, two in zip(found, problem.recordings, strict=True)) else tuple(found)


def _without(problem: Problem, hypothesis: Hypothesis, index: int) -> Recording:
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
        _kept={},
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
    known = other.covers(seen.reference_stamps if of_dvl else seen.dvl_stamps)
    measured = np.array(problem.measured)
    for _ in range(SPIKE_PASSES):
        at = np.flatnonzero(kept)
        part = curve.part(kept)
        off = _in_body(problem, hypothesis, recording, part, of_dvl, true[at]) * measured
        error = (seen.error[at] if of_dvl else -seen.error[at]) * measured
        from_neighbours, from_other = _far(off), _far(error)
        along = (off * error).sum(axis=1) / np.maximum((off**2).sum(axis=1), 1e-300)
        bad = (from_neighbours > FROM_NEIGHBOURS) & (from_other > FROM_OTHER) & known[at]
        bad &= (along > ALIKE[0]) & (along < ALIKE[1])
        beside = np.maximum(np.append(from_neighbours[1:], 0.0), np.append(0.0, from_neighbours[:-1]))
        bad &= from_neighbours >= beside  # what a spike does to its neighbours is not theirs
        if not bad.any():
            break
        kept[at[bad]] = False
    return kept


def _far(values: Array) -> Array:
    """(N,) how many standard deviations values (N, 3) are from nothing, on the axis on which they are farthest."""
    scale = np.maximum(np.asarray(median_abs_deviation(values, axis=0, scale="normal")), 1e-9)
    return np.asarray((np.abs(values) / scale).max(axis=1))


def _in_body(
    problem: Problem, hypothesis: Hypothesis, recording: Recording, curve: Curve, of_dvl: bool, true: Array
) -> Array:
    """(N, 3) how far samples of a stream are from what their neighbours tell, body frame."""
    off = curve.from_neighbours
    if of_dvl:
        return np.asarray(off @ hypothesis.body_from_measured(problem.rotation_dvl_from_body).T)
    if recording.frame is VelocityFrame.BODY:
        return off
    return np.asarray(np.einsum("nji,nj->ni", recording.rotation_enu_from_body(true), off))
