"""Export to Stonefish: a `<sensor type="dvl">` of a scenario."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from ..calibration.numerics.frames import FLU_FROM_FRD, rotation_from_rpy, rpy_from_rotation
from .dvl_description import DvlDescription
from .writer import Settings, Simulator, comment, equal_std, numbers, split, xml_text

TITLE = "Stonefish"
DEFAULTS = {
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


def write(description: DvlDescription) -> Settings:
    """Write the sensor. Bodies are forward-right-down; the sensor, whose beams look along -z, stays forward-left-up."""
    rotation = FLU_FROM_FRD @ rotation_from_rpy(description.mounting_rpy)
    std = None if description.noise_std is None else equal_std(description.noise_std)
    configured = {
        "origin xyz": numbers(FLU_FROM_FRD @ np.array(description.lever_arm)),
        "origin rpy": numbers(rpy_from_rotation(rotation)),
        "rate": description.rate_hz,
        "velocity": std,
    }
    values, from_vehicle, assumed = split(configured, DEFAULTS)
    sensor = ET.Element("sensor", name="dvl", rate=repr(values["rate"]), type="dvl")
    sensor.append(ET.Comment(comment(TITLE, description, from_vehicle, assumed)))
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


SIMULATOR = Simulator(
    TITLE,
    write,
    "put <sensor> into your <robot>, whose link (forward-right-down, its name in <link>) is the reference point",
)
