"""Recordings that are compared: each calibrated by itself, for what it says of the mounting."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ..calibration.extrinsics import Extrinsics
from ..calibration.parameters import Parameters
from ..errors import InputError
from ..recordings.recording import Recording
from ..recordings.topics import Topics
from .replay import extrinsics_of_replay, replay


class Calibrated(NamedTuple):
    """extrinsics: what a recording says. notes: in sentences, what of it is damaged or missing."""

    extrinsics: Extrinsics
    notes: list[str]


def calibrated(
    recording: Recording,
    parameters: Parameters,
    topics: Topics,
    name: str,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Calibrated:
    """Calibrate with a recording, which `name` names in what is said of it. Raises InputError."""
    replayed = replay(recording, parameters, topics, on_progress, judged=False)
    found = extrinsics_of_replay(replayed, name)
    if found is None:
        raise InputError(f"{name}: no sample of it could be used to calibrate; ask dvl-calib doctor")
    known = {str(each) for each in replayed.findings}
    return Calibrated(found, [note for note in replayed.notes if note not in known])
