"""Pictures of a fleet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..fleet.history import CompassDeviation
from .fleet import deviation, largest
from .style import Picture, legend_above, new_figure, picture


def compass(known: Sequence[tuple[str, CompassDeviation]]) -> list[Picture]:
    """Deviation of the heading against the heading, a line a vehicle."""
    told = "; ".join(f"{name} up to {largest(heading):.2f}°" for name, heading in known)
    return [picture("Deviation, °", f"Deviation of the heading by heading: {told}", _draw, known)]


def _draw(known: Sequence[tuple[str, CompassDeviation]]) -> Figure:
    figure, axes = new_figure()
    north = np.linspace(0.0, 360.0, 181)
    for name, heading in known:
        axes.plot(north, deviation(heading, 0.5 * math.pi - np.radians(north)), label=name)
    axes.set_xlabel("heading from north, clockwise, °")
    axes.set_xlim(0.0, 360.0)
    axes.set_xticks(range(0, 361, 45))
    axes.set_ylabel("deviation, °")
    legend_above(axes)
    return figure
