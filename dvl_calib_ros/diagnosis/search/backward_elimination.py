"""Backward elimination of insignificant effects, and effects that occur twice."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ...effects.base import Effect
from ..fit.cross_validation import predictive_gain_of
from ..fit.gauss_newton import Fit, Fitter, n_amplitudes
from ..fit.selection_criteria import (
    WINDOW_STEPS,
    best_of,
    blocks_of,
    finer_steps,
    fit_without,
    log_p_in_place,
    price,
    robust_p,
    step_of_times,
    times_tried,
)
from ..model.hypothesis import Hypothesis, is_time_of_run
from ..model.settings import SETTINGS
from .candidates import KEPT_VARIANTS
from .clock_jumps import LEAP, gaps, is_in_stamps


def eliminate(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """Return a fit without effects that are insignificant given the others, or negligible next to a strong one."""
    threshold = float(np.log(SETTINGS.level / n_effects))
    while fit.effects:
        base = fitter.fit_kept(fit.hypothesis.with_effects([], len(fit.seen), {}), fit.noise)
        least = SETTINGS.ghost_share * (base.deviance - fit.deviance)
        rests = [(effect, fit_without(fitter, fit, effect)) for effect in fit.effects]
        weak = [
            rest
            for effect, rest in rests
            if log_p_in_place(fitter, fit, rest, effect) > threshold
            or is_taken_back(fitter, fit, effect.name)
            or rest.deviance - fit.deviance < least
        ]
        if not weak:
            return fit
        fit = min(weak, key=lambda each: each.deviance)
    return fit


def only_predictive(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """Return a fit without effects that chance or slow noise explains as well.

    An effect is kept if its sandwich p-value over blocks is significant and it predicts held-out data beyond its price.
    """
    problem, n = fitter.problem, len(fit.seen)
    block = blocks_of(problem)
    while fit.effects:
        p_values = {effect.name: robust_p(fit, effect, block) for effect in fit.effects}
        name = max(p_values, key=lambda each: p_values[each])
        if p_values[name] >= SETTINGS.robust_level:
            fit = fit_without(fitter, fit, next(effect for effect in fit.effects if effect.name == name))
            continue
        spare = []
        for effect in fit.effects:
            rest = fit_without(fitter, fit, effect)
            chance = price(effect, n_effects, n, times_tried(effect)) - n_amplitudes(effect, n)
            spare.append((predictive_gain_of(problem, rest, fit) - chance, rest))
        worst, rest = min(spare, key=lambda each: each[0])
        if worst > 0.0:
            return fit
        fit = rest
    return fit


def once_where_confirmed(fitter: Fitter, fit: Fit, every: Mapping[str, Effect], effects: Mapping[str, Effect]) -> Fit:
    """Return a fit with one occurrence of a repeated effect if blocks do not confirm the other."""
    block = blocks_of(fitter.problem)
    for effect in fit.effects:
        own = {spec.name for spec in effect.parameters}
        if not effect.again or not effect.again.keys() <= own:
            continue
        doubtful = {
            each.spec.name
            for each in fit.hypothesis.parameters_of(effect)
            if robust_p(fit, effect, block, each.spec.name) >= SETTINGS.robust_level
        }
        starts = either_alone(fit, effects[effect.name], every[effect.name], clear=own - doubtful)
        found = [fitter.refined(fitter.fit(start, fit.noise), finer_steps(fitter.problem)) for start in starts]
        return min(found, key=lambda each: each.deviance, default=fit)
    return fit


# Standard deviations from which a second occurrence is kept without a trial
CLEAR = 6.0
# An effect reversed to within this share, or after one grid step, may be any temporary cause
TAKEN_BACK = 0.25


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
            starts = either_alone(best, effects[name], whole)
        else:
            n = len(best.seen)
            once, twice = (price(each, len(effects), n, times_tried(each)) for each in (effects[name], whole))
            limit = best.deviance + once - twice
            starts = _a_second_time(fitter, best, whole, limit)
        tried = [fitter.fit(start, best.noise) for start in starts]
        found += [fit for fit in tried if not is_taken_back(fitter, fit, name)]
    return found


def _a_second_time(fitter: Fitter, fit: Fit, whole: Effect, limit: float) -> list[Hypothesis]:
    """Return the best starts below a deviance `limit` with a second occurrence, both in order of time."""
    others = [effect for effect in fit.effects if effect.name != whole.name]
    (again,) = (spec.name for spec in whole.parameters if spec.name in whole.again and is_time_of_run(spec))
    seconds = max(recording.seconds for recording in fitter.problem.recordings)
    left = fit.deviance - fitter.straight_on(fit, fit.hypothesis)[0]
    tried = []
    times = np.linspace(0.0, seconds, 2 * WINDOW_STEPS + 1)[1:-1].tolist()
    if whole.name == LEAP:
        times += [at for at, _ in gaps(fitter, fit)]
    for at in times:
        values = tuple({**whole.defaults, **each, again: at} for each in fit.values[whole.name])
        start = fit.hypothesis.with_effects([*others, whole], len(values), {whole.name: values})
        misfit, start = fitter.straight_on(fit, start)
        if misfit + left > limit:
            continue
        if at < values[0][whole.again[again]]:
            names = {**whole.again, **{first: second for second, first in whole.again.items()}}
            values = tuple({names[key]: value for key, value in each.items()} for each in start.values[whole.name])
            start = start.with_effects(start.effects, len(values), {whole.name: values})
        tried.append((misfit, start))
    return [start for _, start in sorted(tried, key=lambda each: each[0])[:KEPT_VARIANTS]]


def either_alone(fit: Fit, once: Effect, whole: Effect, clear: Collection[str] | None = None) -> list[Hypothesis]:
    """Return starts with the first or the second occurrence alone, if the other is insignificant.

    clear: names of significant parameters; by default larger than `CLEAR` standard deviations.
    """
    if clear is None:
        std = np.sqrt(np.diag(fit.system.covariance()))
        clear = {
            each.spec.name
            for each, own in zip(fit.hypothesis.parameters(), std[6:].tolist(), strict=True)
            if each.effect.name == whole.name and abs(fit.hypothesis.value(each)) > CLEAR * own
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


def is_taken_back(fitter: Fitter, fit: Fit, name: str) -> bool:
    """Return whether a second occurrence reverses the first in each recording, or follows immediately.

    Any temporary cause resembles that. A clock jump that the stamps confirm is kept.
    """
    apart, share = apart_and_undone(fit, name)
    if apart < step_of_times(fitter.problem):
        return True
    return share < TAKEN_BACK and not (name == LEAP and is_in_stamps(fitter, fit))


def apart_and_undone(fit: Fit, name: str) -> tuple[float, float]:
    """Return interval (s) and share not reversed of two occurrences (maxima of recordings; infinite for one)."""
    effect = next(each for each in fit.effects if each.name == name)
    own = {spec.name: spec for spec in effect.parameters}
    if not effect.again or not effect.again.keys() <= own.keys():
        return np.inf, np.inf
    apart, share = [], []
    for second, first in effect.again.items():
        for values in fit.values[name]:
            if is_time_of_run(own[second]):
                apart.append(values[second] - values[first])
            else:
                largest = max(abs(values[first]), abs(values[second]), 1e-12)
                share.append(abs(values[first] + values[second]) / largest)
    return max(apart), max(share)
