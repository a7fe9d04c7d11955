"""What is left after the best combination of effects: does it still follow the vehicle's motion, or time?

A dictionary of what a vehicle's error could follow, each with a free vector in the body frame. Noise of the sky does
not know the vehicle's motion, so what follows it is systematic, whatever its cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ..calibration.frames import Array
from .composed import Grid, Problem, Seen
from .fitting import Fit, Fitter
from .least_squares import WhitenedLeastSquares
from .noise import Noise

LEVEL = 0.001
TIME_KNOTS = 7
SPEED_KNOTS = 7
STEPS = 11
# Time constants, s, in which a turn may go on acting
FADES_S = (4.0, 12.0, 40.0)
# Of these one is enough, and is looked for by itself
ALTERNATIVES = ("a step in time", "a band of speeds", "turns before")
HEADING_HARMONICS = 4
# Of lines in the spectrum: longer than waves are, and more of them than the dictionary in time has
SHORTEST_PERIOD_S, FEWEST_PERIODS = 16.0, 3.0
# Directions of the dictionary that hold less of their length than this beside the others are left out
INDEPENDENT = 1e-3


@dataclass(frozen=True)
class Unexplained:
    """log_p: of the best entry or of all together, adjusted for having looked at all. energy: in units of the noise
    variance, beyond what chance brings. about: what the rest follows. columns: (M, A, f), the dictionary; empty if
    nothing is left, since it would only explain noise.
    """

    log_p: float
    energy: float
    about: str
    columns: Array

    @property
    def found(self) -> bool:
        """Whether something is left."""
        return self.log_p < np.log(LEVEL)


def dictionary(problem: Problem, seen: Sequence[Seen]) -> dict[str, Array]:
    """Name -> (M, c) functions of motion or time, without unit."""
    parts = [_of_motion(grid, each) for grid, each in zip(problem.grids, seen, strict=True)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _of_motion(grid: Grid, seen: Seen) -> dict[str, Array]:
    motion = seen.motion
    velocity, speed = motion.velocity_body, motion.speed
    acceleration = np.gradient(velocity[:, 0], motion.time)
    typical = max(float(np.median(speed)), 0.1)
    hats = _hats(motion.time, np.linspace(motion.time[0], motion.time[-1], TIME_KNOTS))
    s = speed / typical
    found: dict[str, Array] = {
        "speed": np.column_stack([np.ones_like(s), s, s**2, s**3, np.maximum(s - 1.0, 0.0)]),
        "a band of speeds": _hats(
            speed, np.quantile(speed, 0.01) + np.linspace(0.0, 1.0, SPEED_KNOTS) * _spread(speed)
        ),
        "acceleration": np.column_stack([acceleration, np.abs(acceleration)]),
        "sway and heave": np.column_stack([velocity[:, 1:], np.abs(velocity[:, 1:])]),
        "time": np.column_stack([hats, hats * s[:, None]]),
        "a step in time": _steps(motion.time, STEPS),
    }
    if motion.rotation_enu_from_body is not None:
        rotation = motion.rotation_enu_from_body
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        roll, pitch = rotation[:, 2, 1], -rotation[:, 2, 0]
        once = np.column_stack([np.cos(yaw), np.sin(yaw)])
        more = [wave(n * yaw) for n in range(2, HEADING_HARMONICS + 1) for wave in (np.cos, np.sin)]
        found["heading"] = np.column_stack([once, once * s[:, None], *more])
        found["tilt"] = np.column_stack([roll, pitch, np.abs(roll), np.abs(pitch), roll * s, pitch * s])
        steps = np.clip(np.diff(motion.time, prepend=motion.time[0]), 0.0, 10.0)
        up = np.einsum("ni,ni->n", rotation[:, 2], velocity)
        found["depth"] = np.cumsum(up * steps)[:, None]
    if motion.angular_velocity is not None:
        rate = motion.angular_velocity
        turning = rate[:, 2]
        found["turn rate"] = np.column_stack([turning, np.abs(turning), turning * s, np.abs(turning) * s, turning**2])
        found["turns before"] = np.column_stack([_faded(motion.time, turning, seconds) for seconds in FADES_S])
        found["roll and pitch rate"] = np.column_stack([rate[:, :2], np.abs(rate[:, :2])])
    return {name: grid.averaged(values) for name, values in found.items()}


def _spread(speed: Array) -> float:
    return max(float(np.quantile(speed, 0.99) - np.quantile(speed, 0.01)), 1e-3)


def _steps(time: Array, count: int) -> Array:
    """(N, count) functions that step from zero to one at even parts of the time."""
    at = np.linspace(time[0], time[-1], count + 2)[1:-1]
    return (time[:, None] >= at).astype(float)


def _faded(time: Array, values: Array, seconds: float) -> Array:
    """(N,) what values (N,) were, fading with a time constant."""
    steps = np.clip(np.diff(time, prepend=time[0]), 0.0, 10.0)
    decay = np.exp(-steps / seconds)
    out = np.zeros_like(values)
    for i in range(1, len(values)):
        out[i] = decay[i] * out[i - 1] + (1.0 - decay[i]) * values[i]
    return out


def _hats(values: Array, knots: Array) -> Array:
    """Piecewise linear functions (N, knots) that are one at one knot and zero at the others."""
    return np.column_stack([np.interp(values, knots, row) for row in np.eye(len(knots))])


def unexplained(fitter: Fitter, fit: Fit) -> Unexplained:
    """Look for what the residual of a fit still follows."""
    problem, noise = fitter.problem, fit.noise
    known = fit.columns
    q = _orthonormal(noise.whiten(known))
    white = noise.whiten(fit.residual)
    white = white - q @ (q.T @ white)
    variance = float(white @ white) / (len(white) - q.shape[1])
    tests: list[tuple[float, str]] = []
    recoloured: list[tuple[float, str]] = []
    columns, energies = [], [0.0]
    for name, functions in dictionary(problem, fit.seen).items():
        raw = _along_axes(functions, problem.axes)
        columns.append(raw)
        whitened = noise.whiten(raw)
        for at in _looks(name, functions.shape[1], problem.axes):
            tests.append((explained(q, whitened[:, at], white, variance)[0], name))
        if noise.is_coloured and name != "time":  # what changes with time alone may as well be noise
            log_p, energy = _recoloured(noise, known, raw, fit.residual)
            recoloured.append((log_p, name))
            energies.append(energy)
    for line in lines(problem, white.reshape(-1, problem.axes) / np.sqrt(variance)):
        tests.append((line.log_p, f"a period of {line.period_s:.0f} s"))
        if line.log_p < np.log(LEVEL):  # the best of many would always explain some of the noise
            columns.append(_along_axes(line.waves, problem.axes))
    raw = np.concatenate(columns, axis=2)
    log_p, energy = explained(q, noise.whiten(raw), white, variance)
    looked_at = float(np.log(len(tests) + len(recoloured) + 1))
    best, name = min(tests)
    if best + looked_at > np.log(LEVEL):  # else what is left is told by what explains it under one noise
        best, name = min([*tests, *recoloured])
    log_p = min(best, *(each for each, _ in recoloured), log_p) + looked_at
    found = Unexplained(min(log_p, 0.0), max(energy, *energies), name, raw)
    return found if found.found else replace(found, columns=raw[:, :, :0])


@dataclass(frozen=True)
class Line:
    """The clearest line in the spectrum of one recording. log_p: adjusted for all frequencies looked at, up to a
    factor. waves: (M, 2) cosine and sine, zero in other recordings.
    """

    period_s: float
    log_p: float
    waves: Array


def lines(problem: Problem, innovations: Array) -> list[Line]:
    """Lines in the innovations (M, A), of unit variance, of each recording that is long enough.

    Noise of the sky has no period, coloured as it may be. Waves have: what is left of them at the pairing of two
    sensors is no finding, so only periods longer than theirs count.
    """
    found = []
    for index, recording in enumerate(problem.recordings):
        at = problem.recording_of == index
        step = SHORTEST_PERIOD_S / 5.0
        position = ((problem.time[at] - problem.time[at][0]) / step).astype(int)
        sums = np.stack([np.bincount(position, series) for series in innovations[at].T])
        n = 2 * sums.shape[1]  # twice as fine as independent frequencies are
        frequency = np.fft.rfftfreq(n, step)
        power = 2.0 * np.abs(np.fft.rfft(sums, n)) ** 2 / np.count_nonzero(at)  # chi-square of 2 degrees of freedom
        inside = (frequency >= FEWEST_PERIODS / recording.seconds) & (frequency <= 1.0 / SHORTEST_PERIOD_S)
        if not inside.any():
            continue
        log_p = np.vstack([chi2.logsf(power, 2), chi2.logsf(power.sum(axis=0), 2 * innovations.shape[1])])[:, inside]
        best = int(np.argmin(log_p.min(axis=0)))
        period = 1.0 / float(frequency[inside][best])
        phase = 2.0 * np.pi * problem.time / period
        waves = np.where(at[:, None], np.column_stack([np.cos(phase), np.sin(phase)]), 0.0)
        found.append(Line(period, float(log_p.min() + np.log(log_p.size)), waves))
    return found


def holds_out(fitter: Fitter, fit: Fit, rest: Unexplained, fold: NDArray[np.intp]) -> float:
    """Whitened squares that what the rest follows explains on folds (M,) that it was not fitted to.

    One of many regressors may have a small p-value by chance or for an interpolation that is bent in sharp corners;
    what is there tells of itself elsewhere.
    """
    functions = dictionary(fitter.problem, fit.seen).get(rest.about)
    if functions is None:  # a line in the spectrum, which is one of very many
        return rest.energy
    raw = _along_axes(functions, fitter.problem.axes)
    size = np.maximum(np.sqrt((raw**2).mean(axis=(0, 1))), 1e-12)
    known = fit.columns / np.maximum(np.sqrt((fit.columns**2).mean(axis=(0, 1))), 1e-12)
    white = fit.noise.whiten(np.concatenate([known, raw / size], axis=2))
    series = fit.noise.whiten(fit.residual)
    rows = np.repeat(fold, fitter.problem.axes)
    gain = 0.0
    for held in np.unique(fold):
        train, test = rows != held, rows == held
        solution = _solved(white[train], series[train])
        base = _solved(white[train][:, : known.shape[2]], series[train])
        left = series[test] - white[test][:, : known.shape[2]] @ base
        gain += float(left @ left - np.sum((series[test] - white[test] @ solution) ** 2))
    return gain


def _solved(white: Array, series: Array) -> Array:
    ridge = np.full(white.shape[1], 10.0)
    return WhitenedLeastSquares.of(white, series, ridge, np.zeros_like(ridge)).solution()


def _recoloured(noise: Noise, known: Array, raw: Array, residual: Array) -> tuple[float, float]:
    """As `explained`, with the noise estimated anew from what the columns (M, A, c) leave: else it has their colour."""
    joined = np.concatenate([known, raw], axis=2)
    joined = joined / np.maximum(np.sqrt((joined**2).mean(axis=(0, 1))), 1e-12)
    left, colour = residual, noise.white
    for _ in range(2):
        white = colour.whiten(joined)
        left = residual - joined @ np.linalg.lstsq(white, colour.whiten(residual), rcond=INDEPENDENT)[0]
        colour = noise.like(left)
    rank = _orthonormal(white).shape[1] - known.shape[2]
    drop = noise.deviance(residual) - colour.deviance(left)
    return float(chi2.logsf(max(drop, 0.0), max(rank, 1))), drop - rank


def _along_axes(functions: Array, axes: int) -> Array:
    """(M, c) -> (M, A, A c): every function on every axis."""
    m, c = functions.shape
    return np.einsum("mc,ij->mijc", functions, np.eye(axes)).reshape(m, axes, axes * c)


def _looks(name: str, c: int, axes: int) -> list[NDArray[np.intp]]:
    """Columns of `_along_axes` that are tested together: all, each axis, and each of those that are alternatives."""
    index = np.arange(axes * c).reshape(axes, c)
    looks = [index.ravel(), *index]
    return [*looks, *index.T] if name in ALTERNATIVES else looks


def _orthonormal(white: Array) -> Array:
    lengths = np.linalg.norm(white, axis=0)
    white = white[:, lengths > 0.0] / lengths[lengths > 0.0]
    u, s, _ = np.linalg.svd(white, full_matrices=False)
    return u[:, s > INDEPENDENT]


def explained(q: Array, white_columns: Array, white: Array, variance: float) -> tuple[float, float]:
    """log p of what columns explain of a whitened series, and their energy beyond chance."""
    lengths = np.linalg.norm(white_columns, axis=0)
    left = white_columns - q @ (q.T @ white_columns)
    keep = np.linalg.norm(left, axis=0) > 0.02 * np.maximum(lengths, 1e-300)
    if not keep.any():
        return 0.0, 0.0
    u = _orthonormal(left[:, keep])
    energy = float(np.sum((u.T @ white) ** 2)) / variance
    return float(chi2.logsf(energy, u.shape[1])), energy - u.shape[1]
