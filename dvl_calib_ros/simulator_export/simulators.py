"""Simulators by name: for each a function that writes its settings, and an entry in `SIMULATORS`."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..calibration.numerics.frames import FLU_FROM_FRD, rotation_from_rpy, rpy_from_rotation
from ..disk.atomic import own_stream, save_all
from ..disk.text_files import as_json
from ..errors import InputError
from ..version import __version__
from .dvl_description import NOT_EXPLAINED, DvlDescription, load_description

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


# Export to Gazebo (gz-sensors `DopplerVelocityLog`): an SDF sensor of gz:type dvl.

GZ = "http://gazebosim.org/schema"
ROTATIONS_DEG = (45.0, 135.0, -135.0, -45.0)
TILT_DEG = 30.0
GAZEBO_DEFAULTS = {
    "update_rate": 8.0,
    "stddev": 0.0,
    "type": "phased_array",
    "aperture": 2.0,
    "rotation": ROTATIONS_DEG,
    "tilt": TILT_DEG,
    "when": "best",
    "water_mass_mode": "off",
    "resolution": 0.01,
    "minimum_range": 0.1,
    "maximum_range": 100.0,
    "reference_frame": "0 0 0 0 0 0",
}


def write_gazebo(description: DvlDescription) -> Settings:
    """Write the sensor. Its noise is per beam; velocities are solved from the beams by least squares."""
    beams = beams_of(description.noise_std, math.radians(TILT_DEG))
    configured = {
        "pose": numbers((*description.lever_arm, *description.mounting_rpy)),
        "update_rate": description.rate_hz,
        "stddev": beams.std if beams else None,
        "tilt": math.degrees(beams.angle) if beams and beams.is_found else None,
    }
    values, from_vehicle, assumed = split(configured, GAZEBO_DEFAULTS)
    ET.register_namespace("gz", GZ)
    root = ET.Element("sdf", version="1.9")
    root.append(ET.Comment(comment("Gazebo", description, from_vehicle, assumed)))
    link = ET.SubElement(ET.SubElement(root, "model", name="vehicle"), "link", name="base_link")
    sensor = ET.SubElement(link, "sensor", {"name": "dvl", "type": "custom", f"{{{GZ}}}type": "dvl"})
    for name, text in (
        ("pose", values["pose"]),
        ("always_on", "1"),
        ("update_rate", repr(values["update_rate"])),
        ("topic", "/dvl/velocity"),
    ):
        ET.SubElement(sensor, name).text = text
    dvl = ET.SubElement(sensor, f"{{{GZ}}}dvl")
    ET.SubElement(dvl, "type").text = values["type"]
    arrangement = ET.SubElement(dvl, "arrangement", degrees="true")
    for number, rotation in enumerate(values["rotation"], start=1):
        beam = ET.SubElement(arrangement, "beam", id=str(number))
        for name, value in (("aperture", values["aperture"]), ("rotation", rotation), ("tilt", values["tilt"])):
            ET.SubElement(beam, name).text = repr(value)
    bottom = ET.SubElement(ET.SubElement(dvl, "tracking"), "bottom_mode")
    ET.SubElement(bottom, "when").text = values["when"]
    ET.SubElement(ET.SubElement(bottom, "noise", type="gaussian"), "stddev").text = repr(values["stddev"])
    for name in ("resolution", "maximum_range", "minimum_range"):
        ET.SubElement(dvl, name).text = repr(values[name])
    ET.SubElement(dvl, "reference_frame").text = values["reference_frame"]
    return Settings(xml_text(root), from_vehicle, assumed, beams.axis_std if beams else None)


# Export to Stonefish: a `<sensor type="dvl">` of a scenario.

STONEFISH_DEFAULTS = {
    "rate": 10.0,
    "velocity": 0.0,
    "velocity_percent": 0.0,
    "altitude": 0.0,
    "water_velocity": 0.0,
    "water_velocity_percent": 0.0,
    "beam_angle": 30.0,
    "range": "none written: no limit of velocity, altitude 0 .. 1000 m",
    "water_layer": "none written: no water velocity",
    "history samples": 1,
}


def write_stonefish(description: DvlDescription) -> Settings:
    """Write the sensor. Bodies are forward-right-down; the sensor, whose beams look along -z, stays forward-left-up."""
    rotation = FLU_FROM_FRD @ rotation_from_rpy(description.mounting_rpy)
    std = None if description.noise_std is None else equal_std(description.noise_std)
    configured = {
        "origin xyz": numbers(FLU_FROM_FRD @ np.array(description.lever_arm)),
        "origin rpy": numbers(rpy_from_rotation(rotation)),
        "rate": description.rate_hz,
        "velocity": std,
    }
    values, from_vehicle, assumed = split(configured, STONEFISH_DEFAULTS)
    sensor = ET.Element("sensor", name="dvl", rate=repr(values["rate"]), type="dvl")
    sensor.append(ET.Comment(comment("Stonefish", description, from_vehicle, assumed)))
    ET.SubElement(sensor, "specs", beam_angle=repr(values["beam_angle"]))
    noise = ("velocity", "velocity_percent", "altitude", "water_velocity", "water_velocity_percent")
    ET.SubElement(sensor, "noise", {name: repr(values[name]) for name in noise})
    ET.SubElement(sensor, "history", samples=str(values["history samples"]))
    ET.SubElement(sensor, "origin", xyz=values["origin xyz"], rpy=values["origin rpy"])
    ET.SubElement(sensor, "link", name="base_link")
    return Settings(
        xml_text(sensor),
        from_vehicle,
        assumed,
        None if std is None else (std, std, std),
        remarks=("velocity_percent stays 0: its noise follows the signed velocity, and would decrease astern",),
    )


# Export to HoloOcean: a `DVLSensor` of a scenario's agent, as JSON.

ELEVATION_DEG = 22.5
HOLOOCEAN_DEFAULTS = {
    "Hz": 30.0,
    "VelSigma": 0.0,
    "Elevation": ELEVATION_DEG,
    "DebugLines": False,
    "ReturnRange": True,
    "MaxRange": 50.0,
    "RangeSigma": 0.0,
}


def write_holoocean(description: DvlDescription) -> Settings:
    """Write the sensor. Its noise is per beam. Rotations are in degrees about fixed axes: roll, pitch, yaw."""
    beams = beams_of(description.noise_std, math.radians(ELEVATION_DEG))
    configured = {
        "location": description.lever_arm,
        "rotation": [math.degrees(angle) for angle in description.mounting_rpy],
        "Hz": description.rate_hz,
        "VelSigma": beams.std if beams else None,
        "Elevation": math.degrees(beams.angle) if beams and beams.is_found else None,
    }
    values, from_vehicle, assumed = split(configured, HOLOOCEAN_DEFAULTS)
    configuration = {name: values[name] for name in HOLOOCEAN_DEFAULTS if name != "Hz"}
    sensor = {
        "sensor_type": "DVLSensor",
        "sensor_name": "DVLSensor",
        "location": values["location"],
        "rotation": values["rotation"],
        "Hz": values["Hz"],
        "configuration": configuration,
    }
    return Settings(
        json.dumps(sensor, indent=2, allow_nan=False) + "\n",
        from_vehicle,
        assumed,
        beams.axis_std if beams else None,
        remarks=(
            "no socket is named, so location is from the agent's centre: add what lies between",
            "pitch is about y, which points left; its documentation also says right: check the sign",
            f"Hz must divide ticks_per_sec of the scenario; this is {values['Hz']:g}",
        ),
    )


# Export to DVL-Simulator (RWTH Aachen): parameters of its ROS 2 node, YAML.
#
# In three places its sources use a setting differently from its name. `rotation_body_to_sensor_frame` is applied in the
# order z, y, x: yaw comes first. `lever_arm_body_to_sensor_frame` is in the sensor's axes. Scale and biases are drawn
# uniformly from ± an interval; with a constant seed the draws are known (C++ defines mt19937; libstdc++ makes a double
# of two words), and the interval is chosen to give the wanted value.

# first seed whose draws are all far from zero, because a small draw would need a large interval
SEED = 1
BEAM_ANGLE_DEG = 22.5
DVL_SIMULATOR_DEFAULTS: dict[str, Any] = {
    "sample_time": 0.2,
    "seed": 42,
    "use_constant_seed": False,
    "beam_velocity_noise_std": 0.01,
    "scale_factor_noise_std": 0.0,
    "beam_bias_noise_std": 5.0e-04,
    "gyroscope_noise_std": [0.000207479860047933, 0.000243411420514079, 0.000187943045943727],
    "interval_initial_scale_factor": 0.1,
    "interval_initial_beam_bias": [0.0, 0.0, 0.0, 0.0],
    "beam_bias_correlation_time": 1800.0,
    "resolution": 1.0e-04,
    "beam_angle": BEAM_ANGLE_DEG,
    "min_altitude": 0.05,
    "max_altitude": 50.0,
    "distance_to_ground": -5.0,
    "max_velocity": 3.75,
}
ENABLED = ("beam_velocity_noise", "scale_factor", "beam_bias", "gyroscope_noise", "quantization", "altitude_limit",
           "velocity_limit")  # fmt: skip
GENERAL = ("sample_time", "seed", "use_constant_seed")
# correlation time of a bias that must stay constant: 30 years
FOR_EVER_S = 1.0e9


def write_dvl_simulator(description: DvlDescription) -> Settings:
    """Return the settings of a DVL with scale and beam biases, which the simulator draws by its seed."""
    beams = beams_of(description.noise_std, math.radians(BEAM_ANGLE_DEG))
    scale = mixed_scale(description)
    drawn = draws(SEED)
    roll, pitch, yaw = (math.degrees(angle) for angle in description.mounting_rpy)
    body_from_dvl = rotation_from_rpy(description.mounting_rpy)
    configured: dict[str, Any] = {
        "sample_time": None if description.rate_hz is None else 1.0 / description.rate_hz,
        "seed": SEED,
        "use_constant_seed": True,
        "beam_velocity_noise_std": beams.std if beams else None,
        "beam_angle": math.degrees(beams.angle) if beams and beams.is_found else None,
        "interval_initial_scale_factor": float(100.0 * scale / drawn[0]),
        "lever_arm_body_to_sensor_frame": (body_from_dvl.T @ np.array(description.lever_arm)).tolist(),
        "rotation_body_to_sensor_frame": [yaw, pitch, roll],
    }
    if any(description.velocity_bias):
        angle = beams.angle if beams else math.radians(BEAM_ANGLE_DEG)
        bias = directions(angle) @ np.array(description.velocity_bias) / drawn[1:]
        configured |= {
            "interval_initial_beam_bias": bias.tolist(),
            "beam_bias_noise_std": 0.0,
            "beam_bias_correlation_time": FOR_EVER_S,
        }
    values, from_vehicle, assumed = split(configured, DVL_SIMULATOR_DEFAULTS)
    assumed["model_enable_settings"] = "all true"
    document = {
        "dvl_simulator": {
            "general_settings": {name: values[name] for name in GENERAL},
            "model_parameter_settings": {name: value for name, value in values.items() if name not in GENERAL},
            "model_enable_settings": {f"enable_{name}": True for name in ENABLED},
        }
    }
    above = "".join(f"# {line}\n" for line in comment("DVL-Simulator", description, from_vehicle, assumed).splitlines())
    return Settings(
        above + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120),
        from_vehicle,
        assumed,
        beams.axis_std if beams else None,
        scale,
        (
            f"the intervals of scale and biases are made for the constant seed {SEED}: leave it; every run then has "
            "the same noise, and another C++ library than libstdc++ may draw others",
            "rotation_body_to_sensor_frame has yaw, pitch, roll, and the lever arm is in the sensor's axes, as the "
            "simulator's sources use them",
        ),
        frozenset({"scale", "velocity_bias"}),
    )


def draws(seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the first five uniform draws (5,) in -1 .. 1 for a seed, as shares of ± an interval; scale, then beams."""
    words = np.random.RandomState(seed).randint(0, 1 << 32, size=10, dtype=np.uint32).astype(float)
    return 2.0 * (words[::2] + words[1::2] * 2.0**32) / 2.0**64 - 1.0


def directions(angle: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return beam directions (4, 3); velocity along each = directions @ velocity."""
    azimuth = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    across = math.sin(angle)
    return np.column_stack([np.cos(azimuth) * across, np.sin(azimuth) * across, np.full(4, math.cos(angle))])


SIMULATORS: Mapping[str, Simulator] = {
    "gazebo": Simulator(
        "Gazebo",
        write_gazebo,
        "copy <sensor> into the link of your vehicle that is the reference point (forward-left-up)",
    ),
    "stonefish": Simulator(
        "Stonefish",
        write_stonefish,
        "put <sensor> into your <robot>, whose link (forward-right-down, its name in <link>) is the reference point",
    ),
    "holoocean": Simulator(
        "HoloOcean", write_holoocean, 'add the object to the "sensors" of your agent in the scenario'
    ),
    "dvl-simulator": Simulator(
        "DVL-Simulator",
        write_dvl_simulator,
        "use it as the node's parameter file; its odometry must be of the reference point, forward-left-up",
    ),
}


def missing_beside(output: Path) -> Path | None:
    """Return the path of the list of missing effects, next to the output; None for a stream."""
    return None if own_stream(output) is not None else output.with_name(f"{output.name}.missing.json")


def write_settings(simulator: str, source: Path, output: Path, sample: int | None = None) -> Export:
    """Write a source's DVL as the settings of a simulator, and next to it the list of missing effects.

    source: a diagnosis (JSON), a result or a parameter file (YAML). sample: number of a draw of
    `diagnose --samples`. Either both files are written or none. Raises InputError.
    """
    if simulator not in SIMULATORS:
        raise InputError(f"{simulator!r} is none of {', '.join(SIMULATORS)}")
    description = load_description(source, sample)
    exported = export(simulator, SIMULATORS[simulator], description)
    files = {output: exported.settings.text.encode()}
    missing = missing_beside(output)
    if missing is not None:
        files[missing] = as_json(export_document(exported, description, __version__)).encode()
    save_all(files)
    return exported
