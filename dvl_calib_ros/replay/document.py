"""A replay as plain data: what `replay --json` writes, but for what discovery says."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from .. import __version__
from ..calibration.comparison_words import comparison_document
from ..calibration.navigation import navigation_document
from ..calibration.verification import verification_document
from ..calibration.water import water_document
from ..files.result_file import days_document, estimate_document
from .replay import Replayed


def replay_document(replayed: Replayed, models: Sequence[str]) -> dict[str, Any]:
    """Plain data of a replay, of the models asked for. Segments are in s since the first DVL sample."""
    result = replayed.result
    told = [name for name in models if name in result.estimates]
    segments = []
    with suppress(TypeError):  # no sample at all: first_ns is None and there are no segments
        ends = [segment.from_ns for segment in result.segments[1:]] + [result.last_ns]
        segments = [
            {
                "from_s": (segment.from_ns - result.first_ns) * 1e-9,  # type: ignore[operator]
                "to_s": (end - result.first_ns) * 1e-9,  # type: ignore[operator]
                "model": segment.model,
            }
            for segment, end in zip(result.segments, ends, strict=True)
        ]
    return {
        "models": {name: estimate_document(result.estimates[name]) for name in told},
        "verification": {name: verification_document(result.verifications[name]) for name in told},
        "selected": segments,
        **days_document(result),
        "counts": {name: dict(counts) for name, counts in result.counts.items()},
        "parameters": dict(result.parameters),
        "version": __version__,
        "dvl": {"type": replayed.dvl_type, "turned_from_frd": replayed.turned},
        "findings": [found.as_dict() for found in replayed.findings],
        "recordings": None if replayed.recordings is None else comparison_document(replayed.recordings),
        "navigation": navigation_document(replayed.navigation),
        **({} if replayed.water is None else {"water": water_document(replayed.water)}),
    }
