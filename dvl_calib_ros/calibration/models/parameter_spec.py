"""Specification of one parameter: type, unit, range, description."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np


class ParameterError(ValueError):
    """Unknown parameter or unusable value; the message names it and the accepted values."""


@dataclass(frozen=True)
class ParameterSpec:
    """Specification of a parameter apart from its name."""

    default: Any
    description: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True

    @property
    def kind(self) -> str:
        """ROS 2 type: string, bool, double or double_array."""
        names = {str: "string", bool: "bool", float: "double", tuple: "double_array"}
        return names[type(self.default)]

    @property
    def length(self) -> int:
        """Number of elements of an array."""
        return len(self.default)

    def check(self, name: str, value: Any) -> Any:
        """Return the value in its own type (integers as doubles, arrays as tuples), or raise ParameterError."""
        if self.kind == "double_array":
            if isinstance(value, str | bytes) or not hasattr(value, "__len__") or len(value) != self.length:
                raise ParameterError(f"{name}: expected an array of {self.length} numbers, got {value!r}")
            return tuple(self._number(f"{name}[{i}]", element) for i, element in enumerate(value))
        if self.kind == "double":
            return self._number(name, value)
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise ParameterError(f"{name}: expected true or false, got {value!r}")
            return value
        if not isinstance(value, str):
            raise ParameterError(f"{name}: expected text, got {value!r}")
        if self.choices and value not in self.choices:
            raise ParameterError(f"{name}: {value!r} is not one of {', '.join(self.choices)}")
        return value

    def _number(self, name: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            raise ParameterError(f"{name}: expected a number, got {value!r}")
        try:
            number = float(value)
        except OverflowError:
            raise ParameterError(f"{name}: the whole number is too large") from None
        if not math.isfinite(number):
            raise ParameterError(f"{name}: {number} is not finite")
        if (self.low is not None and number < self.low) or (self.high is not None and number > self.high):
            raise ParameterError(f"{name}: {number:g} is outside {self.low:g} .. {self.high:g} {self.unit}".rstrip())
        return number


def _parameter(default: Any, description: str, within: tuple[float, float] | None = None, **known: Any) -> Any:
    """Return the field of a parameter. within: its smallest and largest value."""
    low, high = within or (None, None)
    spec = ParameterSpec(default, description, low=low, high=high, **known)
    return dataclasses.field(default=default, metadata={"spec": spec})
