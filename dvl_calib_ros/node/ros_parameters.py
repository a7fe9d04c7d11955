"""ROS 2 parameters with descriptors, made from the parameter schema."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, ParameterType
from rclpy.parameter import Parameter

from ..calibration.models.parameters import SCHEMA, Parameters, ParameterSpec
from ..files.parameter_files import is_ros_parameter, names_of_others
from .services import AnsweringNode

_TYPES = {
    "string": ParameterType.PARAMETER_STRING,
    "bool": ParameterType.PARAMETER_BOOL,
    "double": ParameterType.PARAMETER_DOUBLE,
    "double_array": ParameterType.PARAMETER_DOUBLE_ARRAY,
}


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return the descriptor for `ros2 param describe`."""
    constraints = []
    if spec.choices:
        constraints.append("one of " + ", ".join(spec.choices))
    if spec.kind == "double_array":
        constraints.append(f"{spec.length} numbers, each {spec.low:g} .. {spec.high:g}")
    described = ParameterDescriptor(
        type=_TYPES[spec.kind],
        description=spec.description + (f" [{spec.unit}]" if spec.unit else ""),
        additional_constraints="; ".join(constraints),
        read_only=spec.read_only,
    )
    if spec.kind == "double" and spec.low is not None and spec.high is not None:
        described.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high, step=0.0)]
    return described


def declare_parameters(node: AnsweringNode, files: Sequence[Path] = ()) -> Parameters:
    """Declare every parameter with its value at the start. Raises ParameterError and InputError.

    The node must have declared its overrides automatically: unknown names are then seen, which ROS 2 would ignore, and
    integers are accepted for doubles, now and later. files: the parameter files of the start. Unknown names in their
    sections for all nodes belong to other nodes.
    """
    names_elsewhere: set[str] = set()
    for path in files:
        names_elsewhere |= names_of_others(path, node.get_fully_qualified_name())
    given: dict[str, Any] = {
        name: node.get_parameter(name).value for name in node.get_parameters_by_prefix("") if not is_ros_parameter(name)
    }
    for name in given:
        node.undeclare_parameter(name)
    ignored = sorted(names_elsewhere & given.keys())
    if ignored:
        node.info(f"set for all nodes, but no parameters of this node: {', '.join(ignored)}")
    parameters = Parameters.from_mapping({name: value for name, value in given.items() if name not in names_elsewhere})
    for name, spec in SCHEMA.items():
        node.declare_parameter(name, parameters.as_dict()[name], descriptor(spec), ignore_override=True)
    node.add_pre_set_parameters_callback(_as_declared)
    return parameters


def _as_declared(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return parameters with integers converted to doubles, which ROS 2 would refuse by their type."""
    found = []
    for parameter in parameters:
        kind = SCHEMA[parameter.name].kind if parameter.name in SCHEMA else ""
        if kind == "double" and parameter.type_ is Parameter.Type.INTEGER:
            parameter = Parameter(parameter.name, Parameter.Type.DOUBLE, float(parameter.value))
        elif kind == "double_array" and parameter.type_ is Parameter.Type.INTEGER_ARRAY:
            parameter = Parameter(parameter.name, Parameter.Type.DOUBLE_ARRAY, [*map(float, parameter.value)])
        found.append(parameter)
    return found
