"""Penalised deviance of a fit, and nuisance parameters.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_isf, chi2_logsf, f_sf
from ...calibration.numerics.frames import Array
from ...effects.base import Effect
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis, is_time_of_run
from ..model.seen import Seen
from ..model.settings import SETTINGS
from ..noise.noise_model import Noise
from ..noise.whitened_least_squares import WhitenedLeastSquares
from .gauss_newton import EQUAL_DEVIANCE, Fit, Fitter, n_amplitudes, prior_std

# Parts of the run at whose ends intermittent effects may begin or end
WINDOW_STEPS = 10
# Time constant, s, of the slowest noise as an alternative to an effect: GNSS multipath lasts minutes
SLOWEST_S = 100.0
# Number of blocks that the noise model counts for in the degrees of freedom of a covariance that it bounds from below
PRIOR_BLOCKS = 30
# Simulated residuals of slow noise
DRAWN = 100


def windows(effect: Effect, seconds: float) -> list[dict[str, float]]:
    """Return the times of the run to try, by name: the whole run first, then every part of the grid."""
    times = [spec.name for spec in effect.parameters if is_time_of_run(spec)]
    if not times:
        return [{}]
    grid = np.linspace(0.0, seconds, WINDOW_STEPS + 1).tolist()
    if len(times) == 1:
        return [{times[0]: at} for at in grid[1:-1]]
    whole = {name: effect.defaults[name] for name in times}
    parts = [dict(zip(times, part, strict=True)) for part in itertools.combinations(grid, len(times))]
    return [whole, *(part for part in parts if part != {times[0]: 0.0, times[-1]: seconds})]


def penalty(effect: Effect, n_effects: int, n_recordings: int, tried: float = 1.0) -> float:
    """Return the deviance that the best of all effects explains under the null with probability `SETTINGS.level`."""
    dof = n_amplitudes(effect, n_recordings)
    return float(chi2_isf(SETTINGS.level / n_effects / tried, dof))


def criterion(fit: Fit, n_effects: int) -> float:
    """Return the deviance plus the price of every effect."""
    n = fit.n_recordings
    return fit.deviance + sum(penalty(effect, n_effects, n, times_tried(effect)) for effect in fit.effects)


def times_tried(effect: Effect) -> float:
    """Return the number of alternatives of an effect: twice its windows, or one without times of the run."""
    return 2.0 * len(windows(effect, 1.0)) if any(is_time_of_run(s) for s in effect.parameters) else 1.0


def best_of(fits: Sequence[Fit], effects: Mapping[str, Effect]) -> Fit:
    """Return the fit with the least criterion; of equivalent fits the one with the most usual effects.

    Usual effects come first in the library.
    """
    scores = [criterion(fit, len(effects)) for fit in fits]
    rank = {name: index for index, name in enumerate(effects)}
    equivalent = [fit for fit, score in zip(fits, scores, strict=True) if score < min(scores) + EQUAL_DEVIANCE]
    return min(equivalent, key=lambda fit: (sum(rank[effect.name] for effect in fit.effects), fit.deviance))


def fit_without(fitter: Fitter, fit: Fit, effect: Effect) -> Fit:
    """Fit without one of the effects, under the same noise."""
    rest = [other for other in fit.effects if other is not effect]
    return fitter.fit_kept(fit.hypothesis.with_effects(rest, fit.n_recordings, {}), fit.noise)


def log_p_value(drop: float, dof: float, tried: float = 1.0) -> float:
    """Return log p of a drop in deviance, adjusted for the number of alternatives."""
    return min(0.0, float(chi2_logsf(max(drop, 0.0), max(dof, 1e-3))) + float(np.log(tried)))


def log_p_in_place(fitter: Fitter, fit: Fit, reduced: Fit, effect: Effect) -> float:
    """Return log p of an effect given all others and unobservable parameters. reduced: the fit without it."""
    problem = fitter.problem
    gain = fit.gain_over(reduced) - max(_absorbed(problem, reduced) - _absorbed(problem, fit), 0.0)
    return log_p_value(gain, fit.dof - reduced.dof, times_tried(effect))


def _absorbed(problem: Problem, fit: Fit) -> float:
    """Return the deviance that unobservable parameters would explain in addition to a fit, linearised."""
    if not problem.has_unobservable(fit.hypothesis):
        return 0.0
    both = NuisanceFit.of_fit(problem, fit).step(fit.noise, fit.residual)
    alone = both.part(np.arange(fit.columns.shape[2]))
    return alone.misfit(alone.solution()) - both.misfit(both.solution())


def robust_p(fit: Fit, effect: Effect, covariance: Array, blocks: int) -> float:
    """Return p of a Wald test of an effect, adjusted for its alternatives.

    covariance: (6 + p, 6 + p), from a number of blocks and the noise model.
    """
    at = fit.hypothesis.indices_of(effect.name)
    defaults = np.array([each.spec.default for each in fit.hypothesis.parameters_of(effect)])
    values = fit.hypothesis.vector()[at] - defaults
    wald = float(values @ np.linalg.solve(covariance[np.ix_(at, at)], values)) / len(at)
    return min(1.0, times_tried(effect) * float(f_sf(wald, len(at), PRIOR_BLOCKS + max(blocks - len(at), 0))))


def robust_covariance(problem: Problem, fit: Fit) -> tuple[Array, int]:
    """Return the covariance (6 + p, 6 + p) from blocks, inflated to the scatter by slow noise, and their number.

    The fit's own noise has a bounded correlation time, so that it absorbs no effect. Blocks are shorter than multipath.
    The uncertain correlation time is sampled from its posterior.
    """
    block = blocks_of(problem)
    covariance, slow, rng = fit.covariance(block), SlowNoiseOfFit.of_fit(problem, fit), np.random.default_rng(0)
    absorbed = slow.noise.absorbed_by(slow.known.columns, slow.known.std)
    drawn = np.stack(list(slow.noise.drawn(slow.left, absorbed, DRAWN, rng)), axis=2)
    steps = fit.system.covariance() @ fit.noise.whiten(fit.columns).T @ fit.noise.whiten(drawn)
    grown = np.sqrt(np.maximum((steps**2).mean(axis=1) / np.diag(covariance), 1.0))
    return np.asarray(covariance * np.outer(grown, grown)), int(block.max()) + 1


def blocks_of(problem: Problem) -> NDArray[np.intp]:
    """Return (M,) block of each bin, from 0: half the length of a hold-out stretch."""
    index = np.floor(problem.time / (0.5 * SETTINGS.block)).astype(int)
    keys = problem.recording_of * (index.max() + 2) + index - index.min()
    return np.asarray(np.unique(keys, return_inverse=True)[1], dtype=np.intp)


def step_of_times(problem: Problem) -> float:
    """Return the interval, s, of the times of the run that are tried; closer events are simultaneous."""
    return max(recording.seconds for recording in problem.recordings) / WINDOW_STEPS


def finer_steps(problem: Problem) -> list[float]:
    """Return steps (s) that refine times of the run: from half the grid's down to the sample interval."""
    seconds = step_of_times(problem)
    steps: list[float] = []
    while seconds > 0.5 * problem.interval and len(steps) < 8:
        seconds /= 2.0
        steps.append(seconds)
    return steps


class NuisanceFit(NamedTuple):
    """Nuisance parameters of a test. columns: (M, A, k) d residual / d parameters. std, centre: (k,), of the prior of
    their contribution to a fit's residual."""

    columns: Array
    std: Array
    centre: Array

    @staticmethod
    def of(problem: Problem, hypothesis: Hypothesis, seen: Sequence[Seen], columns: Array) -> NuisanceFit:
        """Return columns (M, A, k) of the first k parameters of a hypothesis, and u unobservable ones."""
        unobservable, sizes = problem.unobservable_columns(hypothesis, seen)
        k, none = columns.shape[2], np.zeros(len(sizes))
        std, centre = np.append(prior_std(hypothesis)[:k], sizes), np.append(hypothesis.vector()[:k], none)
        return NuisanceFit(np.concatenate([columns, unobservable], axis=2), std, centre)

    @staticmethod
    def of_fit(problem: Problem, fit: Fit) -> NuisanceFit:
        """Return all parameters of a fit and unobservable ones."""
        return NuisanceFit.of(problem, fit.hypothesis, fit.seen, fit.columns)

    def and_nuisance(self, raw: Array, residual: Array) -> NuisanceFit:
        """Add columns raw (M, A, c), scaled to unit size, that may explain a residual (M, A)."""
        size = np.maximum(np.sqrt((raw**2).mean(axis=(0, 1))), 1e-12)
        # jointly no larger than the residual: stretches without a turn would otherwise not bound them
        std, none = np.full(raw.shape[2], _usual_size(raw, residual)), np.zeros(raw.shape[2])
        columns = np.concatenate([self.columns, raw / size], axis=2)
        return NuisanceFit(columns, np.append(self.std, std), np.append(self.centre, none))

    def step(self, noise: Noise, residual: Array) -> WhitenedLeastSquares:
        """Return the system of the step (k,) that minimises a residual (M, A) under a noise."""
        return WhitenedLeastSquares.of(noise.whiten(self.columns), -noise.whiten(residual), self.std, -self.centre)


def _usual_size(raw: Array, residual: Array) -> float:
    """Return the size of each of columns (M, A, c) of unit size that jointly equal a residual (M, A) in size."""
    return float(np.sqrt(np.mean(residual**2) / max(raw.shape[2] / raw.shape[1], 1.0)))


class SlowNoiseOfFit(NamedTuple):
    """Noise as slow as multipath or faster, estimated together with known columns of a residual (M, A).

    left: (M, A), the residual with the columns subtracted.
    """

    known: NuisanceFit
    residual: Array
    noise: Noise
    left: Array

    @staticmethod
    def of(problem: Problem, noise: Noise, known: NuisanceFit, residual: Array) -> SlowNoiseOfFit:
        """Estimate from a residual (M, A), with the level and frame of a noise."""
        left, noise = residual, replace(noise, memory=float(np.exp(-problem.interval / SLOWEST_S)))
        for _ in range(2):
            left = residual + known.columns @ known.step(noise, residual).solution()
            noise = noise.refitted(left, absorbed=noise.absorbed_by(known.columns, known.std))
        return SlowNoiseOfFit(known, residual, noise, left)

    @staticmethod
    def of_fit(problem: Problem, fit: Fit) -> SlowNoiseOfFit:
        """Estimate from the residual of a fit, once."""
        if "slow noise" not in fit.kept:
            known = NuisanceFit.of_fit(problem, fit)
            fit.kept["slow noise"] = SlowNoiseOfFit.of(problem, fit.noise, known, fit.residual)
        slow: SlowNoiseOfFit = fit.kept["slow noise"]
        return slow

    def with_nuisance(self, problem: Problem, noise: Noise, columns: Array) -> SlowNoiseOfFit:
        """Estimate again with columns (M, A, c) that may explain the residual."""
        return SlowNoiseOfFit.of(problem, noise, self.known.and_nuisance(columns, self.residual), self.residual)
