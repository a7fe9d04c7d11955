"""Backward elimination of insignificant effects."""

from __future__ import annotations

import numpy as np

from ..fit.cross_validation import predictive_gain_of
from ..fit.gauss_newton import Fit, Fitter, n_amplitudes
from ..fit.selection_criteria import (
    fit_without,
    log_p_in_place,
    penalty,
    robust_covariance,
    robust_p,
    times_tried,
)
from ..model.settings import SETTINGS


def eliminate(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """Return a fit without effects that are insignificant given the others."""
    threshold = float(np.log(SETTINGS.level / n_effects))
    while fit.effects:
        rests = [(effect, fit_without(fitter, fit, effect)) for effect in fit.effects]
        weak = [rest for effect, rest in rests if log_p_in_place(fitter, fit, rest, effect) > threshold]
        if not weak:
            return fit
        fit = min(weak, key=lambda each: each.deviance)
    return fit


def without_chance(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """Return a fit without effects that chance or slow noise explains as well.

    An effect is kept if the covariance of its interval makes it significant, and it predicts held-out data beyond its
    price.
    """
    problem, n = fitter.problem, fit.n_recordings
    while fit.effects:
        covariance = robust_covariance(problem, fit)
        p_values = {effect.name: robust_p(fit, effect, *covariance) for effect in fit.effects}
        name = max(p_values, key=lambda each: p_values[each])
        if p_values[name] >= SETTINGS.robust_level:
            fit = fit_without(fitter, fit, next(effect for effect in fit.effects if effect.name == name))
            continue
        spare = []
        for effect in fit.effects:
            reduced = fit_without(fitter, fit, effect)
            chance = penalty(effect, n_effects, n, times_tried(effect)) - n_amplitudes(effect, n)
            spare.append((predictive_gain_of(problem, reduced, fit) - chance, reduced))
        worst, reduced = min(spare, key=lambda each: each[0])
        if worst > 0.0:
            return fit
        fit = reduced
    return fit
