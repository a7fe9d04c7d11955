"""Test of whether the reference contains the DVL's noise: it is then a filter's output that cannot judge this DVL.

Motion is smooth between samples, noise is not. A filter passes part of the DVL's noise on; independent instruments
share none. The test multiplies fourth differences of both. The vehicle's motion, which is also in both, is at worst a
random walk. For white noise of variance N and steps of variance Q the DVL's differences have

    v₂ = 6 N + 2 Q,    v₄ = 70 N + 20 Q,    and with a share κ of its noise in the reference    c₄ = 70 κ N + 20 Q,

which gives κ. Smoother motion only lowers κ. A reference too slow for differences is compared with the DVL's sample
nearest in time: the DVL's fourth difference times r - d is -6 N (1 - κ) for any motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..numerics.robust import FEWEST_VALUES, ROUNDING_MPS, median
from ..numerics.samples import Mask
from ..numerics.tests import Z_FIFTY_TESTS, Z_ONE_TEST, chance_of, chi2_isf

# Longest sample intervals, s: of both streams, because slower differences hold waves; and of a reference next to a fast
# DVL.
SLOWEST_S, SLOWEST_REFERENCE_S = 0.3, 1.2
# Time shifts of the reference against the DVL, s, for the delay of a filter and its transport.
SHIFTS_S: Array = 0.1 * np.arange(-2, 11)
# Significance of the best of these shifts, σ (Bonferroni).
Z_BEST_SHIFT = math.sqrt(chi2_isf(chance_of(Z_FIFTY_TESTS) / len(SHIFTS_S), 1.0))
# Tolerances as shares of the interval: of the intervals in a difference, and of the time between the streams' samples.
INTERVAL_TOL, TIME_TOL = 0.25, 0.6
# Differences needed per stretch (three axes); of a slow reference, samples.
MIN_DIFFERENCES = 30
# Share of the noise that is reported. A filter that smooths passes little noise on.
SHARED_FROM = 0.06
# Smallest share of noise in the differences; with less they are motion.
MIN_NOISE_SHARE = 0.3
# Largest correlation of differences without a common sample; vibration has more.
MAX_CORRELATION = 0.15
ORDER = 4
_LATER = range(ORDER + 1, 2 * ORDER + 1)


class SharedNoise:
    """Sums over stretches of DVL and reference at each of `SHIFTS_S`; constant memory."""

    def __init__(self) -> None:
        n = len(SHIFTS_S)
        self._stretches: Array = np.zeros(n)
        self._sums = np.zeros((n, 3))  # of the stretches' c₄, v₄ and 20 Q
        self._squares = np.zeros((n, 3))
        self._later: Array = np.zeros(len(_LATER))
        self._square = 0.0

    def add(self, times: Array, velocity: Array, reference_times: Array, reference: Array) -> None:
        """Add a stretch of both streams, in the same frame.

        times: (N,) s and velocity (N, 3) m/s of the DVL. reference_times: (J,) s and reference (J, 3) m/s, nan along
        unmeasured axes.
        """
        if min(len(times), len(reference_times)) <= 2 * ORDER:
            return
        step, reference_step = float(median(np.diff(times))), float(median(np.diff(reference_times)))
        if step > SLOWEST_S or reference_step > SLOWEST_REFERENCE_S:
            return
        differences = np.diff(velocity, ORDER, axis=0)[_windows(_even(times, step), ORDER)]
        self._later += [(differences[lag:] * differences[:-lag]).sum() for lag in _LATER]
        self._square += float((differences**2).sum())
        compared = _differences(times, step, velocity, reference_times, reference_step, reference)
        known = np.isfinite(compared.dvl_4) & np.isfinite(compared.reference_4)
        count = np.count_nonzero(known, axis=(1, 2))
        dvl_2, dvl_4, reference_4 = (np.where(known, column, 0.0) for column in compared)
        products = np.stack([dvl_4 * reference_4, dvl_4 * dvl_4, dvl_2 * dvl_2])
        c_4, v_4, v_2 = products.sum(axis=(2, 3)) / np.maximum(count, 1)
        is_enough = count >= (MIN_DIFFERENCES if reference_step <= SLOWEST_S else FEWEST_VALUES)
        sums = np.column_stack([c_4, v_4, 70.0 * v_2 - 6.0 * v_4]) * is_enough[:, None]
        self._stretches += is_enough
        self._sums += sums
        self._squares += sums**2

    def share(self) -> float:
        """Return the share of the DVL's noise in the reference, 0 to about 1; 0 if not significant."""
        if self._stretches.max() < FEWEST_VALUES or np.abs(self._later).max() > MAX_CORRELATION * self._square:
            return 0.0
        n = np.maximum(self._stretches, 2.0)[:, None]
        mean = self._sums / n
        std = np.sqrt(np.maximum(self._squares / n - mean**2, 0.0) / (n - 1.0))
        best = int(np.argmax(np.where(self._stretches >= FEWEST_VALUES, mean[:, 0], -math.inf)))
        c_4, v_4, motion = mean[best].tolist()
        if motion < Z_ONE_TEST * float(std[best, 2]):
            motion = 0.0
        shared, noise = c_4 - motion, v_4 - motion
        if noise < max(MIN_NOISE_SHARE * v_4, 70.0 * ROUNDING_MPS**2):
            return 0.0
        return shared / noise if shared > max(SHARED_FROM * noise, Z_BEST_SHIFT * float(std[best, 0])) else 0.0

    def contradiction(self) -> Reason | None:
        """Return the reason if the reference contains the DVL's noise."""
        share = self.share()
        return finding("REFERENCE_HOLDS_DVL", percent=100.0 * min(share, 1.0)) if share else None


class _Differences(NamedTuple):
    """Differences of simultaneous samples for S shifts, m/s: second and fourth of the DVL, fourth of the reference.

    (S or 1, N, 3) each, nan where a sample is missing.
    """

    dvl_2: Array
    dvl_4: Array
    reference_4: Array


def _differences(
    times: Array, step: float, velocity: Array, reference_times: Array, reference_step: float, reference: Array
) -> _Differences:
    """Difference both streams at the slower one's times, with the nearest samples of the faster one.

    times, reference_times: s, with usual steps. velocity, reference: see `SharedNoise.add`.
    """
    if reference_step > SLOWEST_S:
        second = np.diff(velocity, 2, axis=0, prepend=np.nan, append=np.nan)
        fourth = np.where(_evenly(times, step), np.diff(velocity, ORDER, axis=0), np.nan)
        orders = np.column_stack([np.column_stack([velocity, second])[2:-2], fourth])
        dvl, dvl_2, dvl_4 = np.split(_nearest(reference_times, step, times[2:-2], orders, -SHIFTS_S), 3, axis=2)
        # equivalent to a difference with 70 κ N of the noise: v₄ + 70 / 6 Δ⁴d (r - d)
        return _Differences(dvl_2, dvl_4, dvl_4 + 70.0 / 6.0 * _about_mean(reference - dvl))
    if reference_step < step:
        dvl_4 = np.where(_evenly(times, step), np.diff(velocity, ORDER, axis=0), np.nan)
        reference_4 = np.diff(_nearest(times, step, reference_times, reference, SHIFTS_S), ORDER, axis=1)
        return _Differences(np.diff(velocity, 2, axis=0)[None, 1:-1], dvl_4[None], reference_4)
    reference_4 = np.where(_evenly(reference_times, reference_step), np.diff(reference, ORDER, axis=0), np.nan)
    dvl = _nearest(reference_times, reference_step, times, velocity, -SHIFTS_S)
    return _Differences(np.diff(dvl, 2, axis=1)[:, 1:-1], np.diff(dvl, ORDER, axis=1), reference_4[None])


def _about_mean(values: Array) -> Array:
    """Subtract means over N of values (S, N, k) with nan, and restore their expected size."""
    known = np.isfinite(values)
    n = np.maximum(np.count_nonzero(known, axis=1, keepdims=True), 2)
    return (values - np.where(known, values, 0.0).sum(axis=1, keepdims=True) / n) * (n / (n - 1.0))


def _nearest(times: Array, step: float, other_times: Array, other: Array, shifts: Array) -> Array:
    """Return another stream's nearest samples (S, N, k) at times (N,) plus each shift (S,); nan if none is near."""
    wanted = times + shifts[:, None]
    after = np.searchsorted(other_times, wanted).clip(1, len(other_times) - 1)
    near = np.where(wanted - other_times[after - 1] < other_times[after] - wanted, after - 1, after)
    return np.where((np.abs(other_times[near] - wanted) <= TIME_TOL * step)[..., None], other[near], np.nan)


def _evenly(times: Array, step: float) -> Mask:
    """Return whether all samples of a difference (N - ORDER, 1), and the one before, are evenly spaced."""
    return _windows(np.append(True, _even(times, step)), ORDER + 1)[:, None]


def _even(times: Array, step: float) -> Mask:
    return np.asarray(np.abs(np.diff(times) - step) < INTERVAL_TOL * step)


def _windows(even: Mask, order: int) -> Mask:
    """Return which differences (N - order,) have only even steps (N - 1,)."""
    is_even: Mask = even[: len(even) - order + 1].copy()
    for at in range(1, order):
        is_even &= even[at : len(even) - order + 1 + at]
    return is_even
