"""Export to Gazebo (gz-sensors `DopplerVelocityLog`): an SDF sensor of gz:type dvl."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from .dvl_description import DvlDescription
from .writer import Settings, Simulator, beams_of, comment, numbers, split, xml_text

GZ = "http://gazebosim.org/schema"
TITLE = "Gazebo"
ROTATIONS_DEG = (45.0, 135.0, -135.0, -45.0)
TILT_DEG = 30.0
DEFAULTS = {
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


def write(description: DvlDescription) -> Settings:
    """Write the sensor. Its noise is per beam; velocities are solved from the beams by least squares."""
    beams = beams_of(description.noise_std, math.radians(TILT_DEG))
    configured = {
        "pose": numbers((*description.lever_arm, *description.mounting_rpy)),
        "update_rate": description.rate_hz,
        "stddev": beams.std if beams else None,
        "tilt": math.degrees(beams.angle) if beams and beams.is_found else None,
    }
    values, from_vehicle, assumed = split(configured, DEFAULTS)
    ET.register_namespace("gz", GZ)
    root = ET.Element("sdf", version="1.9")
    root.append(ET.Comment(comment(TITLE, description, from_vehicle, assumed)))
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


SIMULATOR = Simulator(
    TITLE, write, "copy <sensor> into the link of your vehicle that is the reference point (forward-left-up)"
)
