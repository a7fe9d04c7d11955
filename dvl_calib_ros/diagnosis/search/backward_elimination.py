"""Backward elimination of insignificant effects, and effects that occur twice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...effects.base import Effect
from ..fit.cross_validation import predictive_gain_of
from ..fit.gauss_newton import Fit, Fitter, n_amplitudes
from ..fit.selection_criteria import (
    WINDOW_STEPS,
    best_of,
    fit_without,
    log_p_in_place,
    penalty,
    robust_covariance,
    robust_p,
    times_tried,
)
from ..model.hypothesis import Hypothesis, is_time_of_run
from ..model.settings import SETTINGS
from .candidates import KEPT_VARIANTS
from .clock_jumps import LEAP, gaps


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


def repeated_effects(
    fitter: Fitter, fits: Sequence[Fit], every: Mapping[str, Effect], effects: Mapping[str, Effect]
) -> list[Fit]:
    """Return the best fits with a second occurrence of an effect, or without a small one.

    every: effects with their second occurrence. Recordings share the times of an effect, so several have no proposals.
    """
    refitted: list[Fit] = []
    if len(fitter.problem.recordings) > 1:
        return refitted
    for name, double in every.items():
        candidates = [fit for fit in fits if double.again and name in fit.values]
        if not candidates:
            continue
        best = best_of(candidates, effects)
        if double.again.keys() <= best.values[name][0].keys():
            starts = single_occurrences(best, effects[name], double)
        else:
            n = best.n_recordings
            once, twice = (penalty(each, len(effects), n, times_tried(each)) for each in (effects[name], double))
            limit = best.deviance + once - twice
            starts = _second_occurrences(fitter, best, double, limit)
        refitted += [fitter.fit(start, best.noise) for start in starts]
    return refitted


def _second_occurrences(fitter: Fitter, fit: Fit, double: Effect, limit: float) -> list[Hypothesis]:
    """Return the best starts below a deviance `limit` with a second occurrence, both in order of time."""
    kept_effects = [effect for effect in fit.effects if effect.name != double.name]
    (again,) = (spec.name for spec in double.parameters if spec.name in double.again and is_time_of_run(spec))
    seconds = max(recording.seconds for recording in fitter.problem.recordings)
    gain = fit.deviance - fitter.one_step(fit, fit.hypothesis)[0]
    tried = []
    times = np.linspace(0.0, seconds, 2 * WINDOW_STEPS + 1)[1:-1].tolist()
    if double.name == LEAP:
        times += [time for time, _ in gaps(fitter, fit)]
    for time in times:
        values = tuple({**double.defaults, **each, again: time} for each in fit.values[double.name])
        start = fit.hypothesis.with_effects([*kept_effects, double], len(values), {double.name: values})
        misfit, start = fitter.one_step(fit, start)
        if misfit + gain > limit:
            continue
        if time < values[0][double.again[again]]:
            names = {**double.again, **{first: second for second, first in double.again.items()}}
            values = tuple({names[key]: value for key, value in each.items()} for each in start.values[double.name])
            start = start.with_effects(start.effects, len(values), {double.name: values})
        tried.append((misfit, start))
    return [start for _, start in sorted(tried, key=lambda each: each[0])[:KEPT_VARIANTS]]


def single_occurrences(fit: Fit, single: Effect, double: Effect) -> list[Hypothesis]:
    """Return starts with the first or the second occurrence alone, if the other is near zero in σ."""
    std = np.sqrt(np.diag(fit.system.covariance()))
    clear = {
        each.spec.name
        for each, sigma in zip(fit.hypothesis.parameters(), std[6:].tolist(), strict=True)
        if each.effect.name == double.name and abs(fit.hypothesis.value(each)) > SETTINGS.outlying * sigma
    }
    clear = {name for name in clear if not any(is_time_of_run(s) for s in double.parameters if s.name == name)}
    kept_effects = [effect for effect in fit.effects if effect.name != double.name]
    back = {first: second for second, first in double.again.items()}
    starts = []
    for kept, out in (({first: first for first in back}, set(double.again)), (back, set(back))):
        if not out & clear:
            values = tuple({first: each[name] for first, name in kept.items()} for each in fit.values[double.name])
            starts.append(fit.hypothesis.with_effects([*kept_effects, single], len(values), {double.name: values}))
    return starts
