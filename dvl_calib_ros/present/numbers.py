"""Display of numbers and quantities, with significant digits and common units."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..effects.base import AnyEffect


def number(value: float, digits: int = 2, *, signed: bool = False) -> str:
    """Format with `digits` decimals and a minus as wide as a plus; – for nan."""
    if value != value:
        return "–"
    rounded = round(value, digits) + 0.0  # avoids minus zero
    return f"{rounded:{'+' if signed else ''}.{digits}f}".replace("-", "−")


def with_std(value: float, std: float, digits: int = 2, *, signed: bool = False) -> str:
    """Format a number with its standard deviation; – if unknown."""
    return f"{number(value, digits, signed=signed)} ± {std:.{digits}f}" if std == std else "–"


def counted(count: int, what: str) -> str:
    """Format a count with its noun in singular or plural."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def p_value(p: float) -> str:
    """Format a probability; – for nan."""
    return "–" if p != p else f"{p:.2g}" if p >= 1e-3 else "< 0.001"


def share(value: float) -> str:
    """Format a share in per cent; – for nan."""
    return f"{100.0 * value:.0f} %".replace("-", "−") if math.isfinite(value) else "–"


def mm(value: float) -> str:
    """Format a speed, m/s, in mm/s."""
    return f"{1e3 * value:.1f}"


def two(value: float) -> str:
    """Format with two significant digits, without an exponent."""
    return f"{float(f'{value:.2g}'):g}"


def three(value: float) -> str:
    """Format with three significant digits."""
    if math.isinf(value):
        return "∞"
    text = f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:#.3g}".rstrip(".")
    return text.replace("-", "−")


# Displayed units and factors of effect parameters; small times and velocities have other units.
_SPOKEN: Mapping[str, tuple[float, str]] = {
    "rad": (math.degrees(1.0), "°"),
    "rad/h": (math.degrees(1.0), "°/h"),
    "rad/(m/s)": (math.degrees(1.0), "° per m/s"),
    "m/s/rad": (math.radians(1.0), "m/s per °"),
    "1": (100.0, "%"),
    "1/h": (100.0, "%/h"),
    "1/m": (1000.0, "% per 10 m"),
}
_SMALL = {"s": (1e3, "ms"), "m/s": (1e3, "mm/s"), "s/h": (1e3, "ms/h")}


def quantity(values: Sequence[float], unit: str) -> tuple[list[float], str]:
    """Convert values to a displayed unit: degrees, ms and mm/s for rad, s and m/s."""
    factor, unit_shown = _SPOKEN.get(unit, (1.0, unit))
    if unit_shown in _SMALL and 0.0 < max((abs(each) for each in values if math.isfinite(each)), default=0.0) < 1.0:
        factor, unit_shown = _SMALL[unit_shown]
    return [factor * each for each in values], unit_shown


def intervals(parameters: Mapping[str, tuple[float, float, float]], effect: AnyEffect | None = None) -> str:
    """Format values with their intervals, by name, to the digits that the intervals justify; – for none.

    effect: the effect of the parameters, if known here.
    """
    specs = {} if effect is None else {each.name: each for each in effect.parameters}
    texts = []
    for name, values in parameters.items():
        label, unit = (specs[name].display_name, specs[name].unit) if name in specs else (name, "")
        (value, low, high), unit = quantity(values, unit)
        half = 0.5 * (high - low)
        if math.isfinite(half) and half > 0.0:
            exponent = math.floor(math.log10(half))
            digits = max(0, (half < 3.0 * 10.0**exponent) - exponent)  # two digits of a half from 1 to 3, else one
            words = [number(each, digits) for each in (value, low, high)]
        else:
            words = [three(each) for each in (value, low, high)]
        space = "" if unit.startswith("°") else " "
        texts.append(" ".join(f"{label} {words[0]}{space}{unit} ({words[1]} to {words[2]})".split()))
    return "; ".join(texts) or "–"


def fitting_unit(seconds: float) -> tuple[float, str]:
    """Return a fitting unit for a time span: its length in s and its name."""
    return (1.0, "s") if seconds <= 600.0 else (60.0, "min") if seconds <= 10_800.0 else (3600.0, "h")


def typed(command: str, bags: Iterable[Path], *options: object) -> str:
    """Format a command to type."""
    return shlex.join(["dvl-calib", *command.split(), *map(str, bags), *map(str, options)])


def options(
    topics: Iterable[tuple[str, str | None]], overrides: Iterable[str], parameters: Path | None = None
) -> list[str]:
    """Return options for topics (role and name, None: found automatically) and parameters, each with its last value."""
    words = [] if parameters is None else ["--params", str(parameters)]
    last = {override.partition(":=")[0]: override for override in overrides}
    words += [word for override in last.values() for word in ("-p", override)]
    return words + [word for role, name in topics if name is not None for word in (f"--{role}-topic", name)]
