"""Confidence intervals of effects: noise and uncertain start times.

A fit's own covariance takes its start times as exact.
"""

from __future__ import annotations

import numpy as np

from ...calibration.numerics.frames import Array
from ...effects.base import MountingEffect
from ..fit.gauss_newton import Fit
from ..fit.selection_criteria import NuisanceFit, robust_covariance
from ..model.forward_model import Problem
from ..model.hypothesis import is_time_of_run
from ..search.clock_jumps import LEAP, time_by_stamps
from ..search.effect_selection import EffectSelection

Triple = tuple[float, float, float]
Times = dict[tuple[str, int, str], Triple]


def covariance_of(selection: EffectSelection) -> tuple[Array, Times]:
    """Return the covariance (6 + p, 6 + p) of a selection, and effects' times with 95 per cent intervals. Times are by
    effect, recording and name."""
    fitter, fit = selection.fitter, selection.fit
    covariance, _ = robust_covariance(fitter.problem, fit)
    if not selection.selected:
        return covariance, {}
    covariance = with_unobservable_turns(fitter.problem, fit, covariance)
    times: Times = {}
    for effect in fit.effects:
        for spec in filter(is_time_of_run, effect.parameters):
            for recording in dict.fromkeys(each.recording or 0 for each in fit.hypothesis.parameters_of(effect)):
                found = time_by_stamps(fitter, fit, spec.name) if effect.name == LEAP else None
                found = found or fitter.time_interval(fit, effect, spec.name, recording)
                times[effect.name, recording, spec.name] = found
                covariance = covariance + fitter.moved_by_time(fit, effect, spec.name, recording, found[1:])
    return covariance, times


def with_unobservable_turns(problem: Problem, fit: Fit, covariance: Array) -> Array:
    """Add the uncertainty from unobservable rotations of a moving mounting to a covariance (n, n).

    A mounting rotated by 4 degrees in pitch shifts yaw by a few tenths of a degree and the arm by centimetres.
    """
    if not any(isinstance(effect, MountingEffect) for effect in fit.effects):
        return covariance
    nuisances, own = NuisanceFit.of_fit(problem, fit), np.arange(fit.columns.shape[2])
    if len(nuisances.std) == len(own):
        return covariance
    both = nuisances.step(fit.noise, fit.residual)
    alone = both.part(own)
    moved = both.solution()[own] - alone.solution()
    return np.asarray(covariance + both.covariance()[np.ix_(own, own)] - alone.covariance() + np.outer(moved, moved))
