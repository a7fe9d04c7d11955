"""Parameters set in a ROS 2 parameter file that somebody wrote by hand, with every other byte kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..calibration.parameters import Parameters
from ..disk.yaml_files import compose_yaml
from ..errors import InputError
from .parameter_files import load_parameters, section_is_ours


def as_yaml(value: Any) -> str:
    """A value as YAML on one line; doubles keep a decimal point, without which ROS takes them for integers."""
    return str(yaml.safe_dump(value, default_flow_style=True, width=10_000)).removesuffix("...\n").strip()


def with_parameters(path: Path, values: Mapping[str, Any]) -> bytes:
    """The content of a parameter file, with these values for our node instead of, or beside, those that it has.

    Raises InputError for what is no parameter file of ours, or cannot be edited in place.
    """
    before = load_parameters(path)
    content = path.read_bytes()
    text = content.decode("utf-8")
    sections = list(_own(compose_yaml(text), ""))
    there = [(key.value, node) for section in sections for key, node in section.value]
    changes = [(*_span(node), as_yaml(values[name])) for name, node in there if name in values]
    new = {name: as_yaml(value) for name, value in values.items() if name not in dict(there)}
    if new:
        changes.append(_added(text, sections[-1], new))
    for start, end, value in sorted(changes, reverse=True):
        text = text[:start] + value + text[end:]
    try:
        found = load_parameters(path, text=text)
    except InputError:
        found = None
    if found != before.replace(**values):  # by something that YAML can do and is not thought of here
        names = ", ".join(f"{name}: {as_yaml(value)}" for name, value in values.items())
        raise InputError(f"{path}: cannot be edited in place; write into it by hand: {names}")
    return text.encode()


def _own(node: Any, prefix: str) -> Iterator[Any]:
    """Mappings of parameters that are for our node, in the order of the file."""
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        if key.value == "ros__parameters":
            if section_is_ours(prefix) and isinstance(value, yaml.MappingNode):
                yield value
        else:
            yield from _own(value, f"{prefix}/{str(key.value).strip('/')}" if prefix else str(key.value))


def _span(node: Any) -> tuple[int, int]:
    """Where a value stands; a list over several lines ends with its last item."""
    last = node.value[-1] if isinstance(node, yaml.SequenceNode) and not node.flow_style and node.value else node
    return node.start_mark.index, last.end_mark.index


def _added(text: str, section: Any, values: Mapping[str, str]) -> tuple[int, int, str]:
    """What puts parameters in front of all others of a section."""
    entries = [f"{name}: {value}" for name, value in values.items()]
    if section.flow_style or not section.value:
        at = section.start_mark.index + 1
        return at, at, ", ".join([*entries, ""] if section.value else entries)
    first = section.value[0][0].start_mark
    at = first.index - first.column
    return at, at, "".join(f"{text[at : first.index]}{entry}\n" for entry in entries)


def new_file(parameters: Parameters, changed: Mapping[str, Any], says: str) -> bytes:
    """A parameter file with what is not at its default. says: its first line, a comment."""
    default = Parameters().as_dict()
    values = {key: value for key, value in parameters.replace(**changed).as_dict().items() if value != default[key]}
    lines = [f"# {says}", "/**:", "  ros__parameters:"]
    return "\n".join([*lines, *(f"    {key}: {as_yaml(value)}" for key, value in values.items()), ""]).encode()
