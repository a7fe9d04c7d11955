"""What was found, as parameters that the node and replay compensate."""

from __future__ import annotations

from typing import Any

import yaml

from ..calibration.parameters import SCHEMA, Parameters
from .results import Diagnosis


def compensated(parameters: Parameters, diagnosis: Diagnosis) -> Parameters:
    """The parameters with what was found on top: the rest of a lever arm, the rest of a time offset.

    Only the first name of a set is taken. What the calibration has no parameter for is left alone.
    """
    values: dict[str, Any] = {}
    for effect in diagnosis.effects:
        found = {name: value for name, (value, _, _) in effect.parameters.items()}
        if effect.name == "lever_arm":
            axes = zip(parameters.lever_arm, ("x_m", "y_m", "z_m"), strict=True)
            values["lever_arm"] = tuple(known + found[axis] for known, axis in axes)
        elif effect.name == "dvl_time_offset":
            values["dvl_time_offset"] = parameters.dvl_time_offset + found["seconds"]
    return parameters.replace(**values)


def parameter_file(parameters: Parameters) -> str:
    """A ROS 2 parameter file with all values that are not the defaults."""
    values = {
        name: value
        for name, value in parameters.as_dict().items()
        if value != (list(default) if isinstance(default := SCHEMA[name].default, tuple) else default)
    }
    return yaml.safe_dump({"/**": {"ros__parameters": values}}, sort_keys=False, default_flow_style=None)
