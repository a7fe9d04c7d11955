"""The figures of a replay: functions from plain arrays to a matplotlib Figure, units on every axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from ..calibration.frames import Array
from .style import (
    FAINT,
    INK,
    MODEL_STYLES,
    REFERENCE_COLOUR,
    legend_above,
    line_widths,
    new_figure,
    plain_log_ticks,
)
from .time_axis import TimeAxis, running_mean, thin

GOOD, WARNING, BAD, AFTER = "#2a7f62", "#e0a030", "#c0392b", "#1f6fb2"


class ModelLine(NamedTuple):
    """One error term of one model over time: value and std (N,), in the unit of the axis."""

    model: str
    value: Array
    std: Array


def estimate_over_time(
    time: TimeAxis, stamps_ns: Array, lines: Sequence[ModelLine], selected: str, label: str
) -> Figure:
    """One error term with the ±1σ sleeves of several models; the selected one stands out."""
    figure, axes = new_figure()
    kept = thin(len(stamps_ns))
    t = time(stamps_ns)[kept]
    for line, width in zip(lines, line_widths([line.model for line in lines], selected), strict=True):
        colour, dashes = MODEL_STYLES[line.model]
        value, std = line.value[kept], line.std[kept]
        strong = line.model == selected
        axes.fill_between(t, value - std, value + std, color=colour, alpha=0.25 if strong else 0.12, linewidth=0)
        dashes = "-" if strong else dashes
        axes.plot(t, value, color=colour, linestyle=dashes, linewidth=width, zorder=2.0 - 0.1 * width, label=line.model)
    axes.set_ylim(*_settled_range(lines))
    axes.set_ylabel(label)
    time.dress(axes)
    return figure


def _settled_range(lines: Sequence[ModelLine]) -> tuple[float, float]:
    """Limits that show every estimate from the first tenth on, and its σ at the end; not the prior's width."""
    settled = [line.value[len(line.value) // 10 :] for line in lines]
    low = min(min(value.min(), line.value[-1] - line.std[-1]) for value, line in zip(settled, lines, strict=True))
    high = max(max(value.max(), line.value[-1] + line.std[-1]) for value, line in zip(settled, lines, strict=True))
    margin = 0.15 * (high - low) or 1.0
    return float(low - margin), float(high + margin)


def velocity_over_time(
    time: TimeAxis, dvl_ns: Array, before: Array, after: Array, reference_ns: Array, reference: Array, label: str
) -> Figure:
    """One body axis of the velocity: DVL before (N,) and after correction (N,), and the reference (M,), m/s."""
    figure, axes = new_figure()
    kept = thin(len(reference_ns))
    if len(reference_ns):
        axes.plot(
            time(reference_ns)[kept], reference[kept], ".", markersize=2.0, color=REFERENCE_COLOUR, label="GNSS",
            rasterized=True,
        )  # fmt: skip
    kept = thin(len(dvl_ns))
    t = time(dvl_ns)[kept]
    axes.plot(t, before[kept], color=BAD, linewidth=1.0, label="DVL as measured")
    axes.plot(t, after[kept], color=AFTER, linewidth=1.0, label="DVL corrected")
    axes.set_ylabel(label)
    time.dress(axes)
    legend_above(axes, markerscale=3.0)
    return figure


def residual_over_time(time: TimeAxis, stamps_ns: Array, before: Array, after: Array, label: str) -> Figure:
    """DVL minus reference (N,) along one body axis, before and after correction, m/s: points and running mean."""
    figure, axes = new_figure()
    t = time(stamps_ns)
    for residual, colour, name in ((before, BAD, "before"), (after, AFTER, "after")):
        rms = float(np.sqrt(np.mean(residual**2)))
        axes.plot(t, residual, ".", markersize=2.0, alpha=0.35, color=colour, rasterized=True)
        axes.plot(*running_mean(t, residual), color=colour, label=f"{name}: RMS {rms:.3f} m/s")
    axes.axhline(0.0, color=INK, linewidth=0.7)
    spread = 1.2 * float(np.quantile(np.abs(np.concatenate([before, after])), 0.995))
    axes.set_ylim(-spread or -0.01, spread or 0.01)
    axes.set_ylabel(label)
    time.dress(axes)
    legend_above(axes)
    return figure


def selection_over_time(
    time: TimeAxis, segments: Sequence[tuple[str, int, int]], stamps_ns: Array, paired_share: Array
) -> Figure:
    """Which model was selected, (name, from, to) in ns, and the share of the samples (N,) that had a reference."""
    names = list(dict.fromkeys(name for name, _, _ in segments))
    figure, axes = new_figure(height=1.0 + 0.36 * (len(names) + 1))
    for name, start, end in segments:
        left, right = time([start, end])
        axes.barh(names.index(name) + 1, right - left, left=left, height=0.62, color=MODEL_STYLES[name].color)
    edges = time(stamps_ns)
    if len(edges) > 1:
        share = _filled_from_next(paired_share[1:])[None]
        axes.pcolormesh(edges, [-0.31, 0.31], share, cmap="Greys", vmin=-0.05, vmax=1.6, rasterized=True)
    axes.set_yticks(range(len(names) + 1), ["GNSS", *names])
    axes.set_ylim(len(names) + 0.6, -0.6)
    axes.grid(False, axis="y")
    time.dress(axes)
    return figure


def _filled_from_next(values: Array) -> Array:
    """(N,) with every nan replaced by the next number: a slow receiver decides several samples at once."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return np.zeros_like(values)
    following = np.searchsorted(known, np.arange(len(values)))
    return np.asarray(values[known[np.minimum(following, len(known) - 1)]])


def innovations_over_time(time: TimeAxis, stamps_ns: Array, nis: Mapping[str, Array], selected: str) -> Figure:
    """Mean normalised innovation squared per measurement row (N,) of several models; 1 is what they expect."""
    figure, axes = new_figure()
    t = time(stamps_ns)
    for (name, values), width in zip(nis.items(), line_widths(list(nis), selected), strict=True):
        used = np.isfinite(values) & (values > 0.0)
        if not used.any():
            continue
        colour, dashes = MODEL_STYLES[name]
        where, mean = running_mean(t[used], np.log10(values[used]), points=9)
        axes.plot(
            where, 10.0**mean, color=colour, linestyle=dashes, linewidth=width, zorder=2.0 - 0.1 * width, label=name
        )
    axes.axhline(1.0, color=INK, linewidth=0.8)
    axes.set_yscale("log")
    plain_log_ticks(axes.yaxis)
    axes.set_ylabel("NIS per measured component")
    time.dress(axes)
    return figure


def samples_by_fate(models: Sequence[str], counts: Mapping[str, Sequence[int]]) -> Figure:
    """Bars of how many DVL samples each model used, gated, or was not given, by reason."""
    colours = (GOOD, BAD, WARNING, FAINT, "#8d99a6", "#d8dde1")
    figure, axes = new_figure(height=1.1 + 0.28 * len(models))
    left = np.zeros(len(models))
    for (reason, values), colour in zip(counts.items(), colours, strict=False):
        axes.barh(models, values, left=left, color=colour, height=0.7, label=reason)
        left += np.asarray(values, dtype=float)
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("DVL samples")
    axes.grid(False, axis="y")
    legend_above(axes, columns=4)
    return figure


def held_out_errors(labels: Sequence[str], uncorrected: Array, corrected: Array, predicted: Array) -> Figure:
    """Velocity error on data held back (N,), m/s rms. Points, not bars from zero: the reference's noise is in each."""
    figure, axes = new_figure(height=1.2 + 0.27 * len(labels))
    rows = np.arange(len(labels))
    axes.hlines(rows, corrected, uncorrected, color=FAINT, linewidth=1.6)
    axes.plot(uncorrected, rows, "|", color=BAD, markersize=11.0, markeredgewidth=2.2, label="uncorrected")
    axes.plot(corrected, rows, "o", color=AFTER, markersize=6.0, label="corrected")
    axes.plot(
        predicted, rows, "D", color=INK, markersize=5.0, markerfacecolor="none", markeredgewidth=1.1, label="predicted"
    )
    axes.set_yticks(rows, labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel("velocity error on held-out data, m/s rms")
    legend_above(axes)
    return figure
