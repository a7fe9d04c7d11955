"""The part of a diagnosis' report that shows recorded against simulated twin, and what is left of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.signal import welch

from ..calibration.frames import Array
from ..diagnosis.series import HeldOutTwin
from . import diagnosis_figures as figures
from .diagnosis import twin_errors
from .numbers import mm
from .style import Picture, picture
from .time_axis import TimeAxis

# Points of a spectrum in each decade of frequency
SPECTRUM_STEPS = 10
# Lines over time are means over this share of the run, and over so many seconds at least
WINDOW_SHARE, WINDOW_S = 1.0 / 100.0, 3.0


def twin_pictures(twin: HeldOutTwin, axes: Mapping[str, str], has_effects: bool) -> Iterable[Picture]:
    """Over time along each axis, by frequency, distribution, and by regime."""
    found = twin.errors(has_effects)
    stamps_ns = np.asarray(1e9 * twin.time, dtype=np.int64)
    time = TimeAxis(stamps_ns)
    interval = float(np.median(np.diff(twin.time)))
    points = max(3, round(WINDOW_S / interval), round(WINDOW_SHARE * len(twin.time)))
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
        f"{twin.name}: distribution", f"Histogram of recorded less twin, {names}, beside that of the noise",
        figures.histogram, pooled, twin.noise[measured],
        caption="All axes together; what lies beyond the ends is in the last bins.",
    )  # fmt: skip
    yield picture(
        f"{twin.name}: against normal noise", f"Quantiles of recorded less twin, {names}, against those of the noise",
        figures.quantiles, pooled, twin.noise[measured],
        caption="On the line, it is distributed as the noise is; what is far off runs out of the picture.",
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
    """Frequency (F,) Hz and amplitude spectral density (F,) of vectors (N, A), means over even steps of log frequency.

    Of the longest stretch without a gap.
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
