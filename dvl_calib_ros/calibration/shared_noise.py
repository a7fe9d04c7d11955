"""Whether a reference holds the DVL's own noise: then a filter made it from this DVL, and it cannot judge it.

What a vehicle does is smooth from one sample to the next, noise is not. The fourth differences of both streams are
their noise, and two instruments share none of it. A filter that has taken the DVL in passes its noise on, in whole or
in part, whatever is added on top, and however large it claims its own to be.
"""

from __future__ import annotations

import math

import numpy as np

from .frames import Array
from .robust import median
from .samples import Mask

# Streams slower than this, s, show what waves do in their differences.
SLOWEST_S = 0.3
# Shifts of the reference against the DVL that are tried, s, a filter and its transport being late by some.
SHIFTS_S: Array = 0.1 * np.arange(-2, 11)
# A difference's samples are as far apart as usual, within this share, and those of both streams no further than this.
EVEN, NEAR = 0.25, 0.6
# Differences of a smaller noise (m/s) are those of rounding.
LEAST_NOISE_MPS = 1e-4
# So many differences tell anything (three axes each).
ENOUGH = 150
# Shares of the noise, and of standard deviations, from which it is said; neighbouring differences hold the same noise.
SHARED_FROM, SURE_FROM, OVERLAP = 0.3, 6.0, 2.0
# The DVL's differences are noise if those of higher order, of noise of the same size, fall by less than these shares,
# and if those that have no sample in common correlate by less than this: a shaking vehicle's do.
SMOOTH_BELOW, WHITE_BELOW, UNCORRELATED_BELOW = 0.2, 0.15, 0.15
# Orders of differences, and the variance of each for white noise of variance 1: central binomial coefficients.
ORDER = 4
_LATER = range(ORDER + 1, 2 * ORDER + 1)
_SIZES = {order: math.comb(2 * order, order) for order in (4, 6, 8)}


class SharedNoise:
    """Sums over differences of the DVL and of the reference at each of `SHIFTS_S`; constant memory."""

    def __init__(self) -> None:
        n = len(SHIFTS_S)
        self._count, self._both, self._dvl, self._reference = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        self._squares = dict.fromkeys(_SIZES, 0.0)
        self._numbers = dict.fromkeys(_SIZES, 0)
        self._later: Array = np.zeros(len(_LATER))

    def add(self, times: Array, velocity: Array, reference_times: Array, reference: Array) -> None:
        """Take a stretch of both, in the same frame.

        times: (N,) s and velocity (N, 3) m/s of the DVL. reference_times: (J,) s and reference (J, 3) m/s, nan along
        axes that are not measured.
        """
        if min(len(times), len(reference_times)) <= 2 * ORDER:
            return
        step, reference_step = float(median(np.diff(times))), float(median(np.diff(reference_times)))
        if max(step, reference_step) > SLOWEST_S:
            return
        even = _even(times, step)
        for order, size in _SIZES.items():
            differences = np.diff(velocity, order, axis=0)[_windows(even, order)]
            self._squares[order] += float((differences**2).sum()) / size
            self._numbers[order] += differences.size
            if order == ORDER:
                self._later += [(differences[lag:] * differences[:-lag]).sum() / size for lag in _LATER]
        # at the slower stream's times, of the faster one the samples next to them
        if reference_step < step:
            own, other = _beside(times, velocity, step, reference_times, reference, SHIFTS_S)
        else:
            other, own = _beside(reference_times, reference, reference_step, times, velocity, -SHIFTS_S)
        known = np.isfinite(own) & np.isfinite(other)
        own, other = np.where(known, own, 0.0), np.where(known, other, 0.0)
        self._count += np.count_nonzero(known, axis=(1, 2))
        self._both += (own * other).sum(axis=(1, 2))
        self._dvl += (own * own).sum(axis=(1, 2))
        self._reference += (other * other).sum(axis=(1, 2))

    def share(self) -> float:
        """How much of the DVL's noise the reference holds, 0 to about 1; 0 where that is not sure."""
        if min(self._numbers.values()) < 3 * ENOUGH or self._count.max() < 3 * ENOUGH:
            return 0.0
        fourth, sixth, eighth = (self._squares[order] / self._numbers[order] for order in _SIZES)
        if fourth < LEAST_NOISE_MPS**2:
            return 0.0
        smooth = 1.0 - sixth / fourth  # share of the differences that is the vehicle's own motion, which both show
        if smooth > SMOOTH_BELOW or 1.0 - eighth / sixth > WHITE_BELOW:
            return 0.0
        if np.abs(self._later).max() > UNCORRELATED_BELOW * self._squares[ORDER]:
            return 0.0
        enough = (self._count >= 3 * ENOUGH) & (self._dvl > 0.0)
        share = np.divide(self._both, self._dvl, out=np.zeros_like(self._both), where=enough)
        best = int(np.argmax(share))
        left = max(float(self._reference[best] - share[best] ** 2 * self._dvl[best]), 0.0)
        std = OVERLAP * math.sqrt(left / self._count[best] / self._dvl[best])
        found = float(share[best]) - max(smooth, 0.0)
        return found if found > max(SHARED_FROM, SURE_FROM * std) else 0.0

    def says(self) -> str:
        """What the data fit, in words, where the reference holds the DVL's noise; else ''."""
        share = self.share()
        if not share:
            return ""
        return (
            f"the data fit a reference that a filter made from this DVL (it holds {100.0 * min(share, 1.0):.0f} % of "
            "the DVL's own noise; take the GNSS velocity alone)"
        )


def _beside(
    times: Array, values: Array, step: float, other_times: Array, other: Array, shifts: Array
) -> tuple[Array, Array]:
    """Differences (S, M, k) of a stream at its times (N,), and of another one beside it, later by each shift (S,).

    Nan where the samples are not evenly apart, or there are none beside each other.
    """
    wanted = times + shifts[:, None]
    after = np.searchsorted(other_times, wanted).clip(1, len(other_times) - 1)
    near = np.where(wanted - other_times[after - 1] < other_times[after] - wanted, after - 1, after)
    beside = np.where((np.abs(other_times[near] - wanted) <= NEAR * step)[..., None], other[near], np.nan)
    even = _windows(_even(times, step), ORDER)
    own = np.where(even[:, None], np.diff(values, ORDER, axis=0), np.nan)
    return np.broadcast_to(own, (len(shifts), *own.shape)), np.diff(beside, ORDER, axis=1)


def _even(times: Array, step: float) -> Mask:
    return np.asarray(np.abs(np.diff(times) - step) < EVEN * step)


def _windows(even: Mask, order: int) -> Mask:
    """Which differences (N - order,) are over steps (N - 1,) that are all even."""
    whole: Mask = even[: len(even) - order + 1].copy()
    for at in range(1, order):
        whole &= even[at : len(even) - order + 1 + at]
    return whole
