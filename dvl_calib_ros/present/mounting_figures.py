"""How the DVL sits on the vehicle: its axes as configured and as found, from above and from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ..calibration.extrinsics import rotation_of, turn_between
from ..calibration.frames import Array, rotation_from_rpy
from ..calibration.parameters import Parameters
from ..calibration.results import Result
from .replay_figures import AFTER
from .style import FAINT, INK, Picture, legend_above, new_figure, picture

# A turn is drawn as large as this (rad) if it is smaller, by a whole number of times up to so many: 1° is not seen.
_SEEN, _MOST_TIMES = math.radians(12.0), 20
# Length of a vehicle whose DVL is in its middle, and of the axes drawn, m and a share of it; its height by its length
_LENGTH, _AXIS, _SLENDER = 2.0, 0.25, 0.3
# Two axes of the body, what the second is called, and who looks along the third
_VIEWS = ((0, 1, "to port", "from above"), (0, 2, "up", "from starboard"))


def mounting_pictures(result: Result) -> list[Picture]:
    """From above and from the side; the place is drawn where it is known."""
    parameters = Parameters.from_mapping(result.parameters)
    nominal = rotation_from_rpy(parameters.mounting_rpy)
    found = result.estimate.rotation_body_from_dvl(nominal.T)
    turn = turn_between(nominal, found)
    angle = float(np.linalg.norm(turn))
    times = int(np.clip(round(_SEEN / max(angle, 1e-9)), 1, _MOST_TIMES))
    place = result.position_in_body
    how = f"The turn of {math.degrees(angle):.2f}° is drawn {times} times as large." if times > 1 else "True to scale."
    if place is None:
        how += " Where the DVL sits is not known: drawn in the middle."
    return [
        picture(
            f"DVL on the vehicle, {where}", f"Axes of the DVL as configured and as found, {where}. {how}",
            _view, (across, up, name), nominal, rotation_of(times * turn) @ nominal, place or (0.0, 0.0, 0.0),
            caption=how,
        )
        for across, up, name, where in _VIEWS
    ]  # fmt: skip


def _view(axes_of: tuple[int, int, str], nominal: Array, found: Array, place: Sequence[float]) -> Figure:
    across, up, name = axes_of
    figure, axes = new_figure(height=2.6)
    length = max(_LENGTH, 2.4 * float(np.abs(place).max()))
    axes.add_patch(Ellipse((0.0, 0.0), length, _SLENDER * length, facecolor="#f1f3f5", edgecolor=FAINT))
    axes.annotate(
        "", (0.62 * length, 0.0), (0.5 * length, 0.0), arrowprops={"arrowstyle": "-|>", "color": FAINT, "lw": 1.5}
    )
    axes.text(0.64 * length, 0.0, "ahead", va="center", fontsize=8.0, color=INK)
    for rotation, colour, label in ((nominal, FAINT, "as configured"), (found, AFTER, "as found")):
        _axes_of_dvl(axes, rotation[[across, up]], (place[across], place[up]), _AXIS * length, colour, label)
    axes.set_xlim(-0.6 * length, 0.85 * length)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("ahead, m")
    axes.set_ylabel(f"{name}, m")
    legend_above(axes)
    return figure


def _axes_of_dvl(axes: Axes, ends: Array, at: tuple[float, float], length: float, colour: str, label: str) -> None:
    """Axes of a DVL, ends (2, 3) in this view, from where it is; one that points at who looks is left out."""
    for index, axis in enumerate("xyz"):
        along = length * ends[:, index]
        if float(np.hypot(*along)) < 0.3 * length:
            continue
        tip = at[0] + along[0], at[1] + along[1]
        axes.annotate("", tip, at, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.8})
        if colour == AFTER:
            axes.text(at[0] + 1.15 * along[0], at[1] + 1.15 * along[1], axis, color=colour, ha="center", va="center")
    axes.plot([], [], color=colour, label=label)
    axes.plot(*at, "o", color=colour, markersize=4.0)
