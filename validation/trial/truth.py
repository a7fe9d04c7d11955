"""What is true of a case: kept sealed from the diagnosis, and joined with its answer by the scorer."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError


class Category(str, Enum):
    """What a case tests."""

    NULL = "null"
    HARD_NULL = "hard_null"
    SINGLE = "single"
    PAIR = "pair"
    TRIPLE = "triple"
    UNKNOWN = "unknown"
    UNIDENTIFIABLE = "unidentifiable"


@dataclass(frozen=True)
class Truth:
    """The sealed truth of a case.

    id: as in the name of the bag, says nothing. key: says everything, and draws it again. family: as in `plan`. faults:
    name -> parameters, "seconds@1" being that of recording 1. q: of each fault, others beside it. distances: name of
    another fault of the library -> norm of what it leaves at best of the trace of that fault which it is nearest to.
    correlation: of a pair, at most. outside_share: of an unknown fault, what two of the library leave.
    hardness: of a hard null. twin: id of the same case with all axes. before_mps: error (rms) that the faults make
    beyond the calibration. noise_mps: error that the noise makes.
    """

    id: str
    category: Category
    kind: str
    key: str = ""
    family: str = "simulated"
    faults: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    q: Mapping[str, float] = field(default_factory=dict)
    q_wanted: float = 0.0
    distances: Mapping[str, float] = field(default_factory=dict)
    correlation: float | None = None
    outside_share: float | None = None
    hardness: str | None = None
    twin: str | None = None
    before_mps: float = 0.0
    noise_mps: float = 0.0
    scene: Mapping[str, Any] = field(default_factory=dict)


def seal(truth: Truth, folder: Path) -> None:
    """Write a truth to its file in a folder."""
    save_text(folder / f"{truth.id}.json", json.dumps(asdict(truth), indent=1) + "\n")


def unseal(folder: Path) -> dict[str, Truth]:
    """All truths of a folder by the id of their case. Raises InputError for a file that is none."""
    truths = {}
    for path in sorted(folder.glob("*.json")):
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            truths[path.stem] = Truth(**{**document, "category": Category(document["category"])})
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: no truth of a trial ({error}); remove it, the trial writes it anew") from error
    return truths
