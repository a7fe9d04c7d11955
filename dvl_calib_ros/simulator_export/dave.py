"""DAVE (ds_sim `dsros_ros_dvl`, Gazebo classic): a xacro with the sensor."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from .dvl_description import DvlDescription
from .writer import Settings, Simulator, beams_of, comment, numbers, split, xml_text

XACRO = "http://www.ros.org/wiki/xacro"
TITLE = "DAVE"
BEAM_ANGLE_DEG = 30.0
DEFAULTS = {
    "updateRateHZ": 7.0,
    "gaussianNoiseBeamVel": 0.005,
    "gaussianNoiseBeamWtrVel": 0.0075,
    "gaussianNoiseBeamRange": 0.1,
    "minRange": 0.7,
    "maxRange": 90.0,
    "maxRangeDiff": 10.0,
    "beamAngleDeg": BEAM_ANGLE_DEG,
    "beamWidthDeg": 4.0,
    "beamAzimuthDeg1": -135.0,
    "beamAzimuthDeg2": 135.0,
    "beamAzimuthDeg3": 45.0,
    "beamAzimuthDeg4": -45.0,
    "pos_z_down": "false",
    "enableWaterTrack": 0,
}


def write(description: DvlDescription) -> Settings:
    """Noise is that of each beam, the same at every speed."""
    beams = beams_of(description.noise_std, math.radians(BEAM_ANGLE_DEG))
    known = {
        "pose": numbers((*description.lever_arm, *description.mounting_rpy)),
        "updateRateHZ": description.rate_hz,
        "gaussianNoiseBeamVel": beams.std if beams else None,
        "beamAngleDeg": math.degrees(beams.angle) if beams and beams.is_found else None,
    }
    values, found, own = split(known, DEFAULTS)
    root = ET.Element("robot", {"xmlns:xacro": XACRO})
    root.append(ET.Comment(comment(TITLE, description, found, own)))
    sensor = ET.SubElement(
        ET.SubElement(root, "gazebo", reference="base_link"), "sensor", name="dvl_sensor", type="dsros_dvl"
    )
    ET.SubElement(sensor, "always_on").text = "1"
    ET.SubElement(sensor, "update_rate").text = repr(values["updateRateHZ"])
    ET.SubElement(sensor, "pose").text = values["pose"]
    plugin = ET.SubElement(sensor, "plugin", name="dvl_sensor_controller", filename="libdsros_ros_dvl.so")
    names = {
        "robotNamespace": "dvl",
        "topicName": "dvl",
        "rangesTopicName": "ranges",
        "frameName": "dvl_link",
        "pointcloudFrame": "base_link",
    }
    for name, value in (names | {name: values[name] for name in DEFAULTS}).items():
        ET.SubElement(plugin, name).text = value if isinstance(value, str) else repr(value)
    return Settings(xml_text(root), found, own, frozenset({"lever_arm"}), beams.axis_std if beams else None)


SIMULATOR = Simulator(
    TITLE, write, "include it in your vehicle's xacro; base_link is the reference point (forward-left-up)"
)
