"""What was found, as parameters that the node and replay compensate."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from ...calibration.models.parameters import SCHEMA, Parameters
from ..search.arm_clock_ambiguity import ARM_PARAMETERS
from .results import Diagnosis

OFFSETS = {
    "dvl_time_offset": "dvl_time_offset",
    "reference_time_offset": "reference_time_offset",
    "attitude_time_offset": "imu_time_offset",
}


# A velocity that begins no later is there all the time
WHOLE_RUN_S = 5.0


def compensated(parameters: Parameters, diagnosis: Diagnosis, recording: int | None = None) -> Parameters:
    """The parameters with what was found on top: the rest of a lever arm, of a clock's offset, drift and jump.

    recording: of several, whose own (of the day) are wanted; None: only what belongs to the vehicle, and the day's
    where there is but one recording. Only the first name of a set is taken, and of a lever arm that may be a clock the
    parts that are one for sure. What the calibration has no parameter for is left alone.
    """
    values: dict[str, Any] = {}
    for effect in sorted(diagnosis.effects, key=lambda each: each.name == "time_offset_jump"):
        parameter_values = effect.parameters
        if effect.by_recording:
            if recording is None:
                continue
            parameter_values = effect.by_recording.get(diagnosis.recordings[recording][0], {})
        found = {name: value for name, (value, _, _) in parameter_values.items()}
        if not found:
            continue
        if effect.name == "lever_arm":
            sure = {
                name: value
                for name, (value, low, high) in parameter_values.items()
                if not effect.equivalent_to or low > 0.0 or high < 0.0
            }
            axes = zip(parameters.lever_arm, ARM_PARAMETERS, strict=True)  # a height is not always shown
            values["lever_arm"] = tuple(known + sure.get(axis, 0.0) for known, axis in axes)
        elif effect.name in OFFSETS:
            name = OFFSETS[effect.name]
            values[name] = values.get(name, getattr(parameters, name)) + found["seconds"]
        elif effect.name == "water_lock" and found["from_s"] < WHOLE_RUN_S and np.isinf(found["to_s"]):
            east, north = parameters.reference_velocity_offset
            values["reference_velocity_offset"] = (east - found["east_mps"], north - found["north_mps"])
        elif effect.name == "clock_drift":
            values["dvl_clock_drift"] = parameters.dvl_clock_drift + found["seconds_per_hour"] / 3600.0
        elif effect.name == "time_offset_jump" and "again_seconds" not in found:  # of two, one would leave the other
            offset = values.get("dvl_time_offset", parameters.dvl_time_offset)
            first_ns = diagnosis.recordings[recording or 0][1]
            values["dvl_time_jump"] = found["seconds"]
            values["dvl_time_jump_at"] = 1e-9 * first_ns + found["at_s"] + offset + 0.5 * found["seconds"]
    return parameters.replace(**values)


def parameter_file(parameters: Parameters) -> str:
    """A ROS 2 parameter file with all values that are not the defaults."""
    values = {
        name: value
        for name, value in parameters.as_dict().items()
        if value != (list(default) if isinstance(default := SCHEMA[name].default, tuple) else default)
    }
    return yaml.safe_dump({"/**": {"ros__parameters": values}}, sort_keys=False, default_flow_style=None)
