"""Pictures of a diagnosis: the gap by regime, what effects close, and their traces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from ..diagnosis.series import DiagnosisSeries
from . import diagnosis_figures as figures
from .style import Picture, picture
from .time_axis import CUT_FROM_S, TimeAxis, running_mean

# Lines over time are means over this share of the run, and over so many seconds at least
WINDOW_SHARE, WINDOW_S = 1.0 / 50.0, 5.0
# An axis of an effect's trace is drawn if it holds this share of its energy
AXIS_SHARE = 0.1
RESAMPLES = 500


def _stamps(series: DiagnosisSeries) -> Array:
    """(M,) ns: the recordings one after the other, far enough apart for the axis to cut out what is between them."""
    apart = CUT_FROM_S + float(series.time.max()) * len(series.recordings)
    return np.asarray(1e9 * (series.time + series.recording_of * (series.time.max() + apart)), dtype=np.int64)


def _window(series: DiagnosisSeries) -> int:
    """Samples in a running mean."""
    interval = float(np.median(np.diff(series.time)))
    return max(3, round(WINDOW_S / interval), round(WINDOW_SHARE * len(series.time)))


def regime_picture(series: DiagnosisSeries, with_effects: bool) -> Picture:
    """The gap in each regime of motion, without and with the effects."""
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
    """Gap (m/s) in a part of the samples and its 95 per cent interval, by a bootstrap over blocks."""
    excess = np.bincount(block[mask], (residual**2 - floor)[mask].sum(axis=1), minlength=block.max() + 1)
    counts = np.bincount(block[mask], minlength=block.max() + 1)
    at = np.random.default_rng(0).integers(0, len(counts), (RESAMPLES, len(counts)))
    resampled = excess[at].sum(axis=1) / np.maximum(counts[at].sum(axis=1), 1)
    low, high = np.percentile(resampled, [2.5, 97.5])
    value, low, high = np.sqrt(np.maximum([excess.sum() / counts.sum(), low, high], 0.0)).tolist()
    return value, low, high


def trace_pictures(name: str, series: DiagnosisSeries, axes: Mapping[str, str]) -> Iterable[Picture]:
    """An effect's trace over time, and against what was measured."""
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
                f"{name}, {where}", f"Measured trace {where} beside the trace of {name}, running mean in mm/s",
                figures.over_time, time, stamps_ns, lines, points, f"{where}, mm/s",
            )  # fmt: skip
    drawn = energy > AXIS_SHARE * energy.sum()
    yield picture(
        f"Measured against {name}", f"Means of what was measured in groups of what {name} adds, with 95 % intervals",
        figures.measured_against_effect, trace[:, drawn].ravel(), measured[:, drawn].ravel(),
        caption="Points on the line: what was measured is what the effect adds.",
    )  # fmt: skip
