"""A scenario with a diagnosed DVL."""

from __future__ import annotations

import math
from dataclasses import replace

from ..effects.base import AnyEffect, Injection
from ..effects.registry import EFFECTS, NOISE_EFFECTS
from ..errors import InputError
from ..simulator_export.dvl_description import NOT_EXPLAINED, DvlDescription, Other
from .scenario import Scenario
from .sensors import JANUS_FROM_VERTICAL, DvlErrors

# findings that are not simulated as effects: included in noise_std, or of unknown size
_NOT_TAKEN = ("noise_inflation", "coloured_reference_noise", "reported_covariance", NOT_EXPLAINED)


def with_dvl(scenario: Scenario, description: DvlDescription) -> tuple[Scenario, tuple[str, ...]]:
    """Return the scenario with the diagnosed mounting, scale, noise, rate and effects, and the names omitted.

    The scenario's own effects are applied in addition. Raises InputError for values outside an effect's bounds.
    """
    std = scenario.errors.beam_std
    if description.noise_std is not None:
        across = math.hypot(description.noise_std[0], description.noise_std[1])
        std = math.sin(JANUS_FROM_VERTICAL) * across
    found = {
        "lever_arm": dict(zip(("x_m", "y_m", "z_m"), description.lever_arm, strict=True)),
        "velocity_bias": dict(zip(("x_mps", "y_mps", "z_mps"), description.velocity_bias, strict=True)),
        **{other.name: dict(other.parameters) for other in description.others if _is_taken(other)},
    }
    effects = tuple(_injection(description, name, values) for name, values in found.items() if any(values.values()))
    taken = replace(
        scenario,
        errors=DvlErrors(scale=description.scale, beam_std=std),
        mounting_rpy=description.mounting_rpy,
        dvl_rate=description.rate_hz or scenario.dvl_rate,
        effects=(*effects, *scenario.effects),
    )
    return taken, tuple(other.name for other in description.others if not _is_taken(other))


def _is_taken(other: Other) -> bool:
    return other.name not in _NOT_TAKEN and not other.of_another_day


def _injection(description: DvlDescription, name: str, values: dict[str, float]) -> Injection:
    """Return a diagnosed effect as an injection. Raises InputError for an unknown effect or value."""
    known: dict[str, AnyEffect] = {**EFFECTS, **NOISE_EFFECTS}
    effect = known.get(name)
    if effect is None:
        raise InputError(f"{description.source}: effect {name!r} is not known here; install the package that brings it")
    bounds = {parameter.name: (parameter.low, parameter.high) for parameter in effect.parameters}
    for parameter, value in values.items():
        low, high = bounds.get(parameter, (math.inf, -math.inf))
        if not low <= value <= high:
            raise InputError(f"{description.source}: {name}: {parameter} {value:g} cannot be simulated; diagnose again")
    return Injection(effect, {**effect.defaults, **values})
