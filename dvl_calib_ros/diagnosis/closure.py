"""How much of the gap goes away, on data that the parameters have not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from .fitting import Fit, Fitter
from .problem import PRIOR_STD, Problem

BLOCK_S = 20.0
FOLDS = 5
RESAMPLES = 1000
Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Gap:
    """Vector RMS, m/s, on held-out data. closure: nan where there is no gap to close, as its interval."""

    before: float
    after: float
    noise_floor: float
    closure: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class Explanation:
    """Columns (M, 3, p) that explain a series (M, 3), least squares with prior (p,) one over std."""

    columns: Array
    series: Array
    prior: Array


def explanation(fitter: Fitter, fit: Fit) -> Explanation:
    """A fit, made linear about its values: calibration and effects."""
    columns, series, prior = [fitter.problem.base], fit.residual + fitter.problem.base @ fit.change, [1.0 / PRIOR_STD]
    for effect in fit.effects:
        specs, jacobian = fitter.jacobian(effect, fit.values[effect.name])
        columns.append(jacobian)
        series = series + jacobian @ np.array([fit.values[effect.name][spec.name] for spec in specs])
        prior.append(np.array([1e-3 / spec.typical for spec in specs]))
    return Explanation(np.concatenate(columns, axis=2), series, np.concatenate(prior))


@dataclass(frozen=True)
class HeldOutResiduals:
    """before, after: residuals (M, 3) m/s of calibrations without and with the effects that have not seen them.
    floor: (M, 3) (m/s)², the square of the noise in both. block: (M,) index, for resampling.
    """

    before: Array
    after: Array
    floor: Array
    block: Integers

    def squares(self) -> tuple[Array, Array, Array]:
        """Squares of before, after and floor summed over each block (B,), (m/s)²."""
        return self._summed(self.before**2), self._summed(self.after**2), self._summed(self.floor)

    def _summed(self, squares: Array) -> Array:
        return np.asarray(np.bincount(self.block, squares.sum(axis=1)), dtype=float)


def held_out(fitter: Fitter, fit: Fit, dictionary: Array) -> HeldOutResiduals:
    """What is left before and after the effects of a fit, on held-out data.

    Calibration and effects are fitted on all folds but one and judged on that. The noise floor is what is left by
    everything together, the dictionary of `unexplained` too, with the degrees of freedom given back: so it shares the
    noise of before and after, and their differences are exact to the size of the gap rather than of the noise.
    """
    problem, noise = fitter.problem, fit.noise
    block, fold = blocks_of(problem)
    bare = Explanation(problem.base, fitter.residual, 1.0 / PRIOR_STD)
    full = explanation(fitter, fit)
    before = _left_in_folds(bare, noise.whiten(bare.columns), noise.whiten(bare.series), fold[block])
    after = before
    if fit.effects:
        after = _left_in_folds(full, noise.whiten(full.columns), noise.whiten(full.series), fold[block])
    size = np.maximum(np.sqrt((dictionary**2).mean(axis=(0, 1))), 1e-12)
    everything = Explanation(
        np.concatenate([full.columns, dictionary / size], axis=2),
        full.series,
        np.concatenate([full.prior, np.full(dictionary.shape[2], 1e-3)]),
    )
    floor = _floor(everything, noise.whiten(everything.columns), noise.whiten(everything.series))
    return HeldOutResiduals(before, after, floor, block)


def measure_gap(fitter: Fitter, fit: Fit, dictionary: Array) -> Gap:
    """Held-out gap before and after the effects of a fit, with a bootstrap over blocks."""
    before, after, floor = held_out(fitter, fit, dictionary).squares()
    n = len(fitter.residual)

    def closure(at: Integers) -> Array:
        gap = np.maximum((before - floor)[at].sum(axis=-1), 1e-300)
        return np.asarray(1.0 - np.maximum((after - floor)[at].sum(axis=-1), 0.0) / gap)

    rng = np.random.default_rng(0)
    resampled = closure(rng.integers(0, len(before), (RESAMPLES, len(before))))
    low, high = np.percentile(np.clip(resampled, -1.0, 1.0), [2.5, 97.5]).tolist()
    excess = [max(0.0, float(part.sum() - floor.sum()) / n) for part in (before, after)]
    is_gap = bool(fit.effects) and excess[0] > 0.0
    value = min(1.0, float(closure(np.arange(len(before))))) if is_gap else np.nan
    return Gap(
        before=float(np.sqrt(excess[0])),
        after=float(np.sqrt(min(excess) if not fit.effects else excess[1])),
        noise_floor=float(np.sqrt(max(0.0, floor.sum() / n))),
        closure=max(-1.0, value) if is_gap else np.nan,
        interval=(low, high) if is_gap else (np.nan, np.nan),
    )


def blocks_of(problem: Problem) -> tuple[Integers, Integers]:
    """Block of each of the M samples, and fold of each block: whole recordings, of one recording stretches in turn."""
    index = np.floor(problem.time / BLOCK_S).astype(int)
    keys = problem.recording_of * (index.max() + 1) + index
    _, first, block = np.unique(keys, return_index=True, return_inverse=True)
    if len(problem.recordings) > 1:
        return block, problem.recording_of[first]
    return block, np.arange(len(first)) % FOLDS


def _left_in_folds(it: Explanation, white: Array, white_series: Array, fold: Integers) -> Array:
    """(M, 3) m/s that is left of each sample, with coefficients from the folds that it (M,) is not in."""
    p = it.columns.shape[2]
    left = np.empty_like(it.series)
    of_row = np.repeat(fold, 3)
    for held in np.unique(fold):
        train = of_row != held
        a = white[train]
        solution = np.linalg.lstsq(
            np.concatenate([a, np.diag(it.prior)]), np.concatenate([white_series[train], np.zeros(p)]), rcond=None
        )[0]
        test = fold == held
        left[test] = it.series[test] - it.columns[test] @ solution
    return left


def _floor(it: Explanation, white: Array, white_series: Array) -> Array:
    """(M, 3) (m/s)², square of the noise: of what is left, and of what the fit has taken of it."""
    normal = white.T @ white + np.diag(it.prior**2)
    covariance = np.linalg.pinv(normal, hermitian=True)
    left = it.series - it.columns @ (covariance @ (white.T @ white_series))
    taken = np.einsum("mip,pq,miq->mi", it.columns, covariance, it.columns, optimize=True)
    floor: Array = left**2 + taken
    return floor
