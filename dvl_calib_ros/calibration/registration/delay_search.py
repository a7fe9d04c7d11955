"""Where two clocks may stand: the misfit of DVL and reference over all delays within a minute, at once.

On a common grid of time, with B(t; ρ) = R(t)ᵀ g(t + ρ) the reference, stamped ρ late, as in the body by the IMU's
attitude, and v(t + τ) the DVL, stamped τ late, Σ|B - C v|² = Σ|B|² + Σ|v|² - 2 tr(C Σ v Bᵀ). The sums over t are
correlations, which Fourier transforms give for all τ at once. The rotation C is the mounting where that is known, else
the best there is (Wahba's problem: Markley, "Attitude determination using vector observations", 1988).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.frames import Array
from ..numerics.robust import median
from ..streams.interpolation import attitude_at
from .motion_streams import MotionStreams

# Clocks further apart than this are looked for nowhere, s.
LONGEST_S = 60.0
# Steps of the grid, s, and how many times it has at most: a vehicle's turns last longer, and a quadrupled recording
# takes four times as long.
STEP_S, LONG_STEP_S, MANY, MOST = 0.5, 1.0, 500, 7200
# Samples further apart than so many of their intervals leave a hole in the grid, and than this, s.
HOLE_INTERVALS, HOLE_S = 2.6, 2.5
# Of the shorter stream so much has to overlap, and so many seconds.
OVERLAP, SHORTEST_S = 0.4, 20.0
# Minima nearer to each other than this are one, s.
APART_S = 2.0


class ClockPlace(NamedTuple):
    """reference, dvl: how late the stamps of each are beside the IMU's, s. misfit: share of the squares left there."""

    reference: float
    dvl: float
    misfit: float


class _Series(NamedTuple):
    """On the grid, zero where it is not known. values (N, 3), known (N,) 0 or 1, squares (N,) of the values."""

    values: Array
    known: Array
    squares: Array


def places(motion: MotionStreams, rotation_body_from_dvl: Array | None, most: int = 4) -> list[ClockPlace]:
    """The likeliest places of the clocks, the best first, and beside these the best within 3 s.

    rotation_body_from_dvl: (3, 3), None where the mounting is not known. Without an attitude, or with a reference in
    the body, only the difference of the two clocks shows, and is taken for the DVL's.
    """
    late, misfit = _misfits(motion, rotation_body_from_dvl)
    by_reference = late if misfit.shape[0] > 1 else np.zeros(1)
    near = (np.abs(by_reference)[:, None] <= 3.0) & (np.abs(late) <= 3.0)
    found = _minima(misfit, by_reference, late, most)
    found += _minima(np.where(near, misfit, np.inf), by_reference, late, 1)
    return sorted(set(found), key=lambda place: place.misfit)


def _minima(misfit: Array, by_reference: Array, by_dvl: Array, most: int) -> list[ClockPlace]:
    around = np.pad(misfit, 1, constant_values=np.inf)  # of a broad one no flank takes the place of another
    is_lowest = np.minimum(misfit, np.minimum(around[2:, 1:-1], around[:-2, 1:-1])) == misfit
    is_lowest &= np.minimum(misfit, np.minimum(around[1:-1, 2:], around[1:-1, :-2])) == misfit
    misfit = np.where(is_lowest, misfit, np.inf)
    found: list[ClockPlace] = []
    for _ in range(most):
        r, d = np.unravel_index(int(np.argmin(misfit)), misfit.shape)
        if not np.isfinite(misfit[r, d]):
            break
        place = ClockPlace(float(by_reference[r]), float(by_dvl[d]), float(misfit[r, d]))
        found.append(place)
        beside = np.abs(by_reference - place.reference)[:, None] < APART_S
        misfit[beside & (np.abs(by_dvl - place.dvl) < APART_S)] = np.inf
    return found


def _misfits(motion: MotionStreams, rotation: Array | None) -> tuple[Array, Array]:
    """Delays (L,) s, and the misfit (L or 1, L) by the delay of the reference and that of the DVL."""
    step, grid = _grid(motion)
    reach = round(LONGEST_S / step)
    late = step * np.arange(-reach, reach + 1)
    v = _on_grid(motion.dvl.times, motion.dvl.velocity, grid, step)
    g = _on_grid(motion.reference_times, np.where(motion.measured, motion.reference, 0.0), grid, step)
    n = len(grid)
    size = 1 << (n + 2 * reach - 1).bit_length()
    of_v = np.fft.rfft(np.column_stack([v.values, v.known, v.squares]), size, axis=0)
    least = max(OVERLAP * min(v.known.sum(), g.known.sum()), SHORTEST_S / step)
    attitude: Array | None = None
    if motion.in_earth and motion.has_attitude:
        attitude, oriented = attitude_at(motion.imu, grid, HOLE_S)
    shifts = range(-reach, reach + 1) if attitude is not None else (0,)
    misfit = np.full((len(shifts), len(late)), np.inf)
    for row, shift in enumerate(shifts):
        b = _shifted(g, shift)
        if attitude is not None:
            known = b.known * oriented
            values = np.einsum("nji,nj->ni", attitude, b.values) * known[:, None]
            b = _Series(values, known, b.squares * known)
        of_b = np.fft.rfft(np.column_stack([b.values, b.known, b.squares]), size, axis=0)
        # Σ_t b(t) v(t + lag): count, squares of either where the other is known, and products of all components
        pairs = [
            np.conj(of_b[:, 3]) * of_v[:, 3],
            np.conj(of_b[:, 3]) * of_v[:, 4],
            np.conj(of_b[:, 4]) * of_v[:, 3],
        ]
        if rotation is not None:
            turned = np.conj(of_b[:, :3]) * (of_v[:, :3] @ rotation.T)
            pairs.append(turned.sum(axis=1))
        else:
            pairs += [np.conj(of_b[:, i]) * of_v[:, j] for i in range(3) for j in range(3)]
        sums = np.fft.irfft(np.array(pairs), size, axis=1)
        sums = np.concatenate([sums[:, -reach:], sums[:, : reach + 1]], axis=1)
        count, squares = sums[0], sums[1] + sums[2]
        if rotation is not None:
            alike = sums[3]
        else:
            matrices = sums[3:].T.reshape(-1, 3, 3)
            alike = np.linalg.svd(matrices, compute_uv=False).sum(axis=1)  # of either handedness: it only looks
        enough = (count >= least) & (squares > 0.0)
        misfit[row, enough] = (squares - 2.0 * alike)[enough] / (0.5 * squares[enough])
    return late, np.maximum(misfit, 0.0)


def _grid(motion: MotionStreams) -> tuple[float, Array]:
    """Step and times (N,) s that hold all streams, of a long recording its beginning."""
    times = [motion.dvl.times, motion.reference_times]
    start, end = min(t[0] for t in times), max(t[-1] for t in times)
    step = STEP_S if end - start <= MANY * STEP_S else LONG_STEP_S
    return step, start + step * np.arange(min(int((end - start) / step) + 1, MOST))


def _on_grid(times: Array, values: Array, grid: Array, step: float) -> _Series:
    """Means over about a step, linearly between them."""
    bins = np.floor((times - grid[0]) / step)
    starts = np.flatnonzero(np.diff(bins, prepend=bins[:1] - 1.0))
    count = np.diff(np.append(starts, len(times)))
    at = np.add.reduceat(times, starts) / count
    means = np.add.reduceat(values, starts, axis=0) / count[:, None]
    after = np.clip(np.searchsorted(at, grid), 1, max(len(at) - 1, 1))
    hole = max(HOLE_S, HOLE_INTERVALS * float(median(np.diff(times)))) if len(times) > 1 else HOLE_S
    if len(at) < 2:
        return _Series(np.zeros((len(grid), 3)), np.zeros(len(grid)), np.zeros(len(grid)))
    known = ((grid >= at[0]) & (grid <= at[-1]) & (at[after] - at[after - 1] <= hole)).astype(float)
    values = np.column_stack([np.interp(grid, at, column) for column in means.T]) * known[:, None]
    return _Series(values, known, (values * values).sum(axis=1))


def _shifted(series: _Series, steps: int) -> _Series:
    """The series as it is so many steps later: x(t + steps)."""
    if steps == 0:
        return series
    moved = []
    for column in series:
        out = np.zeros_like(column)
        if abs(steps) < len(column):
            if steps > 0:
                out[:-steps] = column[steps:]
            else:
                out[-steps:] = column[:steps]
        moved.append(out)
    return _Series(*moved)
