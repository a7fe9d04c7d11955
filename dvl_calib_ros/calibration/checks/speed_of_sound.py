"""Speed of sound in the water against the DVL's setting, as a cause of the scale error.

A DVL set to a speed of sound `used` in water of speed c reads too fast by used / c - 1, except along the face of a
phased array. Medwin's equation (J. Acoust. Soc. Am. 58, 1975, p. 1318) holds for 0 to 35 °C, 0 to 45 PSU and 1000 m of
depth; its error is small compared with a thermometer's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

from ..filters.observability import observability
from ..models import Model
from ..models.parameters import Parameters
from ..numerics.kalman import GaussianState
from ..results.results import scale_and_delay

# Validity of the equation: °C, including the sea's coldest water; m.
TEMPERATURES, DEEPEST = (-2.0, 35.0), 1000.0
# Range of unmeasured salinity, PSU: fresh water to the saltiest sea.
SALINITIES = (0.0, 40.0)
# Uncertainties: thermometer (°C) and measured salinity (PSU), 2 σ; the equation (m/s).
THERMOMETER, SALINOMETER, EQUATION = 0.5, 1.0, 0.5


def speed_of_sound(temperature: float, salinity: float, depth: float = 0.0) -> float:
    """Return the speed of sound, m/s, by Medwin (1975), at a temperature (°C), salinity (PSU) and depth (m)."""
    return _of_salinity_35(temperature, depth) + _by_salinity(temperature) * (salinity - 35.0)


def _of_salinity_35(temperature: float, depth: float) -> float:
    cubic = 4.6 * temperature - 0.055 * temperature**2 + 0.00029 * temperature**3
    return 1449.2 + cubic + 0.016 * depth


def _by_salinity(temperature: float) -> float:
    """Return the change per PSU, m/s."""
    return 1.34 - 0.010 * temperature


class Between(NamedTuple):
    """Range of a quantity."""

    least: float
    most: float

    def meets(self, other: Between) -> bool:
        """Return whether the ranges overlap."""
        return self.least <= other.most and other.least <= self.most


@dataclass(frozen=True)
class Water:
    """Water properties from a recording, nan if not recorded.

    temperature: °C.
    temperature_error: half of its range, °C.
    salinity: PSU, measured.
    depth: m.
    used: speed of sound set in the DVL, m/s.
    source: topic of the temperature.
    """

    temperature: float = math.nan
    temperature_error: float = THERMOMETER
    salinity: float = math.nan
    depth: float = 0.0
    used: float = math.nan
    source: str = ""

    @property
    def speed(self) -> Between | None:
        """Range of the water's speed of sound, m/s; None without a temperature and depth valid for the equation."""
        if not (TEMPERATURES[0] <= self.temperature <= TEMPERATURES[1] and 0.0 <= self.depth <= DEEPEST):
            return None
        salinities = SALINITIES
        if not math.isnan(self.salinity):
            salinities = (max(self.salinity - SALINOMETER, 0.0), self.salinity + SALINOMETER)
        least, most = (
            speed_of_sound(self.temperature + sign * self.temperature_error, salinity, self.depth) + sign * EQUATION
            for sign, salinity in zip((-1.0, 1.0), salinities, strict=True)
        )
        return Between(least, most)

    @property
    def scale(self) -> Between | None:
        """Range of the scale error that results; None if the speed of the water or of the DVL is unknown."""
        speed = self.speed
        if speed is None or math.isnan(self.used):
            return None
        return Between(self.used / speed.most - 1.0, self.used / speed.least - 1.0)

    def salinities(self, speed: Between) -> Between:
        """Return the range of natural salinities that give this speed of sound at this temperature."""
        least, most = (
            35.0 + (sound_speed - _of_salinity_35(celsius, self.depth)) / _by_salinity(celsius)
            for sound_speed, celsius in (
                (speed.least, self.temperature + self.temperature_error),
                (speed.most, self.temperature - self.temperature_error),
            )
        )
        return Between(max(least, SALINITIES[0]), min(most, SALINITIES[1]))


# Keys that differ from the names of `Water`.
_KEYS = {"used": "dvl_speed_of_sound"}


def water_document(water: Water) -> dict[str, Any]:
    """Return plain data, with None if unknown; ranges are [least, most]."""
    ranges = {"speed_of_sound": water.speed, "scale_explained": water.scale}
    return {
        **{_KEYS.get(name, name): None if value != value else value for name, value in asdict(water).items()},
        **{name: None if between is None else list(between) for name, between in ranges.items()},
    }


def water_of_document(document: Mapping[str, Any]) -> Water:
    """Read the output of `water_document`. Raise LookupError, TypeError or ValueError if it is invalid."""
    values = {column.name: document[_KEYS.get(column.name, column.name)] for column in fields(Water)}
    source = str(values.pop("source"))
    return Water(**{name: math.nan if value is None else float(value) for name, value in values.items()}, source=source)


class CauseOfScale(NamedTuple):
    """Cause of a scale error.

    sentence: in full.
    brief: one terminal line after the words "speed of sound".
    setting: speed of sound to set, m/s; nan without a recommendation.
    """

    sentence: str
    brief: str
    setting: float


def cause_of_scale(
    model: Model, state: GaussianState, parameters: Parameters, water: Water | None
) -> CauseOfScale | None:
    """Return the cause of a calibration's scale error; None if the recording holds no information.

    state: of a model, x (n,), P (n, n) of this recording, without day-to-day variation.
    """
    scale = scale_and_delay(model, state, parameters)
    is_shown = all(entry.observed for entry in observability(model, state.p, parameters) if entry.axis == "scale")
    if scale.scale_std is None or not is_shown:
        return cause_of_setting(water)
    return cause(water, scale.scale, scale.scale_std)


def cause_of_setting(water: Water | None) -> CauseOfScale | None:
    """Return the effect of the DVL's speed of sound on a scale that the motion does not show."""
    if water is None or water.speed is None or water.scale is None:
        return None
    text = f"{_used(water)}; {_of_water(water, water.speed)}"
    if water.scale.least <= 0.0 <= water.scale.most:
        return CauseOfScale(f"{_begun(text)}. They agree.", f"{water.used:.1f} m/s used, as this water has", math.nan)
    middle = 0.5 * (water.speed.least + water.speed.most)
    return CauseOfScale(
        f"{_begun(text)}. That makes a scale of {_percent(water.scale)}: set the water's speed of sound.",
        f"{water.used:.1f} m/s used, but this water has {water.speed.least:.1f} to {water.speed.most:.1f}",
        math.nan if math.isnan(water.salinity) else middle,
    )


def cause(water: Water | None, scale: float, std: float) -> CauseOfScale | None:
    """Return the cause of a scale error with its σ, and the setting; None if the recording holds no information."""
    if water is None or (water.speed is None and math.isnan(water.used)):
        return None
    speed, explained = water.speed, water.scale
    measured = Between(scale - 2.0 * std, scale + 2.0 * std)
    parts = ["" if math.isnan(water.used) else _used(water), "" if speed is None else _of_water(water, speed)]
    text = f"Scale {100.0 * scale:+.2f} ± {200.0 * std:.2f} % (2σ): {'; '.join(filter(None, parts))}"
    right_setting = water.used / (1.0 + scale)
    if speed is None:
        return CauseOfScale(
            f"{text}. Set to {right_setting:.1f} m/s, it would read right.",
            f"set to {right_setting:.1f} m/s it would read right (the DVL used {water.used:.1f})",
            right_setting,
        )
    if explained is None:
        was = [limit * (1.0 + end) for limit, end in zip(speed, measured, strict=True)]
        return CauseOfScale(
            f"{text}. The speed of sound explains the scale if the DVL was set to {was[0]:.0f} to {was[1]:.0f} m/s.",
            f"{speed.least:.1f} to {speed.most:.1f} m/s here; what the DVL used is not known",
            math.nan,
        )
    if not explained.meets(measured):
        return CauseOfScale(
            f"{text}. That explains {_percent(explained)}; the rest has another cause, such as beam angles or the "
            f"reference. Set to {right_setting:.1f} m/s, the DVL would read right in this water.",
            f"explains {_percent(explained)} of the scale, not the rest",
            right_setting,
        )
    if measured.least <= 0.0 <= measured.most:
        return CauseOfScale(
            f"{text}. The setting agrees with the scale that was found.",
            f"the DVL's {water.used:.1f} m/s agrees with the scale",
            math.nan,
        )
    condition = ""
    if math.isnan(water.salinity):
        needed = water.salinities(Between(water.used / (1.0 + measured.most), water.used / (1.0 + measured.least)))
        condition = f" if the salinity is {needed.least:.0f} to {needed.most:.0f} PSU"
    return CauseOfScale(
        f"{text}. That explains the scale{condition}: set the speed of sound to {right_setting:.1f} m/s.",
        f"{right_setting:.1f} m/s would take the scale out (the DVL used {water.used:.1f})",
        right_setting,
    )


def _used(water: Water) -> str:
    return f"the DVL used a speed of sound of {water.used:.1f} m/s"


def _of_water(water: Water, speed: Between) -> str:
    """Return temperature, source, salinity and speed of sound of the water, as text."""
    salinity = "unknown salinity (0 to 40 PSU)" if math.isnan(water.salinity) else f"{water.salinity:.1f} PSU"
    source = f" ({water.source})" if water.source else ""
    named = f"water of {water.temperature:.1f} °C{source} and {salinity}"
    return f"{named} has {speed.least:.1f} to {speed.most:.1f} m/s"


def _percent(scale: Between) -> str:
    return f"{100.0 * scale.least:+.2f} to {100.0 * scale.most:+.2f} %"


def _begun(text: str) -> str:
    return text[:1].upper() + text[1:]
