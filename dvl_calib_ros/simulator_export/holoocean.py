"""Export to HoloOcean: a `DVLSensor` of a scenario's agent, as JSON."""

from __future__ import annotations

import json
import math

from .dvl_description import DvlDescription
from .writer import Settings, Simulator, beams_of, split

TITLE = "HoloOcean"
ELEVATION_DEG = 22.5
DEFAULTS = {
    "Hz": 30.0,
    "VelSigma": 0.0,
    "Elevation": ELEVATION_DEG,
    "DebugLines": False,
    "ReturnRange": True,
    "MaxRange": 50.0,
    "RangeSigma": 0.0,
}


def write(description: DvlDescription) -> Settings:
    """Write the sensor. Its noise is per beam. Rotations are in degrees about fixed axes: roll, pitch, yaw."""
    beams = beams_of(description.noise_std, math.radians(ELEVATION_DEG))
    configured = {
        "location": description.lever_arm,
        "rotation": [math.degrees(angle) for angle in description.mounting_rpy],
        "Hz": description.rate_hz,
        "VelSigma": beams.std if beams else None,
        "Elevation": math.degrees(beams.angle) if beams and beams.is_found else None,
    }
    values, from_vehicle, assumed = split(configured, DEFAULTS)
    configuration = {name: values[name] for name in DEFAULTS if name != "Hz"}
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


SIMULATOR = Simulator(TITLE, write, 'add the object to the "sensors" of your agent in the scenario')
