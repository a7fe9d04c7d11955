"""Pictures of a comparison and of a fleet: every quantity over time, with a line at each change."""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from ..calibration.comparison.mounting_change import Change, Comparison
from ..calibration.results.extrinsics import N_COMPONENTS, Extrinsics
from ..fleet_catalogue.update import CompassDeviation
from .comparison import ComparedQuantity, deviation, shown_quantities
from .figure_style import INK, Picture, drawing, legend_above, new_figure, picture

_POINT, _MOVED = "#1f6fb2", "#c0392b"
PANEL_WIDTH, PANEL_HEIGHT = 4.6, 2.3
PNG_DPI = 160
# with more calibrations than these the alternative text has only the first and the last
MOST_LISTED = 20


def trend(comparison: Comparison, components: Collection[int] = range(N_COMPONENTS)) -> list[Picture]:
    """Draw every quantity observable in two calibrations, one picture each. components: restrict to these."""
    pictures = []
    for quantity in (each for each in shown_quantities(comparison) if each.component in components):
        known = [each for each in comparison.calibrations if each.shown[quantity.component]]
        values_text = ", ".join(
            "{} {:+.2f} ± {:.2f}".format(each.name, *quantity.of(each))
            for each in (known if len(known) <= MOST_LISTED else (known[0], known[-1]))
        )
        values_text += f", and {len(known) - 2} between them" if len(known) > MOST_LISTED else ""
        alt = f"{quantity.name} over time, in {quantity.unit}: {values_text}"
        pictures.append(picture(f"{quantity.name.capitalize()}, {quantity.unit}", alt, _panel, comparison, quantity))
    return pictures


def trend_png(comparison: Comparison) -> bytes:
    """Draw every observable quantity over time, as one PNG."""
    with drawing():
        quantities = shown_quantities(comparison)
        columns = 2 if len(quantities) > 1 else 1
        rows = -(-len(quantities) // columns)
        figure = Figure(figsize=(columns * PANEL_WIDTH, rows * PANEL_HEIGHT))
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, quantity in zip(grid.flat, quantities, strict=False):
            _draw_quantity(axes, comparison, quantity)
        for axes in list(grid.flat)[len(quantities) :]:
            axes.set_axis_off()
        target = io.BytesIO()
        figure.savefig(target, format="png", dpi=PNG_DPI)
    return target.getvalue()


def _panel(comparison: Comparison, quantity: ComparedQuantity) -> Figure:
    figure, axes = new_figure(height=PANEL_HEIGHT)
    _draw_quantity(axes, comparison, quantity)
    return figure


def _draw_quantity(axes: Axes, comparison: Comparison, quantity: ComparedQuantity) -> None:
    """Draw one quantity over time with ±1σ, and a line at each change."""
    known = [each for each in comparison.calibrations if each.shown[quantity.component]]
    # calibrations that follow each other; simulated ones may have equal stamps
    dated = all(before.last_ns <= after.first_ns for before, after in pairwise(comparison.calibrations))
    order = {id(each): index for index, each in enumerate(comparison.calibrations)}
    value, std = np.array([quantity.of(each) for each in known]).T
    at = [_middle_day(each) if dated else float(order[id(each)]) for each in known]
    axes.errorbar(at, value, std, fmt="o", color=_POINT, markersize=4.0, capsize=2.5, elinewidth=1.2)
    changes: Sequence[Change] = getattr(comparison, quantity.changes)
    for index, change in enumerate(changes):
        ends = [_middle_day(each) if dated else order[id(each)] for each in (change.last_before, change.first_after)]
        label = "changed" if index == 0 else None
        axes.axvline(sum(ends) / 2.0, color=_MOVED, linewidth=1.2, linestyle="--", label=label)
    if dated:
        # seven dates fit next to each other; with a minimum of three, matplotlib finds an interval for every span
        locator = AutoDateLocator(minticks=3, maxticks=7)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    else:
        names = [each.name for each in comparison.calibrations]
        labels = [name if len(name) <= 16 else f"{name[:7]}…{name[-8:]}" for name in names]
        axes.set_xticks(range(len(names)), labels, rotation=30, ha="right")
        axes.set_xlim(-0.5, len(names) - 0.5)
    axes.margins(y=0.25)
    axes.set_ylabel(f"{quantity.name}, {quantity.unit}", color=INK)
    if changes:
        axes.legend(loc="best")


def _middle_day(each: Extrinsics) -> float:
    """Return the middle in days since 1970, matplotlib's unit of dates."""
    return 0.5 * (each.first_ns + each.last_ns) * 1e-9 / 86400.0


def compass(known: Sequence[tuple[str, CompassDeviation]]) -> Figure:
    """Draw the deviation over the heading, one line per vehicle."""
    figure, axes = new_figure(xlabel="heading from north, clockwise, °", ylabel="deviation, °")
    north = np.linspace(0.0, 360.0, 181)
    for name, heading in known:
        axes.plot(north, deviation(heading, 0.5 * math.pi - np.radians(north)), label=name)
    axes.set_xlim(0.0, 360.0)
    axes.set_xticks(range(0, 361, 45))
    legend_above(axes)
    return figure
