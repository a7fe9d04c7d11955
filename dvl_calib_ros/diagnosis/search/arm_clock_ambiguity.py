"""At one speed a clock looks like a lever arm: what a diagnosis says of both, by the one registration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...calibration.numerics.frames import Array
from ...calibration.numerics.samples import Index
from ...effects.base import Effect
from ..fit.gauss_newton import Fit, Fitter, around
from ..model.hypothesis import Hypothesis, Values
from ..model.settings import SETTINGS
from .initial_guess import FirstGuess

ARM, LAG = "lever_arm", "reference_lag"
DVL_CLOCK, REFERENCE_CLOCK, ATTITUDE_CLOCK = "dvl_time_offset", "reference_time_offset", "attitude_time_offset"
CLOCKS = DVL_CLOCK, REFERENCE_CLOCK, ATTITUDE_CLOCK
# What any two of the three say is told by these
TWO_CLOCKS = DVL_CLOCK, REFERENCE_CLOCK
# What makes a reference late, and from how late on (s) either is tried in place of the other
LAG_OR_DELAY, LAG_FROM_S = (LAG, REFERENCE_CLOCK), 0.2
ARM_PARAMETERS = "x_m", "y_m", "z_m"
# A part of the arm that the columns do not show is guessed by registration where that knows it to this (σ), m.
GUESSED_STD_M = 0.2
# A part of the arm is a clock's as well if, with clocks free, it is known so many times worse, and not to so many σ.
WORSE, SHOWN = 2.0, 2.0
# At one speed, arm and clock are one whatever the fit with both says, if that knows the arm so many times worse
AS_ONE = 3.5
# Metres of the arm that are a clock's as well, from which on neither is known better than registration knows them
OPEN_M = 0.1


@dataclass(frozen=True)
class Combination:
    """What is known of a lever arm and a clock that cannot be told apart: the arm less speed times delay.

    parameter: of the arm. clock: name of the effect. speed: m/s. value: m, with its 95 per cent interval.
    """

    parameter: str
    clock: str
    speed: float
    value: tuple[float, float, float]


@dataclass(frozen=True)
class OpenArm:
    """How far lever arm and the reference's clock are one. by: parameter of the arm -> by how much (m) a second of the
    clock makes it another. late: how late the clock may be, σ, s.
    """

    by: Mapping[str, float]
    late: float


def lags_and_delays(fit: Fit, effects: Mapping[str, Effect]) -> list[dict[str, tuple[Values, ...]]]:
    """Start values, by name, with which what makes the reference of a fit late is a lag alone, or a delay alone.

    To first order a low-pass is a delay; of seconds, a straight line leads from neither to the other.
    """
    own = [fit.values.get(LAG, ()), fit.values.get(REFERENCE_CLOCK, ())]
    each = [[next(iter(values.values())) for values in per] or [0.0] * len(fit.seen) for per in own]
    late = [lag + delay for lag, delay in zip(*each, strict=True)]
    if min(late) < LAG_FROM_S or not any(own):
        return []
    told = {LAG: "time_constant_s", REFERENCE_CLOCK: "seconds"}
    return [
        {name: tuple({key: seconds} for seconds in late)}
        for name, key in told.items()
        if name in effects and {name} != set(LAG_OR_DELAY) & set(fit.values)
    ]


def lag_not_taken_back(fit: Fit, rest: Fit | None = None) -> float:
    """The share of a reference's lag, or of how early its stamps are beside the DVL's, that the other does not take
    back, of the larger; the most of all recordings. rest: of how much earlier they are than in this."""
    lag = np.array([each["time_constant_s"] for each in fit.values[LAG]])
    late = _late_beside_dvl(fit) - (0.0 if rest is None else _late_beside_dvl(rest))
    return float((np.abs(lag + late) / np.maximum(np.maximum(lag, np.abs(late)), 1e-9)).max())


def _late_beside_dvl(fit: Fit) -> Array:
    """How late the reference's stamps are beside the DVL's, s, by recording."""
    of_none = ({"seconds": 0.0},) * len(fit.seen)
    dvl, reference = ([each["seconds"] for each in fit.values.get(name, of_none)] for name in TWO_CLOCKS)
    return np.subtract(reference, dvl)


def is_open(guesses: Sequence[FirstGuess]) -> bool:
    """Whether registration leaves open how much of a clock is a lever arm."""
    return any(each.registration is not None and bool(each.registration.left_open.any()) for each in guesses)


def told_apart(guesses: Sequence[FirstGuess]) -> set[str]:
    """Return the clock offsets of recordings that leave less than `OPEN_M` of the lever arm open to a clock."""
    found = [each.registration for each in guesses if each.registration is not None]
    return {name for each in found if np.trace(each.left_open[3:6, 3:6]) < OPEN_M**2 for name in each.offsets}


def guessed_arm(guesses: Sequence[FirstGuess], effects: Mapping[str, Effect]) -> dict[str, float]:
    """The lever arm to start from, as most recordings have it: what is not shown of it only where it is known.

    A height of 5 m for one of 1 turns the rest of the arm. effects: with what of each is shown.
    """
    shown = {spec.name for spec in effects[ARM].parameters} if ARM in effects else set(ARM_PARAMETERS)
    stds = [guess.registration.lever_arm_std for guess in guesses if guess.registration is not None]
    known = np.min(stds, axis=0) < GUESSED_STD_M if stds else np.zeros(3, dtype=bool)
    arm = np.median([guess.lever_arm for guess in guesses], axis=0)
    return {
        name: value if name in shown or is_known else 0.0
        for name, value, is_known in zip(ARM_PARAMETERS, arm.tolist(), known.tolist(), strict=True)
    }


def with_arm(fitter: Fitter, fit: Fit, guesses: Sequence[FirstGuess], effects: Mapping[str, Effect]) -> Fit:
    """The fit with clocks as registration tells them, and the lever arm beside, where that is left open.

    As it is where no clock is in it, or the other explains less.
    """
    present = [effect.name for effect in fit.effects]
    own = [name for name in TWO_CLOCKS if name in present]
    if not own or ARM not in effects or not is_open(guesses):
        return fit
    shown = {name for each in guesses if each.registration is not None for name in each.registration.offsets}
    clocks = [name for name in TWO_CLOCKS if name in shown] or own
    if not shown <= {*TWO_CLOCKS} or {*clocks, ARM} == {*own, *(name for name in present if name == ARM)}:
        return fit
    rest = [effect for effect in fit.effects if effect.name not in (*TWO_CLOCKS, ARM)]
    start: dict[str, tuple[Values, ...]] = {
        ARM: (guessed_arm(guesses, effects),) * len(guesses),
        DVL_CLOCK: tuple({"seconds": each.offsets.dvl} for each in guesses),
        REFERENCE_CLOCK: tuple({"seconds": each.offsets.reference} for each in guesses),
    }
    wanted = [*rest, effects[ARM], *(effects[name] for name in clocks if name in effects)]
    if len(wanted) > SETTINGS.max_effects:
        return fit
    found = fitter.fit_kept(fit.hypothesis.with_effects(wanted, len(guesses), start), fit.noise)
    return found if found.deviance < fit.deviance + SETTINGS.indistinguishable else fit


def with_clocks(
    fitter: Fitter,
    fit: Fit,
    guesses: Sequence[FirstGuess],
    effects: Mapping[str, Effect],
    block: Index,
    opened: OpenArm | None,
) -> Fit | None:
    """The fit with both clocks beside the lever arm that it has, if a part of that is as likely theirs; else the fit.
    None where the two are one, and the fit stays as it is.

    block: (M,), of each bin, by which σ is found. opened: as `opened_arm` has it; where that is much, a part that is
    another with clocks free, beyond chance, is as likely theirs as well.

    A boat at 0.87 m/s whose DVL sits 0.3 m astern and one whose compass is 0.35 s late look alike, but where it slows
    down; and what turns make of the instruments there, a model that has no clocks calls the arm's.
    """
    present = [effect.name for effect in fit.effects]
    clocks = [effects[name] for name in TWO_CLOCKS if name in effects and name not in present]
    if ARM not in present or not clocks or not is_open(guesses):
        return fit
    joint = fitter.fit_kept(fit.hypothesis.with_effects([*fit.effects, *clocks], len(fit.seen), {}), fit.noise)
    if opened is not None and joint.deviance > fit.deviance + SETTINGS.indistinguishable:
        return None
    (own, own_std), (free, free_std) = (_arm_of(each, block) for each in (fit, joint))
    was_shown, is_shown = np.abs(own) > SHOWN * own_std, np.abs(free) > SHOWN * free_std
    by_chance = np.sqrt(np.maximum(free_std**2 - own_std**2, 0.0))  # of the other, where no clock is late
    is_another = ~is_shown | ((opened is not None) & (np.abs(free - own) > SHOWN * by_chance))
    if bool((was_shown & is_another & (free_std > WORSE * own_std)).any()):
        return joint
    return None if opened is not None and bool((was_shown & (free_std > AS_ONE * own_std)).any()) else fit


def _arm_of(fit: Fit, block: Index) -> tuple[Array, Array]:
    """The parameters (p,) of the lever arm and their σ (p,), as blocks scatter."""
    at = [*_places(fit, ARM).values()]
    return fit.hypothesis.vector()[at], np.sqrt(np.diag(fit.covariance(block))[at])


def opened_arm(guesses: Sequence[FirstGuess]) -> OpenArm | None:
    """As the recording has it that leaves it least open; None where one leaves next to nothing open."""
    found = [each.registration for each in guesses if each.registration is not None]
    least = min(found, key=lambda each: float(np.trace(each.left_open[3:6, 3:6])), default=None)
    if least is None or np.trace(least.left_open[3:6, 3:6]) < OPEN_M**2:
        return None
    late = float(np.sqrt(np.trace(least.left_open) / (least.open_by @ least.open_by)))
    return OpenArm(dict(zip(ARM_PARAMETERS, least.open_by[3:6].tolist(), strict=True)), late)


def moved_arm(fit: Fit, rivals: Sequence[Hypothesis]) -> dict[str, float]:
    """By parameter of the lever arm, by how much (m) it is another by what explains the data as well; the farthest.

    rivals: with another clock.
    """
    if ARM not in fit.values:
        return {}
    own, others = fit.values[ARM][0], [each.values[ARM][0] for each in rivals if ARM in each.values]
    moved = [{name: other.get(name, 0.0) - value for name, value in own.items()} for other in others]
    return max(moved, key=lambda each: sum(by**2 for by in each.values()), default={})


def moved_lag(fit: Fit, joint: Fit) -> dict[str, float]:
    """By how much (s) a lag is another in a fit than in the same with more clocks, which are late in its place, where
    it explains the data as well without these."""
    if not {LAG} <= fit.values.keys() & joint.values.keys():
        return {}
    if fit.deviance > joint.deviance + SETTINGS.indistinguishable:
        return {}
    return {name: value - joint.values[LAG][0][name] for name, value in fit.values[LAG][0].items()}


def with_moved(fit: Fit, covariance: Array, moved: Mapping[str, float]) -> Array:
    """A covariance (6 + p, 6 + p) in which lever arm or lag may be another, as `moved_arm` and `moved_lag` have it."""
    step = np.zeros(len(covariance))
    for name, i in (_places(fit, ARM) | _places(fit, LAG)).items():
        step[i] = moved.get(name, 0.0)
    return np.asarray(covariance + np.outer(step, step))


def with_open(fit: Fit, covariance: Array, opened: OpenArm | None) -> Array:
    """A covariance (6 + p, 6 + p) in which lever arm and the reference's clock are known no better than registration
    knows them, which does not take turns between samples for what a fit makes of them."""
    if opened is None:
        return covariance
    clock = [6 + i for i, each in enumerate(fit.hypothesis.parameters()) if each.effect.name == REFERENCE_CLOCK]
    step = np.zeros(len(covariance))
    step[clock] = 1.0
    for name, i in _places(fit, ARM).items():
        step[i] = opened.by[name]
    known = max(np.diag(covariance)[clock].tolist(), default=0.0)
    return np.asarray(covariance + max(opened.late**2 - known, 0.0) * np.outer(step, step))


def opened_combination(fit: Fit, covariance: Array, opened: OpenArm | None) -> Combination | None:
    """What is known of the lever arm and the reference's clock by a fit of one recording that has no such clock."""
    at = _places(fit, ARM)
    if opened is None or not at or len(fit.seen) > 1:
        return None
    name = max(at, key=lambda each: abs(opened.by[each]))
    value, std = float(fit.hypothesis.vector()[at[name]]), float(np.sqrt(covariance[at[name], at[name]]))
    return Combination(name, REFERENCE_CLOCK, opened.by[name], around(value, std))


def combination(fit: Fit, covariance: Array, clock: str) -> Combination | None:
    """What is known of arm and clock of one recording, by a fit that has both and its covariance (6 + p, 6 + p)."""
    arm, delay = _places(fit, ARM), _places(fit, clock).get("seconds")
    if delay is None or not arm or len(fit.seen) > 1:
        return None
    vector = fit.hypothesis.vector()
    speeds = {name: float(covariance[i, delay] / covariance[delay, delay]) for name, i in arm.items()}
    name = max(speeds, key=lambda each: abs(speeds[each]))
    at, speed = arm[name], speeds[name]
    value = float(vector[at] - speed * vector[delay])
    std = float(np.sqrt(max(covariance[at, at] - speed**2 * covariance[delay, delay], 0.0)))
    return Combination(name, clock, speed, around(value, std))


def _places(fit: Fit, effect: str) -> dict[str, int]:
    """Where the parameters of an effect stand in a fit's vector, by name; of a recording each, the last one's."""
    parameters = enumerate(fit.hypothesis.parameters(), start=6)
    return {each.spec.name: i for i, each in parameters if each.effect.name == effect}
