"""Which effects the data calls for: forward selection with backward check, and what could stand in for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..calibration.frames import Array
from ..effects.base import ActsOn, Effect
from .dictionary import WINDOW_STEPS, Candidate, Dictionary, Seen, is_time_of_run, log_p_value
from .fitting import Fit, Fitter
from .levels import estimated
from .noise import Noise
from .problem import Problem

# Family-wise level of the claim that there is any effect at all
LEVEL = 0.008
MAX_EFFECTS = 3
# Share of what is explained already that a further effect must add: the ghosts of a strong effect whose trace is not
# exact to the last per cent add less
GHOST_SHARE = 0.05
# Effects whose evidence (log p) is within this of the best could be the cause as well: with truth j and a rival that it
# takes for better by d = 2 · this, the odds are at most those of a normal variable beyond √d.
INDISTINGUISHABLE = 3.0
# Deviance behind the best at which no noise of its own will bring a rival back
OUT_OF_THE_QUESTION = 40.0
# Share of an effect's drop in deviance that its rivals may look worse by for being linear
LINEAR_SHARE = 0.05
# Effects that are tested in earnest in one step, of each of two looks
MAX_TESTED = 3
MAX_SWAPS = 2
# Times that the noise is estimated anew from what a fit leaves
ROUNDS = 2
# A time of the run is told to this share of it
FINEST = 500.0
# log p beyond which a hypothesis is worth an estimate of its own noise
WORTH_A_LOOK = -3.0


@dataclass(frozen=True)
class Selected:
    """An effect that the data calls for. log_p: with all others in; equivalent: names that could stand in for it."""

    effect: Effect
    log_p: float
    equivalent: tuple[str, ...]


@dataclass(frozen=True)
class Selection:
    """Outcome of a selection: the effects, strongest first, the fits without and with them, the fitter, and all effects
    through the noise that is left.
    """

    selected: tuple[Selected, ...]
    base: Fit
    fit: Fit
    fitter: Fitter
    seen: Seen

    def withdrawn(self) -> Selection:
        """Without any effect."""
        return replace(self, selected=(), fit=self.base)


def first_noise(problem: Problem) -> tuple[Noise, Array]:
    """Noise of a problem's residual in the frame where it is simplest, and the residual without its outliers."""
    rotations = {id(rotation): rotation for rotation in (problem.rotation_enu_from_body, None)}.values()
    found = [estimated(problem, problem.residual, rotation) for rotation in rotations]
    return min(found, key=lambda each: each[0].deviance(each[1]))


def select(problem: Problem, effects: Mapping[str, Effect]) -> Selection:
    """Forward selection among testable effects, each step with a check of what is in already: whether it is called for
    any more, and whether another effect explains more in its place.
    """
    noise, robust = first_noise(problem)
    fitter = Fitter(problem, robust)
    start = fit = fitter.fit_with_noise([], noise, {})
    dictionary = Dictionary(problem, effects)
    threshold = log_threshold(dictionary)
    while len(fit.effects) < MAX_EFFECTS:
        tested = _best_added(fitter, fit, dictionary)
        if tested is None or tested.log_p > threshold or tested.drop < GHOST_SHARE * (start.deviance - fit.deviance):
            break
        before = fit.effects
        fitter, fit = about(fitter.problem, _called_for(fitter, tested.fit, threshold, tested.fit.effects[:-1]))
        dictionary = dictionary_about(fitter, fit, effects)
        for _ in range(MAX_SWAPS):
            swapped = _swapped(fitter, fit, dictionary)
            if swapped is None:
                break
            fitter, fit = about(fitter.problem, swapped)
            dictionary = dictionary_about(fitter, fit, effects)
        if set(fit.effects) == set(before):
            break
    while (kept := _called_for(fitter, fit, threshold, fit.effects)).effects != fit.effects:
        # with the noise that is left in the end, and about the end's calibration
        fitter, fit = about(fitter.problem, kept)
        dictionary = dictionary_about(fitter, fit, effects)
    seen = dictionary.seen(fit.noise, fitter.residual)
    selected = [_selected(fitter, fit, number, seen) for number in range(len(fit.effects))]
    base = fitter.fit([], fit.noise, {})
    return Selection(tuple(sorted(selected, key=lambda each: each.log_p)), base, fit, fitter, seen)


def log_threshold(dictionary: Dictionary) -> float:
    """log p below which an effect is called for, having looked at all of the dictionary."""
    return float(np.log(LEVEL / len(dictionary.effects)))


def selected_again(seen: Seen) -> list[int]:
    """Variants that forward selection takes from a dictionary, with the noise as it is and traces as they are there."""
    chosen: list[int] = []
    explained = 0.0
    while len(chosen) < MAX_EFFECTS:
        candidates = seen.candidates(chosen).values()
        best = min(candidates, key=lambda candidate: candidate.log_p, default=None)
        if best is None or best.log_p > log_threshold(seen.dictionary) or best.drop < GHOST_SHARE * explained:
            break
        chosen.append(best.index)
        explained += best.drop
    return chosen


def dictionary_about(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> Dictionary:
    """Variants of all effects, those in a fit about its values first."""
    present = [fitter.variant(effect, fit.values[effect.name]) for effect in fit.effects]
    return Dictionary(fitter.problem, effects, present)


@dataclass(frozen=True)
class Tested:
    """An effect tested on top of a fit: log p, the drop in deviance, and the fit with it."""

    log_p: float
    drop: float
    fit: Fit


def _best_added(fitter: Fitter, fit: Fit, dictionary: Dictionary) -> Tested | None:
    """The most significant effect on top of a fit, of those that look like it; None if none does.

    They are looked for with the noise that the fit leaves, with that which all effects together leave, and as if it
    had no colour: the noise may have taken an effect's colour, which then looks small.
    """
    chosen = list(range(dictionary.n_present))
    own = dictionary.seen(fit.noise, fitter.residual)
    others = [fit.noise.like(own.beyond()), *([fit.noise.white] if fit.noise.is_coloured else [])]
    looks = [(fit.noise, own), *((noise, dictionary.seen(noise, fitter.residual)) for noise in others)]
    worth: dict[str, tuple[float, Candidate, Noise]] = {}
    for noise, seen in looks:
        for candidate in sorted(seen.candidates(chosen).values(), key=lambda c: c.log_p)[:MAX_TESTED]:
            name = candidate.effect.name
            if candidate.log_p < WORTH_A_LOOK and (name not in worth or candidate.log_p < worth[name][0]):
                worth[name] = candidate.log_p, candidate, noise
    tested = [_added(fitter, fit, candidate, noise) for _, candidate, noise in worth.values()]
    return min(tested, key=lambda each: each.log_p, default=None)


def _added(fitter: Fitter, fit: Fit, candidate: Candidate, noise: Noise) -> Tested:
    """Test an effect on top of a fit, each with the noise of its own."""
    effects = [*fit.effects, candidate.effect]
    best = fitter.fit(effects, noise, {**fit.values, candidate.effect.name: candidate.values})
    best = fitter.fit_with_noise(effects, fit.noise.like(best.residual), best.values, rounds=1)
    # a better optimum of the noise must not count for the effect
    without = fitter.fit_with_noise(fit.effects, best.noise, fit.values, rounds=1)
    drop = min(fit.deviance, without.deviance) - best.deviance
    drop -= own_doing(fitter, best, candidate.effect)
    return Tested(log_p_value(drop, best.dof - fit.dof, candidate.tried), drop, best)


def own_doing(fitter: Fitter, fit: Fit, effect: Effect) -> float:
    """Drop in deviance that an effect owes to noise which is in the residual and, through the motion, in its trace.

    Samples do not tell their own velocity, but whitening mixes neighbours. Found with noise that is made up. A delay
    owes it nothing (`problem`).
    """
    if effect.delay(fit.values[effect.name]):
        return 0.0
    problem, values, noise = fitter.problem, fit.values[effect.name], fit.noise
    still = problem.trace(effect, values)
    drops = []
    for in_residual, shaken in problem.shaken:
        moved = noise.whiten(shaken.trace(effect, values) - still)
        drops.append(2.0 * float(noise.whiten(in_residual) @ moved) - float(moved @ moved))
    return max(0.0, float(np.mean(drops)))


def _without(fitter: Fitter, fit: Fit, effect: Effect) -> Fit:
    rest = [other for other in fit.effects if other is not effect]
    return fitter.fit_with_noise(rest, fit.noise, fit.values)


def _called_for(fitter: Fitter, fit: Fit, threshold: float, of: Sequence[Effect]) -> Fit:
    """A fit without those of some effects that are not called for (any more), given all others."""
    for effect in of:
        rest = _without(fitter, fit, effect)
        if log_p_value(rest.deviance - fit.deviance, fit.dof - rest.dof) > threshold:
            fit = rest
    return fit


def _swapped(fitter: Fitter, fit: Fit, dictionary: Dictionary) -> Fit | None:
    """A fit with one effect replaced by another that is clearly more significant in its place; None without one."""
    seen = dictionary.seen(fit.noise, fitter.residual)
    chosen = list(range(dictionary.n_present))
    best, best_gain = None, INDISTINGUISHABLE
    for number, effect in enumerate(fit.effects):
        candidates = seen.candidates(chosen, instead_of=number)
        own = candidates.pop(effect.name).log_p
        other = min(candidates.values(), key=lambda candidate: candidate.log_p, default=None)
        if other is not None and own - other.log_p > best_gain:
            best, best_gain = (effect, other), own - other.log_p
    if best is None:
        return None
    out, into = best
    effects = [into.effect if effect is out else effect for effect in fit.effects]
    swapped = fitter.fit_with_noise(effects, fit.noise, {**fit.values, into.effect.name: into.values})
    return swapped if fit.deviance - swapped.deviance > 2.0 * (swapped.dof - fit.dof) else None


def _selected(fitter: Fitter, fit: Fit, number: int, seen: Seen) -> Selected:
    """Test an effect given all others, and every other effect in its place.

    One with more parameters that fits as well could be the cause, however much less likely its numbers make it; one
    that fits worse could be if it needs fewer.
    """
    effect = fit.effects[number]
    rest = _without(fitter, fit, effect)
    drop = rest.deviance - fit.deviance
    # with the noise that is left when the cause is known: it is the same for all that could be the cause
    candidates = seen.candidates(list(range(len(fit.effects))), number)
    own = candidates.pop(effect.name)
    log_p = log_p_value(drop, fit.dof - rest.dof, own.tried)
    found: list[tuple[float, str]] = []
    for name, candidate in candidates.items():
        if own.drop - candidate.drop > OUT_OF_THE_QUESTION + LINEAR_SHARE * own.drop:
            continue
        effects = [*rest.effects, candidate.effect]
        rival = fitter.fit_with_noise(effects, fit.noise, {**fit.values, name: candidate.values}, rounds=1)
        behind = rival.deviance - fit.deviance
        rival_log_p = log_p_value(drop - behind, rival.dof - rest.dof, candidate.tried)
        if rival_log_p - log_p < INDISTINGUISHABLE or behind < 2.0 * INDISTINGUISHABLE:
            found.append((rival_log_p, name))
    return Selected(effect, log_p, tuple(name for _, name in sorted(found)))


def about(problem: Problem, fit: Fit) -> tuple[Fitter, Fit]:
    """A fit once more, with the problem about its own calibration and motion, and the noise that is left then.

    What was drawn in as an outlier before may have been the effect.
    """
    problem = relinearised(problem, fit)
    fitter = Fitter(problem, problem.residual)
    fit = fitter.fit(fit.effects, fit.noise, fit.values)
    for _ in range(ROUNDS):
        fit = refined(fitter, fit)
        explained = fitter.residual - fit.residual
        noise, left = estimated(problem, problem.residual - explained, fit.noise.rotation)
        fitter = fitter.with_residual(explained + left)
        fit = fitter.fit_with_noise(fit.effects, noise, fit.values, rounds=1)
    return fitter, fit


def refined(fitter: Fitter, fit: Fit) -> Fit:
    """A fit with the times at which its effects begin and end made finer than the grid they were found on."""
    seconds = max(recording.seconds for recording in fitter.problem.recordings)
    moving = [
        (effect.name, spec.name)
        for effect in fit.effects
        for spec in effect.parameters
        if is_time_of_run(spec) and np.isfinite(fit.values[effect.name][spec.name])
    ]
    step = seconds / WINDOW_STEPS
    while moving and step > seconds / FINEST:
        step /= 2.0
        for name, time in moving:
            for sign in (-1.0, 1.0):
                at = float(np.clip(fit.values[name][time] + sign * step, 0.0, seconds))
                trial = fitter.fit(fit.effects, fit.noise, {**fit.values, name: {**fit.values[name], time: at}})
                if trial.deviance < fit.deviance:
                    fit = trial
    return fit


def relinearised(problem: Problem, fit: Fit) -> Problem:
    """The problem about the calibration of a fit, its motion without what the fit's effects add to the DVL."""
    added = {
        effect.name: tuple(problem.traces(effect, fit.values[effect.name]))
        for effect in fit.effects
        if effect.acts_on is not ActsOn.REFERENCE
    }
    return replace(problem, calibration=problem.calibration.changed(fit.change), added=added)
