"""Numbers and quantities as people read them: digits that mean something, units that people use."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..effects.base import AnyEffect


def number(value: float, digits: int = 2, *, signed: bool = False) -> str:
    """A number with so many digits, the minus as wide as the plus; – for none."""
    if value != value:
        return "–"
    rounded = round(value, digits) + 0.0  # no minus before zero
    return f"{rounded:{'+' if signed else ''}.{digits}f}".replace("-", "−")


def with_std(value: float, std: float, digits: int = 2, *, signed: bool = False) -> str:
    """A number with its standard deviation; – where that is not known."""
    return f"{number(value, digits, signed=signed)} ± {std:.{digits}f}" if std == std else "–"


def counted(count: int, what: str) -> str:
    """So many of something."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def p_value(p: float) -> str:
    """A probability; – for none."""
    return "–" if p != p else f"{p:.2g}" if p >= 1e-3 else "< 0.001"


def share(value: float) -> str:
    """A share in per cent; – for none."""
    return f"{100.0 * value:.0f} %".replace("-", "−") if math.isfinite(value) else "–"


def mm(value: float) -> str:
    """A speed, m/s, in mm/s."""
    return f"{1e3 * value:.1f}"


def two(value: float) -> str:
    """Two significant digits without an exponent."""
    return f"{float(f'{value:.2g}'):g}"


def three(value: float) -> str:
    """Three significant digits."""
    if math.isinf(value):
        return "∞"
    text = f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:#.3g}".rstrip(".")
    return text.replace("-", "−")


# Units that people use for those of an effect's parameters, and factor; small times and velocities have others again.
_SPOKEN: Mapping[str, tuple[float, str]] = {
    "rad": (math.degrees(1.0), "°"),
    "rad/h": (math.degrees(1.0), "°/h"),
    "rad/(m/s)": (math.degrees(1.0), "° per m/s"),
    "m/s/rad": (math.radians(1.0), "m/s per °"),
    "1": (100.0, "%"),
    "1/h": (100.0, "%/h"),
}
_SMALL = {"s": (1e3, "ms"), "m/s": (1e3, "mm/s"), "s/h": (1e3, "ms/h")}


def quantity(values: Sequence[float], unit: str) -> tuple[list[float], str]:
    """Values and their unit as people say them: degrees, ms and mm/s for rad, s and m/s."""
    factor, spoken = _SPOKEN.get(unit, (1.0, unit))
    if spoken in _SMALL and 0.0 < max((abs(each) for each in values if math.isfinite(each)), default=0.0) < 1.0:
        factor, spoken = _SMALL[spoken]
    return [factor * each for each in values], spoken


def intervals(parameters: Mapping[str, tuple[float, float, float]], of: AnyEffect | None = None) -> str:
    """Values and from where to where each may be, by name, with the digits that this tells; – where there are none.

    of: the effect whose parameters they are; None where that is not known here.
    """
    specs = {} if of is None else {each.name: each for each in of.parameters}
    texts = []
    for name, values in parameters.items():
        said, unit = (specs[name].spoken, specs[name].unit) if name in specs else (name, "")
        (value, low, high), unit = quantity(values, unit)
        half = 0.5 * (high - low)
        if math.isfinite(half) and half > 0.0:
            exponent = math.floor(math.log10(half))
            digits = max(0, (half < 3.0 * 10.0**exponent) - exponent)  # two digits of a half from 1 to 3, else one
            shown = [number(each, digits) for each in (value, low, high)]
        else:
            shown = [three(each) for each in (value, low, high)]
        space = "" if unit.startswith("°") else " "
        texts.append(" ".join(f"{said} {shown[0]}{space}{unit} ({shown[1]} to {shown[2]})".split()))
    return "; ".join(texts) or "–"


def fitting_unit(seconds: float) -> tuple[float, str]:
    """Length in s and name of the unit in which people tell such a time."""
    return (1.0, "s") if seconds <= 600.0 else (60.0, "min") if seconds <= 10_800.0 else (3600.0, "h")


def typed(command: str, bags: Iterable[Path], *options: object) -> str:
    """A line to type."""
    return shlex.join(["dvl-calib", *command.split(), *map(str, bags), *map(str, options)])


def options(
    topics: Iterable[tuple[str, str | None]], overrides: Iterable[str], parameters: Path | None = None
) -> list[str]:
    """What names topics (role and name, None for those that are found) and parameters."""
    words = [] if parameters is None else ["--params", str(parameters)]
    words += [word for override in overrides for word in ("-p", override)]
    return words + [word for role, name in topics if name is not None for word in (f"--{role}-topic", name)]
