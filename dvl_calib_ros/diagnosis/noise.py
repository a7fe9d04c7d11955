"""The noise of the residual: how large, how coloured, in which frame; and how to whiten with it.

Per axis, noise = level(t) · ARMA(p, 1): white noise of both sensors plus what the receiver's filter and the sky add
to the reference. The level may grow with speed, turn rate and acceleration. Everything is estimated from the residual.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter
from scipy.stats import median_abs_deviation

from ..calibration.frames import Array

# Innovations beyond so many standard deviations pull no harder than at it (Huber)
HUBER = 2.5
# Time constant, s, of the slowest noise of a receiver; an effect that comes and goes within a run is slower
LONGEST_S = 15.0
ORDERS = ((0, 0), (1, 0), (1, 1))
# of a periodogram, after averaging neighbours
MAX_FREQUENCIES = 300


@dataclass(frozen=True)
class Arma:
    """(1 - Σ ar_i B^i) noise = (1 + ma B) innovation; std: of the innovation; ratio: std of the noise over it."""

    ar: Array
    ma: float
    std: float
    ratio: float

    def innovations(self, series: Array) -> Array:
        """Innovations (M, ...) over std, of series (M, ...) that begins after a gap."""
        if not len(self.ar) and not self.ma:
            return series / self.std
        numerator = np.concatenate([[1.0], -self.ar])
        white = lfilter(numerator, [1.0, self.ma], series, axis=0) / self.std
        white[0] /= self.ratio  # nothing is known before the first, so it is as uncertain as the noise itself
        return np.asarray(white)

    def series(self, innovations: Array) -> Array:
        """Inverse of `innovations`."""
        white = innovations * self.std
        white[0] *= self.ratio
        return np.asarray(lfilter([1.0, self.ma], np.concatenate([[1.0], -self.ar]), white, axis=0))


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
        scaled = self._scaled(values)
        white = np.empty_like(scaled)
        for part in self.segments:
            for axis, arma in enumerate(self.axes):
                white[part, axis] = arma.innovations(scaled[part, axis])
        return white.reshape(-1, *values.shape[2:])

    def unwhiten(self, white: Array) -> Array:
        """Inverse of `whiten` for one series: (M A,) -> (M, A)."""
        innovations = white.reshape(self.level.shape)
        scaled = np.empty_like(innovations)
        for part in self.segments:
            for axis, arma in enumerate(self.axes):
                scaled[part, axis] = arma.series(innovations[part, axis].copy())
        values = scaled * self.level
        return values if self.rotation is None else np.einsum("mji,mj->mi", self.rotation, values)

    def _scaled(self, values: Array) -> Array:
        if self.rotation is not None:
            values = np.einsum("mij,mj...->mi...", self.rotation, values)
        return values / self.level.reshape(*self.level.shape, *[1] * (values.ndim - 2))

    def refitted(self, residual: Array, orders: Sequence[tuple[int, int]] = ORDERS) -> Noise:
        """The same with the ARMA of each axis fitted to a residual (M, A), of the order that BIC takes."""
        scaled = self._scaled(residual)
        axes = tuple(_fit_arma(column, self.segments, self.memory, orders) for column in scaled.T)
        return replace(self, axes=axes)

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
        logarithms = np.log(self.level).sum() + sum(np.log(arma.std) for arma in self.axes) * len(self.level)
        first = sum(np.log(arma.ratio) for arma in self.axes) * len(self.segments)
        return float(white @ white + 2.0 * (logarithms + first))

    def robust(self, residual: Array) -> Array:
        """The residual (M, A) with its innovations winsorised: what least squares then makes of it is Huber's.

        Pseudo-values ψ(r) / E[ψ'] of the innovations r about zero; so it must be the residual of a good fit.
        """
        white = self.whiten(residual).reshape(residual.shape)
        scale = median_abs_deviation(white, axis=0, scale="normal")
        pseudo = np.clip(white, -HUBER * scale, HUBER * scale)
        pseudo /= np.mean(np.abs(white) < HUBER * scale, axis=0)
        return self.unwhiten(pseudo.ravel())


def segments_of(times: Sequence[Array]) -> tuple[slice, ...]:
    """Stretches of the concatenated times, one array per recording, without a gap of three intervals or more."""
    parts: list[slice] = []
    begin = 0
    for time in times:
        steps = np.diff(time)
        limit = 3.0 * float(np.median(steps)) if len(steps) else 0.0
        edges = [0, *(np.flatnonzero(steps > limit) + 1).tolist(), len(time)]
        parts += [slice(begin + a, begin + b) for a, b in itertools.pairwise(edges)]
        begin += len(time)
    return tuple(parts)


def white_noise(residual: Array, segments: tuple[slice, ...], rotation: Array | None, interval: float = 1.0) -> Noise:
    """White noise with the standard deviation per axis that a residual (M, A) has, robustly. interval: s."""
    scaled = residual if rotation is None else np.einsum("mij,mj->mi", rotation, residual)
    stds = np.maximum(median_abs_deviation(scaled, axis=0, scale="normal"), 1e-9)
    axes = tuple(Arma(np.zeros(0), 0.0, float(std), 1.0) for std in stds)
    return Noise(segments, rotation, np.ones_like(residual), axes, float(np.exp(-interval / LONGEST_S)))


def _fit_arma(series: Array, segments: Sequence[slice], memory: float, orders: Sequence[tuple[int, int]]) -> Arma:
    """ARMA(1, 1) or less, of the order with the smallest BIC, by Whittle's likelihood.

    With g the spectrum over that of its innovations, n log mean(periodogram / g) is the deviance.
    """
    n = len(series)
    frequency, power = _periodogram(series)
    best = (np.inf, 0.0, 0.0)
    for p, q in orders:
        deviance, ar, ma = _searched(frequency, power, n, memory, p, q)
        best = min(best, (deviance + (p + q) * np.log(n), ar, ma))
    _, ar, ma = best
    coefficients = np.array([ar]) if ar else np.zeros(0)
    std = float(np.sqrt(np.mean(_innovations(series, segments, coefficients, ma) ** 2)))
    return Arma(coefficients, ma, max(std, 1e-12), _ratio(coefficients, ma))


def _periodogram(series: Array) -> tuple[Array, Array]:
    """Angular frequency per sample (F,) and power, means over even parts of all frequencies."""
    power = np.abs(np.fft.rfft(series)[1:]) ** 2 / len(series)
    frequency = np.pi * np.arange(1, len(power) + 1) / max(len(power), 1)
    # the lowest one by one, since colour is there
    edges = np.unique(np.concatenate([np.arange(min(60, len(power))), np.linspace(0, len(power), MAX_FREQUENCIES)]))
    starts = np.unique(edges.astype(int))[:-1]
    counts = np.diff(np.append(starts, len(power)))
    return np.add.reduceat(frequency, starts) / counts, np.stack([np.add.reduceat(power, starts) / counts, counts])


def _searched(frequency: Array, power: Array, n: int, memory: float, p: int, q: int) -> tuple[float, float, float]:
    """Deviance, ar and ma of the best ARMA(p, q), on a grid made finer about its best point."""
    power, counts = power
    bound = float(np.arctanh(memory))
    centre, reach = np.zeros(2), np.array([bound if p else 0.0, 2.5 if q else 0.0])
    best = (np.inf, 0.0, 0.0)
    wave = np.cos(frequency)
    for _ in range(5):
        axes = [np.unique(np.clip(np.linspace(c - r, c + r, 15), -b, b)) if r else np.zeros(1)
                for c, r, b in zip(centre, reach, (bound, 2.5), strict=True)]  # fmt: skip
        ars, mas = np.tanh(axes[0])[:, None], np.tanh(axes[1])[:, None]
        numerator = 1.0 + mas**2 + 2.0 * mas * wave
        denominator = 1.0 + ars**2 - 2.0 * ars * wave
        mean = (1.0 / numerator) @ (power * counts * denominator).T / counts.sum()
        deviance = n * np.log(np.maximum(mean, 1e-300)).ravel()
        ar, ma = (each.ravel() for each in np.meshgrid(ars, mas))
        # no noise is quieter at low frequencies than at high ones: where it looks so, a fit has taken them in
        deviance = np.where(ar + ma >= -1e-12, deviance, np.inf)
        at = int(np.argmin(deviance))
        best = min(best, (float(deviance[at]), float(ar[at]), float(ma[at])))
        centre = np.arctanh(np.clip(best[1:], -0.9999, 0.9999))
        reach = reach / 4.0
    return best


def _innovations(series: Array, segments: Sequence[slice], ar: Array, ma: float) -> Array:
    numerator, denominator = np.concatenate([[1.0], -ar]), [1.0, ma]
    ratio = _ratio(ar, ma)
    out = np.empty_like(series)
    for part in segments:
        out[part] = lfilter(numerator, denominator, series[part])
        out[part.start] /= ratio
    return out


def _ratio(ar: Array, ma: float) -> float:
    """Standard deviation of the noise over that of its innovations."""
    a = float(ar[0]) if len(ar) else 0.0
    return float(np.sqrt(1.0 + (a + ma) ** 2 / (1.0 - a**2)))
