"""A vehicle's topics and parameters, stored in a file and used by every command that takes them."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..standard_streams import say

IN_FOLDER = Path(".dvl-calib.yaml")
# Options that a profile may hold next to `parameters`. None names an output file.
OPTIONS = ("dvl-topic", "gnss-topic", "imu-topic", "params")


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add --profile."""
    parser.add_argument(
        "--profile", metavar="NAME",
        help="profile of topics and parameters: NAME.yaml in ~/.config/dvl-calib, or a file, or none for no profile; "
        f"default: {IN_FOLDER} of this folder",
    )  # fmt: skip


def with_profile(argv: Sequence[str], arguments: argparse.Namespace) -> list[str]:
    """Return a command line with the profile's options in front of its own, which override them.

    Prints the profile and its options on standard error. Raises InputError.
    """
    path = _profile_file(arguments.profile)
    if path is None:
        return [*argv]
    words = _profile_words(path)
    say(f"profile {path}: {shlex.join(words)}")
    after = list(argv).index(arguments.command) + 1
    return [*argv[:after], *words, *argv[after:]]


def _profile_file(name: str | None) -> Path | None:
    """Return the file of a profile, by default the one in the current folder, if any."""
    if name is None:
        return IN_FOLDER if IN_FOLDER.exists() else None
    if name == "none":
        return None
    if "/" in name or name.endswith(".yaml"):
        return Path(name)
    folder = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "dvl-calib"
    path = folder / f"{name}.yaml"
    if not path.exists():
        existing = ", ".join(sorted(each.stem for each in folder.glob("*.yaml"))) or "none"
        raise InputError(f"--profile: {path} does not exist; profiles there: {existing}")
    return path


def _profile_words(path: Path) -> list[str]:
    """Return a profile's content as command-line words. Raises InputError."""
    from ..disk.text_files import load_yaml
    from ..files.parameter_files import as_yaml

    content = load_yaml(path, "profile")
    allowed = (*OPTIONS, "parameters")
    if not isinstance(content, dict) or not content.keys() <= set(allowed):
        other = ", ".join(map(repr, content.keys() - set(allowed))) if isinstance(content, dict) else "no names"
        raise InputError(f"{path}: no profile ({other}); it holds {', '.join(allowed)}")
    parameters = content.pop("parameters", {})
    if not isinstance(parameters, dict):
        raise InputError(f"{path}: parameters is not a list of name: value")
    for name, value in content.items():
        if not isinstance(value, str):
            raise InputError(f"{path}: {name} is no text")
    if "params" in content:  # the path is relative to the profile
        content["params"] = path.parent / content["params"]
    words = [f"--{name}={value}" for name, value in content.items()]
    return words + [word for name, value in parameters.items() for word in ("-p", f"{name}:={as_yaml(value)}")]
