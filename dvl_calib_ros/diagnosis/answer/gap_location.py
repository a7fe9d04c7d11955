"""Location of the gap: axis, motion regime, stretch of time and frequency band.

Shapes: F samples, M bins of time, A compared axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...calibration.numerics.tests import holm
from ...effects.base import EffectInput, EffectNeeds
from ..fit.gauss_newton import Fit, Fitter
from ..model.forward_model import Problem
from ..model.seen import Seen
from ..model.settings import SETTINGS
from ..noise.noise_model import Noise
from ..noise.whitened_least_squares import ScoreTest, WhitenedLeastSquares, orthonormal
from ..search.alternative_regressors import TURNING_RADPS

ACCELERATING_MPS2 = 0.05
STRETCHES = 6
BANDS_HZ = (0.0, 0.01, 0.05, 0.2, np.inf)
ALL = "all"
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class GapPlace:
    """Place of the gap. share: of its energy in m²/s². p: adjusted (Holm) over all places tested."""

    axis: str
    regime: str
    segment_s: tuple[float, float]
    band_hz: tuple[float, float]
    share: float
    p: float


def regimes(problem: Problem, seen: Sequence[Seen], per_sample: bool = False) -> dict[str, Mask]:
    """Return (M,) bool each, or (F,) per sample: straight, turning, accelerating, slow or fast (terciles)."""

    def sampled(function: Callable[[EffectInput], Array]) -> Array:
        if per_sample:
            return np.concatenate([function(each.motion) for each in seen])
        return problem.sampled(seen, function)

    speeds = sampled(lambda motion: motion.speed)
    change = sampled(lambda motion: np.gradient(motion.velocity_body[:, 0], motion.time))
    found = {"accelerating": np.abs(change) > ACCELERATING_MPS2}
    if EffectNeeds.ANGULAR_VELOCITY in problem.available:
        found["turning"] = np.abs(sampled(lambda motion: motion.turn_rate[:, 2])) > TURNING_RADPS
        found["straight"] = ~found["turning"]
    slow, fast = np.quantile(speeds, [1 / 3, 2 / 3])
    if fast - slow > 0.1 * fast:
        found["slow"], found["fast"] = speeds <= slow, speeds >= fast
    return {name: mask for name, mask in found.items() if 0.02 < mask.mean() < 0.98}


def places(fitter: Fitter, base: Fit, fit: Fit, columns: Array) -> list[GapPlace]:
    """Return places where the calibrated residual exceeds the noise, by decreasing share of the gap.

    columns: (M, A, p) that explain the gap: traces of the effects, or the dictionary if no effect does.
    """
    problem, noise = fitter.problem, fit.noise
    gap = _signal(base, fit, columns)
    total = float((gap**2).sum())
    if total <= 0.0:
        return []
    white = noise.whiten(base.residual)
    q = orthonormal(noise.whiten(base.columns))
    white = white - q @ (q.T @ white)
    functions = _simplest(problem, fit.seen)
    seconds = max(recording.seconds for recording in problem.recordings)
    nyquist = 0.5 / problem.interval
    names = [name for name, measured in zip("xyz", problem.measured, strict=True) if measured]
    everywhere = np.ones(len(gap), dtype=bool)
    masks = {ALL: everywhere} | regimes(problem, fit.seen)
    cells = [(axis, name, (0.0, seconds), mask) for name, mask in masks.items() for axis in range(problem.axes)]
    edges = np.linspace(0.0, seconds, STRETCHES + 1)
    for start, end in itertools.pairwise(edges.tolist()):
        within = (problem.time >= start) & (problem.time <= end)
        cells += [(axis, ALL, (float(start), float(end)), within) for axis in range(problem.axes)]
    found: list[GapPlace] = []
    for axis, name, segment, mask in cells:
        p = float(np.exp(_log_p(noise, functions, q, white, axis, mask)))
        share = float((gap[mask, axis] ** 2).sum()) / total
        found.append(GapPlace(names[axis], name, segment, (0.0, nyquist), share, p))
        if name == ALL and segment == (0.0, seconds):
            found += [
                GapPlace(names[axis], ALL, segment, (low, min(high, nyquist)), part / total, p)
                for low, high, part in _bands(gap[:, axis], nyquist)
            ]
    adjusted = holm([place.p for place in found])
    kept = [
        replace(place, p=float(p))
        for place, p in zip(found, adjusted, strict=True)
        if p < SETTINGS.level and place.share > 0.02
    ]
    return sorted(kept, key=lambda place: -place.share)


def _signal(base: Fit, fit: Fit, columns: Array) -> Array:
    """Return the estimated gap (M, A): the contribution of the columns beyond the calibration."""
    noise = fit.noise
    size = np.maximum(np.sqrt((columns**2).mean(axis=(0, 1))), 1e-12)
    raw = np.concatenate([base.columns, columns / size], axis=2)
    ridge = np.full(raw.shape[2], 10.0)
    system = WhitenedLeastSquares.of(noise.whiten(raw), noise.whiten(base.residual), ridge, np.zeros_like(ridge))
    return np.asarray(raw @ system.solution())


def _simplest(problem: Problem, seen: Sequence[Seen]) -> Array:
    """Return (M, c): one, speed, and turn rate if available."""
    speed = problem.sampled(seen, lambda motion: motion.speed)
    functions = [np.ones_like(speed), speed]
    if EffectNeeds.ANGULAR_VELOCITY in problem.available:
        functions.append(problem.sampled(seen, lambda motion: motion.turn_rate[:, 2]))
    return np.column_stack(functions)


def _log_p(noise: Noise, functions: Array, q: Array, white: Array, axis: int, mask: Mask) -> float:
    """Return log p of functions of motion (M, c), restricted to a place, for the whitened residual."""
    columns = np.zeros((*noise.level.shape, functions.shape[1]))
    columns[mask, axis] = functions[mask]
    return ScoreTest.of(q, noise.whiten(columns), white).log_p(np.arange(functions.shape[1])[None])[0]


def _bands(gap: Array, nyquist: float) -> list[tuple[float, float, float]]:
    """Return (low, high, energy) of a gap (M,) m/s per frequency band, Hz."""
    energy = np.abs(np.fft.rfft(gap)) ** 2
    frequency = np.linspace(0.0, nyquist, len(energy))
    total = max(float(energy.sum()), 1e-300)
    return [
        (low, high, float((gap**2).sum()) * float(energy[(frequency >= low) & (frequency < high)].sum()) / total)
        for low, high in itertools.pairwise(BANDS_HZ)
        if low < nyquist
    ]
