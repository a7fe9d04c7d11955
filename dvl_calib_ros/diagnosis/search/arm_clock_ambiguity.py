"""Ambiguity of lever arm and clock offset at one speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...calibration.numerics.frames import Array
from ...calibration.numerics.samples import Index
from ...effects.base import Effect
from ..fit.gauss_newton import Z_INTERVAL, Fit, Fitter, around
from ..model.hypothesis import Hypothesis, Values
from ..model.settings import SETTINGS
from .initial_guess import FirstGuess

ARM, LAG = "lever_arm", "reference_lag"
DVL_CLOCK, REFERENCE_CLOCK, ATTITUDE_CLOCK = "dvl_time_offset", "reference_time_offset", "attitude_time_offset"
CLOCKS = DVL_CLOCK, REFERENCE_CLOCK, ATTITUDE_CLOCK
# Clocks that represent the two observable offsets of the three
TWO_CLOCKS = DVL_CLOCK, REFERENCE_CLOCK
# Alternatives for a delayed reference, and the delay from which each is tried for the other, s
LAG_OR_DELAY, LAG_FROM_S = (LAG, REFERENCE_CLOCK), 0.2
ARM_PARAMETERS = "x_m", "y_m", "z_m"
# At one speed, arm and clock are inseparable if a joint fit inflates the arm's σ by this factor
MAX_INFLATION = 3.5
# Ambiguity of the arm, m, from which registration limits the precision of arm and clock
AMBIGUITY_M = 0.1


@dataclass(frozen=True)
class Combination:
    """Observable combination of an ambiguous lever arm and clock: the arm minus speed times delay.

    parameter: of the arm.
    clock: name of the effect.
    speed: m/s.
    value: m, with its 95 per cent interval.
    """

    parameter: str
    clock: str
    speed: float
    value: tuple[float, float, float]


@dataclass(frozen=True)
class ArmAmbiguity:
    """Ambiguity of arm and reference clock: change (m) of arm parameters per second of delay; σ (s) of the delay."""

    by: Mapping[str, float]
    delay_std_s: float


def lags_and_delays(fit: Fit, effects: Mapping[str, Effect]) -> list[dict[str, tuple[Values, ...]]]:
    """Return start values, by name, that make a reference's delay a lag alone or a clock offset alone.

    To first order a low-pass is a delay. For seconds, linear steps do not lead from one to the other.
    """
    own = [fit.values.get(LAG, ()), fit.values.get(REFERENCE_CLOCK, ())]
    each = [[next(iter(values.values())) for values in per] or [0.0] * fit.n_recordings for per in own]
    delays = [lag + delay for lag, delay in zip(*each, strict=True)]
    if min(delays) < LAG_FROM_S or not any(own):
        return []
    keys = {LAG: "time_constant_s", REFERENCE_CLOCK: "seconds"}
    return [
        {name: tuple({key: seconds} for seconds in delays)}
        for name, key in keys.items()
        if name in effects and {name} != set(LAG_OR_DELAY) & set(fit.values)
    ]


def is_open(guesses: Sequence[FirstGuess]) -> bool:
    """Return whether registration leaves lever arm and clock ambiguous."""
    return any(each.registration is not None and bool(each.registration.left_open.any()) for each in guesses)


def separable_clocks(guesses: Sequence[FirstGuess]) -> set[str]:
    """Return the clock offsets of recordings that leave less than `AMBIGUITY_M` of the lever arm open to a clock."""
    found = [each.registration for each in guesses if each.registration is not None]
    return {name for each in found if np.trace(each.left_open[3:6, 3:6]) < AMBIGUITY_M**2 for name in each.offsets}


def guessed_arm(guesses: Sequence[FirstGuess], effects: Mapping[str, Effect]) -> dict[str, float]:
    """Return the lever arm to start from, the median of recordings; unobservable parts only where registered well.

    An error of metres in the height rotates the rest of the arm. effects: with observable parameters.
    """
    observable = {spec.name for spec in effects[ARM].parameters} if ARM in effects else set(ARM_PARAMETERS)
    stds = [guess.registration.lever_arm_std for guess in guesses if guess.registration is not None]
    known = np.min(stds, axis=0) < AMBIGUITY_M if stds else np.zeros(3, dtype=bool)
    arm = np.median([guess.lever_arm for guess in guesses], axis=0)
    return {
        name: value if name in observable or is_known else 0.0
        for name, value, is_known in zip(ARM_PARAMETERS, arm.tolist(), known.tolist(), strict=True)
    }


def with_arm(fitter: Fitter, fit: Fit, guesses: Sequence[FirstGuess], effects: Mapping[str, Effect]) -> Fit:
    """Return a fit with registration's clocks and the lever arm, where these are ambiguous.

    Return the fit unchanged if it has no clock, or if it is significantly better.
    """
    present = [effect.name for effect in fit.effects]
    own = [name for name in TWO_CLOCKS if name in present]
    if not own or ARM not in effects or not is_open(guesses):
        return fit
    registered = {name for each in guesses if each.registration is not None for name in each.registration.offsets}
    clocks = [name for name in TWO_CLOCKS if name in registered] or own
    if not registered <= {*TWO_CLOCKS} or {*clocks, ARM} == {*own, *(name for name in present if name == ARM)}:
        return fit
    others = [effect for effect in fit.effects if effect.name not in (*TWO_CLOCKS, ARM)]
    start: dict[str, tuple[Values, ...]] = {
        ARM: (guessed_arm(guesses, effects),) * len(guesses),
        DVL_CLOCK: tuple({"seconds": each.offsets.dvl} for each in guesses),
        REFERENCE_CLOCK: tuple({"seconds": each.offsets.reference} for each in guesses),
    }
    effects_to_fit = [*others, effects[ARM], *(effects[name] for name in clocks if name in effects)]
    if len(effects_to_fit) > SETTINGS.max_effects:
        return fit
    found = fitter.fit_kept(fit.hypothesis.with_effects(effects_to_fit, len(guesses), start), fit.noise)
    return found if found.deviance < fit.deviance + SETTINGS.indistinguishable else fit


def with_clocks(
    fitter: Fitter,
    fit: Fit,
    guesses: Sequence[FirstGuess],
    effects: Mapping[str, Effect],
    block: Index,
    trade_off: ArmAmbiguity | None,
) -> Fit | None:
    """Return a fit with both clock offsets, if they explain part of the lever arm equally well; else the fit.

    Return None where arm and clock are inseparable. block: (M,) of each bin, for σ. trade_off: from `arm_ambiguity`; if
    given, a part that changes significantly with free clocks is ambiguous as well.

    At 0.87 m/s, a DVL 0.3 m astern and a compass delay of 0.35 s differ only while the boat slows down. A model without
    clocks attributes instrument errors in turns to the arm.
    """
    present = [effect.name for effect in fit.effects]
    clocks = [effects[name] for name in TWO_CLOCKS if name in effects and name not in present]
    if ARM not in present or not clocks or not is_open(guesses):
        return fit
    joint = fitter.fit_kept(fit.hypothesis.with_effects([*fit.effects, *clocks], fit.n_recordings, {}), fit.noise)
    if trade_off is not None and joint.deviance > fit.deviance + SETTINGS.indistinguishable:
        return None
    (own, own_std), (free, free_std) = (_arm_of(each, block) for each in (fit, joint))
    was_shown, is_shown = np.abs(own) > Z_INTERVAL * own_std, np.abs(free) > Z_INTERVAL * free_std
    by_chance = np.sqrt(np.maximum(free_std**2 - own_std**2, 0.0))  # change if no clock is delayed
    is_another = ~is_shown | ((trade_off is not None) & (np.abs(free - own) > Z_INTERVAL * by_chance))
    if bool((was_shown & is_another & (free_std > 2.0 * own_std)).any()):
        return joint
    return None if trade_off is not None and bool((was_shown & (free_std > MAX_INFLATION * own_std)).any()) else fit


def _arm_of(fit: Fit, block: Index) -> tuple[Array, Array]:
    """Return the lever arm's parameters (p,) and standard deviations (p,) from blocks."""
    at = [*_indices(fit, ARM).values()]
    return fit.hypothesis.vector()[at], np.sqrt(np.diag(fit.covariance(block))[at])


def arm_ambiguity(guesses: Sequence[FirstGuess]) -> ArmAmbiguity | None:
    """Return the ambiguity of the least ambiguous recording. Return None if it is negligible."""
    found = [each.registration for each in guesses if each.registration is not None]
    best = min(found, key=lambda each: float(np.trace(each.left_open[3:6, 3:6])), default=None)
    if best is None or np.trace(best.left_open[3:6, 3:6]) < AMBIGUITY_M**2:
        return None
    delay_std_s = float(np.sqrt(np.trace(best.left_open) / (best.open_by @ best.open_by)))
    return ArmAmbiguity(dict(zip(ARM_PARAMETERS, best.open_by[3:6].tolist(), strict=True)), delay_std_s)


def arm_change(fit: Fit, rivals: Sequence[Hypothesis]) -> dict[str, float]:
    """Return the largest change (m), by arm parameter, among rivals that explain the data equally well.

    rivals: hypotheses with another clock.
    """
    if ARM not in fit.values:
        return {}
    own, others = fit.values[ARM][0], [each.values[ARM][0] for each in rivals if ARM in each.values]
    moved = [{name: other.get(name, 0.0) - value for name, value in own.items()} for other in others]
    return max(moved, key=lambda each: sum(by**2 for by in each.values()), default={})


def lag_change(fit: Fit, joint: Fit) -> dict[str, float]:
    """Return the change (s) of a lag from a joint fit with more clocks, if both are equally likely."""
    if not {LAG} <= fit.values.keys() & joint.values.keys():
        return {}
    if fit.deviance > joint.deviance + SETTINGS.indistinguishable:
        return {}
    return {name: value - joint.values[LAG][0][name] for name, value in fit.values[LAG][0].items()}


def with_changes(fit: Fit, covariance: Array, moved: Mapping[str, float]) -> Array:
    """Return a covariance (6 + p, 6 + p) that includes changes from `arm_change` and `lag_change`."""
    step = np.zeros(len(covariance))
    for name, i in (_indices(fit, ARM) | _indices(fit, LAG)).items():
        step[i] = moved.get(name, 0.0)
    return np.asarray(covariance + np.outer(step, step))


def with_ambiguity(fit: Fit, covariance: Array, trade_off: ArmAmbiguity | None) -> Array:
    """Return a covariance (6 + p, 6 + p) that includes registration's ambiguity of arm and reference clock."""
    if trade_off is None:
        return covariance
    clock = [6 + i for i, each in enumerate(fit.hypothesis.parameters()) if each.effect.name == REFERENCE_CLOCK]
    step = np.zeros(len(covariance))
    step[clock] = 1.0
    for name, i in _indices(fit, ARM).items():
        step[i] = trade_off.by[name]
    known = max(np.diag(covariance)[clock].tolist(), default=0.0)
    return np.asarray(covariance + max(trade_off.delay_std_s**2 - known, 0.0) * np.outer(step, step))


def ambiguous_combination(fit: Fit, covariance: Array, trade_off: ArmAmbiguity | None) -> Combination | None:
    """Return the observable combination of arm and reference clock from a fit of one recording without that clock."""
    at = _indices(fit, ARM)
    if trade_off is None or not at or fit.n_recordings > 1:
        return None
    name = max(at, key=lambda each: abs(trade_off.by[each]))
    value, std = float(fit.hypothesis.vector()[at[name]]), float(np.sqrt(covariance[at[name], at[name]]))
    return Combination(name, REFERENCE_CLOCK, trade_off.by[name], around(value, std))


def combination(fit: Fit, covariance: Array, clock: str) -> Combination | None:
    """Return the observable combination of arm and clock of one recording from their covariance (6 + p, 6 + p)."""
    arm, delay = _indices(fit, ARM), _indices(fit, clock).get("seconds")
    if delay is None or not arm or fit.n_recordings > 1:
        return None
    vector = fit.hypothesis.vector()
    speeds = {name: float(covariance[i, delay] / covariance[delay, delay]) for name, i in arm.items()}
    name = max(speeds, key=lambda each: abs(speeds[each]))
    at, speed = arm[name], speeds[name]
    value = float(vector[at] - speed * vector[delay])
    std = float(np.sqrt(max(covariance[at, at] - speed**2 * covariance[delay, delay], 0.0)))
    return Combination(name, clock, speed, around(value, std))


def _indices(fit: Fit, effect: str) -> dict[str, int]:
    """Return the index of each parameter of an effect in a fit's vector; of the last recording."""
    parameters = enumerate(fit.hypothesis.parameters(), start=6)
    return {each.spec.name: i for i, each in parameters if each.effect.name == effect}
