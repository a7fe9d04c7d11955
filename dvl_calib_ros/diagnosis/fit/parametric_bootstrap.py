"""Recordings as a fit says that they came about, with other noise: what a test makes of these is chance.

The fitted model runs forwards on the recorded motion, at the recorded stamps. So a made-up recording has what the
formulas of a test leave out: samples that are interpolated and share neighbours, regressors with noise in them. Between
slow samples its motion goes another way than the one that the diagnosis takes for granted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from ...calibration.numerics.frames import Array
from ...calibration.numerics.samples import VelocityFrame
from ...effects.base import ActsOn
from ...effects.composition import late
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..model.recorded_streams import RecordedStreams
from ..model.seen import Seen
from ..model.stream_curve import FAST_ENOUGH_S, Curve
from .gauss_newton import Fit

# Passes in which the true time of a late stamp is found
_PASSES = 3


class _OtherWay(Curve):
    """A curve through the same samples on Akima's cubics, which bend within two samples of a corner."""

    @cached_property
    def _spline(self) -> Akima1DInterpolator:
        return Akima1DInterpolator(self.time, self.values)

    @cached_property
    def smooth(self) -> Curve:
        """It is."""
        return self


def simulated_recordings(problem: Problem, fit: Fit, count: int) -> Iterator[tuple[Problem, list[Seen], Array]]:
    """`count` problems like one, each seen through the fit's hypothesis, with its residual (M, A) as large as the
    fit's.

    White noise as large as the streams show it, drawn anew; what the residual has beyond that has its colour.
    """
    rng = np.random.default_rng(0)
    moving = replace(problem, recordings=tuple(map(_moving, problem.recordings)))
    truth = [_reference(moving, fit.hypothesis, index) for index in range(len(problem.recordings))]
    wanted = float(np.mean(fit.noise.whiten(fit.residual) ** 2))
    share = 1.0
    for number in range(-1, count):
        drawn = [
            _drawn(recording, reference, share, rng)
            for recording, reference in zip(problem.recordings, truth, strict=True)
        ]
        other = replace(problem, recordings=tuple(drawn))
        seen = other.all_seen(fit.hypothesis)
        residual = other.residual(seen)
        made = float(np.mean(fit.noise.whiten(residual) ** 2))
        if number < 0:  # the roughness of a slow stream is turns as well
            share = min(1.0, float(np.sqrt(wanted / max(made, 1e-300))))
            continue
        beyond = np.sqrt(max(0.0, wanted - made))
        yield other, seen, residual + beyond * fit.noise.unwhiten(rng.standard_normal(residual.size))


def _moving(recording: RecordedStreams) -> RecordedStreams:
    """A recording whose curves are the motion between its samples."""

    def through(curve: Curve | None) -> Curve | None:
        if curve is None or curve.interval <= FAST_ENOUGH_S or len(curve.time) < 5:
            return curve
        return _OtherWay(curve.time, curve.values)

    dvl = recording.dvl.smooth
    return replace(
        recording, dvl=through(dvl) or dvl, attitude=through(recording.attitude), rates=through(recording.rates)
    )


def _drawn(recording: RecordedStreams, reference: Array, share: float, rng: np.random.Generator) -> RecordedStreams:
    def noisy(curve: Curve, values: Array) -> Curve:
        noise = share * curve.noise * curve.loudness * rng.standard_normal(values.shape)
        return Curve(curve.time, values + noise, curve.claimed, claims=curve.claims)

    return replace(
        recording,
        dvl=noisy(recording.dvl, recording.dvl.smooth.values),
        reference=noisy(recording.reference, reference),
    )


def _reference(problem: Problem, hypothesis: Hypothesis, index: int) -> Array:
    """(M, k) m/s that the reference of a recording would report without noise, in its frame, at its own stamps."""
    recording, injections = problem.recordings[index], hypothesis.injections(index)
    time = recording.reference.time
    for _ in range(_PASSES):
        time = recording.reference.time - late(injections, ActsOn.REFERENCE_CLOCK, time)
    seen = problem.seen(hypothesis, index, time)
    motion = seen.motion
    velocity: Array = motion.velocity_body - seen.on_reference(injections)
    if recording.frame is not VelocityFrame.BODY and motion.rotation_enu_from_body is not None:
        velocity = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, velocity)
    return velocity
