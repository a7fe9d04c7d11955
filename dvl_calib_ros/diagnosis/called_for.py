"""A fit without those of its effects that the data does not call for, given all others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial

import numpy as np

from ..effects.base import Effect
from .clock_or_arm import DVL_CLOCK, LAG, TWO_CLOCKS, lag_not_taken_back
from .criteria import blocks_of, finer_steps, fit_without, log_p_in_place, robust_p
from .fitting import Fit, Fitter
from .leaps import LEAP
from .settings import SETTINGS
from .twice import MUCH, TAKEN_BACK, TAKEN_BACK_EXACTLY, apart_and_undone, either_alone, is_taken_back
from .unexplained import Unexplained, matters, unexplained

# A clock that explains less than this share of what two leaps do, and makes them cancel, is not late before them
LITTLE_OF_LEAPS = 0.02


def only_called_for(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """A fit without those effects that are not called for given all others, or add next to nothing to a strong one."""
    threshold = float(np.log(SETTINGS.level / n_effects))
    while fit.effects:
        base = fitter.fit_kept(fit.hypothesis.with_effects([], len(fit.seen), {}), fit.noise)
        explained = base.deviance - fit.deviance
        rests = [(effect, fit_without(fitter, fit, effect)) for effect in fit.effects]
        drops = {effect.name: rest.deviance - fit.deviance for effect, rest in rests}
        left = cache(partial(unexplained, fitter, fit))
        weak = [
            rest
            for effect, rest in rests
            if log_p_in_place(fitter, fit, rest, effect) > threshold
            or is_taken_back(fitter, fit, effect.name, drops[effect.name], rest)
            or _makes_leaps_cancel(fit, effect, drops)
            or _only_smooths(fitter, fit, rest, effect, drops)
            or (
                _is_ghost(effect, drops[effect.name], explained, fit.deviance)
                and not _is_late_before_a_leap(fit, effect)
                and not _is_all_that_is_left(fitter, rest, left)
            )
        ]
        if not weak:
            return fit
        fit = min(weak, key=lambda each: each.deviance)
    return fit


def _makes_leaps_cancel(fit: Fit, effect: Effect, drops: Mapping[str, float]) -> bool:
    """Whether an effect is a clock, late before two leaps that cancel with it alone, and little of what they explain.

    drops: deviance that each effect explains, by name.
    """
    if effect.name != DVL_CLOCK or LEAP not in fit.values or apart_and_undone(fit, LEAP)[1] > TAKEN_BACK_EXACTLY:
        return False
    return drops[DVL_CLOCK] < LITTLE_OF_LEAPS * drops[LEAP]


def _only_smooths(fitter: Fitter, fit: Fit, rest: Fit, effect: Effect, drops: Mapping[str, float]) -> bool:
    """Whether an effect is a lag that clocks take back, and explains no more than smoothing does. rest: without it.

    The two leave the motion where it is, but for its corners, and take noise off the DVL. That of a slow one is known
    by its claims, which may be anything up to its roughness. Of a clock that is late without the lag as well, and
    explains more than this, what it becomes earlier beside it is meant. drops: as for `_makes_leaps_cancel`.
    """
    if effect.name != LAG:
        return False
    is_late_itself = max((drops[name] for name in TWO_CLOCKS if name in drops), default=0.0) > drops[LAG]
    if lag_not_taken_back(fit, rest if is_late_itself else None) >= TAKEN_BACK:
        return False
    smoothed = [float(each.own_noise @ each.own_noise) for each in (rest, fit)]
    more = (smoothed[0] - smoothed[1]) * (fitter.problem.rougher_than_claimed**2 - 1.0)
    return rest.deviance - fit.deviance - more < MUCH


def _is_ghost(effect: Effect, drop: float, explained: float, left: float) -> bool:
    """Whether an effect adds next to nothing to what all of them explain; of what bends an arm, nor to the noise."""
    if drop > SETTINGS.ghost_share * explained:
        return False
    return not effect.bends_arm or drop < SETTINGS.ghost_of_noise * left


def _is_all_that_is_left(fitter: Fitter, rest: Fit, left: Callable[[], Unexplained]) -> bool:
    """Whether a fit without one of its effects (rest) leaves what matters, and with it nothing. left: then.

    What an inexact strong effect leaves has the shape of no other: one takes in a part of it at most.
    """
    return matters(fitter.problem, rest, unexplained(fitter, rest)) and not left().found


def _is_late_before_a_leap(fit: Fit, effect: Effect) -> bool:
    """Whether an effect is that the DVL's clock is late before it leaps, by as much as nothing of the leap could be.

    It tells of the time before the leap alone, which may be short, and so of little of what all of them explain.
    """
    if effect.name != DVL_CLOCK or LEAP not in fit.values:
        return False
    late, leap = fit.values[effect.name], fit.values[LEAP]
    return any(
        abs(own["seconds"]) > TAKEN_BACK * max(abs(each["seconds"]), abs(each.get("again_seconds", 0.0)))
        for own, each in zip(late, leap, strict=True)
    )


def without_nothing(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """A fit without those effects that explain, under the noise as it is known now, no more than chance does.

    At one speed a quadratic scale and the scale go anywhere together, and what noise of the DVL that makes is all they
    explain.
    """
    while fit.effects:
        rests = [
            (rest := fit_without(fitter, fit, effect), log_p_in_place(fitter, fit, rest, effect))
            for effect in fit.effects
        ]
        worst, log_p = max(rests, key=lambda each: each[1])
        if log_p < -float(np.log(n_effects)):
            return fit
        fit = worst
    return fit


def only_borne_out(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """A fit without effects that the scatter of the blocks does not bear out, whatever the noise's colour."""
    block = blocks_of(fitter.problem)
    while fit.effects:
        p_values = {effect.name: robust_p(fit, effect, block) for effect in fit.effects}
        worst = max(p_values, key=lambda name: p_values[name])
        if p_values[worst] < SETTINGS.robust_level:
            return fit
        fit = fit_without(fitter, fit, next(effect for effect in fit.effects if effect.name == worst))
    return fit


def once_where_borne_out(fitter: Fitter, fit: Fit, every: Mapping[str, Effect], effects: Mapping[str, Effect]) -> Fit:
    """A fit in which what happens twice happens once, where the scatter of the blocks does not bear out the other."""
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
