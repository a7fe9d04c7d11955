"""Random surveys by physics of their own, through the command line: usable and wrong, right and rejected.

Each survey is a process of its own; what is done is kept in --results and not done again. Wrong is yaw off by more than
3 sigma and 0.5 degrees, or pitch by more than 3 sigma and 0.7 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..drawn import Judge, Result
from .physics import DECLINATION, DVL_BIAS_STD, draw, write_survey


def _write(seed: int, path: Path) -> Result:
    return write_survey(draw(seed, DVL_BIAS_STD, DECLINATION), path)


def _said(drawn: Mapping[str, Any]) -> str:
    what = [drawn["manoeuvre"], drawn["reference"], "tf" if drawn["transform"] else "no tf"]
    what += [
        f"{name} {drawn[name]:.2f}" for name in ("dvl_late", "reference_late", "compass", "declination") if drawn[name]
    ]
    what += ["lasting noise"] * drawn["lasting"] + ["antenna"] * any(drawn["antenna"])
    return f"{', '.join(what)}; mounted at {drawn['mounting_yaw']:g}"


SURVEYS = Judge("surveys", 23_000, _write, (math.inf, 0.7, 0.5, math.inf), _said)


def main(argv: Sequence[str]) -> int:
    """0; 2 for a wrong call."""
    return SURVEYS.main(argv, __doc__)
