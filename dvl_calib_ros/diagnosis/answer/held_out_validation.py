"""Validation of selected effects against an unknown cause."""

from __future__ import annotations

import itertools

from ...effects.base import Effect
from ..fit.cross_validation import surprise_elsewhere
from ..fit.gauss_newton import Fit
from ..fit.selection_criteria import NuisanceFit
from ..model.forward_model import Problem
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
        other = unexplained(fitter, reduced.fit)
        if not other.found or is_of_group(problem, fit, out, other.about) or not matters(problem, reduced.fit, other):
            continue
        gain = _better_elsewhere(problem, fit, reduced.fit, other) - SETTINGS.indistinguishable - INEXACT * drop
        if gain > 0.0 and (best is None or gain > best[0]):
            best = gain, reduced, other
    return (selection, rest) if best is None else best[1:]


def _better_elsewhere(problem: Problem, fit: Fit, reduced: Fit, other: Unexplained) -> float:
    """Return the held-out deviance gain of an unmodelled regressor over the removed effects."""
    whole, rest = (NuisanceFit.of_fit(problem, each) for each in (fit, reduced))
    rest = rest.and_rest(other.clearest, reduced.residual)
    effects = surprise_elsewhere(problem, fit.noise, whole, fit.residual)
    return effects - surprise_elsewhere(problem, fit.noise, rest, reduced.residual)


def _subsets(selection: EffectSelection) -> list[tuple[Effect, ...]]:
    effects = selection.fit.effects
    return [out for n in range(1, min(2, len(effects)) + 1) for out in itertools.combinations(effects, n)]
