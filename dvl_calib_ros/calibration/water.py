"""The speed of sound that the water had against the one that the DVL used: what a scale may be, said in its cause.

A DVL that counts with a speed of sound `used` in water of another, c, reads too fast by used / c - 1, except along the
face of a phased array. Medwin's equation (J. Acoust. Soc. Am. 58, 1975, p. 1318) holds for 0 to 35 °C, 0 to 45 PSU and
1000 m of depth; what it adds to the uncertainty is small beside a thermometer's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

# Where the equation holds: °C, with the sea's coldest water; m.
TEMPERATURES, DEEPEST = (-2.0, 35.0), 1000.0
# The salinity of water that nobody measured, PSU: fresh to the saltiest sea.
SALINITIES = (0.0, 40.0)
# What is believed of a thermometer and of a measured salinity (2 σ), and of the equation (m/s).
THERMOMETER, SALINOMETER, EQUATION = 0.5, 1.0, 0.5


def speed_of_sound(temperature: float, salinity: float, depth: float = 0.0) -> float:
    """Speed of sound, m/s, of water of a temperature (°C) and salinity (PSU) at a depth (m), by Medwin (1975)."""
    return _of_salinity_35(temperature, depth) + _by_salinity(temperature) * (salinity - 35.0)


def _of_salinity_35(temperature: float, depth: float) -> float:
    cubic = 4.6 * temperature - 0.055 * temperature**2 + 0.00029 * temperature**3
    return 1449.2 + cubic + 0.016 * depth


def _by_salinity(temperature: float) -> float:
    """m/s for each PSU."""
    return 1.34 - 0.010 * temperature


class Between(NamedTuple):
    """What a quantity is at least and at most."""

    least: float
    most: float

    def meets(self, other: Between) -> bool:
        """Whether the two have a value in common."""
        return self.least <= other.most and other.least <= self.most


@dataclass(frozen=True)
class Water:
    """What a recording says of its water, nan where it says nothing.

    temperature: °C; temperature_error: half of its range, °C. salinity: PSU, measured. depth: m. used: speed of sound
    that the DVL counted with, m/s. source: the topic of the temperature.
    """

    temperature: float = math.nan
    temperature_error: float = THERMOMETER
    salinity: float = math.nan
    depth: float = 0.0
    used: float = math.nan
    source: str = ""

    @property
    def speed(self) -> Between | None:
        """The water's speed of sound, m/s; None without a temperature that the equation holds for."""
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
        """The scale-factor error that this makes; None where the water's speed or the DVL's is not known."""
        speed = self.speed
        if speed is None or math.isnan(self.used):
            return None
        return Between(self.used / speed.most - 1.0, self.used / speed.least - 1.0)

    def salinities(self, speed: Between) -> Between:
        """The salinities, of those that water has, at which sound has such a speed at this temperature."""
        least, most = (
            35.0 + (each - _of_salinity_35(at, self.depth)) / _by_salinity(at)
            for each, at in (
                (speed.least, self.temperature + self.temperature_error),
                (speed.most, self.temperature - self.temperature_error),
            )
        )
        return Between(max(least, SALINITIES[0]), min(most, SALINITIES[1]))


def water_document(water: Water) -> dict[str, float | list[float] | None]:
    """Plain data, with None where nothing is known; ranges are least and most."""
    given = {"temperature": water.temperature, "salinity": water.salinity, "dvl_speed_of_sound": water.used}
    ranges = {"speed_of_sound": water.speed, "scale_explained": water.scale}
    return {
        **{name: None if math.isnan(value) else value for name, value in given.items()},
        **{name: None if each is None else list(each) for name, each in ranges.items()},
    }


def in_words(water: Water | None, scale: float, std: float) -> tuple[str, ...]:
    """The cause of a scale-factor error, and what to set, in sentences; none where the recording tells nothing.

    std: of the recording alone, without what differs from day to day.
    """
    if water is None:
        return ()
    speed, explained = water.speed, water.scale
    found = Between(scale - 2.0 * std, scale + 2.0 * std)
    first = f"Scale {100.0 * scale:+.2f} ± {200.0 * std:.2f} % (2σ)"
    used = "" if math.isnan(water.used) else f"the DVL used a speed of sound of {water.used:.1f} m/s"
    of_water = "" if speed is None else f"{_named(water)} has {speed.least:.1f} to {speed.most:.1f} m/s"
    said = f"{first}: {'; '.join(filter(None, (used, of_water)))}"
    new = water.used / (1.0 + scale)
    if explained is None and speed is None:
        return (f"{said}. Set to {new:.1f} m/s, it would read right.",) if used else ()
    if explained is None:
        assert speed is not None  # else the sentence before
        was = [each * (1.0 + end) for each, end in zip(speed, found, strict=True)]
        return (
            f"{said}. The speed of sound explains the scale if the DVL was set to {was[0]:.0f} to {was[1]:.0f} m/s.",
        )
    share = f"{100.0 * explained.least:+.2f} to {100.0 * explained.most:+.2f} %"
    if not explained.meets(found):
        return (
            f"{said}. That explains {share}; the rest has another cause, such as beam angles or the reference. Set to "
            f"{new:.1f} m/s, the DVL would read right in this water.",
        )
    if found.least <= 0.0 <= found.most:
        return (f"{said}. The setting agrees with the scale that was found.",)
    condition = ""
    if math.isnan(water.salinity):
        needed = water.salinities(Between(water.used / (1.0 + found.most), water.used / (1.0 + found.least)))
        condition = f" if the salinity is {needed.least:.0f} to {needed.most:.0f} PSU"
    return (f"{said}. That explains the scale{condition}: set the speed of sound to {new:.1f} m/s.",)


def _named(water: Water) -> str:
    salinity = "unknown salinity (0 to 40 PSU)" if math.isnan(water.salinity) else f"{water.salinity:.1f} PSU"
    source = f" ({water.source})" if water.source else ""
    return f"water of {water.temperature:.1f} °C{source} and {salinity}"
