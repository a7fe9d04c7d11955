"""Common form of all simulator writers: settings, and effects that a simulator cannot represent."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .dvl_description import NOT_EXPLAINED, DvlDescription

# smallest reported error of one axis' noise, as a share of the noise of all
SAME_NOISE = 0.2
# beams are 20 to 30 degrees from vertical; noise that implies an angle outside this range is not due to equal beams
PLAUSIBLE_ANGLES = (math.radians(12.0), math.radians(40.0))
_WHY_NOT = "{} has no setting for it"


@dataclass(frozen=True)
class Missing:
    """A diagnosed effect that a simulator cannot represent. error: remaining m/s, rms; None if unknown."""

    name: str
    says: str
    error: float | None


@dataclass(frozen=True)
class Settings:
    """Output of a writer.

    text: the file.
    found: settings by name from the description.
    defaults: the simulator's own ones.
    noise_std: (3,) m/s of its axes with these settings; None at the default noise.
    scale: the common error of all axes.
    remarks: for the user of the file.
    represented: effects in the file, `scale` or `velocity_bias`.
    """

    text: str
    found: Mapping[str, Any]
    defaults: Mapping[str, Any]
    noise_std: tuple[float, float, float] | None = None
    scale: float = 0.0
    remarks: tuple[str, ...] = ()
    represented: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Simulator:
    """A simulator. title: its name. write: description -> settings. where: what to do with the file."""

    title: str
    write: Callable[[DvlDescription], Settings]
    where: str


@dataclass(frozen=True)
class Export:
    """Settings for one simulator, and the effects that it cannot represent, the largest first."""

    simulator: str
    settings: Settings
    missing: tuple[Missing, ...]
    remarks: tuple[str, ...] = ()


def export(name: str, simulator: Simulator, description: DvlDescription) -> Export:
    """Return the settings of a simulator for a DVL."""
    settings = simulator.write(description)
    missing = sorted(_missing(simulator.title, settings, description), key=lambda effect: -(effect.error or 0.0))
    remarks = (*description.doubts, *settings.remarks, *description.ambiguities, simulator.where)
    return Export(name, settings, tuple(missing), remarks)


def export_document(export: Export, description: DvlDescription, version: str) -> dict[str, Any]:
    """Return plain data for the list next to the file."""
    return {
        "simulator": export.simulator,
        "source": description.source,
        "missing": [{"name": effect.name, "says": effect.says, "error_mps": effect.error} for effect in export.missing],
        "found": dict(export.settings.found),
        "defaults": dict(export.settings.defaults),
        "remarks": list(export.remarks),
        "version": version,
    }


def _missing(title: str, settings: Settings, description: DvlDescription) -> list[Missing]:
    """Return what the settings cannot represent, each with size and reason."""
    why = _WHY_NOT.format(title)
    found = []
    bias = description.velocity_bias
    if any(bias) and "velocity_bias" not in settings.represented:
        text = f"{', '.join(f'{value:.3g}' for value in bias)} m/s; {why}"
        found.append(Missing("velocity_bias", text, float(np.linalg.norm(bias))))
    found += _scale(title, settings, description)
    found += _noise(settings, description)
    for other in description.others:
        values_said = ", ".join(f"{name} {value:.3g}" for name, value in other.parameters.items())
        reason = why
        if other.of_the_reference:
            reason = "it is in the reference or attitude, not in the DVL"
        elif other.of_another_day:
            reason = "it is of another recording than the first, as which the settings are"
        elif other.name == NOT_EXPLAINED:
            reason = "no effect of the library explains it"
        elif "factor" in other.parameters:
            reason = "the noise is set to its true level; there is no setting for the smaller claim of messages"
        found.append(Missing(other.name, f"{values_said}; {reason}".lstrip("; "), other.size))
    return found


def _scale(title: str, settings: Settings, description: DvlDescription) -> list[Missing]:
    """Report the remaining scale-factor errors, if the simulator has no scale or one for all axes."""
    residual = np.array(description.scale) - settings.scale
    if not np.any(np.abs(residual) > 1e-9):
        return []
    error = None if description.speed is None else float(np.linalg.norm(residual * description.speed))
    per_axis = ", ".join(f"{100.0 * value:+.2f}" for value in description.scale)
    only = "one for all axes" if "scale" in settings.represented else "no setting for it"
    return [Missing("scale", f"{per_axis} % along x, y, z; {title} has {only}", error)]


def _noise(settings: Settings, description: DvlDescription) -> list[Missing]:
    """Report axes whose noise differs from the description."""
    if description.noise_std is None or settings.noise_std is None:
        return []
    represented, described = np.array(settings.noise_std), np.array(description.noise_std)
    error = math.sqrt(float(np.abs(represented**2 - described**2).sum()))
    if error <= SAME_NOISE * float(np.linalg.norm(described)):
        return []
    text = " and ".join(
        f"{', '.join(f'{1e3 * value:.1f}' for value in values)} mm/s {label}"
        for values, label in ((described, "found along x, y, z"), (represented, "with these settings"))
    )
    return [Missing("noise", text, error)]


def mixed_scale(description: DvlDescription) -> float:
    """Return the single scale error that best replaces the errors of the three axes, at the speeds driven."""
    scale = np.array(description.scale)
    if description.speed is None:
        return float(scale[0])  # ahead, the main direction of vehicles
    weight = np.square(description.speed)
    return float(scale @ weight / max(float(weight.sum()), 1e-12))


@dataclass(frozen=True)
class Beams:
    """Four equal Janus beams. angle: rad, from vertical. is_found: derived from the noise. std: m/s, each."""

    angle: float
    is_found: bool
    std: float

    @property
    def axis_std(self) -> tuple[float, float, float]:
        """Noise (3,) m/s of the axes, which are solved from the beams by least squares."""
        across = self.std / (math.sqrt(2.0) * math.sin(self.angle))
        return across, across, self.std / (2.0 * math.cos(self.angle))


def beams_of(noise_std: tuple[float, float, float] | None, default_angle: float) -> Beams | None:
    """Return beams whose least squares have this noise along the axes, None if unknown.

    The flatter the beams, the smaller the horizontal noise relative to z: their ratio is √2 / tan(angle).
    """
    if noise_std is None:
        return None
    horizontal, vertical = math.hypot(noise_std[0], noise_std[1]) / math.sqrt(2.0), noise_std[2]
    angle = math.atan2(math.sqrt(2.0) * vertical, horizontal) if horizontal > 0.0 else 0.0
    is_found = PLAUSIBLE_ANGLES[0] <= angle <= PLAUSIBLE_ANGLES[1]
    angle = angle if is_found else default_angle
    return Beams(angle, is_found, math.sqrt(2.0) * math.sin(angle) * horizontal)


def equal_std(noise_std: tuple[float, float, float]) -> float:
    """Return the noise per axis of three equal axes with the same total."""
    return float(np.linalg.norm(noise_std)) / math.sqrt(3.0)


def tidy(value: Any) -> Any:
    """Round numbers to nine digits, more than any is known to, and remove -0.0."""
    if isinstance(value, list | tuple):
        return [tidy(item) for item in value]
    return float(f"{value:.9g}") + 0.0 if isinstance(value, float) else value


def numbers(values: Iterable[float]) -> str:
    """Format numbers in a row."""
    return " ".join(str(tidy(float(value))) for value in values)


def split(
    known: Mapping[str, Any], defaults: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Return all settings, the known ones, and the simulator's defaults. known: None if not found."""
    found = {name: tidy(value) for name, value in known.items() if value is not None}
    assumed = {name: value for name, value in defaults.items() if name not in found}
    return {**defaults, **found}, found, assumed


def comment(title: str, description: DvlDescription, found: Mapping[str, Any], own: Mapping[str, Any]) -> str:
    """Return the origin of a file for its first lines, without two hyphens in a row, as XML comments need."""
    lines = [
        f"DVL for {title}, from {description.source} (dvl-calib export).",
        f"From what was found: {', '.join(found)}.",
        f"At {title}'s defaults: {', '.join(own) or 'nothing'}.",
        "The .missing.json next to it lists the effects that cannot be represented.",
    ]
    text = "\n".join(" ".join(line.split()) for line in lines)
    while "--" in text:
        text = text.replace("--", "- -")
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def xml_text(root: ET.Element) -> str:
    """Return an indented document with a declaration."""
    ET.indent(root, space="  ")
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
