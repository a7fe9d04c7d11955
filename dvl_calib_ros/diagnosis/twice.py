"""What happens twice: a second time tried beside the first, either tried alone, and what is only taken back."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ..effects.base import Effect
from .composed import Hypothesis, is_time_of_run
from .criteria import WINDOW_STEPS, best_of, price, step_of_times, times_tried
from .fitting import Fit, Fitter
from .leaps import LEAP, gaps, is_shown_by_stamps
from .proposing import KEPT_VARIANTS
from .settings import SETTINGS
from .unexplained import unexplained

# Standard deviations from which on a second time that something happens stands without being tried without
CLEAR = 6.0
# What is taken back but for this share of it, or within a step of the grid, may be anything that is there for a while
TAKEN_BACK = 0.25
# (taken back exactly: but for this one), where it explains less than this much or an unknown cause in its place more
TAKEN_BACK_EXACTLY, MUCH = 0.05, 150.0


def happening_again(
    fitter: Fitter, fits: Sequence[Fit], every: Mapping[str, Effect], effects: Mapping[str, Effect]
) -> list[Fit]:
    """Of what may happen twice, the best fit in which it happens once with a second time, where that promises to be
    worth it, and the best in which it happens twice with either alone, where the other is small.

    every: effects with what they are the second time. Several recordings share their times, which two of a day do not.
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
        found += [fit for fit in tried if not is_taken_back(fitter, fit, name, best.deviance - fit.deviance)]
    return found


def _a_second_time(fitter: Fitter, fit: Fit, whole: Effect, limit: float) -> list[Hypothesis]:
    """The likeliest starts with a second time, one straight step about a fit, in the order of time, that are to leave
    less deviance than a limit."""
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
    """What happens twice in a fit, as the first alone and as the second, each where the other is not clear.

    clear: names of the parameters that are; by default those many standard deviations large.
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


def is_taken_back(fitter: Fitter, fit: Fit, name: str, drop: float, rest: Fit | None = None) -> bool:
    """Whether what happens twice in a fit is undone the second time, or happens at once, in each recording.

    drop: deviance that it explains. What explains much may be undone where an unknown cause in its place (rest: without
    it) explains less. That is asked of what explains more than such causes do unseen only if it is undone exactly. A
    clock that is set back and then put right shows that by its stamps.
    """
    apart, share = apart_and_undone(fit, name)
    if apart < step_of_times(fitter.problem):
        return True
    if share >= TAKEN_BACK or (name == LEAP and is_shown_by_stamps(fitter, fit)):
        return False
    if drop < MUCH:
        return True
    if rest is None or (drop > SETTINGS.instead_of and share >= TAKEN_BACK_EXACTLY):
        return False
    other = unexplained(fitter, rest)
    return other.clear_energy - other.price > drop


def apart_and_undone(fit: Fit, name: str) -> tuple[float, float]:
    """How far (s) the second time that something happens in a fit is from the first, and what share is not undone by
    it, of the larger; the most of all recordings. Infinite where it cannot happen twice."""
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
