"""One stream as a function of time: interpolation, outlier rejection and noise estimate."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dst, idst
from scipy.interpolate import make_interp_spline

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...calibration.streams.outliers import deviation_from_neighbours, neighbours, without_spikes
from .claimed_noise import relative_noise
from .settings import SETTINGS

# Bands of a spectrum whose power is averaged
BANDS = 40
# Ratios of a band's power to noise up to which it is removed as noise, and from which it is kept
NOISE_POWER_RATIO, MOTION_POWER_RATIO = 1.4, 2.5
# Weights of fourth differences
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
# Longest interval, s, of a stream that resolves turns and waves: only its noise is removed; samples per smoothing cubic
FAST_ENOUGH_S, SMOOTH_SAMPLES = 0.45, 5
# Half width, s, of the difference for the derivative in a turning frame
DERIVATIVE_S = 0.05
# Largest product of the intervals to both neighbours, in usual intervals; at the middle of two samples it is 0.25
MAX_NEIGHBOUR_PRODUCT = 0.4


class EvaluationCache:
    """Cache of values at the last few sets of times: fits evaluate the same times repeatedly."""

    _LIMIT = 8

    def __init__(self) -> None:
        self._made: dict[Any, Any] = {}

    def at(self, what: str, times: Array, make: Callable[[], Any]) -> Any:
        """Return the result of `make`, cached for times (M,) s."""
        key = what, len(times), float(times.sum()), *times[[0, len(times) // 2, -1] if len(times) else []].tolist()
        made = self._made.pop(key) if key in self._made else make()
        self._made[key] = made  # newest entry
        if len(self._made) > self._LIMIT:
            self._made.pop(next(iter(self._made)))
        return made


class TurningFrame(NamedTuple):
    """Frame in which a velocity is measured, as functions of times (M,) s.

    rotation: (M, 3, 3) from the earth's frame. swing: (M, 3) m/s, velocity by the vehicle's rotation, in this frame.
    """

    rotation: Callable[[Array], Array]
    swing: Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Curve:
    """Stream as a function of time, cubic between samples. time: (N,) s, increasing. values: (N, k). reported: (k,)
    reported standard deviation. like: curve of the same stream without simulated noise, which defines the noise level.
    sample_std: (N, k) standard deviation reported per sample. frame: turning frame of the values, which are then
    interpolated in the earth's frame; None: they are interpolated as they are."""

    time: Array
    values: Array
    reported: Array | None = None
    like: Curve | None = None
    sample_std: Array | None = None
    frame: TurningFrame | None = None
    kept: EvaluationCache = field(init=False, default_factory=EvaluationCache, repr=False)

    @cached_property
    def interval(self) -> float:
        """Return the median time between samples, s."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @cached_property
    def _spline(self) -> Any:
        return make_interp_spline(self.time, self.steady, k=min(3, len(self.time) - 1))

    def __call__(self, at: Array) -> Array:
        """Return values (M, k) at times (M,) s, constant beyond the ends."""
        at = np.clip(at, self.time[0], self.time[-1])
        return self._measured(at, self._spline(at))

    @cached_property
    def steady(self) -> Array:
        """Return the values (N, k) that are interpolated: with a turning frame in the earth's, without the swing."""
        if self.frame is None:
            return self.values
        return np.einsum("nji,nj->ni", self.frame.rotation(self.time), self.values - self.frame.swing(self.time))

    def _measured(self, at: Array, steady: Array) -> Array:
        """Convert interpolated values (M, k) at times (M,) s back: the inverse of `steady`."""
        values = self._from_earth(at, steady)
        return values if self.frame is None else values + self.frame.swing(at)

    def _from_earth(self, at: Array, vectors: Array) -> Array:
        """Rotate vectors (M, k) of the earth's frame at times (M,) s; without a turning frame, they are unchanged."""
        return vectors if self.frame is None else np.einsum("nij,nj->ni", self.frame.rotation(at), vectors)

    @cached_property
    def denoised(self) -> Curve:
        """Return the curve without frequencies of pure noise, stretch by stretch.

        Noise then is equal between and at samples, and a delay does not gain from it. The sine transform about the line
        between the ends avoids ringing. Frequencies with any motion are kept: turns are rare, and a filter of least
        mean error would distort them.
        """
        values = self.values.copy()
        for part in self.stretches:
            if part.stop - part.start < SETTINGS.min_bins or self.interval > FAST_ENOUGH_S:
                continue
            spectrum, _ = _sines((self.like or self).values[part])
            variance = self.noise**2 * (self.relative_noise[part] ** 2).mean(axis=0)
            gain = np.column_stack([_gain(column**2, of) for column, of in zip(spectrum.T, variance, strict=True)])
            own, line = _sines(self.values[part])
            values[part] = line + idst(gain * own, type=2, axis=0, norm="ortho")
        return Curve(self.time, values, frame=self.frame)

    @property
    def bending(self) -> float:
        """Return the sum of squares of fourth differences, which interpolation errors follow."""
        return float((np.diff(self.steady, 4, axis=0) ** 2).sum())

    @cached_property
    def smooth(self) -> Curve:
        """Return the curve for regressors: `denoised`, or for a slow stream each sample on a local cubic."""
        if self.interval <= FAST_ENOUGH_S or len(self.time) <= SMOOTH_SAMPLES:
            return self.denoised
        return Curve(self.time, self._measured(self.time, _on_cubics(self.steady)), frame=self.frame)

    @cached_property
    def stretches(self) -> list[slice]:
        """Return the ranges without a gap."""
        breaks = np.flatnonzero(np.diff(self.time) > SETTINGS.max_gap_intervals * self.interval) + 1
        edges = [0, *breaks.tolist(), len(self.time)]
        return [slice(start, end) for start, end in pairwise(edges)]

    @cached_property
    def derivative(self) -> Any:
        """Return the derivative (M,) -> (M, k) per s of the unsmoothed curve."""
        if self.frame is None:
            return self._spline.derivative()
        return lambda at: (self(at + DERIVATIVE_S) - self(at - DERIVATIVE_S)) / (2.0 * DERIVATIVE_S)

    @cached_property
    def roughness(self) -> Array:
        """Return the standard deviation (k,) of a usual sample about its neighbours: noise, and unresolved motion.

        From fourth differences, which cancel turns and inflate white noise by √70.
        """
        if self.like is not None:
            return self.like.roughness
        if len(self.time) < 10:
            return np.zeros(self.values.shape[1])
        fourth = self._from_earth(self.time[2:-2], np.diff(self.steady, 4, axis=0))
        return robust_std(fourth / self.relative_noise[2:-2]) / np.sqrt(70.0)

    @cached_property
    def relative_noise(self) -> Array:
        """Return each sample's noise level (N, k) relative to the usual one, if reported values predict it."""
        if self.like is not None:
            return self.like.relative_noise
        return relative_noise(self.time, self.sample_std, np.diff(self.values, 4, axis=0), FOURTH)

    def part(self, kept: NDArray[np.bool_]) -> Curve:
        """Return the samples selected by a mask (N,)."""
        sample_std = None if self.sample_std is None else self.sample_std[kept]
        return Curve(self.time[kept], self.values[kept], self.reported, sample_std=sample_std, frame=self.frame)

    @cached_property
    def from_neighbours(self) -> Array:
        """Return the deviation (N, k) from the cubic through two neighbours on either side, over the noise level."""
        return deviation_from_neighbours(self.values) / self.relative_noise

    def without_spikes(self) -> Curve:
        """Reject samples far from their neighbours, which would bend the curve.

        Fast streams only: between the samples of a slow one a vehicle can turn (`without_slow_outliers`).
        """
        if self.interval > FAST_ENOUGH_S:
            return self
        kept = without_spikes(self.values, self.relative_noise)
        return self if kept.all() else self.part(kept)

    @cached_property
    def noise(self) -> Array:
        """Return the standard deviation (k,) of usual noise: the roughness; for a slow stream at most the reported one.

        A slow stream is rough from turns between samples as well; otherwise reported values are not trusted.
        """
        if self.like is not None:
            return self.like.noise
        if self.reported is None or self.interval <= FAST_ENOUGH_S:
            return self.roughness
        return np.minimum(self.roughness, self.reported)

    def perturbed(self, rng: np.random.Generator) -> Curve:
        """Return the curve with additional simulated noise of the same size."""
        noise = self.noise * self.relative_noise * rng.standard_normal(self.values.shape)
        return Curve(self.time, self.values + noise, like=self, frame=self.frame)

    def covers(self, at: Array) -> NDArray[np.bool_]:
        """Return (M,) whether samples lie on both sides within the largest gap."""
        after = np.clip(np.searchsorted(self.time, at), 1, len(self.time) - 1)
        gap = self.time[after] - self.time[after - 1]
        inside = (at >= self.time[0]) & (at <= self.time[-1])
        return inside & (gap <= SETTINGS.max_gap_intervals * self.interval)

    def is_complete_at(self, at: Array) -> NDArray[np.bool_]:
        """Return (M,) whether the stream `covers` a time and, if slow, lost no sample there."""
        known = self.covers(at)
        if self.interval <= FAST_ENOUGH_S:
            return known
        after = np.clip(np.searchsorted(self.time, at), 1, len(self.time) - 1)
        product = (at - self.time[after - 1]) * (self.time[after] - at)
        return known & (product <= MAX_NEIGHBOUR_PRODUCT * self.interval**2)

    def averaged(self, rate_hz: float) -> Curve:
        """Return the curve averaged over groups of samples, so that its rate is at most `rate_hz`."""
        every = int(np.ceil(1.0 / (rate_hz * self.interval) - 0.05))
        if every <= 1:
            return self
        group = np.floor((self.time - self.time[0]) / (every * self.interval) + 1e-6)
        starts = np.flatnonzero(np.diff(group, prepend=-1.0))
        counts = np.diff(np.append(starts, len(self.time)))
        time = np.add.reduceat(self.time, starts) / counts
        reported = None if self.reported is None else self.reported / np.sqrt(every)
        each = self.sample_std
        if each is not None:
            each = np.sqrt(np.add.reduceat(each**2, starts, axis=0)) / counts[:, None]
        return Curve(time, np.add.reduceat(self.values, starts, axis=0) / counts[:, None], reported, sample_std=each)


def _on_cubics(values: Array) -> Array:
    """Smooth evenly spaced values (N, k) by local cubics of SMOOTH_SAMPLES (Savitzky and Golay)."""
    half = SMOOTH_SAMPLES // 2
    powers = np.vander(np.arange(-half, half + 1.0), 4)
    fitted = powers @ np.linalg.pinv(powers)  # (5, 5) values on the cubic of values
    around = np.lib.stride_tricks.sliding_window_view(values, SMOOTH_SAMPLES, axis=0)
    return np.concatenate(
        [fitted[:half] @ values[:SMOOTH_SAMPLES], around @ fitted[half], fitted[half + 1 :] @ values[-SMOOTH_SAMPLES:]]
    )


def _sines(values: Array) -> tuple[Array, Array]:
    """Return sine coefficients (N, k) of values (N, k) about the line between their ends, and that line."""
    line = np.linspace(values[0], values[-1], len(values))
    return dst(values - line, type=2, axis=0, norm="ortho"), line


def _gain(power: Array, noise: float) -> Array:
    """Return (N,) zero where sine power (N,) is noise, one where it is more; low bands are narrow."""
    n = len(power)
    edges = np.unique(np.concatenate([[0], np.geomspace(1.0, n, BANDS), [n]]).astype(int))
    mean = np.add.reduceat(power, edges[:-1]) / np.diff(edges)
    over = np.clip((mean / max(noise, 1e-300) - NOISE_POWER_RATIO) / (MOTION_POWER_RATIO - NOISE_POWER_RATIO), 0.0, 1.0)
    return np.repeat(np.maximum(over, neighbours(over)), np.diff(edges))


def segments_of(times: Sequence[Array]) -> tuple[slice, ...]:
    """Return ranges of the concatenated times, one array per recording, without a gap of three intervals or more."""
    parts: list[slice] = []
    begin = 0
    for time in times:
        steps = np.diff(time)
        limit = 3.0 * float(np.median(steps)) if len(steps) else 0.0
        edges = [0, *(np.flatnonzero(steps > limit) + 1).tolist(), len(time)]
        parts += [slice(begin + a, begin + b) for a, b in itertools.pairwise(edges)]
        begin += len(time)
    return tuple(parts)
