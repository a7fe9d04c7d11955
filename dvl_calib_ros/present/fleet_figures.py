"""Pictures of a fleet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..fleet_catalogue.vehicle_history import CompassDeviation
from .fleet import deviation
from .style import legend_above, new_figure


def compass(known: Sequence[tuple[str, CompassDeviation]]) -> Figure:
    """Deviation of the heading against the heading, a line a vehicle."""
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
