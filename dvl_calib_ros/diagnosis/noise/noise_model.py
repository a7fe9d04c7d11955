"""The noise of the residual: how large, how coloured, in which frame; and how to whiten with it.

Per axis, noise = level(t) · ARMA(p, 1): white noise of both sensors plus what the receiver's filter and the sky add
to the reference. The level may grow with speed, turn rate and acceleration. Everything is estimated from the residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...effects.recursion import recursion
from .whitened_least_squares import root_of_inverse

# Innovations beyond so many standard deviations pull no harder than at it (Huber)
HUBER = 2.5
# Share of the innovations of a good fit that are within that, at least: of Student's t with 3 degrees 0.93
MOST_NEAR = 0.5
# Time constant, s, of the slowest noise of a receiver; an effect that comes and goes within a run is slower
LONGEST_S = 15.0
ORDERS = ((0, 0), (1, 0), (1, 1))
# of a periodogram, after averaging neighbours
MAX_FREQUENCIES = 300
# Share of a frequency that a fit takes in, from which on the rest tells nothing of the noise
MOST_TAKEN = 0.99
# m/s: less than any instrument writes. Of streams that are alike to rounding, calibrations would have no other end
LEAST_MPS = 1e-6
Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Arma:
    """(1 - Σ ar_i B^i) noise = (1 + ma B) innovation; std: of the innovation; ratio: std of the noise over it."""

    ar: Array
    ma: float
    std: float
    ratio: float

    def innovations(self, series: Array, starts: Integers) -> Array:
        """Innovations (M, ...) over std, of series (M, ...) of which a new one, after a gap, begins at every start."""
        if not len(self.ar) and not self.ma:
            return series / self.std
        known = self._after(series, starts, -self.ar[0] if len(self.ar) else 0.0)
        white = self._recursion(known, starts, -self.ma)
        white /= self.std
        white[starts] /= self.ratio  # nothing is known before the first, so it is as uncertain as the noise itself
        return white

    def series(self, innovations: Array, starts: Integers) -> Array:
        """Inverse of `innovations`."""
        white = innovations * self.std
        white[starts] *= self.ratio
        return self._recursion(self._after(white, starts, self.ma), starts, self.ar[0] if len(self.ar) else 0.0)

    @staticmethod
    def _after(series: Array, starts: Integers, share: float) -> Array:
        """The series and a share of the sample before, but at starts."""
        after = series.copy()
        if share:
            after[1:] += share * series[:-1]
            after[starts] = series[starts]
        return after

    @staticmethod
    def _recursion(added: Array, starts: Integers, share: float) -> Array:
        """x_n = share x_(n-1) + added_n, beginning anew at starts."""
        if not share:
            return added
        decay = np.full(len(added), share)
        decay[starts] = 0.0
        return recursion(decay, added)


@dataclass(frozen=True)
class Noise:
    """Noise of M samples on A axes.

    segments: the stretches without a gap. rotation: (M, A, A), frame of the noise from that of the residual, None if
    it is that. level: (M, A), relative standard deviation. axes: one ARMA each. memory: largest autocorrelation of
    neighbours: what lasts longer than that is no noise.
    """

    segments: tuple[slice, ...]
    rotation: Array | None
    level: Array
    axes: tuple[Arma, ...]
    memory: float = 0.998

    def whiten(self, values: Array) -> Array:
        """Values (M, A, ...) as white noise of unit variance would be, flattened to (M A, ...)."""
        white = self._scaled(values)
        for axis, arma in enumerate(self.axes):
            white[:, axis] = arma.innovations(white[:, axis], self._starts)
        return white.reshape(-1, *values.shape[2:])

    def part(self, rows: slice) -> Noise:
        """That of some samples, which no stretch goes on from or into."""
        within = [each for each in self.segments if rows.start <= each.start and each.stop <= rows.stop]
        segments = tuple(slice(each.start - rows.start, each.stop - rows.start) for each in within)
        rotation = None if self.rotation is None else self.rotation[rows]
        return replace(self, segments=segments, rotation=rotation, level=self.level[rows])

    def unwhiten(self, white: Array) -> Array:
        """Inverse of `whiten` for one series: (M A,) -> (M, A)."""
        innovations = white.reshape(self.level.shape)
        scaled = np.empty_like(innovations)
        for axis, arma in enumerate(self.axes):
            scaled[:, axis] = arma.series(innovations[:, axis], self._starts)
        values = scaled * self.level
        return values if self.rotation is None else np.einsum("mji,mj->mi", self.rotation, values)

    @property
    def _starts(self) -> Integers:
        return _starts_of(self.segments)

    @cached_property
    def _levelled(self) -> Array | None:
        """(M, A, A) the rotation with the level taken off, in one."""
        return None if self.rotation is None else self.rotation / self.level[:, :, None]

    def _scaled(self, values: Array) -> Array:
        if self._levelled is None:
            return values / self.level.reshape(*self.level.shape, *[1] * (values.ndim - 2))
        if values.ndim == 2:
            return np.asarray(np.einsum("mij,mj->mi", self._levelled, values))
        return self._levelled @ values  # of several columns in a fifth of the time

    def refitted(
        self, residual: Array, orders: Sequence[tuple[int, int]] = ORDERS, taken: Array | None = None
    ) -> Noise:
        """The same with the ARMA of each axis fitted to a residual (M, A), of the order that BIC takes.

        taken: (A, F) what of the noise a fit has taken out of the residual (`taken_by`); None: nothing.
        """
        scaled = self._scaled(residual)
        each: Sequence[Array | None] = [None] * len(self.axes) if taken is None else list(taken)
        axes = tuple(
            _fit_arma(column, self.segments, self.memory, orders, of_it)
            for column, of_it in zip(scaled.T, each, strict=True)
        )
        return replace(self, axes=axes)

    def taken_by(self, columns: Array, std: Array) -> Array:
        """(A, M // 2 + 1) share of noise like this, by axis and frequency, that a fit of columns (M, A, p) takes in.

        std: (p,) of the fit's prior. What is slow is taken in most: taken for all the noise there is, what is left has
        too little colour, and a slow effect is found in it.
        """
        white = self.whiten(columns)
        m = len(columns)
        # Of columns made orthonormal it is the sum of their power. Two of them in one complex series have the mean of
        # its powers at a frequency and at minus that
        root = root_of_inverse(white.T @ white + np.diag(std**-2.0))
        root = np.concatenate([root, np.zeros((len(root) % 2, len(root)))])
        waves = fft((white @ root.T).view(complex).reshape(m, len(self.axes), -1), axis=0, overwrite_x=True)
        parts = waves.view(float)
        power = np.einsum("map,map->am", parts, parts) / m
        half = np.arange(m // 2 + 1)
        return np.clip(0.5 * (power[:, half] + power[:, -half]), 0.0, MOST_TAKEN)

    @property
    def is_coloured(self) -> bool:
        """Whether any axis is more than white."""
        return any(arma.ratio > 1.0 for arma in self.axes)

    @property
    def white(self) -> Noise:
        """The same, as large but white."""
        axes = tuple(Arma(np.zeros(0), 0.0, arma.std * arma.ratio, 1.0) for arma in self.axes)
        return replace(self, axes=axes)

    def like(self, residual: Array) -> Noise:
        """`refitted` at the orders as they are, from scratch."""
        scaled = self._scaled(residual)
        axes = tuple(
            _fit_arma(scaled[:, axis], self.segments, self.memory, [(len(arma.ar), int(arma.ma != 0.0))])
            for axis, arma in enumerate(self.axes)
        )
        return replace(self, axes=axes)

    def deviance(self, residual: Array) -> float:
        """-2 log likelihood of a residual (M, A), but for a constant."""
        white = self.whiten(residual)
        return float(white @ white) + self.log_size

    @property
    def log_size(self) -> float:
        """Log determinant of the covariance."""
        logarithms = np.log(self.level).sum() + sum(np.log(arma.std) for arma in self.axes) * len(self.level)
        first = sum(np.log(arma.ratio) for arma in self.axes) * len(self.segments)
        return float(2.0 * (logarithms + first))

    def robust(self, residual: Array) -> Array:
        """The residual (M, A) with its innovations winsorised: what least squares then makes of it is Huber's.

        Pseudo-values ψ(r) / E[ψ'] of the innovations r about zero; so it must be the residual of a good fit. An axis on
        which most of them are far from zero is that of a bad one, and is left as it is.
        """
        white = self.whiten(residual).reshape(residual.shape)
        scale = robust_std(white)
        near = np.mean(np.abs(white) < HUBER * scale, axis=0)
        pseudo = np.clip(white, -HUBER * scale, HUBER * scale) / np.maximum(near, MOST_NEAR)
        return self.unwhiten(np.where(near > MOST_NEAR, pseudo, white).ravel())


def white_noise(residual: Array, segments: tuple[slice, ...], rotation: Array | None, interval: float = 1.0) -> Noise:
    """White noise with the standard deviation per axis that a residual (M, A) has, robustly. interval: s."""
    scaled = residual if rotation is None else np.einsum("mij,mj->mi", rotation, residual)
    stds = np.maximum(robust_std(scaled), LEAST_MPS)
    axes = tuple(Arma(np.zeros(0), 0.0, float(std), 1.0) for std in stds)
    return Noise(segments, rotation, np.ones_like(residual), axes, float(np.exp(-interval / LONGEST_S)))


def _starts_of(segments: Sequence[slice]) -> Integers:
    """Where those begin that are not empty."""
    return np.array([part.start for part in segments if part.stop > part.start], dtype=np.intp)


def _fit_arma(
    series: Array,
    segments: Sequence[slice],
    memory: float,
    orders: Sequence[tuple[int, int]],
    taken: Array | None = None,
) -> Arma:
    """ARMA(1, 1) or less, of the order with the smallest BIC, by Whittle's likelihood, restricted to what is not taken.

    With g the spectrum over that of its innovations, and k the share of each frequency that a fit has left,
    n mean(k) log(mean(periodogram / g) / mean(k)) + n mean(k log g) is the deviance; the mean of log g is 0.
    """
    n = len(series)
    frequency, power, counts, lost = _periodogram(series, taken)
    best = (np.inf, 0.0, 0.0)
    for p, q in orders:
        deviance, ar, ma = _searched(frequency, power, counts, lost, n, memory, p, q)
        best = min(best, (deviance + (p + q) * np.log(n), ar, ma))
    _, ar, ma = best
    coefficients = np.array([ar]) if ar else np.zeros(0)
    arma = Arma(coefficients, ma, 1.0, _ratio(coefficients, ma))
    left = 1.0 if taken is None else 1.0 - (2.0 * taken.sum() - taken[0] - (taken[-1] if n % 2 == 0 else 0.0)) / n
    std = float(np.sqrt(np.mean(arma.innovations(series, _starts_of(segments)) ** 2) / left))
    return replace(arma, std=max(std, LEAST_MPS))


def _periodogram(series: Array, taken: Array | None) -> tuple[Array, Array, Array, Array]:
    """Angular frequency per sample (F,), power, number and what is taken: means over even parts of all frequencies."""
    power = np.abs(np.fft.rfft(series)[1:]) ** 2 / len(series)
    frequency = np.pi * np.arange(1, len(power) + 1) / max(len(power), 1)
    # the lowest one by one, since colour is there
    edges = np.unique(np.concatenate([np.arange(min(60, len(power))), np.linspace(0, len(power), MAX_FREQUENCIES)]))
    starts = np.unique(edges.astype(int))[:-1]
    counts = np.diff(np.append(starts, len(power)))
    lost = np.zeros_like(power) if taken is None else taken[1:]
    frequency, power, lost = (np.add.reduceat(each, starts) / counts for each in (frequency, power, lost))
    return frequency, power, counts, lost


def _searched(
    frequency: Array, power: Array, counts: Array, lost: Array, n: int, memory: float, p: int, q: int
) -> tuple[float, float, float]:
    """Deviance, ar and ma of the best ARMA(p, q), on a grid made finer about its best point."""
    share, wave = counts / counts.sum(), np.cos(frequency)
    power, lost = power * share, lost * share
    left = 1.0 - float(lost.sum())
    moments = np.column_stack([power, power * wave])
    bound = float(np.arctanh(memory))
    centre, reach = np.zeros(2), np.array([bound if p else 0.0, 2.5 if q else 0.0])
    best = (np.inf, 0.0, 0.0)
    for _ in range(5 if p or q else 1):
        axes = [np.unique(np.clip(np.linspace(c - r, c + r, 15), -b, b)) if r else np.zeros(1)
                for c, r, b in zip(centre, reach, (bound, 2.5), strict=True)]  # fmt: skip
        ars, mas = np.tanh(axes[0])[None, :], np.tanh(axes[1])[:, None]
        # the mean of power over spectrum, with |1 - ar e^iω|² = 1 + ar² - 2 ar cos ω and the like of ma
        of_ma = 1.0 + mas**2 + 2.0 * mas * wave
        even, odd = ((1.0 / of_ma) @ moments).T[:, :, None]
        mean = (1.0 + ars**2) * even - 2.0 * ars * odd
        logarithm = np.log(1.0 + ars.T**2 - 2.0 * ars.T * wave) @ lost - (np.log(of_ma) @ lost)[:, None]
        # no noise is quieter at low frequencies than at high ones: where it looks so, a fit has taken them in
        value = n * (left * np.log(np.maximum(mean, 1e-300) / left) + logarithm)
        deviance = np.where(ars + mas >= -1e-12, value, np.inf)
        row, column = divmod(int(np.argmin(deviance)), ars.size)
        best = min(best, (float(deviance[row, column]), float(ars[0, column]), float(mas[row, 0])))
        centre = np.arctanh(np.clip(best[1:], -0.9999, 0.9999))
        reach = reach / 4.0
    return best


def _ratio(ar: Array, ma: float) -> float:
    """Standard deviation of the noise over that of its innovations."""
    a = float(ar[0]) if len(ar) else 0.0
    return float(np.sqrt(1.0 + (a + ma) ** 2 / (1.0 - a**2)))
