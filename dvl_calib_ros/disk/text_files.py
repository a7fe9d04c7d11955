"""Size-limited reading of files, and JSON output."""

from __future__ import annotations

import json
import math
import os
import re
import stat
from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError
from .atomic import save_text

# Safe loading of YAML, with the numbers and texts of ROS 2.


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """A SafeLoader that reads scalars like rcl's YAML parser.

    1e-3 is a number (YAML 1.1 wants 1.0e-3), 2026-05-01 is text (YAML 1.1 has dates). Aliases are refused: a few nested
    aliases can expand to more than the memory. Duplicate keys are refused: ROS merges two sections of a node, PyYAML
    keeps only the last.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        if yaml.__with_libyaml__:  # four times faster, and ROS uses the same parser
            events = yaml.cyaml.CParser(text)
            self.check_event, self.peek_event = events.check_event, events.peek_event
            self.get_event = events.get_event

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases, which can expand to any size."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "write it out, without aliases (*name)", mark)
        return super().compose_node(parent, index)

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Refuse a mapping with the same key twice."""
        node = super().compose_mapping_node(anchor)
        lines: dict[tuple[str, str], int] = {}
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            name = (key.tag, key.value)
            if name in lines:
                problem = f"{key.value!r} is there twice, first in line {lines[name]}; keep one"
                raise yaml.composer.ComposerError(None, None, problem, key.start_mark)
            lines[name] = key.start_mark.line + 1
        return node


# Numbers for rcl's parser. YAML 1.1 has more: 1:30 is ninety, 1_0 is ten.
_NUMBERS = {
    "int": (r"[-+]?(?:0|[1-9]\d*|0[0-7]+|0x[\da-fA-F]+)$", "-+0123456789"),
    "float": (
        r"[-+]?(?:(?:\d+\.\d*|\.\d+)(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+|\.(?:inf|Inf|INF))$|\.(?:nan|NaN|NAN)$",
        "-+.0123456789",
    ),
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag.rpartition(":")[2] not in (*_NUMBERS, "timestamp")]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}
for _name, (_pattern, _first) in _NUMBERS.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(_pattern), list(_first))


def parse_scalar(text: str) -> Any:
    """Parse a value as written after ``name:=``. Invalid YAML is returned as text."""
    try:
        return yaml.load(text, Loader=_Loader)  # a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError):
        return text


def compose_yaml(text: str) -> Any:
    """Return the YAML nodes with their positions in the text. The text must be valid for `load_yaml`."""
    return yaml.compose(text, Loader=_Loader)  # a SafeLoader


def load_yaml(path: Path, what: str, text: str | None = None) -> Any:
    """Load a YAML file. Raises InputError with the file, the line and `what` the file should be.

    text: content to parse instead of the file's current content.
    """
    content = read_file(path, what) if text is None else None
    try:
        if content is not None:
            text = content.decode("utf-8")
        return yaml.load(text, Loader=_Loader)  # a SafeLoader
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no {what}, because it is not text ({error})") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        where = " ".join(str(error).split()).replace('in "<unicode string>", line', "in line")
        raise InputError(f"{path}: no {what}, because it is not valid YAML: {where}") from error


def as_json(document: Any) -> str:
    """Format as JSON; numbers that are not finite become null."""
    return json.dumps(_finite(document), indent=1, allow_nan=False) + "\n"


def write_json(path: Path, document: Any) -> None:
    """Write JSON atomically. Raises InputError."""
    save_text(path, as_json(document))


def _finite(value: Any) -> Any:
    """Replace numbers that are not finite by None, in nested data."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# A result file has about 10 kB. A much larger file is not one, and would take minutes to parse.
LARGEST_FILE = 1 << 22


def read_file(path: Path, what: str, largest: int = LARGEST_FILE) -> bytes:
    """Read a file. `what` names its kind in errors.

    Raises InputError if it cannot be read, is too large, or is a pipe or device, which might block forever.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            mode = os.fstat(handle).st_mode
            if not stat.S_ISREG(mode):
                what_it_is = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
                raise InputError(f"{path}: cannot be read as {what}, it is {what_it_is}; name a file")
            with open(handle, "rb", closefd=False) as file:
                content = file.read(largest + 1)
        finally:
            os.close(handle)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such {what}") from None
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise InputError(f"{path}: cannot be read as {what} ({why})") from error
    if len(content) > largest:
        raise InputError(f"{path}: is too large for a {what}, which has {largest >> 20} MB at most; name another")
    return content
