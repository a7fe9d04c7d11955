"""Noise of the residual: level, colour and frame, and whitening.

Per axis, noise = level(t) · ARMA(1, 1) or less: white noise of both sensors plus coloured noise of the receiver's
filter and the sky in the reference. The level may depend on reported covariances, speed and turn rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...effects.base import recursion
from .whitened_least_squares import root_of_inverse

# Standard deviations from which innovations have constant influence (Huber)
HUBER = 2.5
# Passes of winsorising: an outlier is in its neighbours' predictions until it is corrected
WINSORISED_TIMES = 3
# Least share of a good fit's innovations within that; of Student's t with 3 degrees of freedom 0.93
MIN_NEAR_SHARE = 0.5
# Time constant, s, of the slowest receiver noise; intermittent effects are slower
LONGEST_S = 15.0
ORDERS = ((0, 0), (1, 0), (1, 1))
# Periodogram bins after averaging neighbours
MAX_FREQUENCIES = 300
# Points per coefficient of an ARMA's posterior, and largest inverse hyperbolic tangent of a moving average
POSTERIOR_POINTS, MA_REACH = 40, 2.5
# Upper bound of the share of noise at a frequency that a fit absorbs
MAX_ABSORBED_SHARE = 0.99
# Share of a whitened value that is rounding
ROUNDED_TO = 1e-12
# m/s; below any instrument's resolution: streams equal to rounding would otherwise have no noise
LEAST_MPS = 1e-6
Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Arma:
    """ARMA noise (1 - Σ ar_i B^i) noise = (1 + ma B) innovation. std: of the innovation; ratio: of both stds."""

    ar: Array
    ma: float
    std: float
    ratio: float

    def innovations(self, series: Array, starts: Integers) -> Array:
        """Return standardised innovations (M, ...) of series (M, ...), which restart at every start."""
        if not len(self.ar) and not self.ma:
            return series / self.std
        known = self._after(series, starts, -self.ar[0] if len(self.ar) else 0.0)
        white = self._recursion(known, starts, -self.ma)
        white /= self.std
        white[starts] /= self.ratio  # the first sample has the noise's own variance
        return white

    def series(self, innovations: Array, starts: Integers) -> Array:
        """Invert `innovations`."""
        white = innovations * self.std
        white[starts] *= self.ratio
        return self._recursion(self._after(white, starts, self.ma), starts, self.ar[0] if len(self.ar) else 0.0)

    @property
    def given_others(self) -> float:
        """Return the standard deviation of a sample given all others."""
        a = float(self.ar[0]) if len(self.ar) else 0.0
        return self.std / float(np.sqrt(1.0 + (a + self.ma) ** 2 / (1.0 - self.ma**2)))

    def deviations(self, series: Array, segments: Sequence[slice]) -> Array:
        """Return the deviations (M,) of samples from the prediction by all others of their segment, standardised."""
        found = np.zeros_like(series)
        start = np.zeros(1, dtype=np.intp)
        for part in segments:
            if part.stop > part.start:
                backwards = self.innovations(series[part], start)[::-1]
                found[part] = self.innovations(backwards, start)[::-1]
        return found * self.given_others

    @staticmethod
    def _after(series: Array, starts: Integers, share: float) -> Array:
        """Return the series plus a share of the previous sample, except at starts."""
        after = series.copy()
        if share:
            after[1:] += share * series[:-1]
            after[starts] = series[starts]
        return after

    @staticmethod
    def _recursion(added: Array, starts: Integers, share: float) -> Array:
        """Return x_n = share x_(n-1) + added_n, restarted at starts."""
        if not share:
            return added
        decay = np.full(len(added), share)
        decay[starts] = 0.0
        return recursion(decay, added)


@dataclass(frozen=True)
class Noise:
    """Noise of M samples on A axes.

    segments: ranges without a gap.
    rotation: (M, A, A), frame of the noise from the residual's, None if equal.
    level: (M, A), relative standard deviation.
    axes: one ARMA each.
    memory: largest autocorrelation of neighbours: slower variation is no noise.
    """

    segments: tuple[slice, ...]
    rotation: Array | None
    level: Array
    axes: tuple[Arma, ...]
    memory: float = 0.998

    def whiten(self, values: Array) -> Array:
        """Whiten values (M, A, ...) to unit variance, flattened to (M A, ...)."""
        white = self._scaled(values)
        for axis, arma in enumerate(self.axes):
            white[:, axis] = arma.innovations(white[:, axis], self._starts)
        return white.reshape(-1, *values.shape[2:])

    def part(self, rows: slice) -> Noise:
        """Return the noise of some samples; it restarts at their first."""
        ends = ((max(each.start, rows.start), min(each.stop, rows.stop)) for each in self.segments)
        segments = tuple(slice(start - rows.start, stop - rows.start) for start, stop in ends if start < stop)
        rotation = None if self.rotation is None else self.rotation[rows]
        return replace(self, segments=segments, rotation=rotation, level=self.level[rows])

    def unwhiten(self, white: Array) -> Array:
        """Invert `whiten` for one series: (M A,) -> (M, A)."""
        innovations = white.reshape(self.level.shape)
        scaled = np.empty_like(innovations)
        for axis, arma in enumerate(self.axes):
            scaled[:, axis] = arma.series(innovations[:, axis], self._starts)
        return self._unscaled(scaled)

    def _unscaled(self, scaled: Array) -> Array:
        values = scaled * self.level
        return values if self.rotation is None else np.einsum("mji,mj->mi", self.rotation, values)

    @property
    def _starts(self) -> Integers:
        return _starts_of(self.segments)

    @cached_property
    def _levelled(self) -> Array | None:
        """Return the rotation divided by the level, (M, A, A)."""
        return None if self.rotation is None else self.rotation / self.level[:, :, None]

    def _scaled(self, values: Array) -> Array:
        """Divide values (M, A, ...) by the noise level, in the frame of the noise."""
        if self._levelled is None:
            return values / self.level.reshape(*self.level.shape, *[1] * (values.ndim - 2))
        if values.ndim == 2:
            return np.asarray(np.einsum("mij,mj->mi", self._levelled, values))
        return self._levelled @ values  # a fifth of einsum's time for several columns

    def refitted(
        self, residual: Array, orders: Sequence[tuple[int, int]] = ORDERS, absorbed: Array | None = None
    ) -> Noise:
        """Fit the ARMA of each axis to a residual (M, A), of the order with the least BIC.

        absorbed: (A, F) share of the noise that a fit has absorbed (`absorbed_by`); None: nothing.
        """
        scaled = self._scaled(residual)
        each: Sequence[Array | None] = [None] * len(self.axes) if absorbed is None else list(absorbed)
        axes = tuple(
            _fit_arma(column, self.segments, self.memory, orders, of_it)
            for column, of_it in zip(scaled.T, each, strict=True)
        )
        return replace(self, axes=axes)

    def absorbed_by(self, columns: Array, std: Array) -> Array:
        """Return the share (A, M // 2 + 1) of noise, by axis and frequency, absorbed by a fit of columns (M, A, p).

        std: (p,) of the fit's prior. Slow noise is absorbed most. Uncorrected, the noise is too white: slow effects
        appear.
        """
        white = self.whiten(columns)
        m = len(columns)
        # For orthonormal columns it is the sum of their power. Two columns in one complex series: their power is the
        # mean of its power at a frequency and at minus that frequency
        root = root_of_inverse(white.T @ white + np.diag(std**-2.0))
        root = np.concatenate([root, np.zeros((len(root) % 2, len(root)))])
        waves = fft((white @ root.T).view(complex).reshape(m, len(self.axes), -1), axis=0, overwrite_x=True)
        parts = waves.view(float)
        power = np.einsum("map,map->am", parts, parts) / m
        half = np.arange(m // 2 + 1)
        return np.clip(0.5 * (power[:, half] + power[:, -half]), 0.0, MAX_ABSORBED_SHARE)

    @property
    def memory_samples(self) -> int:
        """Return the number of samples in which whitened values fade to `ROUNDED_TO` after the last nonzero one."""
        largest = max(abs(arma.ma) for arma in self.axes)
        return 1 + (int(np.log(ROUNDED_TO) / np.log(largest)) if largest else 0)

    @property
    def is_coloured(self) -> bool:
        """Return whether any axis is coloured."""
        return any(arma.ratio > 1.0 for arma in self.axes)

    @property
    def white(self) -> Noise:
        """Return white noise of the same size."""
        axes = tuple(Arma(np.zeros(0), 0.0, arma.std * arma.ratio, 1.0) for arma in self.axes)
        return replace(self, axes=axes)

    def like(self, residual: Array) -> Noise:
        """Refit to a residual (M, A) at the same orders."""
        scaled = self._scaled(residual)
        axes = tuple(
            _fit_arma(scaled[:, axis], self.segments, self.memory, [(len(arma.ar), int(arma.ma != 0.0))])
            for axis, arma in enumerate(self.axes)
        )
        return replace(self, axes=axes)

    def drawn(self, residual: Array, absorbed: Array, count: int, rng: np.random.Generator) -> Iterator[Array]:
        """Yield `count` simulated residuals (M, A) under colours drawn from their posterior, given a residual (M, A).

        Few independent values of slow noise determine its memory, and a mean of noise varies with it. absorbed: (A, F),
        from `absorbed_by`.
        """
        each = [
            [spectrum.arma(*drawn, series, self.segments) for drawn in spectrum.drawn(self.memory, count, rng)]
            for series, lost in zip(self._scaled(residual).T, absorbed, strict=True)
            for spectrum in [_spectrum(series, lost)]
        ]  # fmt: skip
        for axes in zip(*each, strict=True):
            yield replace(self, axes=axes).unwhiten(rng.standard_normal(residual.size))

    def deviance(self, residual: Array) -> float:
        """Return -2 log likelihood of a residual (M, A), up to a constant."""
        white = self.whiten(residual)
        return float(white @ white) + self.log_size

    @property
    def log_size(self) -> float:
        """Return the log determinant of the covariance."""
        logarithms = np.log(self.level).sum() + sum(np.log(arma.std) for arma in self.axes) * len(self.level)
        first = sum(np.log(arma.ratio) for arma in self.axes) * len(self.segments)
        return float(2.0 * (logarithms + first))

    def robust(self, residual: Array) -> Array:
        """Winsorise each sample of a residual (M, A) given all others, so that least squares is Huber's estimate.

        Pseudo-values ψ(r) / E[ψ'] about zero, so the fit must be good. An axis with most samples far from zero belongs
        to a bad fit and is unchanged. Innovations are not winsorised: an outlier is also in later ones, which would
        shift the level of slow noise.
        """
        scaled = self._scaled(residual)
        stds = np.array([arma.given_others for arma in self.axes])
        beyond = np.zeros_like(scaled)
        for _ in range(WINSORISED_TIMES):
            cleaned = scaled - beyond * stds
            deviation = beyond + np.stack(
                [arma.deviations(series, self.segments) for arma, series in zip(self.axes, cleaned.T, strict=True)], 1
            )
            scale = robust_std(deviation)
            share_within = np.mean(np.abs(deviation) < HUBER * scale, axis=0)
            beyond = deviation - np.clip(deviation, -HUBER * scale, HUBER * scale)
        pseudo = (scaled - beyond * stds) / np.maximum(share_within, MIN_NEAR_SHARE)
        return self._unscaled(np.where(share_within > MIN_NEAR_SHARE, pseudo, scaled))


def white_noise(residual: Array, segments: tuple[slice, ...], rotation: Array | None, interval: float = 1.0) -> Noise:
    """Return white noise with the robust standard deviation per axis of a residual (M, A). interval: s."""
    scaled = residual if rotation is None else np.einsum("mij,mj->mi", rotation, residual)
    stds = np.maximum(robust_std(scaled), LEAST_MPS)
    axes = tuple(Arma(np.zeros(0), 0.0, float(std), 1.0) for std in stds)
    return Noise(segments, rotation, np.ones_like(residual), axes, float(np.exp(-interval / LONGEST_S)))


def _starts_of(segments: Sequence[slice]) -> Integers:
    """Return the starts of segments that are not empty."""
    return np.array([part.start for part in segments if part.stop > part.start], dtype=np.intp)


def _fit_arma(
    series: Array,
    segments: Sequence[slice],
    memory: float,
    orders: Sequence[tuple[int, int]],
    absorbed: Array | None = None,
) -> Arma:
    """Fit ARMA(1, 1) or less, of least BIC, by Whittle's likelihood restricted to noise that is not absorbed.

    With g the spectrum over that of its innovations, and k the share of each frequency that a fit has left, n mean(k)
    log(mean(periodogram / g) / mean(k)) + n mean(k log g) is the deviance; the mean of log g is 0.
    """
    spectrum, best = _spectrum(series, absorbed), (np.inf, 0.0, 0.0)
    for p, q in orders:
        deviance, ar, ma = spectrum.best_arma(memory, p, q)
        best = min(best, (deviance + (p + q) * np.log(len(series)), ar, ma))
    return spectrum.arma(*best[1:], series, segments)


@dataclass(frozen=True)
class _Spectrum:
    """Periodogram of n samples in F bands: angular frequency per sample, share of all frequencies, power and absorbed
    share times that."""

    n: int
    frequency: Array
    share: Array
    power: Array
    lost: Array

    @property
    def left(self) -> float:
        """Return the share of the noise that no fit has absorbed."""
        return 1.0 - float(self.lost.sum())

    def arma(self, ar: float, ma: float, series: Array, segments: Sequence[slice]) -> Arma:
        """Return the ARMA with the standard deviation of the innovations of a series."""
        coefficients = np.array([ar]) if ar else np.zeros(0)
        unit = Arma(coefficients, ma, 1.0, _ratio(coefficients, ma))
        std = float(np.sqrt(np.mean(unit.innovations(series, _starts_of(segments)) ** 2) / self.left))
        return replace(unit, std=max(std, LEAST_MPS))

    def deviances(self, ars: Array, mas: Array) -> Array:
        """Return the deviance (Q, P) of ARMA(1, 1) noise by coefficients ars (P,) and mas (Q,)."""
        ars, mas, wave = ars[None, :], mas[:, None], np.cos(self.frequency)
        moments = np.column_stack([self.power, self.power * wave])
        # the mean of power over spectrum, with |1 - ar e^iω|² = 1 + ar² - 2 ar cos ω and the like of ma
        of_ma = 1.0 + mas**2 + 2.0 * mas * wave
        even, odd = ((1.0 / of_ma) @ moments).T[:, :, None]
        mean = (1.0 + ars**2) * even - 2.0 * ars * odd
        logarithm = np.log(1.0 + ars.T**2 - 2.0 * ars.T * wave) @ self.lost - (np.log(of_ma) @ self.lost)[:, None]
        # noise at low frequencies is no smaller than at high ones; if it seems so, a fit has absorbed it
        value = self.n * (self.left * np.log(np.maximum(mean, 1e-300) / self.left) + logarithm)
        return np.asarray(np.where(ars + mas >= -1e-12, value, np.inf))

    def best_arma(self, memory: float, p: int, q: int) -> tuple[float, float, float]:
        """Return deviance, ar and ma of the best ARMA(p, q), by a grid search refined about its best point."""
        bound = float(np.arctanh(memory))
        centre, reach = np.zeros(2), np.array([bound if p else 0.0, MA_REACH if q else 0.0])
        best = (np.inf, 0.0, 0.0)
        for _ in range(5 if p or q else 1):
            ars, mas = (
                np.tanh(np.unique(np.clip(np.linspace(c - r, c + r, 15), -b, b))) if r else np.zeros(1)
                for c, r, b in zip(centre, reach, (bound, MA_REACH), strict=True)
            )
            deviance = self.deviances(ars, mas)
            row, column = divmod(int(np.argmin(deviance)), ars.size)
            best = min(best, (float(deviance[row, column]), float(ars[column]), float(mas[row])))
            centre = np.arctanh(np.clip(best[1:], -0.9999, 0.9999))
            reach = reach / 4.0
        return best

    def drawn(self, memory: float, count: int, rng: np.random.Generator) -> list[tuple[float, float]]:
        """Draw ar and ma from their posterior; every memory up to the longest is equally likely a priori."""
        memories = np.geomspace(1.0, -1.0 / np.log(memory), POSTERIOR_POINTS)
        ars, mas = np.exp(-1.0 / memories), np.tanh(np.linspace(-MA_REACH, MA_REACH, POSTERIOR_POINTS))
        deviance = self.deviances(ars, mas)
        weights = np.exp(-0.5 * (deviance - deviance.min())) * memories
        at = rng.choice(weights.size, count, p=weights.ravel() / weights.sum())
        return [(float(ars[i % ars.size]), float(mas[i // ars.size])) for i in at]


def _spectrum(series: Array, absorbed: Array | None) -> _Spectrum:
    """Return the spectrum of a series (n,): means over bands. absorbed: (n // 2 + 1,) share that a fit has absorbed."""
    power = np.abs(np.fft.rfft(series)[1:]) ** 2 / len(series)
    frequency = np.pi * np.arange(1, len(power) + 1) / max(len(power), 1)
    # the lowest frequencies unaveraged: colour is there
    edges = np.unique(np.concatenate([np.arange(min(60, len(power))), np.linspace(0, len(power), MAX_FREQUENCIES)]))
    starts = np.unique(edges.astype(int))[:-1]
    counts = np.diff(np.append(starts, len(power)))
    lost = np.zeros_like(power) if absorbed is None else absorbed[1:]
    frequency, power, lost = (np.add.reduceat(each, starts) / counts for each in (frequency, power, lost))
    share = counts / counts.sum()
    return _Spectrum(len(series), frequency, share, power * share, lost * share)


def _ratio(ar: Array, ma: float) -> float:
    """Return the standard deviation of the noise divided by the standard deviation of its innovations."""
    a = float(ar[0]) if len(ar) else 0.0
    return float(np.sqrt(1.0 + (a + ma) ** 2 / (1.0 - a**2)))
