"""How far an IMU's heading is to be believed, by what its messages claim of it."""

from __future__ import annotations

import math

# What an IMU claims of its heading (rad) is believed between these: few are as good as the first, and one that claims
# more than the second says that it does not know.
BEST_HEADING, WORST_HEADING = math.radians(0.1), math.radians(10.0)


def believed_heading(claimed_std: float) -> float | None:
    """`heading_deviation_std` (rad) by a claimed σ of the heading (rad, nan for none); None where that says nothing."""
    return float(f"{max(claimed_std, BEST_HEADING):.2g}") if claimed_std <= WORST_HEADING else None
