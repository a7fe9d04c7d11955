"""Validation of selected effects, on held-out data and against an unknown cause."""

from __future__ import annotations

import itertools

from ...effects.base import Effect
from ..fit.cross_validation import predictive_gain
from ..fit.selection_criteria import SlowNoise
from ..model.settings import SETTINGS
from ..search.effect_selection import EffectSelection
from ..search.unexplained import (
    INEXACT,
    Unexplained,
    is_of_group,
    matters,
    unexplained,
)


def settled(selection: EffectSelection) -> tuple[EffectSelection, Unexplained]:
    """Reject effects that an unknown cause explains better or may contribute to; return also the new residual's tests.

    Better means better prediction of held-out stretches. A group of functions that contains the effects includes their
    cause and is no rival. Only effects below `SETTINGS.instead_of` are tested.
    """
    fitter, fit = selection.fitter, selection.fit
    problem, rest = fitter.problem, unexplained(fitter, fit)
    best: tuple[float, EffectSelection, Unexplained] | None = None
    for out in _subsets(selection):
        reduced = selection.without({effect.name for effect in out})
        drop = reduced.fit.deviance - fit.deviance
        if drop > SETTINGS.instead_of:
            continue
        other = unexplained(fitter, reduced.fit, asked=0.0)
        if not other.found or is_of_group(problem, fit, out, other.about) or not matters(problem, reduced.fit, other):
            continue
        cause = SlowNoise.of_fit(problem, reduced.fit).with_rest(problem, reduced.fit.noise, other.clearest)
        gain = predictive_gain(problem, SlowNoise.of_fit(problem, fit), cause)
        gain -= SETTINGS.indistinguishable + INEXACT * drop
        if gain > 0.0 and (best is None or gain > best[0]):
            best = gain, reduced, other
    return (selection, rest) if best is None else best[1:]


def _subsets(selection: EffectSelection) -> list[tuple[Effect, ...]]:
    effects = selection.fit.effects
    return [out for n in range(1, min(2, len(effects)) + 1) for out in itertools.combinations(effects, n)]
