"""Stretches of time, or whole recordings, that are held out in turn, and what is fitted to all the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..model.settings import SETTINGS
from ..noise.noise_model import Noise
from .gauss_newton import Fit, Fitter

Integers = NDArray[np.intp]
# Steps of a fit that starts from that to all of the data
FOLD_STEPS = 6


def fitted_without(
    fitter: Fitter,
    hypotheses: Sequence[Hypothesis],
    noise: Noise,
    fold_of: Integers,
    fixed: frozenset[str] = frozenset(),
) -> Iterator[tuple[int, list[Fit]]]:
    """Every fold of bins (M,), and fits of hypotheses to all the others.

    Models that are linear need no further fit: `calibration.filters.cross_validation` leaves out what a fold told.
    """
    for fold in np.unique(fold_of).tolist():
        train = fitter.without(fold_of == fold)
        yield fold, [train.fit(each, noise, FOLD_STEPS, fixed=fixed) for each in hypotheses]


def folds_of(problem: Problem) -> Integers:
    """(M,) fold of each bin: whole recordings, of one recording stretches in turn."""
    if len(problem.recordings) > 1:
        return problem.recording_of
    return stretch_of(problem.time) % SETTINGS.folds


def stretch_of(time: Array) -> Integers:
    """Which of the stretches of time that are held out together times (M,) s are in; folds take them in turn."""
    return np.floor(time / SETTINGS.block).astype(np.intp)
