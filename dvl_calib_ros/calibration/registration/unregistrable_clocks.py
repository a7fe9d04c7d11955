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
from ..streams.interpolation import attitude_at, shortened
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
    own, others = _steps(dvl_times), _steps(reference_times)
    known, is_own = (covered(t, at).astype(float) for t, at in ((reference_times, others), (dvl_times, own)))
    late, is_far = lag(
        _speed(dvl_times, body), dvl_times[0], _speed(reference_times, reference), reference_times[0], known, is_own
    )
    if is_far:
        return UnregistrableClocks("the DVL's", "the reference's", late)
    if not motion.in_earth or not motion.has_attitude:
        return None
    at = np.arange(max(dvl_times[0] - late, reference_times[0]), min(dvl_times[-1] - late, reference_times[-1]), STEP_S)
    if not len(at):
        return None
    course: Series = (velocity_at(reference_times, reference, at)[:, :2] @ [1.0, 1j]) * np.conj(
        velocity_at(dvl_times, body, at + late)[:, :2] @ [1.0, 1j]
    )
    turned = _steps(motion.imu.times)
    rotation, _ = attitude_at(motion.imu, turned, HOLE_S)
    ahead: Series = rotation[:, :2, 0] @ [1.0, 1j]
    moving = ((np.abs(course) > MOVING_MPS**2) & covered(reference_times, at)).astype(float)
    late, is_far = lag(_unit(ahead), motion.imu.times[0], _unit(course), at[0], moving)
    return UnregistrableClocks("the IMU's", "those of DVL and reference", late) if is_far else None


def _without_long_pauses(motion: MotionStreams) -> MotionStreams:
    """Return the motion with shared pauses shortened, so that the length is limited by the number of samples."""
    streams = motion.dvl.times, motion.reference_times, motion.imu.times
    every = np.sort(np.concatenate(streams))
    most = max(LONGEST_PAUSES_S, STEPS_OF_A_SAMPLE * STEP_S * len(every))
    if not len(every) or max(own[-1] - own[0] for own in streams if len(own)) <= most:
        return motion
    gaps = np.diff(every)
    # only pauses within all streams: the offset between two clocks must remain
    is_pause = np.any([(own[0] <= every[:-1]) & (own[-1] >= every[1:]) for own in streams if len(own)], axis=0)
    cut = np.zeros(len(gaps))
    cut[is_pause] = gaps[is_pause] - shortened(gaps[is_pause], most)
    removed = np.append(0.0, np.cumsum(cut))
    first = np.maximum.accumulate(np.where(np.append(True, ~is_pause), np.arange(len(every)), 0))
    moved = every - (removed - removed[first])
    dvl, reference, imu = (np.interp(own, every, moved) for own in streams)
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


def velocity_at(times: Array, values: Array, at: Array) -> Array:
    """Interpolate a stream (N, 3) linearly at times (M,). Return (M, 3)."""
    return np.column_stack([np.interp(at, times, column) for column in values.T])


def _speed(times: Array, velocity: Array) -> Series:
    """Return the median-filtered horizontal speed (N,) m/s, every STEP_S from the first sample on."""
    values = velocity_at(times, velocity, _steps(times))
    around = np.pad(np.hypot(values[:, 0], values[:, 1]), SPIKE_STEPS // 2)
    windows = np.lib.stride_tricks.sliding_window_view(around, SPIKE_STEPS)
    return np.asarray(median(windows.T), dtype=complex)


def lag(
    one: Series,
    one_start: float,
    other: Series,
    other_start: float,
    weight: Array | None = None,
    own: Array | None = None,
) -> tuple[float, bool]:
    """Return the delay (s) of a series relative to another, and whether it surely exceeds FARTHEST_S.

    The delay minimises the mean squared difference; it must be clearly better than none, a far one than all near ones.

    Parameters
    ----------
    one, other: (N,), (M,), every STEP_S.
    one_start, other_start: Times of their first samples, s.
    weight, own: (M,) weights of `other`, (N,) of `one`; default 1.
    """
    n, m = len(one), len(other)
    weight = np.ones(m) if weight is None else weight
    own = np.ones(n) if own is None else own
    size = n + m

    def correlated(a: Series | Array, b: Series | Array) -> Array:
        """Return Σ Re(a(i + lag) conj(b(i))) for lags -(m - 1) .. n - 1."""
        sums = np.real(np.fft.ifft(np.fft.fft(a, size) * np.conj(np.fft.fft(b, size))))
        return np.concatenate([sums[size - (m - 1) :], sums[:n]])

    def means(weight: Array) -> Array:
        """Return the mean squared difference at each lag, infinite where the overlap is too short."""
        count = correlated(own, weight)
        squares = correlated(own * np.abs(one) ** 2, weight) + correlated(own, weight * np.abs(other) ** 2)
        squares -= 2.0 * correlated(own * one, weight * other)
        enough = count >= max(MIN_OVERLAP * min(float(n), float(weight.sum())), SHORTEST_OVERLAP_S / STEP_S)
        return np.where(enough, np.maximum(squares, 0.0) / np.maximum(count, 1.0), np.inf)

    mean = means(weight)
    delays = one_start - other_start + STEP_S * np.arange(-(m - 1), n)
    near = np.abs(delays) <= FARTHEST_S + STEP_S
    best = int(np.argmin(mean))
    nearest = float(mean[near].min()) if near.any() else np.inf
    if not near[best] and mean[best] < MAX_SQUARE_SHARE * nearest:
        # compare on the same samples: a noisy stretch may be outside the overlap of the far delay
        index = np.arange(m) + best - (m - 1)
        overlap = np.where((index >= 0) & (index < n), weight, 0.0)
        nearest = min(nearest, float(means(overlap)[near].min(initial=np.inf)))
        # periodic motion may agree at far lags, but it then agrees at near lags, too, to the change within one step
        both = weight[1:] * weight[:-1]
        of_a_step = float((both * np.abs(np.diff(other)) ** 2).sum() / max(both.sum(), 1.0))
        if mean[best] < MAX_SQUARE_SHARE * nearest and nearest > of_a_step:
            # repeated legs agree at several lags: take the smallest
            as_good = np.where(mean <= 1.5 * mean[best], np.abs(delays), np.inf)
            return float(delays[int(np.argmin(as_good))]), True
    best = int(np.argmin(np.where(near, mean, np.inf)))
    # a nearly constant speed agrees as well at any lag
    is_better = near[best] and mean[best] < MAX_SQUARE_SHARE * mean[int(np.argmin(np.abs(delays)))]
    return float(delays[best]) if is_better else 0.0, False
