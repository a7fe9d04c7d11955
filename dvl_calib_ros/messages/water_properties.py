"""Water properties in messages: temperature, salinity, pressure, and the speed of sound that a DVL used."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from ..calibration.checks.speed_of_sound import SALINITIES, TEMPERATURES, THERMOMETER, Water
from ..calibration.numerics.frames import Array

_FLOATS = ("std_msgs/msg/Float32", "std_msgs/msg/Float64")
_PHASED_ARRAY = 1
# words in topic names of thermometers in the water, and of others
_IN_WATER = {"water", "sea", "ctd", "dvl", "ocean", "outside", "external"}
_NOT_IN_WATER = {
    "imu", "air", "cpu", "gpu", "board", "battery", "motor", "esc", "internal", "inside", "hull", "housing",
}  # fmt: skip
# thermometers that differ by more (°C) are not all in the water
_AGREE = 1.0
# range of the speed of sound in water, m/s; a DVL whose value varies by more than this share has no fixed setting
_SPEEDS, _STEADY = (1350.0, 1650.0), 0.001
_SURFACE_PA, _PA_PER_M = 101_325.0, 1025.0 * 9.81


class OfWater(NamedTuple):
    """Readings of a topic. kind: temperature, salinity, pressure, used. values: (N,) °C, PSU, Pa, m/s. std: of each."""

    topic: str
    kind: str
    values: Array
    std: float = 0.0


def _sound_speed_in_use(field: str) -> Callable[[Any], float]:
    """Return a reader of the speed of sound that the velocities depend on; nan for a phased array."""

    def read(message: Any) -> float:
        # the horizontal velocities of a phased array do not depend on the speed of sound
        is_phased = getattr(message, "dvl_type", 0) == _PHASED_ARRAY
        return math.nan if is_phased else float(getattr(message, field))

    return read


_OF_TYPES: Mapping[str, Mapping[str, Callable[[Any], float]]] = {
    "sensor_msgs/msg/Temperature": {"temperature": attrgetter("temperature")},
    "sensor_msgs/msg/FluidPressure": {"pressure": attrgetter("fluid_pressure")},
    "ds_sensor_msgs/msg/Ctd": {"temperature": attrgetter("temperature"), "salinity": attrgetter("salinity")},
    "marine_acoustic_msgs/msg/Dvl": {"used": _sound_speed_in_use("sound_speed")},
    "ds_sensor_msgs/msg/Dvl": {"used": _sound_speed_in_use("speed_sound")},
}


def readers(topic: str, msgtype: str) -> Mapping[str, Callable[[Any], float]]:
    """Return the readers of a topic's water properties, by kind; a plain number is recognised by the topic's name."""
    if msgtype not in _FLOATS:
        return _OF_TYPES.get(msgtype, {})
    *places, name = topic.lower().split("/")
    if name == "salinity":
        return {"salinity": attrgetter("data")}
    return {"used": attrgetter("data")} if name in ("sound_speed", "speed_of_sound") and "dvl" in places else {}


class WaterCollector:
    """Collector of one topic's last `most` readings."""

    def __init__(self, topic: str, msgtype: str, max_readings: int | None = None) -> None:
        self._topic, self._readers = topic, readers(topic, msgtype)
        self._values: dict[str, deque[float]] = {kind: deque(maxlen=max_readings) for kind in self._readers}
        self._variance = 0.0

    def add(self, message: Any) -> None:
        """Read a message."""
        for kind, read in self._readers.items():
            self._values[kind].append(read(message))
        self._variance = max(self._variance, float(getattr(message, "variance", 0.0)))

    def readings(self) -> list[OfWater]:
        """Return the readings of each kind with a finite number."""
        std = math.sqrt(self._variance) if math.isfinite(self._variance) else 0.0
        found = {kind: np.array(values)[np.isfinite(values)] for kind, values in self._values.items()}
        return [OfWater(self._topic, kind, values, std) for kind, values in found.items() if len(values)]


def water_of(readings: Sequence[OfWater], dvl: str) -> Water | None:
    """Return the known water properties, with the speed of sound used by the DVL of topic `dvl`; None if none.

    A thermometer counts if its topic's name indicates water, or if it is the only one and its name indicates no other
    place. Contradicting readings are ignored.
    """
    by_kind: dict[str, list[OfWater]] = {}
    for reading in readings:
        by_kind.setdefault(reading.kind, []).append(reading)
    known: dict[str, Any] = {}
    wet = _in_water(by_kind.get("temperature", []))
    if wet is not None:
        low, middle, high = np.percentile(wet.values, (5.0, 50.0, 95.0)).tolist()
        known |= {"temperature": middle, "source": wet.topic}
        known["temperature_error"] = max(THERMOMETER, 2.0 * wet.std) + 0.5 * (high - low)
    salinity = _middle(
        [reading for reading in by_kind.get("salinity", []) if reading.values.any()]
    )  # all 0: not filled
    if SALINITIES[0] <= salinity <= SALINITIES[1] + 5.0:
        known["salinity"] = salinity
    pressure = _middle(by_kind.get("pressure", []))
    if not math.isnan(pressure):
        known["depth"] = max(0.0, (pressure - _SURFACE_PA) / _PA_PER_M)
    of_dvl = [reading for reading in by_kind.get("used", []) if reading.topic == dvl] or by_kind.get("used", [])
    used = _middle(of_dvl)
    if _SPEEDS[0] <= used <= _SPEEDS[1] and np.ptp(of_dvl[0].values) <= _STEADY * used:
        known["used"] = used
    return Water(**known) if "temperature" in known or "used" in known else None


def _middle(readings: Sequence[OfWater]) -> float:
    """Return the median if exactly one topic has readings, else nan."""
    return float(np.median(readings[0].values)) if len(readings) == 1 else math.nan


def _in_water(readings: Sequence[OfWater]) -> OfWater | None:
    """Return the readings of the thermometer in the water; None if it is unclear which that is."""
    words = [set(re.split("[^a-z]+", reading.topic.lower())) for reading in readings]
    possible = [(reading, word) for reading, word in zip(readings, words, strict=True) if not word & _NOT_IN_WATER]
    named = [reading for reading, word in possible if word & _IN_WATER]
    chosen = named or [reading for reading, _ in possible]
    if not chosen or (len(chosen) > 1 and not named):
        return None
    middles = [float(np.median(reading.values)) for reading in chosen]
    if max(middles) - min(middles) > _AGREE or not TEMPERATURES[0] <= middles[0] <= TEMPERATURES[1]:
        return None
    return chosen[0]
