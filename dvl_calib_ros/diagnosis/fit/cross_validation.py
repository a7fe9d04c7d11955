"""Cross-validation over stretches of time or whole recordings.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..model.settings import SETTINGS
from ..noise.noise_model import Noise
from ..noise.whitened_least_squares import WhitenedLeastSquares
from .gauss_newton import Fit, Fitter
from .selection_criteria import NuisanceFit, SlowNoiseOfFit

Integers = NDArray[np.intp]
# Steps of a fit that starts from the fit to all data
FOLD_STEPS = 6


def fitted_without(
    fitter: Fitter,
    hypotheses: Sequence[Hypothesis],
    noise: Noise,
    fold_of: Integers,
    fixed: frozenset[str] = frozenset(),
) -> Iterator[tuple[int, list[Fit]]]:
    """Yield every fold of bins (M,), and fits of hypotheses to the other folds.

    Linear models need no further fit: `calibration.filters.cross_validation` downdates a fold.
    """
    for fold in np.unique(fold_of).tolist():
        train = fitter.without(fold_of == fold)
        yield fold, [train.fit(each, noise, FOLD_STEPS, fixed=fixed) for each in hypotheses]


def folds_of(problem: Problem) -> Integers:
    """Return (M,) fold of each bin: recordings, or alternating stretches of one recording."""
    if len(problem.recordings) > 1:
        return problem.recording_of
    return stretch_of(problem.time) % SETTINGS.folds


def stretch_of(time: Array) -> Integers:
    """Return the index of the hold-out stretch of times (M,) s; folds take them in turn."""
    return np.floor(time / SETTINGS.block).astype(np.intp)


def held_out_deviance(problem: Problem, noise: Noise, fitted: NuisanceFit, residual: Array) -> float:
    """Return the held-out deviance of a residual (M, A), predicted from other stretches of time.

    It accounts for the columns' uncertainty: if the only dive of a run is held out, no other stretch determines an
    effect of the pitch, and the prediction is correspondingly uncertain.
    """
    white, series = noise.whiten(fitted.columns), noise.whiten(residual)
    rows = np.repeat(stretch_of(problem.time) % SETTINGS.folds, residual.shape[1])
    parts = [(white[rows == fold], series[rows == fold]) for fold in np.unique(rows)]
    systems = [WhitenedLeastSquares.of(*part, fitted.std, fitted.centre) for part in parts]
    grams = np.stack([each.gram for each in systems])
    whole, *trained = (
        replace(systems[0], gram=grams[kept].sum(axis=0)).marginal_deviance()
        for kept in (np.ones(len(grams), dtype=bool), *~np.eye(len(grams), dtype=bool))
    )
    return sum(whole - each for each in trained)


def predictive_gain(problem: Problem, simpler: SlowNoiseOfFit, richer: SlowNoiseOfFit) -> float:
    """Return the held-out deviance gain of one set of columns over a simpler one.

    The noise is re-estimated with either, so that slow noise is an alternative explanation. Each takes the noise with
    the better prediction.
    """
    colours = simpler.noise, richer.noise
    worse, better = (
        min(held_out_deviance(problem, colour, each.known, each.residual) + colour.log_size for colour in colours)
        for each in (simpler, richer)
    )
    return worse - better


def predictive_gain_of(problem: Problem, simpler: Fit, richer: Fit) -> float:
    """Return the `predictive_gain` of a fit over a simpler one, without the gain from smoothing instrument noise."""
    own, other = (SlowNoiseOfFit.of_fit(problem, each) for each in (simpler, richer))
    smoothed = float(simpler.own_noise @ simpler.own_noise - richer.own_noise @ richer.own_noise)
    return predictive_gain(problem, own, other) + max(-smoothed, 0.0)
