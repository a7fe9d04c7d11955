"""The noise of the residual: how large, how coloured, in which frame; and how to whiten with it.

Per axis, noise = level(t) · ARMA(p, 1): white noise of both sensors plus what the receiver's filter and the sky add
to the reference. The level may grow with speed, turn rate and acceleration. Everything is estimated from the residual.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from ..calibration.frames import Array

# Innovations beyond so many standard deviations pull no harder than at it (Huber)
HUBER = 2.5
# Time constant, s, of the slowest noise of a receiver; an effect that comes and goes within a run is slower
LONGEST_S = 15.0
ORDERS = ((0, 0), (1, 0), (1, 1))
_STARTS = (0.0, 0.9)


@dataclass(frozen=True)
class Arma:
    """(1 - Σ ar_i B^i) noise = (1 + ma B) innovation; std: of the innovation; ratio: std of the noise over it."""

    ar: Array
    ma: float
    std: float
    ratio: float

    def innovations(self, series: Array) -> Array:
        """Innovations (M, ...) over std, of series (M, ...) that begins after a gap."""
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
    """Noise of M samples on three axes.

    segments: the stretches without a gap. rotation: (M, 3, 3), frame of the noise from body, None if it is the body.
    level: (M, 3), relative standard deviation. axes: one ARMA each. memory: largest partial autocorrelation: what lasts
    longer than that is no noise.
    """

    segments: tuple[slice, ...]
    rotation: Array | None
    level: Array
    axes: tuple[Arma, ...]
    memory: float = 0.998

    def whiten(self, values: Array) -> Array:
        """Body-frame values (M, 3, ...) as white noise of unit variance would be, flattened to (3 M, ...)."""
        scaled = self._scaled(values)
        white = np.empty_like(scaled)
        for part in self.segments:
            for axis, arma in enumerate(self.axes):
                white[part, axis] = arma.innovations(scaled[part, axis])
        return white.reshape(-1, *values.shape[2:])

    def unwhiten(self, white: Array) -> Array:
        """Inverse of `whiten` for one series: (3 M,) -> (M, 3)."""
        innovations = white.reshape(-1, 3)
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
        """The same with the ARMA of each axis fitted to a residual (M, 3), of the order that BIC takes."""
        scaled = self._scaled(residual)
        return replace(
            self, axes=tuple(_fit_arma(scaled[:, axis], self.segments, self.memory, orders) for axis in range(3))
        )

    def updated(self, residual: Array) -> Noise:
        """`refitted` at the orders as they are."""
        scaled = self._scaled(residual)
        return replace(
            self,
            axes=tuple(
                _fit_arma(scaled[:, axis], self.segments, self.memory, [(len(arma.ar), int(arma.ma != 0.0))], arma)
                for axis, arma in enumerate(self.axes)
            ),
        )

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
        """-2 log likelihood of a residual (M, 3), but for a constant."""
        white = self.whiten(residual)
        logarithms = np.log(self.level).sum() + sum(np.log(arma.std) for arma in self.axes) * len(self.level)
        first = sum(np.log(arma.ratio) for arma in self.axes) * len(self.segments)
        return float(white @ white + 2.0 * (logarithms + first))

    def robust(self, residual: Array) -> Array:
        """The residual (M, 3) with its innovations winsorised: what least squares then makes of it is Huber's.

        Pseudo-values ψ(r) / E[ψ'] of the innovations r about zero; so it must be the residual of a good fit.
        """
        white = self.whiten(residual).reshape(-1, 3)
        scale = 1.4826 * np.median(np.abs(white), axis=0)
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
    """White noise with the standard deviation per axis that a residual (M, 3) has, robustly. interval: s."""
    scaled = residual if rotation is None else np.einsum("mij,mj->mi", rotation, residual)
    stds = np.maximum(1.4826 * np.median(np.abs(scaled), axis=0), 1e-9)
    axes = tuple(Arma(np.zeros(0), 0.0, float(std), 1.0) for std in stds)
    return Noise(segments, rotation, np.ones_like(residual), axes, float(np.exp(-interval / LONGEST_S)))


def _fit_arma(
    series: Array,
    segments: Sequence[slice],
    memory: float,
    orders: Sequence[tuple[int, int]],
    start: Arma | None = None,
) -> Arma:
    """ARMA of the order with the smallest BIC, by conditional least squares."""
    n = len(series)
    best, best_bic = None, np.inf
    for p, q in orders:
        if p + q == 0:
            candidates: list[Array] = [np.zeros(0)]
        else:
            starts = [_encoded(start, q)] if start is not None else [_start(p, q, value) for value in _STARTS]
            candidates = [_fitted(series, segments, memory, p, at) for at in starts]
        for encoded in candidates:
            ar, ma = _decoded(encoded, p)
            squares = float(np.mean(_innovations(series, segments, ar, ma) ** 2))
            bic = n * np.log(max(squares, 1e-30)) + (p + q) * np.log(n)
            if bic < best_bic:
                best_bic = bic
                best = Arma(ar, ma, max(np.sqrt(squares), 1e-12), _ratio(ar, ma))
    assert best is not None
    return best


def _fitted(series: Array, segments: Sequence[slice], memory: float, p: int, start: Array) -> Array:
    std = float(np.std(series)) or 1.0
    bound = float(np.arctanh(memory))
    start = np.clip(start, -0.999 * bound, 0.999 * bound)

    def residual(encoded: Array) -> Array:
        return _innovations(series, segments, *_decoded(encoded, p)) / std

    return np.asarray(least_squares(residual, start, xtol=1e-4, ftol=1e-6, max_nfev=25, bounds=(-bound, bound)).x)


def _innovations(series: Array, segments: Sequence[slice], ar: Array, ma: float) -> Array:
    numerator, denominator = np.concatenate([[1.0], -ar]), [1.0, ma]
    ratio = _ratio(ar, ma)
    out = np.empty_like(series)
    for part in segments:
        out[part] = lfilter(numerator, denominator, series[part])
        out[part.start] /= ratio
    return out


def _start(p: int, q: int, value: float) -> Array:
    return np.concatenate([np.arctanh([value] + [0.0] * (p - 1)), np.full(q, np.arctanh(-0.8 * value))])


def _encoded(arma: Arma, q: int) -> Array:
    """Partial autocorrelations and ma, each through atanh: any real numbers are a stationary, invertible ARMA."""
    ar = arma.ar.copy()
    partial = np.zeros(len(ar))
    for k in range(len(ar) - 1, -1, -1):
        partial[k] = ar[k]
        if k:
            ar = (ar[:k] + partial[k] * ar[:k][::-1]) / (1.0 - partial[k] ** 2)
    return np.clip(np.arctanh(np.clip(np.concatenate([partial, [arma.ma] * q]), -0.998, 0.998)), -3.49, 3.49)


def _decoded(encoded: Array, p: int) -> tuple[Array, float]:
    values = np.tanh(encoded)
    ar = np.zeros(0)
    for partial in values[:p]:
        ar = np.concatenate([ar - partial * ar[::-1], [partial]])
    return ar, float(values[p]) if len(values) > p else 0.0


def _ratio(ar: Array, ma: float) -> float:
    """Standard deviation of the noise over that of its innovations, from the impulse response."""
    if not len(ar) and ma == 0.0:
        return 1.0
    impulse = np.zeros(2000)
    impulse[0] = 1.0
    response = lfilter([1.0, ma], np.concatenate([[1.0], -ar]), impulse)
    return float(np.sqrt(response @ response))
