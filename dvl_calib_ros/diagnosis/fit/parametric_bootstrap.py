"""Parametric bootstrap: recordings simulated from a fit, for the null distribution of a test.

The fitted model runs forwards on the recorded motion, at the recorded stamps. A simulated recording therefore has what
a test's formulas omit: interpolated samples that share neighbours, and noisy regressors. Between slow samples, its
motion differs from the diagnosis' interpolation.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from ...calibration.numerics.frames import Array
from ...calibration.numerics.samples import VelocityFrame
from ...effects.base import ActsOn, true_times
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..model.recorded_streams import RecordedStreams
from ..model.seen import Seen
from ..model.stream_curve import FAST_ENOUGH_S, Curve
from .gauss_newton import Fit

# Number of simulated recordings for a null distribution
SIMULATED = 12


class _AkimaCurve(Curve):
    """A curve through the same samples on Akima's cubics, which bend within two samples of a corner."""

    @cached_property
    def _spline(self) -> Akima1DInterpolator:
        return Akima1DInterpolator(self.time, self.steady)

    @cached_property
    def smooth(self) -> Curve:
        """Return the curve, which is smooth."""
        return self


def simulated_recordings(problem: Problem, fit: Fit, count: int) -> Iterator[tuple[Problem, list[Seen], Array]]:
    """Yield `count` simulated problems, their evaluation and a residual (M, A) of the fit's size.

    White noise is redrawn at the streams' noise level; the residual's excess has its own colour.
    """
    rng = np.random.default_rng(0)
    moving = replace(problem, recordings=tuple(map(_moving, problem.recordings)))
    truth = [_reference(moving, fit.hypothesis, index) for index in range(len(problem.recordings))]
    target = float(np.mean(fit.noise.whiten(fit.residual) ** 2))
    share = 1.0
    for number in range(-1, count):
        recordings = [
            _drawn(recording, reference, share, rng)
            for recording, reference in zip(problem.recordings, truth, strict=True)
        ]
        simulated = replace(problem, recordings=tuple(recordings))
        seen = simulated.all_seen(fit.hypothesis)
        residual = simulated.residual(seen)
        achieved = float(np.mean(fit.noise.whiten(residual) ** 2))
        if number < 0:  # a slow stream is rough from turns too
            share = min(1.0, float(np.sqrt(target / max(achieved, 1e-300))))
            continue
        excess = np.sqrt(max(0.0, target - achieved))
        yield simulated, seen, residual + excess * fit.noise.unwhiten(rng.standard_normal(residual.size))


def _moving(recording: RecordedStreams) -> RecordedStreams:
    """Return a recording whose curves are the motion between its samples."""

    def through(curve: Curve | None) -> Curve | None:
        if curve is None or curve.interval <= FAST_ENOUGH_S or len(curve.time) < 5:
            return curve
        return _AkimaCurve(curve.time, curve.values, frame=curve.frame)

    dvl = recording.dvl.smooth
    return replace(
        recording, dvl=through(dvl) or dvl, attitude=through(recording.attitude), rates=through(recording.rates)
    )


def _drawn(recording: RecordedStreams, reference: Array, share: float, rng: np.random.Generator) -> RecordedStreams:
    """Return a recording with simulated white noise. reference: noise-free. share: of the streams' noise level."""

    def noisy(curve: Curve, values: Array) -> Curve:
        noise = share * curve.noise * curve.relative_noise * rng.standard_normal(values.shape)
        return replace(curve, values=values + noise, like=None)

    return replace(
        recording,
        dvl=noisy(recording.dvl, recording.dvl.smooth.values),
        reference=noisy(recording.reference, reference),
    )


def _reference(problem: Problem, hypothesis: Hypothesis, index: int) -> Array:
    """Return the noise-free reference (M, k) m/s of a recording, in its frame, at its own stamps."""
    recording, injections = problem.recordings[index], hypothesis.injections(index)
    time = true_times(injections, ActsOn.REFERENCE_CLOCK, recording.reference.time)
    seen = problem.seen(hypothesis, index, time)
    motion = seen.motion
    velocity: Array = motion.velocity_body - seen.on_reference(injections)
    if recording.frame is not VelocityFrame.BODY and motion.rotation_enu_from_body is not None:
        velocity = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, velocity)
    return velocity
