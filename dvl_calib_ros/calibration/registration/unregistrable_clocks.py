"""Detection of clock offsets beyond the search range, by correlation over the whole recording.

Offsets up to `FARTHEST_S` are registered. Beyond, a registration would find a wrong delay, so the data are refused.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..numerics.robust import median
from ..streams.interpolation import attitude_at, linear_at, shortened
from .delay_search import FARTHEST_S, HOLE_S, MIN_OVERLAP, STEP_S
from .motion_streams import MotionStreams

# Largest share of the squared residual at the best near delay that a far delay may leave. Repeated legs agree to a
# half.
MAX_SQUARE_SHARE = 0.25
# Smallest overlap, s.
SHORTEST_OVERLAP_S = 60.0
# Longest series, s, or steps per sample: memory must not grow with pauses.
LONGEST_PAUSES_S, STEPS_OF_A_SAMPLE = 86_400.0, 16
# Width of the running median that removes spikes of the speed, steps.
SPIKE_STEPS = 9
# Lowest speed that determines a direction.
MOVING_MPS = 0.2
Series = NDArray[Any]  # complex


class UnregistrableClocks(NamedTuple):
    """Clock `whose` with a delay of about `delay_s` relative to `others`, beyond the search range."""

    whose: str
    others: str
    delay_s: float

    @property
    def reason(self) -> Reason:
        """Finding that names the clock."""
        way = "later" if self.delay_s > 0.0 else "earlier"
        return finding(
            "CLOCK_FAR", whose=self.whose, seconds=abs(self.delay_s), way=way, others=self.others, limit=FARTHEST_S
        )


def far_clocks(motion: MotionStreams, rotation_dvl_from_body: Array) -> UnregistrableClocks | None:
    """Return the clock with an offset beyond the search range, or None if there is no significant one.

    rotation_dvl_from_body: (3, 3) nominal mounting.
    """
    motion = _without_long_pauses(motion)
    dvl_times, velocity = motion.dvl
    body = velocity @ rotation_dvl_from_body
    reference_times, reference = motion.reference_times, motion.reference
    of_speed = lag(
        _speed(dvl_times, body), dvl_times[0], _speed(reference_times, reference), reference_times[0],
        covered(reference_times, _steps(reference_times)).astype(float),
        covered(dvl_times, _steps(dvl_times)).astype(float),
    )  # fmt: skip
    if of_speed.is_far:
        return UnregistrableClocks("the DVL's", "the reference's", of_speed.delay_s)
    if not motion.in_earth or not motion.has_attitude:
        return None
    synchronised_times = dvl_times - of_speed.delay_s
    start, end = max(synchronised_times[0], reference_times[0]), min(synchronised_times[-1], reference_times[-1])
    shared_grid = np.arange(start, end, STEP_S)
    if not len(shared_grid):
        return None
    # direction over ground relative to the direction in the body: the heading without the IMU
    heading: Series = (linear_at(reference_times, reference, shared_grid)[:, :2] @ [1.0, 1j]) * np.conj(
        linear_at(dvl_times, body, shared_grid + of_speed.delay_s)[:, :2] @ [1.0, 1j]
    )
    imu_grid = _steps(motion.imu.times)
    rotation, _ = attitude_at(motion.imu, imu_grid, HOLE_S)
    imu_heading: Series = rotation[:, :2, 0] @ [1.0, 1j]
    moving = ((np.abs(heading) > MOVING_MPS**2) & covered(reference_times, shared_grid)).astype(float)
    of_heading = lag(_unit(imu_heading), motion.imu.times[0], _unit(heading), shared_grid[0], moving)
    if of_heading.is_far:
        return UnregistrableClocks("the IMU's", "those of DVL and reference", of_heading.delay_s)
    return None


def _without_long_pauses(motion: MotionStreams) -> MotionStreams:
    """Return the motion with shared pauses shortened, so that the length is limited by the number of samples."""
    streams = motion.dvl.times, motion.reference_times, motion.imu.times
    every = np.sort(np.concatenate(streams))
    most = max(LONGEST_PAUSES_S, STEPS_OF_A_SAMPLE * STEP_S * len(every))
    if not len(every) or max(times[-1] - times[0] for times in streams if len(times)) <= most:
        return motion
    gaps = np.diff(every)
    # only pauses within all streams: the offset between two clocks must remain
    is_pause = np.any([(times[0] <= every[:-1]) & (times[-1] >= every[1:]) for times in streams if len(times)], axis=0)
    cut = np.zeros(len(gaps))
    cut[is_pause] = gaps[is_pause] - shortened(gaps[is_pause], most)
    removed_s = np.append(0.0, np.cumsum(cut))
    last_fixed = np.maximum.accumulate(np.where(np.append(True, ~is_pause), np.arange(len(every)), 0))
    shortened_times = every - (removed_s - removed_s[last_fixed])
    dvl, reference, imu = (np.interp(times, every, shortened_times) for times in streams)
    return replace(
        motion, dvl=motion.dvl._replace(times=dvl), reference_times=reference, imu=motion.imu._replace(times=imu)
    )


def _unit(series: Series) -> Series:
    found: Series = series / np.maximum(np.abs(series), 1e-9)
    return found


def _steps(times: Array) -> Array:
    return np.arange(times[0], times[-1], STEP_S)


def covered(times: Array, at: Array) -> NDArray[np.bool_]:
    """Return a mask (M,) of times within samples that are near each other, not across an outage."""
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    is_near = times[after] - times[after - 1] <= max(HOLE_S, 3.0 * float(median(np.diff(times))))
    return np.asarray(is_near & (at >= times[0]) & (at <= times[-1]))


def _speed(times: Array, velocity: Array) -> Series:
    """Return the median-filtered horizontal speed (N,) m/s, every STEP_S from the first sample on."""
    values = linear_at(times, velocity, _steps(times))
    around = np.pad(np.hypot(values[:, 0], values[:, 1]), SPIKE_STEPS // 2)
    windows = np.lib.stride_tricks.sliding_window_view(around, SPIKE_STEPS)
    return np.asarray(median(windows.T), dtype=complex)


class Lag(NamedTuple):
    """Delay (s) of one series relative to another. is_far: it surely exceeds FARTHEST_S."""

    delay_s: float
    is_far: bool


def lag(
    series: Series,
    series_start: float,
    other: Series,
    other_start: float,
    weight: Array | None = None,
    own: Array | None = None,
) -> Lag:
    """Return the delay of a series relative to another.

    The delay minimises the mean squared difference; it must be clearly better than none, a far one than all near ones.

    Parameters
    ----------
    series, other: (N,), (M,), every STEP_S.
    series_start, other_start: Times of their first samples, s.
    weight, own: (M,) weights of `other`, (N,) of `series`; default 1.
    """
    n, m = len(series), len(other)
    weight = np.ones(m) if weight is None else weight
    own = np.ones(n) if own is None else own
    mean = _mean_squares(series, own, other, weight)
    delays = series_start - other_start + STEP_S * np.arange(-(m - 1), n)
    is_near = np.abs(delays) <= FARTHEST_S + STEP_S
    best = int(np.argmin(mean))
    smallest_near = float(mean[is_near].min()) if is_near.any() else np.inf
    if not is_near[best] and mean[best] < MAX_SQUARE_SHARE * smallest_near:
        # compare on the same samples: a noisy stretch may be outside the overlap of the far delay
        index = np.arange(m) + best - (m - 1)
        overlap = np.where((index >= 0) & (index < n), weight, 0.0)
        on_overlap = _mean_squares(series, own, other, overlap)
        smallest_near = min(smallest_near, float(on_overlap[is_near].min(initial=np.inf)))
        # periodic motion may agree at far lags, but it then agrees at near lags, too, to the change within one step
        pair_weight = weight[1:] * weight[:-1]
        step_change = float((pair_weight * np.abs(np.diff(other)) ** 2).sum() / max(pair_weight.sum(), 1.0))
        if mean[best] < MAX_SQUARE_SHARE * smallest_near and smallest_near > step_change:
            # repeated legs agree at several lags: take the smallest
            as_good = np.where(mean <= 1.5 * mean[best], np.abs(delays), np.inf)
            return Lag(float(delays[int(np.argmin(as_good))]), True)
    best = int(np.argmin(np.where(is_near, mean, np.inf)))
    # a nearly constant speed agrees as well at any lag
    is_better = is_near[best] and mean[best] < MAX_SQUARE_SHARE * mean[int(np.argmin(np.abs(delays)))]
    return Lag(float(delays[best]) if is_better else 0.0, False)


def _mean_squares(series: Series, own: Array, other: Series, weight: Array) -> Array:
    """Return the mean squared difference at lags -(M - 1) .. N - 1 steps, infinite where the overlap is too short.

    series: (N,) with weights `own`. other: (M,) with weights `weight`.
    """
    count = _correlated(own, weight)
    squares = _correlated(own * np.abs(series) ** 2, weight) + _correlated(own, weight * np.abs(other) ** 2)
    squares -= 2.0 * _correlated(own * series, weight * other)
    is_enough = count >= max(MIN_OVERLAP * min(float(len(own)), float(weight.sum())), SHORTEST_OVERLAP_S / STEP_S)
    return np.where(is_enough, np.maximum(squares, 0.0) / np.maximum(count, 1.0), np.inf)


def _correlated(a: Series | Array, b: Series | Array) -> Array:
    """Return Σ Re(a(i + lag) conj(b(i))) for lags -(M - 1) .. N - 1, of a (N,) and b (M,)."""
    n, m = len(a), len(b)
    sums = np.real(np.fft.ifft(np.fft.fft(a, n + m) * np.conj(np.fft.fft(b, n + m))))
    return np.concatenate([sums[n + 1 :], sums[:n]])
