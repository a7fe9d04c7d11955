"""Remedies as a user carries them out: the options in their text, and what they set."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.verdict.kinds import Kind
from dvl_calib_ros.verdict.reasons import Reason

NAMES = {each.name for each in fields(Parameters)}
VALUE = r"(\[[^\]]*\]|[^\s,;)]+)"
OPTION = re.compile(rf"-p (\w+):={VALUE}|\b(\w+) to {VALUE}|--(restamp) {VALUE}")
# an alternative, for another cause
OR = re.compile("; |, or ")


def options(remedy: str) -> dict[str, Any]:
    """Return the parameters that the first part of a remedy with any sets, by name."""
    for part in OR.split(remedy):
        pairs = [[text for text in each if text] for each in OPTION.findall(part)]
        if found := [f"{name}:={value}" for name, value in pairs if name in NAMES]:
            parameters = load_parameters(None, found)
            return {name: getattr(parameters, name) for name, _ in pairs if name in NAMES}
    return {}


def changes(remedy: str, parameters: Parameters) -> dict[str, Any]:
    """Return the parameters that a remedy sets, all of which have another value so far."""
    found = options(remedy)
    assert found, f"no option in: {remedy}"
    same = [name for name, value in found.items() if getattr(parameters, name) == value]
    assert not same, f"{remedy}: {', '.join(same)} already set"
    return found


def is_typed(kind: Kind) -> bool:
    """Return whether a remedy gives a value of a parameter: the rest is done by a person."""
    named = OPTION.findall(kind.remedy.replace("{parameter}", "model"))
    return any(name in NAMES for each in named for name in each)


def causes(reasons: Iterable[Reason]) -> list[Reason]:
    """Reasons, and all that these hold."""
    return [each for reason in reasons for each in (reason, *causes(reason.causes))]
