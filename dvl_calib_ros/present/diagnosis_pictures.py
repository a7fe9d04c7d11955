"""Pictures of a diagnosis: gap by regime, closure by effects, their traces, simulated twin, and residual."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from ..calibration.numerics.frames import Array
from ..diagnosis.answer.plotted_series import DiagnosisSeries, HeldOutTwin
from . import diagnosis_figures as figures
from .diagnosis import twin_errors
from .figure_data import CUT_FROM_S, TimeAxis, running_mean
from .figure_style import Picture, picture
from .numbers import mm

# a line over time is a running mean over this share of the run, and at least this number of seconds
WINDOW_SHARE, WINDOW_S = 1.0 / 50.0, 5.0
# an axis of an effect's trace is drawn if it has at least this share of the energy
AXIS_SHARE = 0.1
RESAMPLES = 500


def _stamps(series: DiagnosisSeries) -> Array:
    """Return stamps (M,) ns that put the recordings one after the other, with gaps that the time axis cuts out."""
    apart = CUT_FROM_S + float(series.time.max()) * len(series.recordings)
    return np.asarray(1e9 * (series.time + series.recording_of * (series.time.max() + apart)), dtype=np.int64)


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
        "Gap by regime of motion", alt, figures.gap_bars, names, gaps,
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
    smooth = [float(np.nansum(running_mean(stamps_ns, each, points)[1] ** 2)) for each in trace.T]
    for name_of_axis, where in axes.items():
        axis = "xyz".index(name_of_axis)
        if smooth[axis] > AXIS_SHARE * sum(smooth):
            lines = {"measured": measured[:, axis], name: trace[:, axis]}
            yield picture(
                f"{name}, {where}", f"Measured trace {where} and the trace of {name}, running mean in mm/s",
                figures.over_time, time, stamps_ns, lines, points, f"{where}, mm/s",
            )  # fmt: skip
    drawn = energy > AXIS_SHARE * energy.sum()
    yield picture(
        f"Measured against {name}", f"Means of what was measured in groups of what {name} adds, with 95 % intervals",
        figures.measured_against_effect, trace[:, drawn].ravel(), measured[:, drawn].ravel(),
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
            figures.over_time, time, stamps_ns, lines, points, f"recorded − twin {where}, mm/s",
            caption=f"Means over {points * interval:.0f} s.",
        )  # fmt: skip
    measured = ["xyz".index(letter) for letter in axes]
    spectra = {name: spectrum(twin, values[:, measured]) for name, values in found.items()}
    frequency = next(iter(spectra.values()))[0]
    noise = float(np.sqrt(2.0 * interval * (twin.noise**2).sum()))
    densities = {name: density for name, (_, density) in spectra.items()} | {"noise": np.full(len(frequency), noise)}
    yield picture(
        f"{twin.name}: by frequency", f"Amplitude spectral density of recorded less twin, {names}, beside the noise",
        figures.spectra, frequency, densities, "recorded − twin, mm/s/√Hz",
    )  # fmt: skip
    pooled = {name: values[:, measured].ravel() for name, values in found.items()}
    yield picture(
        f"{twin.name}: distribution", f"Histogram of recorded less twin, {names}, and of the noise",
        figures.histogram, pooled, twin.noise[measured],
        caption="All axes together; what lies beyond the ends is in the last bins.",
    )  # fmt: skip
    yield picture(
        f"{twin.name}: against normal noise", f"Quantiles of recorded less twin, {names}, against the noise",
        figures.quantiles, pooled, twin.noise[measured],
        caption="On the line, the distribution equals the noise; larger outliers are outside the picture.",
    )  # fmt: skip
    parts = twin_errors(twin, has_effects)
    errors = {name: np.array([[each.errors[name]] for each in parts]) for name in found}
    alt = "; ".join(
        f"{each.regime}: " + ", ".join(f"{name} {mm(error)} mm/s" for name, error in each.errors.items())
        for each in parts
    )
    yield picture(
        f"{twin.name}: error by regime", alt, figures.error_bars, [each.regime for each in parts], errors, twin.level
    )


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
