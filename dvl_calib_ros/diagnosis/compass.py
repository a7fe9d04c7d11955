"""A heading that is wrong, where several recordings of one vehicle disagree in yaw.

A constant error of a heading is not told from the DVL's mounting: the same heading navigates. One that swings once or
twice around with the heading (magnetised iron, and iron that takes on the earth's field) or drifts looks like a
mounting that moves, or that has moved between recordings on other headings. A compass does that every day and a
mounting hardly ever, so it is named first: but where the same heading on another day contradicts.
"""

from __future__ import annotations

from collections.abc import Collection

from ..effects.base import Effect
from .composed import Hypothesis, Values
from .fitting import Fit, Fitter
from .settings import SETTINGS

HEADING, MOVED, DRIFT = "heading_error", "mounting_moved", "misalignment_drift"
# What turns DVL and reference against each other by the heading, by the recording or by the time
BY_YAW = frozenset({HEADING, MOVED, DRIFT, "water_lock"})
OF_DRIFT = "rad_per_hour"
# Deviance that two cycles of a heading must promise to explain, as straight lines tell it, to be fitted
PROMISING = 20.0


def with_two_cycles(fitter: Fitter, fit: Fit, heading: Effect | None) -> list[Hypothesis]:
    """What a fit holds that turns DVL and reference against each other, by a heading of two cycles instead: the same
    in all recordings, and another in each. Where it holds no such thing, if that promises to explain something.

    heading: with all that is rarer of it; None where it cannot be tested. None of it for a single recording.
    """
    if heading is None or len(fit.seen) < 2:
        return []
    found = [_instead(fit, BY_YAW, each) for each in _two_cycles(heading)]
    if BY_YAW & fit.values.keys():
        return found
    straight = [fitter.straight_on(fit, each) for each in (fit.hypothesis, *found)]
    return [each for misfit, each in straight[1:] if misfit < straight[0][0] - PROMISING]


def heading_first(fitter: Fitter, fit: Fit, heading: Effect | None) -> tuple[Fit, dict[str, str]]:
    """A fit in which a heading stands for a mounting that moves, if that explains the data as well, and by name what
    may stand for what is in it."""
    if heading is None or len(fit.seen) < 2:
        return fit, {}
    alike: dict[str, str] = {}
    if DRIFT in fit.values:
        own = next((_names(each) for each in fit.effects if each.name == HEADING), frozenset())
        drifting = heading.without(_names(heading) - own - {OF_DRIFT})
        found = fitter.fit_kept(_instead(fit, {DRIFT, HEADING}, drifting), fit.noise)
        if found.deviance < fit.deviance + SETTINGS.indistinguishable:
            fit = found
            alike[HEADING] = DRIFT
    if MOVED in fit.values:
        of_vehicle, of_day = (
            fitter.fit_kept(_instead(fit, {MOVED, HEADING}, each), fit.noise) for each in _two_cycles(heading)
        )
        if of_vehicle.deviance < fit.deviance + SETTINGS.indistinguishable:
            return of_vehicle, {HEADING: MOVED}
        if of_day.deviance < fit.deviance + SETTINGS.indistinguishable:
            alike[MOVED] = HEADING
    return fit, alike


def _two_cycles(heading: Effect) -> tuple[Effect, Effect]:
    """The same in all recordings, and another in each."""
    of_day = heading.without({OF_DRIFT})
    return of_day.of_the_vehicle, of_day


def _names(effect: Effect) -> frozenset[str]:
    return frozenset(spec.name for spec in effect.parameters)


def _instead(fit: Fit, names: Collection[str], heading: Effect) -> Hypothesis:
    """The hypothesis of a fit with a heading in place of effects by name."""
    n = len(fit.seen)
    none = {name: value for name, value in heading.defaults.items() if name in _names(heading)}
    own: tuple[Values, ...] = fit.values.get(HEADING, (none,) * n)
    start = tuple({name: each.get(name, value) for name, value in none.items()} for each in own)
    if not heading.of_the_day:
        start = ({name: sum(each[name] for each in start) / n for name in none},) * n
    rest = [effect for effect in fit.effects if effect.name not in names]
    return fit.hypothesis.with_effects([*rest, heading], n, {HEADING: start})
