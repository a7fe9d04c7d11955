"""One stream as a function of time: between its samples, without its spikes, and what of it is noise."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dst, idst
from scipy.interpolate import make_interp_spline

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...calibration.streams.outliers import deviation_from_neighbours, neighbours, without_spikes
from .claimed_noise import loudness
from .settings import SETTINGS

# Shorter stretches have too few frequencies to tell motion from noise, whose power is averaged over so many bands
MIN_SPECTRUM, BANDS = 60, 40
# Power of a band over that of noise up to which it is noise alone, and from which all of it is kept
NOISE_ALONE, SOME_MOTION = 1.4, 2.5
# Fourth differences
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
# Streams slower than this show turns and waves barely; they have no frequencies to spare
FAST_ENOUGH_S, SMOOTH_SAMPLES = 0.45, 5
# Standard deviations beyond which a sample is an outlier that pulls no more; and by how many of itself the size of the
# tails has to be above that of normal noise: a median of neighbours' differences is known to 1.6 / √n
SPIKY, SURELY_HEAVY = 6.0, 3.0 * 1.6
# Times before and after, in intervals, whose product is larger lie where a sample is lost: 0.25 in the middle of two
TOLD = 0.4


class Remembered:
    """What was made of a stream at some times, the last few: fits look at the same times again and again."""

    _LIMIT = 8

    def __init__(self) -> None:
        self._made: dict[Any, Any] = {}

    def at(self, what: str, times: Array, make: Callable[[], Any]) -> Any:
        """What `make` gives, which is asked if this is not kept for these times (M,) s."""
        key = what, len(times), float(times.sum()), *times[[0, len(times) // 2, -1] if len(times) else []].tolist()
        made = self._made.pop(key) if key in self._made else make()
        self._made[key] = made  # as the newest
        if len(self._made) > self._LIMIT:
            self._made.pop(next(iter(self._made)))
        return made


@dataclass(frozen=True, eq=False)
class Curve:
    """One stream as a function of time: cubic between samples. time: (N,) s, increasing. values: (N, k). claimed:
    (k,) standard deviation that messages claim. like: a curve of the same stream, without made-up noise, that tells
    what is noise. claims: (N, k) standard deviation that each sample's message claims.
    """

    time: Array
    values: Array
    claimed: Array | None = None
    like: Curve | None = None
    claims: Array | None = None
    kept: Remembered = field(init=False, default_factory=Remembered, repr=False)

    @cached_property
    def interval(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @cached_property
    def _spline(self) -> Any:
        return make_interp_spline(self.time, self.values, k=min(3, len(self.time) - 1))

    def __call__(self, at: Array) -> Array:
        """(M, k) at times (M,) s; before the first and after the last as there."""
        values: Array = self._spline(np.clip(at, self.time[0], self.time[-1]))
        return values

    @cached_property
    def quiet(self) -> Curve:
        """The same without those frequencies in which there is next to nothing but noise, stretch by stretch.

        So a stream is as noisy between its samples as at them, and a delay does not gain by the noise. On sines about
        the line from end to end, so that nothing rings there. What holds any motion is left as it is: turns are rare,
        and a filter that is best on average would bend them.
        """
        values = self.values.copy()
        for part in self.stretches:
            if part.stop - part.start < MIN_SPECTRUM or self.interval > FAST_ENOUGH_S:
                continue
            spectrum, _ = _sines((self.like or self).values[part])
            variance = self.noise**2 * (self.loudness[part] ** 2).mean(axis=0)
            gain = np.column_stack([_gain(column**2, of) for column, of in zip(spectrum.T, variance, strict=True)])
            own, line = _sines(self.values[part])
            values[part] = line + idst(gain * own, type=2, axis=0, norm="ortho")
        return Curve(self.time, values)

    @cached_property
    def smooth(self) -> Curve:
        """The same for regressors: `quiet`, or of a slow stream each sample on the cubic through those around it."""
        if self.interval <= FAST_ENOUGH_S or len(self.time) <= SMOOTH_SAMPLES:
            return self.quiet
        return Curve(self.time, _on_cubics(self.values))

    @cached_property
    def stretches(self) -> list[slice]:
        """Parts without a gap."""
        breaks = np.flatnonzero(np.diff(self.time) > SETTINGS.max_gap_intervals * self.interval) + 1
        edges = [0, *breaks.tolist(), len(self.time)]
        return [slice(start, end) for start, end in pairwise(edges)]

    @cached_property
    def derivative(self) -> Any:
        """(M,) -> (M, k) per s, of the curve as it is."""
        return self._spline.derivative()

    @cached_property
    def roughness(self) -> Array:
        """(k,) what neighbours do not tell of a usual sample, std: its noise, and what it is too far from them to show.

        Of fourth differences, to which turns are nothing and white noise is √70 times itself.
        """
        if self.like is not None:
            return self.like.roughness
        if len(self.time) < 10:
            return np.zeros(self.values.shape[1])
        return robust_std(np.diff(self.values, 4, axis=0) / self.loudness[2:-2]) / np.sqrt(70.0)

    @cached_property
    def tails(self) -> float:
        """By what factor the variance of the noise, spikes apart, is surely more than that of the usual sample's.

        1 of normal noise; of Student's t with few degrees more, and of a slow stream unknown, whose turns look like it.
        """
        if self.interval > FAST_ENOUGH_S or len(self.time) < MIN_SPECTRUM:
            return 1.0
        off = np.diff(self.values, 4, axis=0) / self.loudness[2:-2]
        std = robust_std(off)
        off, std = off[:, std > 0.0], std[std > 0.0]
        if not len(std):
            return 1.0
        own = np.sqrt(np.mean((np.clip(off / std, -SPIKY, SPIKY)) ** 2))
        return float(np.maximum(own / (1.0 + SURELY_HEAVY / np.sqrt(off.size)), 1.0) ** 2)

    @cached_property
    def loudness(self) -> Array:
        """(N, k) standard deviation of each sample's noise over that of the usual one, if its claim tells it."""
        if self.like is not None:
            return self.like.loudness
        return loudness(self.time, self.claims, np.diff(self.values, 4, axis=0), FOURTH)

    def part(self, kept: NDArray[np.bool_]) -> Curve:
        """The samples (N,) that are to be kept."""
        claims = None if self.claims is None else self.claims[kept]
        return Curve(self.time[kept], self.values[kept], self.claimed, claims=claims)

    @cached_property
    def from_neighbours(self) -> Array:
        """(N, k) how far samples are from the cubic through two neighbours on either side, over their loudness."""
        return deviation_from_neighbours(self.values) / self.loudness

    def without_spikes(self) -> Curve:
        """The same without samples far from where their neighbours are, which would bend the curve about them.

        Of a fast stream only: between the samples of a slow one a vehicle can turn (`without_slow_outliers`).
        """
        if self.interval > FAST_ENOUGH_S:
            return self
        kept = without_spikes(self.values, self.loudness)
        return self if kept.all() else self.part(kept)

    @cached_property
    def noise(self) -> Array:
        """(k,) standard deviation of a usual sample's noise: the roughness; of a slow stream no more than is claimed.

        Between the samples of a slow stream a vehicle turns, which is rough as well; else a claim is not believed.
        """
        if self.like is not None:
            return self.like.noise
        if self.claimed is None or self.interval <= FAST_ENOUGH_S:
            return self.roughness
        return np.minimum(self.roughness, self.claimed)

    def shaken(self, rng: np.random.Generator) -> Curve:
        """The same with as much noise again."""
        noise = self.noise * self.loudness * rng.standard_normal(self.values.shape)
        return Curve(self.time, self.values + noise, like=self)

    def covers(self, at: Array) -> NDArray[np.bool_]:
        """(M,) whether samples stand on both sides, not too far apart."""
        after = np.clip(np.searchsorted(self.time, at), 1, len(self.time) - 1)
        apart = self.time[after] - self.time[after - 1]
        inside = (at >= self.time[0]) & (at <= self.time[-1])
        return inside & (apart <= SETTINGS.max_gap_intervals * self.interval)

    def tells(self, at: Array) -> NDArray[np.bool_]:
        """(M,) whether `covers`, and no sample is lost there of a slow stream, of which nothing else tells a wave."""
        known = self.covers(at)
        if self.interval <= FAST_ENOUGH_S:
            return known
        after = np.clip(np.searchsorted(self.time, at), 1, len(self.time) - 1)
        apart = (at - self.time[after - 1]) * (self.time[after] - at)
        return known & (apart <= TOLD * self.interval**2)

    def averaged(self, rate_hz: float) -> Curve:
        """Means over groups of samples, so that they come at no more than a rate."""
        every = int(np.ceil(1.0 / (rate_hz * self.interval) - 0.05))
        if every <= 1:
            return self
        group = np.floor((self.time - self.time[0]) / (every * self.interval) + 1e-6)
        starts = np.flatnonzero(np.diff(group, prepend=-1.0))
        counts = np.diff(np.append(starts, len(self.time)))
        time = np.add.reduceat(self.time, starts) / counts
        claimed = None if self.claimed is None else self.claimed / np.sqrt(every)
        claims = self.claims
        if claims is not None:
            claims = np.sqrt(np.add.reduceat(claims**2, starts, axis=0)) / counts[:, None]
        return Curve(time, np.add.reduceat(self.values, starts, axis=0) / counts[:, None], claimed, claims=claims)


def _on_cubics(values: Array) -> Array:
    """Each of values (N, k), evenly spaced, on the cubic through SMOOTH_SAMPLES about it (Savitzky and Golay)."""
    half = SMOOTH_SAMPLES // 2
    powers = np.vander(np.arange(-half, half + 1.0), 4)
    fitted = powers @ np.linalg.pinv(powers)  # (5, 5) values on the cubic of values
    around = np.lib.stride_tricks.sliding_window_view(values, SMOOTH_SAMPLES, axis=0)
    return np.concatenate(
        [fitted[:half] @ values[:SMOOTH_SAMPLES], around @ fitted[half], fitted[half + 1 :] @ values[-SMOOTH_SAMPLES:]]
    )


def _sines(values: Array) -> tuple[Array, Array]:
    """Coefficients (N, k) of sines of values (N, k) about the line from their first to their last, and that line."""
    line = np.linspace(values[0], values[-1], len(values))
    return dst(values - line, type=2, axis=0, norm="ortho"), line


def _gain(power: Array, noise: float) -> Array:
    """(N,) zero where the power (N,) of sines is that of noise, one where it is more; low bands are narrow."""
    n = len(power)
    edges = np.unique(np.concatenate([[0], np.geomspace(1.0, n, BANDS), [n]]).astype(int))
    mean = np.add.reduceat(power, edges[:-1]) / np.diff(edges)
    over = np.clip((mean / max(noise, 1e-300) - NOISE_ALONE) / (SOME_MOTION - NOISE_ALONE), 0.0, 1.0)
    return np.repeat(np.maximum(over, neighbours(over)), np.diff(edges))


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
