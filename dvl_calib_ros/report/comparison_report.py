"""The report of a comparison: `dvl-calib compare --report out.html`, or the trend alone as a picture, out.png."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from ..calibration.comparison import (
    MOUNTING,
    Change,
    ChiSquare,
    Comparison,
    Difference,
)
from ..calibration.comparison_words import date, reasons, remarks
from ..calibration.extrinsics import Extrinsics
from ..calibration.frames import Array, rpy_from_rotation
from ..disk.atomic import save_bytes
from .page import Table, signed, write_page
from .style import INK, Picture, drawing, new_figure, picture

_DEGREE = math.degrees(1.0)
_POINT, _MOVED = "#1f6fb2", "#c0392b"
PANEL_WIDTH, PANEL_HEIGHT = 4.6, 2.3
PNG_DPI = 160


class _Quantity(NamedTuple):
    """What is drawn over time. component: its index in `COMPONENTS`. factor: from SI. changes: of `Comparison`."""

    component: int
    name: str
    unit: str
    factor: float
    changes: str


QUANTITIES = (
    _Quantity(0, "roll", "°", _DEGREE, "moved"),
    _Quantity(1, "pitch", "°", _DEGREE, "moved"),
    _Quantity(2, "yaw", "°", _DEGREE, "moved"),
    _Quantity(3, "lever arm x", "m", 1.0, "moved"),
    _Quantity(4, "lever arm y", "m", 1.0, "moved"),
    _Quantity(5, "lever arm z", "m", 1.0, "moved"),
    _Quantity(6, "scale", "%", 100.0, "scale_changed"),
    _Quantity(7, "stamps late", "s", 1.0, "clock_changed"),
)


def write_comparison_report(path: Path, comparison: Comparison) -> None:
    """Write the report (HTML), or the picture if `path` ends in .png. Raises InputError if it cannot be written."""
    if path.suffix.lower() == ".png":
        save_bytes(path, trend_png(comparison))
        return
    write_page(
        path,
        "comparison.html",
        {
            "title": "DVL calibrations compared",
            "subtitle": ", ".join(each.name for each in comparison.calibrations),
            "written": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC"),
            "verdict": {
                "word": "same mounting" if comparison.same_mounting else comparison.word,
                "kind": comparison.answer.severity.value,
                "reasons": [each.full_sentence for each in reasons(comparison)],
            },
            "warnings": [str(each) for each in remarks(comparison)],
            "pictures": [_picture(comparison, quantity) for quantity in _shown(comparison)],
            "calibrations": _calibrations(comparison),
            "pairs": _differences(
                comparison.pairs, [f"{each.first.name} → {each.second.name}" for each in comparison.pairs]
            ),
            "against_rest": _differences(
                comparison.against_rest, [each.second.name for each in comparison.against_rest]
            )
            if comparison.against_rest
            else None,
        },
    )


def trend_png(comparison: Comparison) -> bytes:
    """Every quantity that was shown over time, as one picture."""
    with drawing():
        quantities = _shown(comparison)
        columns = 2 if len(quantities) > 1 else 1
        rows = -(-len(quantities) // columns)
        figure = Figure(figsize=(columns * PANEL_WIDTH, rows * PANEL_HEIGHT))
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, quantity in zip(grid.flat, quantities, strict=False):
            _draw(axes, comparison, quantity)
        for axes in list(grid.flat)[len(quantities) :]:
            axes.set_axis_off()
        target = io.BytesIO()
        figure.savefig(target, format="png", dpi=PNG_DPI)
    return target.getvalue()


def _shown(comparison: Comparison) -> list[_Quantity]:
    """Quantities that two calibrations have shown at least."""
    return [each for each in QUANTITIES if sum(own.shown[each.component] for own in comparison.calibrations) > 1]


def _values(each: Extrinsics) -> Array:
    """(8,) in SI: roll, pitch, yaw, lever arm, scale, delay."""
    rpy = rpy_from_rotation(each.rotation_body_from_dvl)
    return np.array([*rpy, *each.lever_arm, each.scale, each.time_offset])


def _picture(comparison: Comparison, quantity: _Quantity) -> Picture:
    def draw() -> Figure:
        figure, axes = new_figure(height=PANEL_HEIGHT)
        _draw(axes, comparison, quantity)
        return figure

    at = quantity.component
    told = ", ".join(
        f"{each.name} {quantity.factor * _values(each)[at]:+.2f} ± {quantity.factor * each.std[at]:.2f}"
        for each in comparison.calibrations
        if each.shown[at]
    )
    title = f"{quantity.name.capitalize()}, {quantity.unit}"
    return picture(title, f"{quantity.name} over time, in {quantity.unit}: {told}", draw)


def _draw(axes: Axes, comparison: Comparison, quantity: _Quantity) -> None:
    """One quantity over time with ±1σ; a line where it is said to have changed."""
    known = [each for each in comparison.calibrations if each.shown[quantity.component]]
    dated = _dated(comparison.calibrations)
    order = {id(each): index for index, each in enumerate(comparison.calibrations)}
    value = quantity.factor * np.array([_values(each)[quantity.component] for each in known])
    std = quantity.factor * np.array([each.std[quantity.component] for each in known])
    at = [_middle(each) if dated else float(order[id(each)]) for each in known]
    axes.errorbar(at, value, std, fmt="o", color=_POINT, markersize=4.0, capsize=2.5, elinewidth=1.2)
    changes: Sequence[Change] = getattr(comparison, quantity.changes)
    for index, change in enumerate(changes):
        ends = [_middle(each) if dated else order[id(each)] for each in (change.last_before, change.first_after)]
        label = "changed" if index == 0 else None
        axes.axvline(sum(ends) / 2.0, color=_MOVED, linewidth=1.2, linestyle="--", label=label)
    if dated:
        locator = AutoDateLocator(maxticks=6)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    else:
        names = [each.name for each in comparison.calibrations]
        axes.set_xticks(range(len(names)), [_short(name) for name in names], rotation=30, ha="right")
        axes.set_xlim(-0.5, len(names) - 0.5)
    axes.margins(y=0.25)
    axes.set_ylabel(f"{quantity.name}, {quantity.unit}", color=INK)
    if changes:
        axes.legend(loc="best")


def _short(name: str) -> str:
    return name if len(name) <= 16 else f"{name[:7]}…{name[-8:]}"


def _dated(calibrations: Sequence[Extrinsics]) -> bool:
    """Whether they follow each other; those of simulations, stamped alike, do not."""
    return all(before.last_ns <= after.first_ns for before, after in pairwise(calibrations))


def _middle(each: Extrinsics) -> float:
    """In days since 1970, as matplotlib counts dates."""
    return 0.5 * (each.first_ns + each.last_ns) * 1e-9 / 86400.0


def _calibrations(comparison: Comparison) -> Table:
    columns = _shown(comparison)
    rows = [
        (each.name, date(each.first_ns), each.model, str(each.used), *_cells(_values(each), each.std, columns, False))
        for each in comparison.calibrations
    ]
    head = ("", "from (UTC)", "model", "samples", *(f"{each.name}, {each.unit}" for each in columns))
    return Table(head, rows, dense=True, notes=("± is 1σ as each calibration states it; – was not shown by its data.",))


def _cells(values: Array, stds: Array, columns: Sequence[_Quantity], with_sign: bool) -> list[str]:
    cells = []
    for each in columns:
        value, std = each.factor * values[each.component], each.factor * stds[each.component]
        number = signed(float(value)) if with_sign else f"{value + 0.0:.2f}".replace("-", "−")
        cells.append(f"{number} ± {std:.2f}" if std == std else "–")
    return cells


def _differences(differences: Sequence[Difference], names: Sequence[str]) -> Table:
    columns = [each for each in QUANTITIES if any(pair.compared[each.component] for pair in differences)]
    titles = {"roll": "about x", "pitch": "about y", "yaw": "about z"}
    head = ("", *(f"{titles.get(each.name, each.name)}, {each.unit}" for each in columns), "mounting: χ²", "p")
    rows = []
    for each, name in zip(differences, names, strict=True):
        test = each.test(MOUNTING)
        rows.append((name, *_cells(each.value, each.std, columns, True), *_test_cells(test)))
    return Table(
        head,
        rows,
        dense=True,
        notes=(
            "Angles are the turn of the mounting about the body's axes. χ² (of so many components) of angles and lever "
            "arm together; p: how often chance alone makes it as large.",
        ),
    )


def _test_cells(test: ChiSquare) -> tuple[str, str]:
    if not test.freedom:
        return "–", "–"
    return f"{test.value:.1f} ({test.freedom})", f"{test.p:.2f}" if test.p >= 0.01 else f"{test.p:.0e}"
