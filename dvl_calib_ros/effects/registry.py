"""All effects by name, from this package and others, and their table in the documentation.

[project.entry-points."dvl_calib_ros.effects"]
cable_drag = "my_vehicle.effects:CableDrag"
"""

from __future__ import annotations

from collections import UserDict
from collections.abc import Iterable
from functools import cached_property, lru_cache
from importlib.metadata import EntryPoint, entry_points
from itertools import chain, groupby
from typing import TypeVar

from ..errors import InputError
from . import environment, noise, sensor, timing
from .base import ActsOn, AnyEffect, ClockEffect, Effect, MountingEffect, NoiseEffect

ENTRY_POINTS = "dvl_calib_ros.effects"

OWN: tuple[type[AnyEffect], ...] = (
    sensor.LeverArm,
    timing.DvlTimeOffset,
    timing.ReferenceTimeOffset,
    timing.AttitudeTimeOffset,
    timing.TimeOffsetJump,
    timing.ClockDrift,
    timing.ReferenceLag,
    sensor.VelocityBias,
    sensor.QuadraticScale,
    sensor.ScaleDrift,
    sensor.SoundSpeedLayer,
    sensor.MisalignmentDrift,
    sensor.MountFlexure,
    sensor.AxisNonorthogonality,
    environment.HeadingError,
    environment.WaterLock,
    sensor.Sideslip,
    sensor.TiltCoupling,
    sensor.MountingMoved,
    sensor.SoundSpeedMoved,
    noise.Outliers,
    noise.StaleSamples,
    noise.NoiseInflation,
    noise.ColouredReferenceNoise,
)

E = TypeVar("E", bound=AnyEffect)


class Registry(UserDict[str, E]):
    """Mapping from name to the only instance of each effect of a kind, own ones first.

    Entry points are read at the first use.
    """

    def __init__(self, kind: type[E]) -> None:
        self._kind = kind

    @cached_property
    def data(self) -> dict[str, E]:  # type: ignore[override]  # an attribute of UserDict
        """All effects of the kind."""
        return {effect.name: effect for effect in all_effects() if isinstance(effect, self._kind)}


@lru_cache(maxsize=1)
def all_effects() -> tuple[AnyEffect, ...]:
    """Return systematic and noise effects, own ones first. Raises InputError for a broken plug-in."""
    effects = {kind.name: kind() for kind in OWN}
    for point in entry_points(group=ENTRY_POINTS):
        effect = _plugged_in(point)
        if effect.name in effects:
            raise InputError(f"{_label(point)}: there is an effect {effect.name!r} already; give it another name")
        effects[effect.name] = effect
    return tuple(effects.values())


def _plugged_in(point: EntryPoint) -> AnyEffect:
    """Return the effect of an entry point. Raises InputError for any fault of its package."""
    try:
        kind = point.load()
        if not (isinstance(kind, type) and issubclass(kind, Effect | NoiseEffect)):
            raise TypeError(f"{point.value} is no subclass of Effect or NoiseEffect")
        effect = kind()
        wanted = ("name", "summary", "parameters", "acts_on", *(["manoeuvre"] if isinstance(effect, Effect) else []))
        for attribute in wanted:
            getattr(effect, attribute)
        _check_stage(effect)
    except Exception as error:  # any fault of a foreign package
        raise InputError(
            f"{_label(point)}: cannot be used ({type(error).__name__}: {error}); repair or uninstall that package"
        ) from error
    return effect


_CLOCKS = (ActsOn.DVL_CLOCK, ActsOn.REFERENCE_CLOCK, ActsOn.ATTITUDE_CLOCK)
# allowed stages of an effect, by the first matching class
_STAGES: tuple[tuple[type[AnyEffect], tuple[ActsOn, ...]], ...] = (
    (NoiseEffect, (ActsOn.DVL, ActsOn.REFERENCE)),
    (ClockEffect, _CLOCKS),
    (MountingEffect, (ActsOn.MOUNTING,)),
    (Effect, (ActsOn.MOTION, ActsOn.DVL, ActsOn.REFERENCE)),
)


def _check_stage(effect: AnyEffect) -> None:
    """Raise TypeError for an effect at a stage where it would never be applied."""
    kind, stages = next((kind, stages) for kind, stages in _STAGES if isinstance(effect, kind))
    if effect.acts_on not in stages:
        listed = " or ".join(f"ActsOn.{stage.name}" for stage in stages)
        raise TypeError(f"acts_on is {listed} for a subclass of {kind.__name__}, not {effect.acts_on}")


def _label(point: EntryPoint) -> str:
    package = f" of package {point.dist.name}" if point.dist else ""
    return f"effect plug-in {point.name!r}{package}"


EFFECTS: Registry[Effect] = Registry(Effect)  # type: ignore[type-abstract]
NOISE_EFFECTS: Registry[NoiseEffect] = Registry(NoiseEffect)  # type: ignore[type-abstract]


def effect_table() -> str:
    """Return every effect with its parameters, in Markdown."""
    lines = ["| effect | is | parameters | needs | looks like |", "|---|---|---|---|---|"]
    lines += [_table_row(effect) for effect in chain(EFFECTS.values(), NOISE_EFFECTS.values())]
    return "\n".join(lines) + "\n"


def _table_row(effect: AnyEffect) -> str:
    """Return an effect's row of the table, in Markdown."""
    by_unit = [
        f"{_codes(parameter.name for parameter in group)} {unit}"
        for unit, group in groupby(effect.parameters, lambda parameter: parameter.unit)
    ]
    summary = effect.summary.replace("|", "\\|")  # a bar would end the cell
    needs = ", ".join(sorted(need.value for need in effect.needs))
    return f"| `{effect.name}` | {summary} | {', '.join(by_unit)} | {needs} | {_codes(effect.confounded_with)} |"


def _codes(names: Iterable[str]) -> str:
    return " ".join(f"`{name}`" for name in names)
