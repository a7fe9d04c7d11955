"""Observable parameters of effects for a horizontal reference, by their columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...calibration.numerics.frames import Array
from ...effects.base import Effect
from ..fit.gauss_newton import Z_INTERVAL, Fit
from ..model.forward_model import Problem
from ..model.hypothesis import Values, amplitudes, is_time_of_run, no_effect
from ..model.seen import Seen
from .arm_clock_ambiguity import ARM

# A parameter of typical size is excluded if its column is below this share of its effect's largest, or of a usual bias
# (m/s): model errors are as large. A boat that rolls at 0.2°/s does not make the DVL's height observable, an AUV at
# 1°/s does. A level vehicle makes neither the upward bias nor roll and pitch of the mounting observable.
MIN_SHARE, USUAL_BIAS_MPS = 0.2, 0.02
# A part of the lever arm is kept if this length (m) is observable: metres left out would rotate the rest. An AUV that
# rolls at 0.5°/s is such a case.
ARM_FROM_M = 0.6


def observable_parts(effects: Mapping[str, Effect], problem: Problem) -> dict[str, Effect]:
    """Return effects reduced to their observable parameters: all, unless the reference is horizontal only."""
    if problem.measured[2]:
        return dict(effects)
    seen = problem.all_seen(no_effect())
    return {name: _observable_part(each, problem, seen) for name, each in effects.items()}


def unobservable_parts(effects: Mapping[str, Effect], shown: Mapping[str, Effect]) -> tuple[Effect, ...]:
    """Return the unobservable parts of effects, which accompany the observable ones."""
    left_out = (effect.without({spec.name for spec in shown[name].parameters}) for name, effect in effects.items())
    return tuple(effect for effect in left_out if effect.parameters)


def _observable_part(effect: Effect, problem: Problem, seen: Sequence[Seen]) -> Effect:
    """Return an effect without parameters that have little influence on the residual."""
    specs = amplitudes(effect)
    columns = problem.columns(no_effect(), seen, effect, default_values(effect, problem))
    squares = (columns**2).sum(axis=1).mean(axis=0).reshape(-1, len(specs))
    by_unit = np.sqrt(squares.max(axis=0))  # of recordings the most informative
    sizes = by_unit * [spec.typical for spec in specs]
    threshold = MIN_SHARE * min(float(sizes.max()), USUAL_BIAS_MPS)
    out = {spec.name for spec, size in zip(specs, sizes.tolist(), strict=True) if size < threshold}
    if effect.name == ARM:
        by_metre = zip(specs, by_unit.tolist(), strict=True)
        out &= {spec.name for spec, size in by_metre if ARM_FROM_M * size < MIN_SHARE * USUAL_BIAS_MPS}
    return effect.without(out)


def without_insignificant(problem: Problem, fit: Fit) -> Effect | None:
    """Return the lever arm effect without components below 2 σ of the model error, None if all are significant."""
    known = _model_error(problem, fit)
    faint = {name for name, std in known.items() if abs(fit.values[ARM][0][name]) < Z_INTERVAL * std}
    (arm,) = (effect for effect in fit.effects if effect.name == ARM) if faint else (None,)
    return arm and arm.without(faint)


def with_observable(problem: Problem, fit: Fit, covariance: Array) -> Array:
    """Add the model error of the lever arm to a fit's covariance (6 + p, 6 + p)."""
    found, known = covariance.copy(), _model_error(problem, fit)
    for number, each in enumerate(fit.hypothesis.parameters(), start=6):
        if each.effect.name == ARM:
            found[number, number] += known.get(each.spec.name, 0.0) ** 2
    return found


def _model_error(problem: Problem, fit: Fit) -> dict[str, float]:
    """Return the model error, m, of lever arm parameters whose typical size is unobservable."""
    if problem.measured[2] or ARM not in fit.values:
        return {}
    sizes = np.sqrt((fit.columns[:, :, 6:] ** 2).sum(axis=1).mean(axis=0)).tolist()
    own = [
        (each.spec, size)
        for each, size in zip(fit.hypothesis.parameters(), sizes, strict=True)
        if each.effect.name == ARM
    ]
    threshold = MIN_SHARE * min(max(size * spec.typical for spec, size in own), USUAL_BIAS_MPS)
    return {spec.name: MIN_SHARE * USUAL_BIAS_MPS / size for spec, size in own if size * spec.typical < threshold}


def default_values(effect: Effect, problem: Problem) -> list[Values]:
    """Return default values, with events at the middle of the run if no time is given."""
    values: list[Values] = []
    for recording in problem.recordings:
        times = {
            spec.name: 0.5 * recording.seconds
            for spec in effect.parameters
            if is_time_of_run(spec) and not any(is_time_of_run(o) for o in effect.parameters if o is not spec)
        }
        values.append(effect.defaults | times)
    return values
