"""Search of both delays: the misfit of DVL and reference over all delays within a minute.

On a common time grid, B(t; ρ) = R(t)ᵀ g(t + ρ) is the reference with delay ρ in the body, v(t + τ) the DVL with delay
τ, and Σ|B - C v|² = Σ|B|² + Σ|v|² - 2 tr(C Σ v Bᵀ). The sums over t are correlations; Fourier transforms give them for
all τ. C is the nominal mounting or the best rotation (Wahba's problem: Markley, "Attitude determination using vector
observations", 1988).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..numerics.frames import Array, squared, turned_back
from ..numerics.robust import median
from ..streams.interpolation import REACH_INTERVALS, linear_at, quaternion_at
from .motion_streams import MotionStreams

# Largest searched delay, s.
FARTHEST_S = 60.0
# Grid steps of short and long recordings, s, most steps of a short one, and most grid points: memory and time are
# bounded, and turns of a vehicle last longer than a step.
STEP_S, LONG_STEP_S, MAX_SHORT_STEPS, MAX_STEPS = 0.5, 1.0, 500, 7200
# Gaps longer than both `REACH_INTERVALS` and this time (s) are not interpolated.
HOLE_S = 2.5
# Smallest overlap: share of the shorter stream, and seconds.
MIN_OVERLAP, MIN_OVERLAP_S = 0.4, 20.0
# Smallest distance of two minima, s, and most minima that are refined.
SEPARATION_S, N_CANDIDATES = 2.0, 4


Spectra = NDArray[np.complex128]


class DelayPair(NamedTuple):
    """Candidate delays of reference and DVL relative to the IMU, s. misfit: share of the squares left."""

    reference: float
    dvl: float
    misfit: float


def candidate_delays(motion: MotionStreams, rotation_body_from_dvl: Array | None) -> list[DelayPair]:
    """Return the likeliest delays by misfit, always with the best ones within 3 s.

    rotation_body_from_dvl: (3, 3), None if unknown. Without an attitude, or with a body-frame reference, only the
    relative delay is observable and is assigned to the DVL.
    """
    delays, misfit = _misfits(motion, rotation_body_from_dvl)
    by_reference = delays if misfit.shape[0] > 1 else np.zeros(1)
    near = (np.abs(by_reference)[:, None] <= 3.0) & (np.abs(delays) <= 3.0)
    found = _minima(misfit, by_reference, delays, N_CANDIDATES)
    found += _minima(np.where(near, misfit, np.inf), by_reference, delays, 1)
    return sorted(set(found), key=lambda place: place.misfit)


def _minima(misfit: Array, by_reference: Array, by_dvl: Array, count: int) -> list[DelayPair]:
    """Return the `count` lowest local minima of a misfit (R, D) over reference and DVL delays (R,) and (D,), s."""
    # only local minima, so that flanks of a broad one do not count
    padded = np.pad(misfit, 1, constant_values=np.inf)
    is_lowest = np.minimum(misfit, np.minimum(padded[2:, 1:-1], padded[:-2, 1:-1])) == misfit
    is_lowest &= np.minimum(misfit, np.minimum(padded[1:-1, 2:], padded[1:-1, :-2])) == misfit
    misfit = np.where(is_lowest, misfit, np.inf)
    found: list[DelayPair] = []
    for _ in range(count):
        row, column = np.unravel_index(int(np.argmin(misfit)), misfit.shape)
        if not np.isfinite(misfit[row, column]):
            break
        candidate = DelayPair(float(by_reference[row]), float(by_dvl[column]), float(misfit[row, column]))
        found.append(candidate)
        near = np.abs(by_reference - candidate.reference)[:, None] < SEPARATION_S
        misfit[near & (np.abs(by_dvl - candidate.dvl) < SEPARATION_S)] = np.inf
    return found


def _misfits(motion: MotionStreams, rotation: Array | None) -> tuple[Array, Array]:
    """Return all delays (L,) s up to `FARTHEST_S`, and the misfit by reference delay (rows) and DVL delay, (L, L).

    The misfit is (1, L) if only the DVL delay is observable, and inf where too little overlaps.

    rotation: (3, 3) rotation_body_from_dvl of the prior mounting, None to estimate it at each pair.
    """
    step, grid = _grid(motion)
    max_shift = round(FARTHEST_S / step)
    delays = step * np.arange(-max_shift, max_shift + 1)
    dvl = _on_grid(motion.dvl.times, motion.dvl.velocity, grid, step)
    reference = _on_grid(motion.reference_times, np.where(motion.measured, motion.reference, 0.0), grid, step)
    size = 1 << (len(grid) + 2 * max_shift - 1).bit_length()
    dvl_spectra = np.fft.rfft(dvl, size)
    if rotation is not None:
        dvl_spectra[:3] = rotation @ dvl_spectra[:3]
    min_count = max(MIN_OVERLAP * min(dvl[3].sum(), reference[3].sum()), MIN_OVERLAP_S / step)
    attitude: Array | None = None
    if motion.in_earth and motion.has_attitude:
        attitude, oriented = quaternion_at(motion.imu, grid, HOLE_S)
    shifts = range(-max_shift, max_shift + 1) if attitude is not None else (0,)
    misfit = np.empty((len(shifts), len(delays)))
    for row, shift in enumerate(shifts):
        body = _shifted(reference, shift)
        if attitude is not None:
            body = np.vstack([turned_back(attitude, body[:3]), body[3:]]) * oriented
        spectra = np.fft.rfft(body, size), dvl_spectra
        misfit[row] = _misfit_over_lags(*spectra, rotation is not None, size, max_shift, min_count)
    return delays, misfit


def _misfit_over_lags(
    body: Spectra, dvl: Spectra, is_aligned: bool, size: int, max_shift: int, min_count: float
) -> Array:
    """Return the misfit of body(t) and dvl(t + lag) for lags up to `max_shift` steps, from their spectra (5, F).

    is_aligned: the DVL's components are rotated by C; else by the best rotation at each lag. Lags of fewer than
    `min_count` steps have a misfit of inf.
    """
    conjugate = np.conj(body)
    # count, squares of each where the other is known, then products of the components
    products = [conjugate[i] * dvl[j] for i, j in ((3, 3), (3, 4), (4, 3))]
    if is_aligned:
        products.append((conjugate[:3] * dvl[:3]).sum(axis=0))
    else:
        products += [conjugate[i] * dvl[j] for i in range(3) for j in range(3)]
    sums = np.fft.irfft(np.array(products), size)
    n_steps, of_dvl, of_body, *correlations = np.concatenate([sums[:, -max_shift:], sums[:, : max_shift + 1]], axis=1)
    squares, correlation = of_dvl + of_body, correlations[0]
    if not is_aligned:  # the best orthogonal matrix: either handedness will do for a search
        by_lag = np.array(correlations).T.reshape(-1, 3, 3)
        correlation = np.linalg.svd(by_lag, compute_uv=False).sum(axis=1)
    is_enough = (n_steps >= min_count) & (squares > 0.0)
    share = (squares - 2.0 * correlation) / np.where(is_enough, 0.5 * squares, 1.0)
    return np.where(is_enough, np.maximum(share, 0.0), np.inf)


def _grid(motion: MotionStreams) -> tuple[float, Array]:
    """Return step (s) and times (N,) s of the grid over all streams, cut off for long recordings."""
    times = [motion.dvl.times, motion.reference_times]
    start, end = min(stream[0] for stream in times), max(stream[-1] for stream in times)
    step = STEP_S if end - start <= MAX_SHORT_STEPS * STEP_S else LONG_STEP_S
    return step, start + step * np.arange(min(int((end - start) / step) + 1, MAX_STEPS))


def _on_grid(times: Array, values: Array, grid: Array, step: float) -> Array:
    """Return a stream on the grid: means over about one step, linearly interpolated.

    The rows (5, L) are three components, 1 where known, and the sum of squares; all zero where unknown.

    times: (N,) s, of values (N, 3). grid: (L,) s, with an interval of `step` s.
    """
    bins = np.floor((times - grid[0]) / step)
    starts = np.flatnonzero(np.diff(bins, prepend=bins[:1] - 1.0))
    count = np.diff(np.append(starts, len(times)))
    mean_times = np.add.reduceat(times, starts) / count
    means = np.add.reduceat(values, starts, axis=0) / count[:, None]
    after = np.clip(np.searchsorted(mean_times, grid), 1, max(len(mean_times) - 1, 1))
    longest_gap = max(HOLE_S, REACH_INTERVALS * float(median(np.diff(times)))) if len(times) > 1 else HOLE_S
    if len(mean_times) < 2:
        return np.zeros((5, len(grid)))
    is_near = mean_times[after] - mean_times[after - 1] <= longest_gap
    known = ((grid >= mean_times[0]) & (grid <= mean_times[-1]) & is_near).astype(float)
    values = linear_at(mean_times, means, grid).T * known
    return np.vstack([values, known, squared(values.T)])


def _shifted(series: Array, steps: int) -> Array:
    """Return the series (5, N) shifted by steps: x(t + steps), zero beyond its ends."""
    at = np.arange(series.shape[1]) + steps
    return series.take(at, axis=1, mode="clip") * ((at >= 0) & (at < len(at)))
