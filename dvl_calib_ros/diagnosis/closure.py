"""How much of the gap goes away, on data that the parameters have not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from ..effects.base import Effect
from .fitting import Fit, Fitter
from .problem import PRIOR_STD, Problem
from .selection import Selection, selected_again

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


def held_out(selection: Selection, dictionary: Array, only: Effect | None = None) -> HeldOutResiduals:
    """What is left before and after the effects of a selection, on held-out data.

    Effects are selected, and fitted with the calibration, on all folds but one, and judged on that; `only`: that one
    effect in all folds. The noise floor is what is left by everything together, the dictionary of `unexplained` too if
    given, with the degrees of freedom given back: so it shares the noise of before and after, and their differences are
    exact to the size of the gap rather than of the noise. A simulator that lacks nothing would still be calibrated on
    the other folds: what that costs belongs to the floor.
    """
    fitter, fit = selection.fitter, selection.fit
    block, fold = blocks_of(fitter.problem)
    before, after = np.empty_like(fitter.residual), np.empty_like(fitter.residual)
    floor = _floor(fitter, fit, dictionary)
    for held in np.unique(fold):
        test = fold[block] == held
        train = selection.seen.without(test)
        before[test] = train.left(train.solved([]), [])[test]
        after[test] = before[test]
        if fit.effects:
            chosen = [fit.effects.index(only)] if only is not None else selected_again(train)
            after[test] = train.left(train.solved(chosen), chosen)[test]
        base = fitter.problem.base[test]
        floor[test] += np.einsum("mip,pq,miq->mi", base, train.covariance([]), base, optimize=True)
    return HeldOutResiduals(before, after, floor, block)


def measure_gap(selection: Selection, dictionary: Array, only: Effect | None = None) -> Gap:
    """Held-out gap before and after the effects of a selection, or one of them, with a bootstrap over blocks."""
    before, after, floor = held_out(selection, dictionary, only).squares()
    n = len(selection.fitter.residual)

    def closure(at: Integers) -> Array:
        gap = np.maximum((before - floor)[at].sum(axis=-1), 1e-300)
        return np.asarray(1.0 - np.maximum((after - floor)[at].sum(axis=-1), 0.0) / gap)

    rng = np.random.default_rng(0)
    resampled = closure(rng.integers(0, len(before), (RESAMPLES, len(before))))
    low, high = np.percentile(np.clip(resampled, -1.0, 1.0), [2.5, 97.5]).tolist()
    excess = [max(0.0, float(part.sum() - floor.sum()) / n) for part in (before, after)]
    is_gap = bool(selection.fit.effects) and excess[0] > 0.0
    value = min(1.0, float(closure(np.arange(len(before))))) if is_gap else np.nan
    return Gap(
        before=float(np.sqrt(excess[0])),
        after=float(np.sqrt(excess[1])),
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


def _floor(fitter: Fitter, fit: Fit, dictionary: Array) -> Array:
    """(M, 3) (m/s)², square of the noise: of what is left, and of what the fit has taken of it."""
    base = fitter.problem.base
    jacobians = [(effect, *fitter.jacobian(effect, fit.values[effect.name])) for effect in fit.effects]
    series = fit.residual + base @ fit.change
    for effect, specs, jacobian in jacobians:
        series = series + jacobian @ np.array([fit.values[effect.name][spec.name] for spec in specs])
    size = np.maximum(np.sqrt((dictionary**2).mean(axis=(0, 1))), 1e-12)
    columns = np.concatenate([base, *(jacobian for *_, jacobian in jacobians), dictionary / size], axis=2)
    weak = [np.array([1e-3 / spec.typical for spec in specs]) for _, specs, _ in jacobians]
    prior = np.concatenate([1.0 / PRIOR_STD, *weak, np.full(dictionary.shape[2], 1e-3)])
    white = fit.noise.whiten(np.concatenate([columns, series[:, :, None]], axis=2))
    normal = white[:, :-1].T @ white[:, :-1] + np.diag(prior**2)
    covariance = np.linalg.pinv(normal, hermitian=True)
    left = series - columns @ (covariance @ (white[:, :-1].T @ white[:, -1]))
    taken = np.einsum("mip,pq,miq->mi", columns, covariance, columns, optimize=True)
    floor: Array = left**2 + taken
    return floor
