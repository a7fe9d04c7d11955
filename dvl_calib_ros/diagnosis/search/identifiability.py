"""Significance of each effect of a fit, and equivalent effects."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...calibration.registration.registration import PRIOR_DELAY_STD_S
from ...effects.base import Effect
from ..fit.cross_validation import predictive_gain_of
from ..fit.gauss_newton import Z_INTERVAL, Fit, Fitter, n_amplitudes
from ..fit.selection_criteria import (
    blocks_of,
    fit_without,
    log_p_in_place,
    log_p_value,
    robust_covariance,
    robust_p,
    times_tried,
)
from ..model.hypothesis import Hypothesis
from ..model.settings import SETTINGS
from .arm_clock_ambiguity import (
    ARM,
    CLOCKS,
    LAG,
    REFERENCE_CLOCK,
    TWO_CLOCKS,
    ArmAmbiguity,
    arm_ambiguity,
    arm_change,
    is_open,
    lag_change,
    separable_clocks,
    with_arm,
    with_clocks,
)
from .candidates import combined, linearised
from .initial_guess import FirstGuess

# Share of an effect's deviance drop, less a margin, from which a substitute is fitted: linearisation errs by as much.
SCREENED_SHARE, SCREENED_MARGIN = 0.7, 4.0 * SETTINGS.indistinguishable


@dataclass(frozen=True)
class Selected:
    """Significant effect. log_p: given all others; equivalent: names of substitutes; rivals: hypotheses with them."""

    effect: Effect
    log_p: float
    equivalent: tuple[str, ...]
    rivals: tuple[Hypothesis, ...] = field(default=(), repr=False, compare=False)


@dataclass(frozen=True)
class Identifiability:
    """Selected effects, strongest first, and the fit with equally likely clocks.

    opened, changes: as in `EffectSelection`.
    """

    selected: tuple[Selected, ...]
    fit: Fit
    trade_off: ArmAmbiguity | None
    changes: Mapping[str, float]


def identify_effects(
    fitter: Fitter, fit: Fit, guesses: Sequence[FirstGuess], effects: Mapping[str, Effect], swaps: Mapping[str, str]
) -> Identifiability:
    """Test each effect of a fit and its substitutes. swaps: by effect name, a substitute that is equally likely."""
    selection, fit = fit.effects, with_arm(fitter, fit, guesses, effects)
    selected = [_selected(fitter, fit, effect, effects) for effect in fit.effects]
    trade_off = arm_ambiguity(guesses) if ARM in fit.values else None
    if is_open(guesses):
        selected = _clock_or_arm(fitter, fit, selected, len(effects), selection, trade_off, separable_clocks(guesses))
    selected = [_with_equivalents(each, [swaps[n]]) if (n := each.effect.name) in swaps else each for each in selected]
    rivals = [one for each in selected if trade_off is not None and each.effect.name in CLOCKS for one in each.rivals]
    freed = with_clocks(fitter, fit, guesses, effects, blocks_of(fitter.problem), trade_off)
    clocks = tuple(effect.name for effect in (freed or fit).effects if effect not in fit.effects)
    if freed is None:
        clocks = tuple(name for name in TWO_CLOCKS if name not in fit.values)
    if clocks:
        selected = [_with_equivalents(each, clocks) if each.effect.name == ARM else each for each in selected]
    if trade_off and any(each.effect.name == ARM and REFERENCE_CLOCK in each.equivalent for each in selected):
        trade_off = replace(trade_off, delay_std_s=PRIOR_DELAY_STD_S)  # only their combination is observable
    if trade_off is not None:  # a lag differs from a delay by less than interpolation errors
        selected = [
            _with_equivalents(each, [*each.equivalent, REFERENCE_CLOCK]) if each.effect.name == LAG else each
            for each in selected
        ]
    fit, changes = (fit, arm_change(fit, rivals)) if freed is None or freed is fit else (freed, lag_change(fit, freed))
    if any(each.registration is not None and each.registration.ambiguity for each in guesses):
        selected = [
            _with_equivalents(each, TWO_CLOCKS) if each.effect.name in TWO_CLOCKS else each for each in selected
        ]
    return Identifiability(tuple(sorted(selected, key=lambda each: each.log_p)), fit, trade_off, changes)


def _selected(fitter: Fitter, fit: Fit, effect: Effect, effects: Mapping[str, Effect]) -> Selected:
    """Test an effect given all others, and every other effect in its place.

    A substitute that fits worse is a possible cause, too, if it has fewer parameters or fewer times were tried for it.
    """
    reduced = fit_without(fitter, fit, effect)
    log_p = log_p_in_place(fitter, fit, reduced, effect)
    drop = reduced.deviance - fit.deviance
    table = linearised(fitter, reduced, effects)
    n = fit.n_recordings
    own = list(range(len(reduced.effects)))
    found: list[tuple[float, str, Hypothesis]] = []
    best_by_name: dict[str, int] = {}
    drops = {i: table.misfit(own) - table.misfit([*own, i]) for i in range(len(own), len(table.variants))}
    for index in sorted(drops, key=lambda i: -drops[i]):
        best_by_name.setdefault(table.variants[index].effect.name, index)
    linear_drop = drops.get(best_by_name.get(effect.name, -1), drop)
    for name, index in best_by_name.items():
        if name == effect.name or drops[index] < SCREENED_SHARE * min(linear_drop, drop) - SCREENED_MARGIN:
            continue
        rival = fitter.fit_kept(combined(fitter, reduced, table, [*own, index]), fit.noise)
        behind = rival.deviance - fit.deviance
        if behind < 0.5 * drop:  # a fit much worse under one noise is so under its own
            behind = min(behind, predictive_gain_of(fitter.problem, rival, fit))
        fewer = n_amplitudes(effect, n) - n_amplitudes(effects[name], n)
        chosen = float(np.log(times_tried(effect) / times_tried(effects[name])))
        if behind < SETTINGS.indistinguishable + max(0.0, 2.0 * (fewer + chosen)):
            found.append((behind, name, rival.hypothesis))
    found.sort(key=lambda each: each[:2])
    return Selected(effect, log_p, tuple(name for _, name, _ in found), tuple(each for *_, each in found))


def _clock_or_arm(
    fitter: Fitter,
    fit: Fit,
    selected: list[Selected],
    n_effects: int,
    selection: Sequence[Effect],
    trade_off: ArmAmbiguity | None,
    clear: Collection[str] = (),
) -> list[Selected]:
    """Merge lever arm and clock into one entry if each is insignificant given the other.

    selection: selected effects; a further clock is named only if significant.
    trade_off: from `arm_ambiguity`; a reference delay within that ambiguity is insignificant.
    clear: from `separable_clocks`; an insignificant arm is no alternative to these clocks.
    """
    threshold, covariance = float(np.log(SETTINGS.level / n_effects)), robust_covariance(fitter.problem, fit)

    delays = [abs(each["seconds"]) for each in fit.values.get(REFERENCE_CLOCK, ())]
    is_late = trade_off is None or max(delays, default=0.0) >= Z_INTERVAL * trade_off.delay_std_s

    def passes(each: Selected) -> bool:
        if each.effect.name == REFERENCE_CLOCK and not is_late:
            return False
        return each.log_p <= threshold and robust_p(fit, each.effect, *covariance) < SETTINGS.robust_level

    by_name = {each.effect.name: each for each in selected}
    arm, clocks = by_name.get(ARM), [by_name[name] for name in TWO_CLOCKS if name in by_name]
    if arm is None or not clocks:
        return selected
    clock = min(clocks, key=lambda each: each.log_p)
    dropped = [each for each in clocks if each is not clock and each.effect not in selection and not passes(each)]
    selected = [each for each in selected if each not in dropped]
    if passes(arm) and passes(clock):
        return selected
    if passes(clock) and clock.effect.name in clear and arm.log_p > threshold:
        return [each for each in selected if each is not arm]
    kept, other = (arm, clock) if passes(arm) else (clock, arm)
    remaining = [effect for effect in fit.effects if effect not in (arm.effect, clock.effect)]
    without = fitter.fit_kept(fit.hypothesis.with_effects(remaining, fit.n_recordings, {}), fit.noise)
    log_p = log_p_value(fit.gain_over(without), fit.dof - without.dof)
    equivalent = dict.fromkeys((other.effect.name, *kept.equivalent))
    return [Selected(kept.effect, log_p, tuple(equivalent)), *(each for each in selected if each not in (kept, other))]


def _with_equivalents(selected: Selected, names: Sequence[str]) -> Selected:
    """Add equivalent effects to an effect."""
    others = (name for name in (*names, *selected.equivalent) if name != selected.effect.name)
    return replace(selected, equivalent=tuple(dict.fromkeys(others)))
