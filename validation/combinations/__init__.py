"""Random combinations on the traps' physics, through the command line: usable and wrong, right and rejected.

The physics is the shared folder's (cases/traps/phys.py; DVL_CALIB_SHARED, else ../shared), which was not made with this
package. Wrong is an angle off by more than 3 sigma and 0.5 degrees, or a scale by more than 3 sigma and 0.5 percent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..drawn import Judge
from .recordings import physics_path, write_combination


def _said(drawn: Mapping[str, Any]) -> str:
    size = f" {drawn['size']}" if drawn["size"] else ""
    return f"{drawn['manoeuvre']} {drawn['seconds']:g} s, {drawn['defect']}{size}; mounted at {drawn['nominal']}"


COMBINATIONS = Judge("combinations", 0, write_combination, (0.5, 0.5, 0.5, 0.5), _said)


def main(argv: Sequence[str]) -> int:
    """0, also if the physics is not there; 2 for a wrong call."""
    if not physics_path().exists():
        print(f"skipped: {physics_path()} is not there (set DVL_CALIB_SHARED)")
        return 0
    return COMBINATIONS.main(argv, __doc__)
