"""Effects with parameters for the simulator, and their application to motions and samples."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..calibration.numerics.frames import Array
from ..effects.base import ActsOn, AnyEffect, EffectInput, Injection, NoiseEffect
from ..effects.registry import EFFECTS, NOISE_EFFECTS
from ..errors import InputError

FORM = "NAME:PARAMETER=VALUE,PARAMETER=VALUE"


def injection(text: str) -> Injection:
    """Parse ``lever_arm:x_m=0.3,z_m=-0.1``; missing parameters keep their defaults. Raises InputError."""
    name, _, values = text.strip().partition(":")
    effect = _effect(name.strip())
    given: dict[str, str] = {}
    for assignment in filter(str.strip, values.split(",")):
        parameter, equals, number = (part.strip() for part in assignment.partition("="))
        if not equals:
            raise InputError(f"effect {name}: {assignment.strip()!r} is no PARAMETER=VALUE; it has {_listed(effect)}")
        if parameter in given:
            raise InputError(f"effect {name}: {parameter} is given twice; give it once")
        given[parameter] = number
    return injection_of(effect.name, given)


def injection_of(name: str, given: Mapping[str, float | str]) -> Injection:
    """Return an effect with the given parameters, in its units; others keep their defaults. Raises InputError."""
    effect = _effect(name)
    if not given:
        raise InputError(f"effect {effect.name} without parameters does nothing; give some of {_listed(effect)}")
    checked = {parameter: _checked(effect, parameter, value) for parameter, value in given.items()}
    return Injection(effect, {**effect.defaults, **checked})


def _effect(name: str) -> AnyEffect:
    """Return the effect of a name. Raises InputError."""
    known: dict[str, AnyEffect] = {**EFFECTS, **NOISE_EFFECTS}
    if name not in known:
        raise InputError(
            f"effect {name!r}: no such effect{_meant(name, list(known))}; give {FORM}, with one of {', '.join(known)}"
        )
    return known[name]


def _checked(effect: AnyEffect, name: str, number: float | str) -> float:
    """Return a parameter's value as number within its limits. Raises InputError."""
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    if name not in parameters:
        meant = _meant(name, list(parameters))
        raise InputError(f"effect {effect.name}: no parameter {name!r}{meant}; it has {_listed(effect)}")
    parameter = parameters[name]
    try:
        value = float(number)
    except (TypeError, ValueError):
        raise InputError(
            f"effect {effect.name}: {name}: {number!r} is no number; give it in {parameter.unit}, without the unit"
        ) from None
    if not parameter.low <= value <= parameter.high:
        raise InputError(
            f"effect {effect.name}: {name}: {value:g} is outside {parameter.low:g} .. {parameter.high:g} "
            f"{parameter.unit}"
        )
    return value


def _listed(effect: AnyEffect) -> str:
    return ", ".join(f"{parameter.name} ({parameter.unit})" for parameter in effect.parameters)


def _meant(name: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    return f", did you mean {close[0]!r}?" if close else ""


def disturbed(
    velocity: Array,
    injections: Sequence[tuple[Injection, np.random.SeedSequence]],
    motion: EffectInput,
    acts_on: ActsOn,
) -> Array:
    """Apply the effects on a sensor's noise, in order, to samples (N, 3) m/s at `motion.time`."""
    for injection, seed in injections:
        if isinstance(injection.effect, NoiseEffect) and injection.effect.acts_on is acts_on:
            velocity = injection.effect.disturb(velocity, motion, injection.values, np.random.default_rng(seed))
    return velocity


def injection_document(injection: Injection) -> dict[str, object]:
    """Return plain data as in the diagnosis' JSON; null means no limit."""
    values = {name: value if math.isfinite(value) else None for name, value in injection.values.items()}
    return {"name": injection.effect.name, "parameters": values}
