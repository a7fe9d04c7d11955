"""YAML, safely loaded, with the numbers and texts that ROS 2 takes for such."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """SafeLoader that takes scalars for what rcl's YAML parser does.

    1e-3 is a number (YAML 1.1 wants 1.0e-3), 2026-05-01 is text (YAML 1.1 has dates). Aliases are refused: a few lines
    of them that refer to each other stand for more than fits in memory.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "write it out, without aliases (*name)", mark)
        return super().compose_node(parent, index)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}


def parse_scalar(text: str) -> Any:
    """A value as written after ``name:=``; text that is no YAML is text."""
    try:
        return yaml.load(text, Loader=_Loader)  # a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError):
        return text


def compose_yaml(text: str) -> Any:
    """The nodes of YAML, which know where in the text they stand; of text that `load_yaml` takes."""
    return yaml.compose(text, Loader=_Loader)  # a SafeLoader


def load_yaml(path: Path, what: str, text: str | None = None) -> Any:
    """Content of a YAML file. Raises InputError naming the file, the line and what the file should have been.

    text: what is to be read instead of what the file holds now.
    """
    try:
        if text is not None:
            return yaml.load(text, Loader=_Loader)  # a SafeLoader
        with path.open(encoding="utf-8") as file:
            return yaml.load(file, Loader=_Loader)  # a SafeLoader
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read as {what} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no {what}, not text: {error}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        where = " ".join(str(error).split())
        raise InputError(f"{path}: no {what}, not valid YAML: {where}") from error
