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
    problem, n = fitter.problem, len(fit.seen)
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
    found: list[Fit] = []
    if len(fitter.problem.recordings) > 1:
        return found
    for name, whole in every.items():
        own = [fit for fit in fits if whole.again and name in fit.values]
        if not own:
            continue
        best = best_of(own, effects)
        if whole.again.keys() <= best.values[name][0].keys():
            starts = single_occurrences(best, effects[name], whole)
        else:
            n = len(best.seen)
            once, twice = (penalty(each, len(effects), n, times_tried(each)) for each in (effects[name], whole))
            limit = best.deviance + once - twice
            starts = _second_occurrences(fitter, best, whole, limit)
        found += [fitter.fit(start, best.noise) for start in starts]
    return found


def _second_occurrences(fitter: Fitter, fit: Fit, whole: Effect, limit: float) -> list[Hypothesis]:
    """Return the best starts below a deviance `limit` with a second occurrence, both in order of time."""
    others = [effect for effect in fit.effects if effect.name != whole.name]
    (again,) = (spec.name for spec in whole.parameters if spec.name in whole.again and is_time_of_run(spec))
    seconds = max(recording.seconds for recording in fitter.problem.recordings)
    gain = fit.deviance - fitter.one_step(fit, fit.hypothesis)[0]
    tried = []
    times = np.linspace(0.0, seconds, 2 * WINDOW_STEPS + 1)[1:-1].tolist()
    if whole.name == LEAP:
        times += [at for at, _ in gaps(fitter, fit)]
    for at in times:
        values = tuple({**whole.defaults, **each, again: at} for each in fit.values[whole.name])
        start = fit.hypothesis.with_effects([*others, whole], len(values), {whole.name: values})
        misfit, start = fitter.one_step(fit, start)
        if misfit + gain > limit:
            continue
        if at < values[0][whole.again[again]]:
            names = {**whole.again, **{first: second for second, first in whole.again.items()}}
            values = tuple({names[key]: value for key, value in each.items()} for each in start.values[whole.name])
            start = start.with_effects(start.effects, len(values), {whole.name: values})
        tried.append((misfit, start))
    return [start for _, start in sorted(tried, key=lambda each: each[0])[:KEPT_VARIANTS]]


def single_occurrences(fit: Fit, once: Effect, whole: Effect) -> list[Hypothesis]:
    """Return starts with the first or the second occurrence alone, if the other is near zero in σ."""
    std = np.sqrt(np.diag(fit.system.covariance()))
    clear = {
        each.spec.name
        for each, own in zip(fit.hypothesis.parameters(), std[6:].tolist(), strict=True)
        if each.effect.name == whole.name and abs(fit.hypothesis.value(each)) > SETTINGS.outlying * own
    }
    clear = {name for name in clear if not any(is_time_of_run(s) for s in whole.parameters if s.name == name)}
    others = [effect for effect in fit.effects if effect.name != whole.name]
    back = {first: second for second, first in whole.again.items()}
    starts = []
    for kept, out in (({first: first for first in back}, set(whole.again)), (back, set(back))):
        if not out & clear:
            values = tuple({first: each[name] for first, name in kept.items()} for each in fit.values[whole.name])
            starts.append(fit.hypothesis.with_effects([*others, once], len(values), {whole.name: values}))
    return starts
