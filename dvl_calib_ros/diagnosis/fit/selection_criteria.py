"""Cost and gain of a fit, with nuisance columns beside it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
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
from .gauss_newton import Fit, Fitter, n_amplitudes, prior_std

# Parts of the run at whose ends effects that come and go are tried to begin or end
WINDOW_STEPS = 10
# Deviance within which the usual is preferred
AS_WELL = 2.0


def windows(effect: Effect, seconds: float) -> list[dict[str, float]]:
    """Times of the run, by name, that are tried: none at all first, then every part of the grid."""
    times = [spec.name for spec in effect.parameters if is_time_of_run(spec)]
    if not times:
        return [{}]
    grid = np.linspace(0.0, seconds, WINDOW_STEPS + 1).tolist()
    if len(times) == 1:
        return [{times[0]: at} for at in grid[1:-1]]
    whole = {name: effect.defaults[name] for name in times}
    parts = [dict(zip(times, part, strict=True)) for part in itertools.combinations(grid, len(times))]
    return [whole, *(part for part in parts if part != {times[0]: 0.0, times[-1]: seconds})]


def price(effect: Effect, n_effects: int, n_recordings: int, tried: float = 1.0) -> float:
    """Deviance that an effect explains by chance, once in 1 / level data sets, having looked at all of them."""
    dof = n_amplitudes(effect, n_recordings)
    return float(chi2_isf(SETTINGS.level / n_effects / tried, dof))


def price_of_a_time(effect: Effect, n_effects: int) -> float:
    """Deviance that the best of the times at which an effect may begin explains by chance, once in 1 / level data
    sets, beyond what is there from the beginning."""
    return float(chi2_isf(SETTINGS.level / n_effects / times_tried(effect), 1))


def criterion(fit: Fit, n_effects: int) -> float:
    """Deviance and the price of every effect."""
    n = len(fit.seen)
    return fit.deviance + sum(price(effect, n_effects, n, times_tried(effect)) for effect in fit.effects)


def times_tried(effect: Effect) -> float:
    """How many alternatives are looked at for an effect: twice its times of the run, or one."""
    return 2.0 * len(windows(effect, 1.0)) if any(is_time_of_run(s) for s in effect.parameters) else 1.0


def best_of(fits: Sequence[Fit], effects: Mapping[str, Effect]) -> Fit:
    """The fit that explains most for its price; of those that do as well, that of the most usual effects.

    These come first in the library.
    """
    scores = [criterion(fit, len(effects)) for fit in fits]
    rank = {name: index for index, name in enumerate(effects)}
    alike = [fit for fit, score in zip(fits, scores, strict=True) if score < min(scores) + AS_WELL]
    return min(alike, key=lambda fit: (sum(rank[effect.name] for effect in fit.effects), fit.deviance))


def fit_without(fitter: Fitter, fit: Fit, effect: Effect) -> Fit:
    """A fit without one of its effects, under the same noise."""
    rest = [other for other in fit.effects if other is not effect]
    return fitter.fit_kept(fit.hypothesis.with_effects(rest, len(fit.seen), {}), fit.noise)


def log_p_value(drop: float, dof: float, tried: float = 1.0) -> float:
    """log p of a drop in deviance, times how many alternatives were tried."""
    return min(0.0, float(chi2_logsf(max(drop, 0.0), max(dof, 1e-3))) + float(np.log(tried)))


def log_p_in_place(fitter: Fitter, fit: Fit, rest: Fit, effect: Effect) -> float:
    """log p of an effect of a fit, given all others and what is not shown. rest: the fit without it."""
    problem = fitter.problem
    gain = fit.gain_over(rest) - max(_told_by_unshown(problem, rest) - _told_by_unshown(problem, fit), 0.0)
    return log_p_value(gain, fit.dof - rest.dof, times_tried(effect))


def _told_by_unshown(problem: Problem, fit: Fit) -> float:
    """Deviance that what is not shown, and not fitted, would explain beside a fit, as straight lines tell it."""
    if not problem.lacks_columns(fit.hypothesis):
        return 0.0
    both = NuisanceFit.of_fit(problem, fit).step(fit.noise, fit.residual)
    alone = both.part(np.arange(fit.columns.shape[2]))
    return alone.misfit(alone.solution()) - both.misfit(both.solution())


def robust_p(fit: Fit, effect: Effect, block: NDArray[np.intp], name: str = "", moved: Array | float = 0.0) -> float:
    """p of a Wald test with the covariance that blocks show, of all parameters of an effect or of one by name.

    moved: (6 + p,) by how much the parameters may be others for a cause that is not in the fit.
    """
    at, start = np.zeros(0, dtype=int), 6
    for other in fit.effects:
        p = len(fit.hypothesis.parameters_of(other))
        if other is effect:
            at = np.arange(start, start + p)
        start += p
    own = fit.hypothesis.parameters_of(effect)
    is_asked = np.array([not name or each.spec.name == name for each in own])
    at, defaults = at[is_asked], np.array([each.spec.default for each in own])[is_asked]
    values = fit.hypothesis.vector()[at] - defaults
    covariance = (fit.covariance(block) + np.outer(moved, moved))[np.ix_(at, at)]
    wald = float(values @ np.linalg.solve(covariance, values)) / len(at)
    blocks = int(block.max()) + 1
    return float(f_sf(wald, len(at), max(blocks - len(at), 2)))


def blocks_of(problem: Problem) -> NDArray[np.intp]:
    """(M,) block of each bin, from 0: stretches of time, half of those of hold-out."""
    index = np.floor(problem.time / (0.5 * SETTINGS.block)).astype(int)
    keys = problem.recording_of * (index.max() + 2) + index - index.min()
    return np.asarray(np.unique(keys, return_inverse=True)[1], dtype=np.intp)


def step_of_times(problem: Problem) -> float:
    """Seconds between the times of the run that are tried: what is nearer happens at once."""
    return max(recording.seconds for recording in problem.recordings) / WINDOW_STEPS


def finer_steps(problem: Problem) -> list[float]:
    """Steps (s) by which times of the run are refined: half of those tried, down to the time between samples."""
    seconds = step_of_times(problem)
    steps: list[float] = []
    while seconds > 0.5 * problem.interval and len(steps) < 8:
        seconds /= 2.0
        steps.append(seconds)
    return steps


class NuisanceFit(NamedTuple):
    """What is fitted beside what is looked for. columns: (M, A, k) d residual / d parameters. std, centre: (k,), of the
    prior of what they explain of a fit's residual.
    """

    columns: Array
    std: Array
    centre: Array

    @staticmethod
    def of(problem: Problem, hypothesis: Hypothesis, seen: Sequence[Seen], columns: Array) -> NuisanceFit:
        """Columns (M, A, k) of the first k parameters of a hypothesis, and those of what is not shown (u more)."""
        unshown, sizes = problem.unshown_columns(hypothesis, seen)
        k, none = columns.shape[2], np.zeros(len(sizes))
        std, centre = np.append(prior_std(hypothesis)[:k], sizes), np.append(hypothesis.vector()[:k], none)
        return NuisanceFit(np.concatenate([columns, unshown], axis=2), std, centre)

    @staticmethod
    def of_fit(problem: Problem, fit: Fit) -> NuisanceFit:
        """All parameters of a fit, and what is not shown."""
        return NuisanceFit.of(problem, fit.hypothesis, fit.seen, fit.columns)

    def and_rest(self, raw: Array, residual: Array) -> NuisanceFit:
        """And columns raw (M, A, c), of unit size, of what a residual (M, A) follows."""
        size = np.maximum(np.sqrt((raw**2).mean(axis=(0, 1))), 1e-12)
        # all together are no larger than the residual: else stretches without a turn would be told of any size
        std, none = np.full(raw.shape[2], _likely(raw, residual)), np.zeros(raw.shape[2])
        columns = np.concatenate([self.columns, raw / size], axis=2)
        return NuisanceFit(columns, np.append(self.std, std), np.append(self.centre, none))

    def step(self, noise: Noise, residual: Array) -> WhitenedLeastSquares:
        """Of the step (k,) of what is fitted that leaves least of a residual (M, A) under a noise."""
        return WhitenedLeastSquares.of(noise.whiten(self.columns), -noise.whiten(residual), self.std, -self.centre)


def _likely(raw: Array, residual: Array) -> float:
    """Size of each of columns (M, A, c) of unit size that all together are no larger than a residual (M, A)."""
    return float(np.sqrt(np.mean(residual**2) / max(raw.shape[2] / raw.shape[1], 1.0)))
