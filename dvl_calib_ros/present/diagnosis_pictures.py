"""Pictures of a diagnosis: gap by regime, closure by effects, their traces, simulated twin, and residual.

Also of the comparison of a simulator's DVL with the vehicle's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray
from scipy.signal import welch

from ..calibration.numerics.distributions import normal_isf, normal_sf
from ..calibration.numerics.frames import Array
from ..diagnosis.answer.plotted_series import DiagnosisSeries, HeldOutTwin, RegressorPlot
from ..unpaired.effect_comparison import ALL, AS_IT_IS, NOISE, Shrunk
from ..unpaired.results import UnpairedComparison
from .diagnosis import twin_errors
from .figure_style import (
    CUT_FROM_S,
    FAINT,
    INK,
    Picture,
    TimeAxis,
    legend_above,
    log_scale,
    new_figure,
    picture,
    rows_figure,
    running_mean,
)
from .numbers import mm
from .replay_figures import AFTER, BAD

# Figures of a diagnosis: functions from plain arrays to a matplotlib Figure, units on every axis.

# points of a line; a running mean has no finer detail
LINE_POINTS = 300
# number of groups of equal size in which measurement and effect are compared
GROUPS = 12
# bins of a histogram, points of a line of quantiles, dots of a scatter plot
BINS, QUANTILES, SCATTER_POINTS = 40, 200, 2000
MM = 1e3
MEASURED_COLOUR = "#555b61"
_STYLES = {
    "before": (BAD, 1.3),
    "after": (AFTER, 1.3),
    "measured": (MEASURED_COLOUR, 1.1),
    "residual": (MEASURED_COLOUR, 1.3),
    "without": (BAD, 1.1),
    "with": (AFTER, 1.3),
    "twin": (AFTER, 1.3),
    "noise": (FAINT, 2.0),
}


def over_time(time: TimeAxis, stamps_ns: Array, series: Mapping[str, Array], points: int, label: str) -> Figure:
    """Draw running means over `points` samples of series (M,), m/s, by name; the last in front."""
    figure, axes = new_figure(ylabel=label)
    t = time(stamps_ns)
    for (name, values), (colour, width) in zip(series.items(), _line_styles(list(series)), strict=True):
        where, mean = running_mean(t, MM * values, points)
        kept = slice(None, None, max(1, len(where) // LINE_POINTS))
        axes.plot(where[kept], mean[kept], color=colour, linewidth=width, label=name)
    axes.axhline(0.0, color=INK, linewidth=0.7)
    time.label_time(axes)
    legend_above(axes)
    return figure


def _line_styles(names: Sequence[str]) -> list[tuple[str, float]]:
    """Return colour and width of each line by its name; effects have the default."""
    return [_STYLES.get(name, (AFTER, 2.0)) for name in names]


def spectra(frequency: Array, series: Mapping[str, Array], label: str) -> Figure:
    """Draw amplitude spectral densities (F,) m/s/√Hz of one body axis, by name, over frequency (F,) Hz."""
    figure, axes = new_figure(xlabel="frequency, Hz", ylabel=label)
    for (name, values), (colour, width) in zip(series.items(), _line_styles(list(series)), strict=True):
        axes.plot(frequency, MM * values, color=colour, linewidth=width, label=name)
    axes.set_ylim(*_decade_limits(MM * np.concatenate(list(series.values()))))
    log_scale(axes, "xy")
    legend_above(axes)
    return figure


def _decade_limits(values: Array) -> tuple[float, float]:
    """Return limits around positive values, at least a decade apart, so that a logarithmic axis has tick labels."""
    low, high = 0.8 * float(values.min()), 1.25 * float(values.max())
    widen = max(1.0, np.sqrt(10.0 * low / high))
    return low / widen, high * widen


def regime_bars(names: Sequence[str], groups: Mapping[str, Array], label: str, noise: float | None = None) -> Figure:
    """Draw bars for each regime of motion, by name (R, 1) or with a 95 per cent interval (R, 3), m/s.

    noise: m/s, a line across all.
    """
    figure, axes, places = rows_figure(names, label, pad=0.5)
    height = 0.8 / len(groups)
    for i, ((name, values), (colour, _)) in enumerate(zip(groups.items(), _line_styles(list(groups)), strict=True)):
        rows = places + (i - 0.5 * (len(groups) - 1)) * height
        value, *interval = MM * values.T
        axes.barh(rows, value, height=0.9 * height, color=colour, alpha=0.85, label=name)
        if interval:
            axes.hlines(rows, *interval, color=INK, linewidth=1.0)
    if noise is not None:
        axes.axvline(MM * noise, color=INK, linewidth=1.0, linestyle=":", label="noise")
    axes.set_xlim(left=0.0)
    legend_above(axes)
    return figure


def histogram(values: Mapping[str, Array], noise: Array) -> Figure:
    """Draw densities of values (K,) m/s, by name, and of mixed normal noise with σ (A,) m/s.

    The range is set by the last series; values beyond it are in the last bins.
    """
    figure, axes = new_figure(xlabel="recorded − twin, mm/s", ylabel="density, 1/(mm/s)")
    last = list(values.values())[-1]
    reach = MM * float(max(np.quantile(np.abs(last), 0.995), 4.0 * np.max(noise)))
    edges = np.linspace(-reach, reach, BINS + 1)
    for (name, each), (colour, width) in zip(values.items(), _line_styles(list(values)), strict=True):
        counts, _ = np.histogram(np.clip(MM * each, -reach, reach), edges)
        axes.stairs(counts / len(each) / np.diff(edges), edges, color=colour, linewidth=width, label=name)
    at = np.linspace(-reach, reach, 20 * BINS)
    std = MM * np.maximum(noise, 1e-9)[:, None]
    density = (np.exp(-0.5 * (at / std) ** 2) / (std * np.sqrt(2.0 * np.pi))).mean(axis=0)
    axes.plot(at, density, color=FAINT, linewidth=2.0, label="noise", zorder=1)
    axes.set_ylim(bottom=0.0)
    legend_above(axes)
    return figure


def quantiles(values: Mapping[str, Array], noise: Array) -> Figure:
    """Draw quantiles of values (K,) m/s, by name, against mixed normal noise with σ (A,) m/s.

    The range is set by the last series.
    """
    figure, axes = new_figure(height=3.2, xlabel="quantiles of normal noise, mm/s", ylabel="of recorded − twin, mm/s")
    k = max(len(each) for each in values.values())
    end = float(normal_isf(0.5 / k))
    shares = normal_sf(np.linspace(end, -end, QUANTILES))
    std = MM * np.maximum(noise, 1e-9)
    grid = np.linspace(-6.0, 6.0, 4001) * std.max()
    of_noise = np.interp(shares, normal_sf(-grid[:, None] / std).mean(axis=1), grid)
    axes.plot(of_noise[[0, -1]], of_noise[[0, -1]], color=FAINT, linewidth=2.0, label="noise", zorder=1)
    for (name, each), (colour, _) in zip(values.items(), _line_styles(list(values)), strict=True):
        axes.plot(of_noise, MM * np.quantile(each, shares), ".", color=colour, markersize=3.5, label=name)
    reach = 1.3 * max(float(of_noise[-1]), MM * float(np.abs(list(values.values())[-1]).max()))
    axes.set_ylim(-reach, reach)
    legend_above(axes, markerscale=2.0)
    return figure


def residual_over_regressor(plotted: RegressorPlot, label: str) -> Figure:
    """Draw the residual against its explaining variable: samples, group means with two standard errors, and scatter."""
    figure, axes = new_figure(height=3.2, xlabel=plotted.label, ylabel=label)
    at, mean, std, error = plotted.groups()
    every = slice(None, None, max(1, len(plotted.at) // SCATTER_POINTS))
    axes.plot(
        plotted.at[every], MM * plotted.residual[every], ".", color=FAINT, markersize=2.5, label="residual", zorder=1,
        rasterized=True,
    )  # fmt: skip
    axes.fill_between(at, MM * (mean - std), MM * (mean + std), color=AFTER, alpha=0.15, linewidth=0.0, label="σ")
    axes.errorbar(at, MM * mean, 2.0 * MM * error, fmt="o", markersize=4.0, color=AFTER, linewidth=1.2, label="mean")
    axes.axhline(0.0, color=INK, linewidth=0.7)
    reach = 1.2 * MM * float(np.nanmax([np.quantile(np.abs(plotted.residual), 0.98), *np.abs(mean) + std]))
    axes.set_ylim(-reach, reach)
    legend_above(axes, markerscale=2.0)
    return figure


def closure_bars(names: Sequence[str], closures: Array, together: tuple[float, float, float]) -> Figure:
    """Draw the share of the gap closed by each effect alone (E,), and by all: value and 95 per cent interval."""
    labels = [*names, "together"] if len(names) > 1 else list(names)
    values = [*closures, together[0]] if len(names) > 1 else [together[0]]
    colours = [FAINT] * len(names) + [AFTER] if len(names) > 1 else [AFTER]
    figure, axes, rows = rows_figure(labels, "share of the gap closed on held-out data, %", height=1.1)
    axes.barh(rows, 100.0 * np.asarray(values), color=colours, height=0.6)
    axes.hlines(rows[-1], 100.0 * together[1], 100.0 * together[2], color=INK, linewidth=1.4)
    axes.axvline(100.0, color=INK, linewidth=0.7, linestyle=":")
    axes.set_xlim(min(0.0, 100.0 * float(np.min([*values, together[1]]))), 105.0)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
    return figure


def measured_against_effect(effect: Array, measured: Array) -> Figure:
    """Draw measurements (K,) against an effect's contribution (K,), m/s: group means with 95 per cent intervals.

    Points on the diagonal mean that the effect equals the measurement.
    """
    figure, axes = new_figure(height=3.2, xlabel="the effect's trace, mm/s", ylabel="measured, mm/s")
    groups = np.array_split(np.argsort(effect), GROUPS)
    at = MM * np.array([effect[group].mean() for group in groups])
    mean = MM * np.array([measured[group].mean() for group in groups])
    error = 1.96 * MM * np.array([measured[group].std() / np.sqrt(len(group)) for group in groups])
    ends = np.array([at.min(), at.max()])
    axes.plot(ends, ends, color=AFTER, linewidth=2.0, label="as the effect says")
    axes.errorbar(at, mean, error, fmt="o", markersize=4.0, color=MEASURED_COLOUR, linewidth=1.0, label="measured")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6))
    legend_above(axes)
    return figure


# a line over time is a running mean over this share of the run, and at least this number of seconds
WINDOW_SHARE, WINDOW_S = 1.0 / 50.0, 5.0
# an axis of an effect's trace is drawn if it has at least this share of the energy
AXIS_SHARE = 0.1
RESAMPLES = 500


def _stamps(series: DiagnosisSeries) -> Array:
    """Return stamps (M,) ns that put the recordings one after the other, with gaps that the time axis cuts out."""
    spacing = CUT_FROM_S + float(series.time.max()) * len(series.recordings)
    return np.asarray(1e9 * (series.time + series.recording_of * (series.time.max() + spacing)), dtype=np.int64)


def _window(series: DiagnosisSeries) -> int:
    """Return the number of samples in a running mean."""
    interval = float(np.median(np.diff(series.time)))
    return max(3, round(WINDOW_S / interval), round(WINDOW_SHARE * len(series.time)))


def regime_picture(series: DiagnosisSeries, with_effects: bool) -> Picture:
    """Draw the gap in each regime of motion, without and with the effects."""
    before, after = series.held_out.before, series.held_out.after
    residuals: Mapping[str, Array] = {"before": before, "after": after} if with_effects else {"residual": before}
    names = ["all of the run", *series.regimes]
    masks = [np.ones(len(series.time), dtype=bool), *series.regimes.values()]
    floor, block = series.held_out.floor, series.held_out.block
    gaps = {
        name: np.array([_gap(residual, floor, block, mask) for mask in masks]) for name, residual in residuals.items()
    }
    alt = "; ".join(
        f"{regime}: " + ", ".join(f"{name} {1e3 * gaps[name][i, 0]:.1f} mm/s" for name in gaps)
        for i, regime in enumerate(names)
    )
    return picture(
        "Gap by regime of motion", alt, regime_bars, names, gaps, "gap beyond the noise, mm/s rms (95 %)",
        caption="Held out."
        + (" Slow and fast: the lowest and the highest third of the speeds." if "slow" in series.regimes else ""),
    )  # fmt: skip


def _gap(
    residual: Array, floor: Array, block: NDArray[np.integer[Any]], mask: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Return the gap (m/s) in a part of the samples, with its 95 per cent bootstrap interval over blocks."""
    excess = np.bincount(block[mask], (residual**2 - floor)[mask].sum(axis=1), minlength=block.max() + 1)
    counts = np.bincount(block[mask], minlength=block.max() + 1)
    at = np.random.default_rng(0).integers(0, len(counts), (RESAMPLES, len(counts)))
    resampled = excess[at].sum(axis=1) / np.maximum(counts[at].sum(axis=1), 1)
    low, high = np.percentile(resampled, [2.5, 97.5])
    value, low, high = np.sqrt(np.maximum([excess.sum() / counts.sum(), low, high], 0.0)).tolist()
    return value, low, high


def trace_pictures(name: str, series: DiagnosisSeries, axes: Mapping[str, str]) -> Iterable[Picture]:
    """Draw an effect's trace over time, and against the measurement."""
    stamps_ns = _stamps(series)
    time, points = TimeAxis(stamps_ns), _window(series)
    trace = series.traces[name]
    measured = series.held_out.after + trace
    energy = (trace**2).sum(axis=0)
    smooth_energy = [float(np.nansum(running_mean(stamps_ns, each, points)[1] ** 2)) for each in trace.T]
    for name_of_axis, where in axes.items():
        axis = "xyz".index(name_of_axis)
        if smooth_energy[axis] > AXIS_SHARE * sum(smooth_energy):
            lines = {"measured": measured[:, axis], name: trace[:, axis]}
            yield picture(
                f"{name}, {where}", f"Measured error {where} and the error caused by {name}, running mean in mm/s",
                over_time, time, stamps_ns, lines, points, f"{where}, mm/s",
            )  # fmt: skip
    drawn = energy > AXIS_SHARE * energy.sum()
    yield picture(
        f"Measured against {name}", f"Means of what was measured in groups of what {name} adds, with 95 % intervals",
        measured_against_effect, trace[:, drawn].ravel(), measured[:, drawn].ravel(),
        caption="Points on the line: the measurement equals the effect's contribution.",
    )  # fmt: skip


# points of a spectrum per decade of frequency
SPECTRUM_STEPS = 10
# a line over time is a running mean over this share of the run, and at least this number of seconds
TWIN_WINDOW_SHARE, TWIN_WINDOW_S = 1.0 / 100.0, 3.0


def twin_pictures(twin: HeldOutTwin, axes: Mapping[str, str], has_effects: bool) -> Iterable[Picture]:
    """Draw recorded against twin over time along each axis, by frequency, as distribution, and by regime."""
    found = twin.errors(has_effects)
    stamps_ns = np.asarray(1e9 * twin.time, dtype=np.int64)
    time = TimeAxis(stamps_ns)
    interval = float(np.median(np.diff(twin.time)))
    points = max(3, round(TWIN_WINDOW_S / interval), round(TWIN_WINDOW_SHARE * len(twin.time)))
    names = " and ".join(found)
    for letter, where in axes.items():
        lines = {name: values[:, "xyz".index(letter)] for name, values in found.items()}
        yield picture(
            f"{twin.name}: recorded less twin {where}", f"Recorded less twin {where} over time, {names}, in mm/s",
            over_time, time, stamps_ns, lines, points, f"recorded − twin {where}, mm/s",
            caption=f"Means over {points * interval:.0f} s.",
        )  # fmt: skip
    measured = ["xyz".index(letter) for letter in axes]
    by_name = {name: spectrum(twin, values[:, measured]) for name, values in found.items()}
    frequency = next(iter(by_name.values()))[0]
    noise = float(np.sqrt(2.0 * interval * (twin.noise**2).sum()))
    densities = {name: density for name, (_, density) in by_name.items()} | {"noise": np.full(len(frequency), noise)}
    yield picture(
        f"{twin.name}: by frequency", f"Amplitude spectral density of recorded less twin, {names}, and the noise",
        spectra, frequency, densities, "recorded − twin, mm/s/√Hz",
    )  # fmt: skip
    pooled = {name: values[:, measured].ravel() for name, values in found.items()}
    yield picture(
        f"{twin.name}: distribution", f"Histogram of recorded less twin, {names}, and of the noise",
        histogram, pooled, twin.noise[measured],
        caption="All axes together; what lies beyond the ends is in the last bins.",
    )  # fmt: skip
    yield picture(
        f"{twin.name}: against normal noise", f"Quantiles of recorded less twin, {names}, against the noise",
        quantiles, pooled, twin.noise[measured],
        caption="On the line, the distribution equals the noise; larger outliers are outside the picture.",
    )  # fmt: skip
    parts = twin_errors(twin, has_effects)
    errors = {name: np.array([[each.errors[name]] for each in parts]) for name in found}
    alt = "; ".join(
        f"{each.regime}: " + ", ".join(f"{name} {mm(error)} mm/s" for name, error in each.errors.items())
        for each in parts
    )
    yield picture(
        f"{twin.name}: error by regime", alt,
        regime_bars, [each.regime for each in parts], errors, "recorded − twin, mm/s rms", twin.level,
    )  # fmt: skip


def spectrum(twin: HeldOutTwin, values: Array) -> tuple[Array, Array]:
    """Return frequency (F,) Hz and amplitude spectral density (F,) of vectors (N, A).

    They are averaged in even steps of log frequency, over the longest stretch without a gap.
    """
    longest = max(twin.segments, key=lambda part: part.stop - part.start)
    count = longest.stop - longest.start
    interval = float(np.median(np.diff(twin.time[longest]))) if count > 1 else 1.0
    per_segment = min(count, max(16, count // 3))
    frequency, power = welch(values[longest], 1.0 / interval, nperseg=per_segment, detrend=False, axis=0)
    frequency, power = frequency[1:], power[1:].sum(axis=1)
    step = np.floor(SPECTRUM_STEPS * np.log10(frequency / frequency[0])).astype(int)
    _, group, n = np.unique(step, return_inverse=True, return_counts=True)
    return np.bincount(group, frequency) / n, np.sqrt(np.bincount(group, power) / n)


# Pictures of a simulator's DVL and the vehicle's.

DVL_AXES = ("x", "y", "z")


def shrink_pictures(c: UnpairedComparison) -> Iterator[Picture]:
    """Draw the decrease of error and distance from the original simulator to one with all effects."""
    names = [rung.name for rung in c.rungs if rung.name != NOISE]
    errors = [MM * rung.error_mps for rung in c.rungs if rung.name != NOISE]
    alt = "; ".join(f"{name}: {error:.1f} mm/s" for name, error in zip(names, errors, strict=True))
    yield picture("Error of the simulated DVL", alt, error_bars, names, errors, MM * c.floor_mps)
    yield picture(
        "Energy distance of recorded and simulated",
        "; ".join(f"{rung.name}: {rung.distance:.2f}, alike below {rung.null95:.2f}" for rung in c.rungs),
        distance_bars, [r.name for r in c.rungs], [r.distance for r in c.rungs], [r.null95 for r in c.rungs],
        caption="Line: 95 % quantile of the distance if recorded and simulated are alike.",
    )  # fmt: skip
    shrunk = c.series.get("shrunk")
    if isinstance(shrunk, Shrunk):
        last = ALL if ALL in shrunk.errors else NOISE
        for axis, name in enumerate(DVL_AXES):
            yield picture(
                f"Recorded less simulated over time, {name} of the DVL",
                f"Running means over time of axis {name}: the original simulator, and with all effects",
                residual_over_time, shrunk, axis, (AS_IT_IS, last),
            )  # fmt: skip


def error_bars(names: Sequence[str], errors: Sequence[float], floor: float) -> Figure:
    """Draw the error of each model, mm/s, and the noise."""
    figure, axes, rows = rows_figure(names, "recorded less simulated, held out, mm/s rms")
    colours = [BAD] + [FAINT] * (len(names) - 2) + [AFTER] if len(names) > 1 else [BAD]
    axes.barh(rows, errors, color=colours, height=0.6)
    axes.axvline(floor, color=INK, linewidth=0.9, linestyle=":", label="noise")
    legend_above(axes)
    return figure


def distance_bars(names: Sequence[str], distances: Sequence[float], null95: Sequence[float]) -> Figure:
    """Draw the energy distance of each model, and its 95 % quantile if both sides are alike."""
    figure, axes, rows = rows_figure(names, "energy distance")
    indistinguishable = [d <= n for d, n in zip(distances, null95, strict=True)]
    axes.barh(rows, distances, color=[AFTER if each else BAD for each in indistinguishable], height=0.6)
    axes.vlines(null95, rows - 0.38, rows + 0.38, color=INK, linewidth=1.6)
    return figure


def residual_over_time(shrunk: Shrunk, axis: int, models: Sequence[str]) -> Figure:
    """Draw the residual on one axis of the DVL with each model, for the recording with the largest."""
    first = shrunk.errors[models[0]]
    squares = np.bincount(shrunk.recording_of, np.nansum(first**2, axis=1))
    at = shrunk.recording_of == int(np.argmax(squares))
    time = shrunk.time[at]
    points = max(3, round(WINDOW_SHARE * len(time)))
    figure, axes = new_figure(
        xlabel="time from the start, s", ylabel=f"recorded less simulated, {DVL_AXES[axis]}, mm/s"
    )
    for model, colour in zip(models, (BAD, AFTER), strict=True):
        where, mean = running_mean(time, MM * shrunk.errors[model][at, axis], points)
        axes.plot(where, mean, color=colour, label=AS_IT_IS if model == AS_IT_IS else "with all effects")
    axes.axhline(0.0, color=INK, linewidth=0.7)
    legend_above(axes)
    return figure


def noise_pictures(c: UnpairedComparison) -> Iterator[Picture]:
    """Draw the noise of both sides by regime and by frequency."""
    if c.levels:
        alt = "; ".join(f"{name}: {MM * v:.1f} and {MM * s:.1f} mm/s" for name, (v, s) in c.levels.items())
        yield picture("Noise of the DVL by regime", f"Vehicle and simulator: {alt}", level_bars, c.levels)
    residuals: Any = c.series.get("residuals")
    intervals: Any = c.series.get("intervals")
    if residuals and all(residuals.values()):
        for axis, name in enumerate(DVL_AXES):
            lines = {}
            for side, of_side in residuals.items():
                values, interval = max(of_side, key=len)[:, axis], float(np.median(intervals[side]))
                per_segment = min(len(values), max(16, len(values) // 6))
                frequency, power = welch(values, 1.0 / interval, nperseg=per_segment)
                lines[side] = frequency[1:], np.sqrt(power[1:])
            yield picture(
                f"Residual by frequency, {name} of the DVL",
                f"Amplitude spectral density of each side's residual on {name}",
                residual_spectra, lines,
            )  # fmt: skip


def level_bars(levels: Mapping[str, tuple[float, float]]) -> Figure:
    """Draw the noise of both sides in each regime, m/s."""
    figure, axes, rows = rows_figure(list(levels), "noise over the axes, mm/s")
    for i, (side, colour) in enumerate((("vehicle", INK), ("simulator", AFTER))):
        values = [MM * each[i] for each in levels.values()]
        axes.barh(rows + (i - 0.5) * 0.38, values, height=0.34, color=colour, label=side)
    legend_above(axes)
    return figure


def residual_spectra(lines: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Draw amplitude spectral densities of both sides, m/s/√Hz."""
    figure, axes = new_figure(xlabel="frequency, Hz", ylabel="mm/s/√Hz")
    for (side, (frequency, density)), colour in zip(lines.items(), (INK, AFTER), strict=True):
        axes.plot(frequency, MM * np.maximum(density, 1e-7), color=colour, label=side)
    log_scale(axes, "xy")
    legend_above(axes)
    return figure
