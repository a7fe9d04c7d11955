"""Which effects the data calls for: forward selection with backward check, and what could stand in for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..calibration.frames import Array
from ..effects.base import ActsOn, Effect
from .fitting import WINDOW_STEPS, Fit, Fitter, is_time_of_run, log_p_value, smooth_parameters
from .levels import with_levels
from .noise import Noise, white_noise
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
# Starts of an effect with several from which a fit goes on
BEST_STARTS = 2
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
    """Outcome of a selection: the effects, strongest first, the fits without and with them, and the fitter."""

    selected: tuple[Selected, ...]
    base: Fit
    fit: Fit
    fitter: Fitter

    def withdrawn(self) -> Selection:
        """Without any effect."""
        return Selection((), self.base, self.base, self.fitter)


def first_noise(problem: Problem) -> tuple[Noise, Array]:
    """Noise of a problem's residual in the frame where it is simplest, and the residual robustified with it."""
    best: tuple[float, Noise] | None = None
    for rotation in {id(r): r for r in (problem.rotation_enu_from_body, None)}.values():
        noise = white_noise(problem.residual, problem.segments, rotation, problem.interval).refitted(problem.residual)
        robust = noise.robust(problem.residual)
        noise = noise.refitted(robust)
        deviance = noise.deviance(robust)
        if best is None or deviance < best[0]:
            best = deviance, noise
    assert best is not None
    noise = with_levels(problem, best[1])
    robust = noise.robust(problem.residual)
    return noise.refitted(robust), robust


def select(problem: Problem, effects: Mapping[str, Effect]) -> Selection:
    """Forward selection among testable effects; each step keeps what the data calls for at the family-wise level."""
    noise, robust = first_noise(problem)
    fitter = Fitter(problem, robust)
    start = fit = fitter.fit_with_noise([], noise, {})
    threshold = float(np.log(LEVEL / len(effects)))
    chosen: list[Effect] = []
    while len(chosen) < MAX_EFFECTS:
        tested = {name: added(fitter, fit, effect) for name, effect in effects.items() if effect not in chosen}
        name = min(tested, key=lambda name: tested[name].log_p)
        if tested[name].log_p > threshold or tested[name].drop < GHOST_SHARE * (start.deviance - fit.deviance):
            break
        chosen, fit = _backward(fitter, [*chosen, effects[name]], tested[name].fit, threshold)
        fitter, fit = about(problem, fit)
        problem = fitter.problem
        if effects[name] not in chosen:
            break
    selected = [_selected(fitter, fit, effect, effects) for effect in chosen]
    base = fitter.fit_with_noise([], fit.noise, {}) if chosen else fit
    return Selection(tuple(sorted(selected, key=lambda each: each.log_p)), base, fit, fitter)


@dataclass(frozen=True)
class Tested:
    """An effect tested on top of a fit: log p, the drop in deviance, and the fit with it."""

    log_p: float
    drop: float
    fit: Fit


def added(fitter: Fitter, fit: Fit, effect: Effect) -> Tested:
    """Test an effect on top of a fit."""
    effects = [*fit.effects, effect]
    best, tried = _best_start(fitter, fit, effects, fit.noise, fit.deviance)
    if fit.noise.is_coloured:
        # the noise may have taken the effect's colour, and the effect left to it then looks small
        white = fit.noise.white
        other, other_tried = _best_start(fitter, fit, effects, white, white.deviance(fit.residual))
        if log_p_value(white.deviance(fit.residual) - other.deviance, other.dof - fit.dof, other_tried) < WORTH_A_LOOK:
            other = fitter.fit_with_noise(effects, fit.noise.like(other.residual), other.values, rounds=1)
            if other.deviance < best.deviance:
                best, tried = other, other_tried
    drop = fit.deviance - best.deviance
    log_p = log_p_value(drop, best.dof - fit.dof, tried)
    if log_p < WORTH_A_LOOK:
        best = fitter.fit_with_noise(effects, best.noise, best.values)
        # a better optimum of the noise must not count for the effect
        without = fitter.fit_with_noise(fit.effects, best.noise, fit.values, rounds=1)
        drop = min(fit.deviance, without.deviance) - best.deviance - own_doing(fitter, best, effect)
        log_p = log_p_value(drop, best.dof - fit.dof, tried)
    return Tested(log_p, drop, best)


def own_doing(fitter: Fitter, fit: Fit, effect: Effect) -> float:
    """Drop in deviance that an effect owes to noise which is in the residual and, through the motion, in its trace.

    Samples do not tell their own velocity, but whitening mixes neighbours. Found with noise that is made up.
    """
    problem, values, noise = fitter.problem, fit.values[effect.name], fit.noise
    still = problem.trace(effect, values)
    drops = []
    for in_residual, shaken in problem.shaken:
        moved = noise.whiten(shaken.trace(effect, values) - still)
        drops.append(2.0 * float(noise.whiten(in_residual) @ moved) - float(moved @ moved))
    return max(0.0, float(np.mean(drops)))


def _best_start(fitter: Fitter, fit: Fit, effects: list[Effect], noise: Noise, deviance: float) -> tuple[Fit, float]:
    """The most significant fit from the starts of the last of the effects, and how many starts were like it."""
    effect = effects[-1]
    starts = fitter.starts(effect)
    if smooth_parameters(effect) and len(starts) > BEST_STARTS:
        starts.sort(key=lambda start: fitter.misfit(effects, noise, {**fit.values, effect.name: start[0]}))
        starts = starts[:BEST_STARTS]
    trials = [(fitter.fit(effects, noise, {**fit.values, effect.name: start}), tried) for start, tried in starts]
    return min(trials, key=lambda trial: log_p_value(deviance - trial[0].deviance, trial[0].dof - fit.dof, trial[1]))


def _without(fitter: Fitter, fit: Fit, effect: Effect) -> Fit:
    rest = [other for other in fit.effects if other is not effect]
    return fitter.fit_with_noise(rest, fit.noise, fit.values)


def _backward(fitter: Fitter, chosen: list[Effect], fit: Fit, threshold: float) -> tuple[list[Effect], Fit]:
    """Drop what is not called for any more now that others are in."""
    for effect in chosen[:-1]:
        rest = _without(fitter, fit, effect)
        if log_p_value(rest.deviance - fit.deviance, fit.dof - rest.dof) > threshold:
            chosen = [other for other in chosen if other is not effect]
            fit = rest
    return chosen, fit


def _selected(fitter: Fitter, fit: Fit, effect: Effect, effects: Mapping[str, Effect]) -> Selected:
    """Test an effect given all others, and every other effect in its place.

    One with more parameters that fits as well could be the cause, however much less likely its numbers make it; one
    that fits worse could be if it needs fewer.
    """
    rest = _without(fitter, fit, effect)
    drop = rest.deviance - fit.deviance
    log_p = log_p_value(drop, fit.dof - rest.dof, fitter.tried(effect, fit.values[effect.name]))
    found: list[tuple[float, str]] = []
    for name, other in effects.items():
        if other in fit.effects:
            continue
        # with the noise that is left when the cause is known: it is the same for all that could be the cause
        effects_then = [*rest.effects, other]
        rival, tried = _best_start(fitter, rest, effects_then, fit.noise, fit.noise.deviance(rest.residual))
        if rival.deviance - fit.deviance > OUT_OF_THE_QUESTION:
            continue
        rival = fitter.fit_with_noise(effects_then, fit.noise, rival.values, rounds=1)
        behind = rival.deviance - fit.deviance
        rival_log_p = log_p_value(drop - behind, rival.dof - rest.dof, tried)
        if rival_log_p - log_p < INDISTINGUISHABLE or behind < 2.0 * INDISTINGUISHABLE:
            found.append((rival_log_p, name))
    return Selected(effect, log_p, tuple(name for _, name in sorted(found)))


def _robust_about(fitter: Fitter, fit: Fit, problem: Problem) -> Array:
    """The problem's residual robustified about a fit."""
    explained = fitter.residual - fit.residual
    return explained + fit.noise.robust(problem.residual - explained)


def about(problem: Problem, fit: Fit) -> tuple[Fitter, Fit]:
    """A fit once more, with the problem about its own calibration and motion."""
    problem = relinearised(problem, fit)
    fitter = Fitter(problem, problem.residual)
    again = fitter.fit(fit.effects, fit.noise, fit.values)
    fitter = Fitter(problem, _robust_about(fitter, again, problem))
    return fitter, fitter.fit_with_noise(fit.effects, fit.noise, again.values)


def refined(fitter: Fitter, fit: Fit, effect: Effect) -> Fit:
    """A fit with the times at which an effect begins and ends made finer than the grid they were found on."""
    times = [spec for spec in effect.parameters if is_time_of_run(spec)]
    if all(fit.values[effect.name][spec.name] == spec.default for spec in times):
        return fit
    seconds = max(recording.seconds for recording in fitter.problem.recordings)
    step = seconds / WINDOW_STEPS
    while step > seconds / 500.0:
        step /= 2.0
        for spec in times:
            for sign in (-1.0, 1.0):
                values = dict(fit.values[effect.name])
                values[spec.name] = float(np.clip(values[spec.name] + sign * step, 0.0, seconds))
                trial = fitter.fit(fit.effects, fit.noise, {**fit.values, effect.name: values})
                if trial.deviance < fit.deviance:
                    fit = trial
    return fit


def relinearised(problem: Problem, fit: Fit) -> Problem:
    """The problem about the calibration of a fit, its motion without what the fit's effects add to the DVL."""
    added = None
    if fit.effects:
        traces = [problem.traces(effect, fit.values[effect.name]) for effect in fit.effects if not on_reference(effect)]
        if traces:
            added = tuple(np.sum(parts, axis=0) for parts in zip(*traces, strict=True))
    return replace(problem, calibration=problem.calibration.changed(fit.change), added=added)


def on_reference(effect: Effect) -> bool:
    """Whether an effect leaves the DVL's velocity as it is."""
    return effect.acts_on is ActsOn.REFERENCE
