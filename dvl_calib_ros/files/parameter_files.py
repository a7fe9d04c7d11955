"""ROS 2 parameter files: read without ROS, written from the schema, and edited in place."""

from __future__ import annotations

import difflib
import fnmatch
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ..calibration.models import MODELS
from ..calibration.models.parameters import SCHEMA, ParameterError, Parameters
from ..disk.text_files import compose_yaml, load_yaml, parse_scalar
from ..errors import InputError
from ..messages.drivers import TYPES_OF, may_be_recognised, velocity_type
from ..messages.field_map import field_map

NODE_NAME = "dvl_calibration"
# rclpy's own parameters, which a file for the node may have
ROS_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides")

# from this similarity on (1: equal), an unknown name that is set for all nodes is a misspelt one of ours
MISSPELT = 0.8


def load_parameters(
    path: Path | None, overrides: Sequence[str] = (), defaults: Mapping[str, Any] | None = None, text: str | None = None
) -> Parameters:
    """Load parameters from a ROS 2 parameter file, then ``name:=value`` overrides. Raises InputError.

    defaults: values instead of the schema's defaults. An override may give angles in degrees: 45deg. text: content to
    parse instead of the file's current content.
    """
    values = dict(defaults or {}) | ({} if path is None else _node_parameters(path, text))
    try:
        Parameters.from_mapping(values)
    except ParameterError as error:
        raise InputError(f"{path}: {error}") from error
    values |= dict(_override(override) for override in overrides)
    try:
        parameters = Parameters.from_mapping({k: v for k, v in values.items() if not is_ros_parameter(k)})
    except ParameterError as error:
        raise InputError(f"-p {error}") from error
    for name in TYPES_OF:
        if name != "dvl_type" or not (may_be_recognised(parameters.dvl_type) or parameters.dvl_fields):
            velocity_type(name, getattr(parameters, name))
    if parameters.dvl_fields:
        field_map(parameters.dvl_fields)
    return parameters


def given_parameters(path: Path | None, overrides: Sequence[str] = ()) -> frozenset[str]:
    """Return the names of the parameters set by an override, or in a file to another value than the default.

    A file that lists every parameter at its default, such as the shipped one, sets none. Raises InputError.
    """
    in_file = {} if path is None else changed_parameters(load_parameters(path))
    return frozenset({*in_file, *(_override(override)[0] for override in overrides)})


def ros_override(text: str) -> str:
    """Return an override in ROS 2's syntax, which has no degrees. Raises InputError."""
    name, value = _override(text)
    written = text.partition(":=")[2]
    return f"{name}:={value}" if value != parse_scalar(written) and written else text


def _override(text: str) -> tuple[str, Any]:
    """Return name and value of ``name:=value``. Raises InputError."""
    name, separator, written = text.partition(":=")
    if not separator:
        raise InputError(f"{text!r}: give parameters as name:=value")
    value = parse_scalar(written)
    if name in SCHEMA and SCHEMA[name].unit == "rad":
        value = _in_radians(value)
    return name, "" if value is None else value


_DEGREES = re.compile(r"([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?:deg|°)$")


def _in_radians(value: Any) -> Any:
    """Convert angles to radians: 45deg to a number, a text of several to a list; other values are unchanged."""
    if isinstance(value, str):
        parts = re.sub(r"\s+(?=deg|°)", "", value).replace(",", " ").split()
        return [_number_or_degrees(part) for part in parts] if len(parts) > 1 else _number_or_degrees(value)
    return [_number_or_degrees(element) for element in value] if isinstance(value, list) else value


def _number_or_degrees(value: Any) -> Any:
    """Return a text such as ``90 deg`` as radians, or as a number; other values unchanged."""
    if not isinstance(value, str):
        return value
    found = _DEGREES.match(value.strip())
    try:
        return math.radians(float(found[1])) if found else float(value)
    except ValueError:
        return value


def _node_parameters(path: Path, text: str | None = None) -> dict[str, Any]:
    """Return this node's parameters in a ROS parameter file, without use_sim_time and the like."""
    sections = _own_sections(path, NODE_NAME, section_is_ours, text)
    values: dict[str, Any] = {}
    for _, body in sections:
        values.update(body)
    others = _names_for_all_nodes(sections)
    return {name: value for name, value in values.items() if not is_ros_parameter(name) and name not in others}


def names_of_others(path: Path, node: str) -> set[str]:
    """Return the unknown parameters that a ROS 2 parameter file sets for all nodes.

    Parameters
    ----------
    path: The file.
    node: Full name of the running node, such as /auv/dvl_calibration.

    Raises
    ------
    InputError: If the file has nothing for this node, which would then use its defaults, or is no parameter file.
    """
    return _names_for_all_nodes(_own_sections(path, node, lambda section: _matches(_tokens(section), _tokens(node))))


def _own_sections(
    path: Path, node: str, is_own: Callable[[str], bool], text: str | None = None
) -> list[tuple[str, dict[str, Any]]]:
    """Return the parameters that apply to the node, by section. Raises InputError if there are none."""
    content = load_yaml(path, "ROS 2 parameter file", text)
    if not isinstance(content, dict):
        raise InputError(f"{path}: no ROS 2 parameter file; it begins with '/**:', then 'ros__parameters:'")
    sections = [found for key, section in content.items() for found in _sections(str(key), section)]
    own_sections = [(name, body) for name, body in sections if is_own(name)]
    for name, body in own_sections:
        if not isinstance(body, dict):
            raise InputError(f"{path}: ros__parameters of {name} is not a list of name: value")
    if not sections:
        remedy = "put parameters under '/**:' and 'ros__parameters:'"
        if str(content.get("format")).startswith("dvl_calib_ros result"):
            remedy = "it is a result file, which -p initial_calibration:=FILE and dvl-calib apply take"
        raise InputError(f"{path}: no ros__parameters in it; {remedy}")
    if not own_sections:  # ROS would silently use the defaults
        others = ", ".join(name for name, _ in sections)
        raise InputError(f"{path}: nothing in it is for node {node}, only for {others}; name '/**:' or the node")
    return [(name, _flattened(body)) for name, body in own_sections]


def _names_for_all_nodes(sections: Sequence[tuple[str, Mapping[str, Any]]]) -> set[str]:
    """Return unknown names that are set for all nodes, except likely misspellings of ours."""
    for_all = {name for section, body in sections if "*" in _tokens(section)[-1] for name in body}
    ours = {name for section, body in sections if "*" not in _tokens(section)[-1] for name in body}
    return {
        name
        for name in for_all - ours
        if name not in SCHEMA and not is_ros_parameter(name)
        and not difflib.get_close_matches(str(name), SCHEMA, n=1, cutoff=MISSPELT)
    }  # fmt: skip


def _tokens(name: str) -> list[str]:
    return name.strip("/").split("/")


def _matches(section: Sequence[str], node: Sequence[str]) -> bool:
    """Return whether a section's name matches a node's by rcl's rules: * is one token, ** any number."""
    if not section:
        return not node
    if section[0] == "**":
        return any(_matches(section[1:], node[at:]) for at in range(len(node) + 1))
    return bool(node) and section[0] in ("*", node[0]) and _matches(section[1:], node[1:])


def is_ros_parameter(name: str) -> bool:
    """Return whether a parameter is rclpy's own."""
    return name.split(".")[0] in ROS_PARAMETERS


def _sections(prefix: str, section: Any) -> list[tuple[str, Any]]:
    """Return (node, parameters) pairs of a file, with namespaces written nested or as a path."""
    if not isinstance(section, dict):
        return []
    found = []
    for key, value in section.items():
        if key == "ros__parameters":
            found.append((prefix, value))
        else:
            found += _sections(f"{prefix}/{str(key).strip('/')}", value)
    return found


def section_is_ours(node: str) -> bool:
    """Return whether a section's name (with wildcards * and **) can be this node's, in any namespace."""
    return fnmatch.fnmatchcase(NODE_NAME, node.rsplit("/", 1)[-1])


def _flattened(body: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Join nested mappings into one, with names separated by dots."""
    values: dict[str, Any] = {}
    for key, value in body.items():
        name = f"{prefix}{key}"
        values |= _flattened(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return values


def changed_parameters(parameters: Parameters) -> dict[str, Any]:
    """Return name -> value of parameters not at their defaults, as `Parameters.as_dict`."""
    default = Parameters().as_dict()
    return {name: value for name, value in parameters.as_dict().items() if value != default[name]}


def parameter_file_text() -> str:
    """Return `config/calibration.yaml`: every parameter at its default, with its description."""
    lines = [
        "# Every parameter of dvl_calib_ros at its default. An ordinary ROS 2 parameter file:",
        "#   ros2 run dvl_calib_ros calibration_node --ros-args --params-file vehicle.yaml",
        "#   dvl-calib replay BAG --params vehicle.yaml",
        "/**:",
        "  ros__parameters:",
    ]
    for name, spec in SCHEMA.items():
        about = "; ".join(part for part in (spec.unit, ", ".join(spec.choices), _range(name)) if part)
        lines.append(f"    # {spec.description}" + (f" [{about}]" if about else ""))
        value = list(spec.default) if isinstance(spec.default, tuple) else spec.default
        lines.append(f"    {name}: {as_yaml(value)}")
    return "\n".join(lines) + "\n"


def parameter_table() -> str:
    """Return the documentation's table of parameters, in Markdown."""
    lines = ["| parameter | default | unit, range | meaning |", "|---|---|---|---|"]
    for name, spec in SCHEMA.items():
        about = " ".join(part for part in (spec.unit, ", ".join(spec.choices), _range(name)) if part)
        at_run_time = "" if spec.read_only else " *"
        lines.append(f"| `{name}`{at_run_time} | {_default_text(spec.default)} | {about} | {spec.description} |")
    return "\n".join(lines) + "\n"


def model_table() -> str:
    """Return the documentation's table of models, in Markdown."""
    lines = ["| model | assumes | is wrong |", "|---|---|---|"]
    for model in MODELS.values():
        lines.append(f"| {model.name} | {model.assumes} | {model.wrong_when} |")
    return "\n".join(lines) + "\n"


def _default_text(default: Any) -> str:
    """Return a default value as text for the table of parameters."""
    if isinstance(default, tuple):
        return " ".join(f"{value:g}" for value in default)
    if isinstance(default, bool):
        return str(default).lower()
    return f"{default:.6g}" if isinstance(default, float) else default or "''"


def _range(name: str) -> str:
    spec = SCHEMA[name]
    return "" if spec.low is None or spec.high is None else f"{spec.low:.4g} .. {spec.high:.4g}"


def as_yaml(value: Any) -> str:
    """Format a value as YAML on one line; doubles keep a decimal point, because ROS distinguishes integers."""
    return str(yaml.safe_dump(value, default_flow_style=True, width=10_000)).removesuffix("...\n").strip()


def with_parameters(path: Path, values: Mapping[str, Any]) -> bytes:
    """Return the content of a parameter file with these values for our node added or replaced.

    Raises InputError if it is no parameter file of ours, or cannot be edited in place.
    """
    before = load_parameters(path)
    content = path.read_bytes()
    text = content.decode("utf-8")
    sections = list(_own_mappings(compose_yaml(text), ""))
    existing = [(key.value, node) for section in sections for key, node in section.value]
    changes = [(*_span(node), as_yaml(values[name])) for name, node in existing if name in values]
    new = {name: as_yaml(value) for name, value in values.items() if name not in dict(existing)}
    if new:
        changes.append(_insertion(text, sections[-1], new))
    for start, end, value in sorted(changes, reverse=True):
        text = text[:start] + value + text[end:]
    try:
        found = load_parameters(path, text=text)
    except InputError:
        found = None
    if found != before.replace(**values):  # an unforeseen feature of YAML
        names = ", ".join(f"{name}: {as_yaml(value)}" for name, value in values.items())
        raise InputError(f"{path}: cannot be edited in place; write into it by hand: {names}")
    return text.encode()


def _own_mappings(node: Any, prefix: str) -> Iterator[Any]:
    """Yield the mappings of our node's parameters, in the order of the file."""
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        if key.value == "ros__parameters":
            if section_is_ours(prefix) and isinstance(value, yaml.MappingNode):
                yield value
        else:
            yield from _own_mappings(value, f"{prefix}/{str(key.value).strip('/')}" if prefix else str(key.value))


def _span(node: Any) -> tuple[int, int]:
    """Return start and end of a value; a list over several lines ends with its last item."""
    last = node.value[-1] if isinstance(node, yaml.SequenceNode) and not node.flow_style and node.value else node
    return node.start_mark.index, last.end_mark.index


def _insertion(text: str, section: Any, values: Mapping[str, str]) -> tuple[int, int, str]:
    """Return an edit that inserts parameters at the start of a section."""
    entries = [f"{name}: {value}" for name, value in values.items()]
    if section.flow_style or not section.value:
        at = section.start_mark.index + 1
        return at, at, ", ".join([*entries, ""] if section.value else entries)
    first = section.value[0][0].start_mark
    at = first.index - first.column
    return at, at, "".join(f"{text[at : first.index]}{entry}\n" for entry in entries)


def new_file(parameters: Parameters, changed: Mapping[str, Any], says: str) -> bytes:
    """Return a parameter file with the values that are not defaults. says: text of its first line, a comment."""
    values = changed_parameters(parameters.replace(**changed))
    lines = [f"# {says}", "/**:", "  ros__parameters:"]
    return "\n".join([*lines, *(f"    {key}: {as_yaml(value)}" for key, value in values.items()), ""]).encode()
