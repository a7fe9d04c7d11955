"""Figures of an evaluation: functions from plain arrays to a matplotlib Figure, units on every axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ..calibration.numerics.frames import Array
from .evaluation import CLAIMED
from .figure_style import (
    INK,
    MODEL_STYLES,
    UNCALIBRATED_COLOUR,
    legend_above,
    line_widths,
    log_scale,
    new_figure,
    rows_figure,
)

# position of "all" of a run, seconds beyond the longest window
ALL_STANDS_S = 40.0


def improvement_bars(models: Sequence[str], improvement: Array, published: Array) -> Figure:
    """Draw the share of the uncalibrated error that each model removes.

    improvement, published: (S, M) removed share of Avg.VRMSE, nan if missing. Bars are means over the sets, points the
    sets, rings the published figures.
    """
    figure, axes = new_figure(height=1.2 + 0.3 * len(models), xlabel="reduction of the uncalibrated Avg.VRMSE, %")
    rows = np.arange(len(models))
    mean = 100.0 * improvement.mean(axis=0)
    axes.barh(rows, mean, color=[MODEL_STYLES[name].color for name in models], height=0.62, alpha=0.85)
    for at, values in zip(rows, 100.0 * improvement.T, strict=True):
        axes.plot(values, np.full(len(values), at), ".", color=INK, markersize=3.5, label="a set" if at == 0 else None)
    if np.isfinite(published).any():
        for at, values in zip(rows, 100.0 * published.T, strict=True):
            axes.plot(
                values, np.full(len(values), at + 0.18), "o", color=INK, markersize=3.5, markerfacecolor="none",
                markeredgewidth=0.8, label="a set, published" if at == 0 else None,
            )  # fmt: skip
    axes.axvline(0.0, color=INK, linewidth=0.8)
    axes.set_yticks(rows, models)
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    legend_above(axes)
    return figure


def error_over_calibration_time(
    models: Sequence[str],
    windows_s: Sequence[float | None],
    uncalibrated: float,
    errors: Array,
    published_window_s: float | None,
    published: Array,
) -> Figure:
    """Draw Avg.VRMSE (W, M) m/s of models calibrated on the first windows_s (None: all) of a run.

    uncalibrated: m/s. published: (M,) m/s at published_window_s, nan if missing.
    """
    figure, axes = new_figure(height=3.2, xlabel="calibration time, s", ylabel="Avg.VRMSE, m/s")
    finite = [window for window in windows_s if window is not None]
    all_at = (max(finite) if finite else 0.0) + ALL_STANDS_S
    at = np.array([all_at if window is None else window for window in windows_s])
    order = np.argsort(at)
    axes.axhline(uncalibrated, color=UNCALIBRATED_COLOUR, linewidth=1.0, linestyle=":")
    axes.annotate(
        "uncalibrated", (at.min(), uncalibrated), xytext=(0, 2), textcoords="offset points", fontsize=7.5,
        color=UNCALIBRATED_COLOUR,
    )  # fmt: skip
    published_at = all_at if published_window_s is None else published_window_s
    for name, values, then, width in zip(models, errors.T, published, line_widths(models), strict=True):
        colour, dashes = MODEL_STYLES[name]
        axes.plot(at[order], values[order], color=colour, linestyle=dashes, linewidth=width, marker=".", markersize=4.0)
        axes.plot(
            [published_at], [then], "o", color=colour, markersize=7.0, markerfacecolor="none", markeredgewidth=1.4
        )
    log_scale(axes, "y")
    ticks = [window for window in finite if window % 50.0 == 0.0]
    axes.set_xticks([*ticks, all_at], [*(f"{tick:g}" for tick in ticks), "all"])
    return figure


def misalignment_over_time(
    times_s: Sequence[float],
    models: Sequence[str],
    gnss_std: Sequence[float | None],
    degrees: Sequence[Array],
    published: tuple[float, float],
) -> Figure:
    """Draw the error of the misalignment (T,) ° of several models over time. gnss_std: m/s, None without a reference.

    published: s and ° of a published method.
    """
    figure, axes = new_figure(height=3.2, xlabel="calibration time, s", ylabel="error, ° rms")
    for name, std, values in zip(models, gnss_std, degrees, strict=True):
        dashes = ":" if std is None else "--" if std < 0.1 else "-"
        with_what = "no reference" if std is None else f"{std:g} m/s"
        axes.plot(
            times_s, values, color=MODEL_STYLES[name].color, linestyle=dashes,
            label=f"{name}, {with_what}",
        )  # fmt: skip
    axes.plot(*published, "*", color=INK, markersize=9.0)
    log_scale(axes, "xy")
    legend_above(axes)
    return figure


def coverage_points(models: Sequence[str], within: Mapping[float, Sequence[float]]) -> Figure:
    """Draw the share of errors inside the intervals of σ; claimed share -> observed share per model, all in 0..1."""
    figure, axes, rows = rows_figure(models, "errors inside, %", 1.1, 0.28, pad=0.5, grid=True)
    for (claimed, shares), marker, colour in zip(within.items(), "os", ("#1f6fb2", "#e76300"), strict=True):
        low, high = dict(CLAIMED)[claimed]
        axes.axvspan(100.0 * low, 100.0 * high, color=colour, alpha=0.12, linewidth=0)
        axes.axvline(100.0 * claimed, color=colour, linewidth=0.8)
        axes.plot(
            100.0 * np.asarray(shares), rows, marker, color=colour, markersize=5.0, linestyle="none",
            label=f"inside the {100 * claimed:.0f} % interval",
        )  # fmt: skip
    axes.set_xlim(0.0, 102.0)
    legend_above(axes)
    return figure


def error_by_run(runs: Sequence[str], models: Sequence[str], uncalibrated: Array, errors: Array) -> Figure:
    """Draw Avg.VRMSE m/s of every model (L, M), calibrated on each of L runs; uncalibrated: (L,)."""
    figure, axes, rows = rows_figure(runs, "Avg.VRMSE on all other runs, m/s", 1.1, 0.26, pad=0.5, grid=True)
    axes.plot(uncalibrated, rows, "|", color=UNCALIBRATED_COLOUR, markersize=9.0, markeredgewidth=1.6)
    for name, values in zip(models, errors.T, strict=True):
        colour, dashes = MODEL_STYLES[name]
        filled = colour if dashes == "-" else "white"
        axes.plot(values, rows, "o", color=colour, markersize=4.5, markerfacecolor=filled, markeredgewidth=1.3)
    log_scale(axes, "x")
    return figure
