"""UUV Simulator (`DVLROSPlugin`): a xacro that calls its DVL macro."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from .dvl_description import DvlDescription
from .writer import Settings, Simulator, comment, equal_std, numbers, split, xml_text

XACRO = "http://www.ros.org/wiki/xacro"
TITLE = "UUV Simulator"
DEFAULTS = {
    "update_rate": 7.0,
    "noise_sigma": 0.0,
    "noise_amplitude": 0.0,
    "enable_local_ned_frame": "false",
    "beams": "0.52 rad from vertical, 0.55 .. 81 m, fixed in the macro",
}


def write(description: DvlDescription) -> Settings:
    """noise_amplitude is the noise of each axis, noise_sigma only what the covariance claims: both are given alike."""
    std = None if description.noise_std is None else equal_std(description.noise_std)
    known = {
        "origin xyz": numbers(description.lever_arm),
        "origin rpy": numbers(description.mounting_rpy),
        "update_rate": description.rate_hz,
        "noise_sigma": std,
        "noise_amplitude": std,
    }
    values, found, own = split(known, DEFAULTS)
    root = ET.Element("robot", {"xmlns:xacro": XACRO})
    root.append(ET.Comment(comment(TITLE, description, found, own)))
    ET.SubElement(root, "xacro:arg", name="namespace", default="vehicle")
    ET.SubElement(root, "xacro:include", filename="$(find uuv_sensor_ros_plugins)/urdf/dvl_snippets.xacro")
    macro = ET.SubElement(
        root,
        "xacro:dvl_plugin_macro",
        namespace="$(arg namespace)",
        suffix="",
        parent_link="$(arg namespace)/base_link",
        reference_frame="world",
        update_rate=repr(values["update_rate"]),
        topic="dvl",
        noise_sigma=repr(values["noise_sigma"]),
        noise_amplitude=repr(values["noise_amplitude"]),
        scale="1",
    )
    ET.SubElement(macro, "origin", xyz=values["origin xyz"], rpy=values["origin rpy"])
    return Settings(
        xml_text(root),
        found,
        own,
        frozenset(),
        None if std is None else (std, std, std),
        remarks=(
            "origin xyz is written, but not to be counted on: the plugin takes the velocity of a link, which has no "
            "lever arm where that link is lumped into its parent",
        ),
    )


SIMULATOR = Simulator(
    TITLE,
    write,
    "include it in your vehicle's xacro (argument namespace); base_link is the reference point (forward-left-up)",
)
