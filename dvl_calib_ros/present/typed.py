"""Commands as they are typed, with the options that say what is calibrated."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path


def typed(command: str, bags: Iterable[Path], *options: object) -> str:
    """A line to type."""
    return shlex.join(["dvl-calib", *command.split(), *map(str, bags), *map(str, options)])


def options(
    topics: Iterable[tuple[str, str | None]], overrides: Iterable[str], parameters: Path | None = None
) -> list[str]:
    """What names topics (role and name, None for those that are found) and parameters."""
    words = [] if parameters is None else ["--params", str(parameters)]
    words += [word for override in overrides for word in ("-p", override)]
    return words + [word for role, name in topics if name is not None for word in (f"--{role}-topic", name)]
