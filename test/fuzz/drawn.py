"""Values out of the bytes of an input, so that a changed byte is one changed value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

from dvl_calib_ros.calibration.models.parameters import SCHEMA

T = TypeVar("T")
# What sensors send and what they should not; the other bytes are numbers from -4 to 4
_NUMBERS = (0.0, -0.0, -1.0, 1e-3, 0.04, 5e-324, 1e-310, 1e-12, 25.0, 1e3, 1e6, 3e15, 1e150, 1e308, -1e308)
_NUMBERS += (math.inf, -math.inf, math.nan)
_TEXTS = ("", "dvl_link", "base_link", "ned", "map", "/", "../x", "\x1b[2J", "é" * 40)


class Drawn:
    """Takes values one after the other; after the end of the input, zeros."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def has_more(self) -> bool:
        """Whether bytes are left."""
        return self._at < len(self._data)

    def byte(self) -> int:
        """0 .. 255."""
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def one_of(self, values: Sequence[T]) -> T:
        """One of up to 256 values."""
        return values[self.byte() % len(values)]

    def number(self) -> float:
        """Any number, rarely a sound one."""
        byte = self.byte()
        return _NUMBERS[byte] if byte < len(_NUMBERS) else (byte - 128) / 32

    def near(self, value: float) -> float:
        """Mostly about the value, else any number."""
        byte = self.byte()
        return value + (byte - 128) / 512 if byte < 240 else self.number()

    def text(self) -> str:
        """One of a few names."""
        return self.one_of(_TEXTS)

    def setting(self) -> tuple[str, Any]:
        """A parameter and a value, mostly inside its bounds. Names of files stay as they are."""
        name = self.one_of([name for name in SCHEMA if name not in ("result_file", "initial_calibration")])
        spec = SCHEMA[name]
        if spec.kind == "bool":
            return name, bool(self.byte() % 2)
        if spec.kind == "string":
            return name, self.one_of(spec.choices) if spec.choices else self.text()
        values = tuple(self._inside(spec.low, spec.high) for _ in range(spec.length if "array" in spec.kind else 1))
        return name, values if "array" in spec.kind else values[0]

    def _inside(self, low: float | None, high: float | None) -> float:
        byte = self.byte()
        if low is None or high is None or byte >= 250:
            return self.number()
        if low > 0.0:  # a scale: in equal ratios
            return min(high, low * (high / low) ** (byte / 249))
        return min(high, low + (high - low) * (byte / 249) ** (3 if low == 0.0 else 1))
