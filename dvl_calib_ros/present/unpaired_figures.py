"""Pictures of a simulator's DVL and the vehicle's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import welch

from ..calibration.numerics.frames import Array
from ..unpaired.gap_ladder import ALL, AS_IT_IS, NOISE, Shrunk
from ..unpaired.results import UnpairedComparison
from .figure_style import FAINT, INK, Picture, legend_above, log_scale, new_figure, picture, rows_figure, running_mean
from .replay_figures import AFTER, BAD

DVL_AXES = ("x", "y", "z")
# a line over time is a running mean over this share of the run
WINDOW_SHARE = 1.0 / 50.0
MM = 1e3


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
                over_time, shrunk, axis, (AS_IT_IS, last),
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


def over_time(shrunk: Shrunk, axis: int, models: Sequence[str]) -> Figure:
    """Draw the residual on one axis of the DVL with each model, for the recording with the largest."""
    first = shrunk.errors[models[0]]
    squares = np.bincount(shrunk.recording_of, np.nansum(first**2, axis=1))
    at = shrunk.recording_of == int(np.argmax(squares))
    time = shrunk.time[at]
    points = max(3, round(WINDOW_SHARE * len(time)))
    figure, axes = new_figure()
    for model, colour in zip(models, (BAD, AFTER), strict=True):
        where, mean = running_mean(time, MM * shrunk.errors[model][at, axis], points)
        axes.plot(where, mean, color=colour, label=AS_IT_IS if model == AS_IT_IS else "with all effects")
    axes.axhline(0.0, color=INK, linewidth=0.7)
    axes.set_xlabel("time from the start, s")
    axes.set_ylabel(f"recorded less simulated, {DVL_AXES[axis]}, mm/s")
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
            lines = {
                side: spectrum(max(residuals[side], key=len)[:, axis], float(np.median(intervals[side])))
                for side in residuals
            }
            yield picture(
                f"Residual by frequency, {name} of the DVL",
                f"Amplitude spectral density of what each side's own explanation leaves on {name}", spectra, lines,
            )  # fmt: skip


def level_bars(levels: Mapping[str, tuple[float, float]]) -> Figure:
    """Draw the noise of both sides in each regime, m/s."""
    figure, axes, rows = rows_figure(list(levels), "noise over the axes, mm/s")
    for i, (side, colour) in enumerate((("vehicle", INK), ("simulator", AFTER))):
        values = [MM * each[i] for each in levels.values()]
        axes.barh(rows + (i - 0.5) * 0.38, values, height=0.34, color=colour, label=side)
    legend_above(axes)
    return figure


def spectrum(values: Array, interval: float) -> tuple[Array, Array]:
    """Return frequency (F,) Hz and amplitude spectral density (F,) of values (N,)."""
    frequency, power = welch(values, 1.0 / interval, nperseg=min(len(values), max(16, len(values) // 6)))
    return frequency[1:], np.sqrt(power[1:])


def spectra(lines: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Draw amplitude spectral densities of both sides, m/s/√Hz."""
    figure, axes = new_figure()
    for (side, (frequency, density)), colour in zip(lines.items(), (INK, AFTER), strict=True):
        axes.plot(frequency, MM * np.maximum(density, 1e-7), color=colour, label=side)
    log_scale(axes, "xy")
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("mm/s/√Hz")
    legend_above(axes)
    return figure
