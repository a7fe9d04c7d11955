"""Scan of a residual for one event: a step that stays, or a passage that ends.

A beam that drops out switches an error on or off; a magnetic anomaly turns the heading while the vehicle passes. Slow
noise takes such an error for its own unless the time of the event is searched.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_logsf
from ...calibration.numerics.frames import Array
from ..fit.gauss_newton import Fit
from ..model.forward_model import Problem
from ..model.hypothesis import is_time_of_run

# Times of a step that are tried, at most, and times that are tried at once
TIMES, AT_ONCE = 150, 50
# A time of the run is known to this, s: clocks and gaps move it
KNOWN_TO_S = 4.0
# Lengths of a passage, s
LENGTHS_S = (8.0, 24.0, 72.0)


class Event(NamedTuple):
    """Most significant event of a kind. log_p: adjusted for all times; columns: (M, A, c); tried: number of times."""

    about: str
    log_p: float
    columns: Array
    tried: int


def events(problem: Problem, fit: Fit, basis: Array, white: Array) -> list[Event]:
    """Return the most significant step and passages of a residual.

    basis: orthonormal (m, k) of what a fit takes, whitened, with its prior rows. white: (m,) whitened residual of unit
    variance, orthogonal to it.
    """
    found, beside = [], _beside_known_times(problem, fit)
    for about, kind in EVENTS.items():
        best, tried, event = 0.0, 0, None
        for columns in kind(problem, fit):
            columns[beside] = 0.0
            log_p = _log_p(fit, basis, white, columns)
            tried += len(log_p)
            at = int(np.argmin(log_p))
            if log_p[at] < best:
                best, event = float(log_p[at]), columns[:, :, at]
        if event is not None:
            found.append(Event(about, best + float(np.log(tried)), event, tried))
    return found


def _beside_known_times(problem: Problem, fit: Fit) -> NDArray[np.bool_]:
    """Return (M,) bins next to the beginning or end of a fit's effects, which is known to some seconds."""
    beside = np.zeros(len(problem.time), dtype=bool)
    for effect in fit.effects:
        for rows, values in zip(problem.rows_of, fit.values[effect.name], strict=True):
            for spec in filter(is_time_of_run, effect.parameters):
                beside[rows] |= np.abs(problem.time[rows] - values[spec.name]) < KNOWN_TO_S
    return beside


def _log_p(fit: Fit, basis: Array, white: Array, columns: Array) -> Array:
    """Return log p (K,) of columns (M, A, K, c) of K events."""
    m, a, k, c = columns.shape
    each = fit.noise.whiten(columns.reshape(m, a, k * c))
    rows = len(each)
    known = basis[:rows].T @ each
    along = (each.T @ white[:rows] - known.T @ (basis.T @ white)).reshape(k, c)
    each, known = each.reshape(rows, k, c), known.reshape(-1, k, c)
    gram = np.einsum("rki,rkj->kij", each, each, optimize=True)
    left = gram - np.einsum("rki,rkj->kij", known, known, optimize=True)
    squares, directions = np.linalg.eigh(left)
    has = squares > 1e-4 * np.trace(gram, axis1=1, axis2=2)[:, None]
    turned = np.einsum("kij,ki->kj", directions, along)
    energy = np.sum(np.where(has, turned**2 / np.where(has, squares, 1.0), 0.0), axis=1)
    dof = has.sum(axis=1)
    return np.where(dof > 0, chi2_logsf(energy, np.maximum(dof, 1)), 0.0)


def _steps(problem: Problem, _: Fit) -> Iterator[Array]:
    """Yield steps (M, A, K, A) in each axis."""
    for rows, at in _times(problem):
        on = (problem.time[rows, None] >= at).astype(float)
        yield _in(problem, rows, on[:, None, :, None] * np.eye(problem.axes)[:, None, :])


def _passages(problem: Problem, _: Fit) -> Iterator[Array]:
    """Yield constant errors (M, A, K, A) for a while in each axis."""
    for rows, on in _whiles(problem):
        yield _in(problem, rows, on[:, None, :, None] * np.eye(problem.axes)[:, None, :])


def _turned(problem: Problem, fit: Fit) -> Iterator[Array]:
    """Yield errors (M, A, K, 1) of a heading that is off for a while."""
    across = []
    for grid, seen in zip(problem.grids, fit.seen, strict=True):
        rotation = seen.motion.rotation_enu_from_body
        if rotation is None:
            return
        across.append(grid.averaged(np.cross(rotation[:, 2], seen.motion.velocity_body)))
    measured = np.concatenate(across)[:, np.array(problem.measured)]
    for rows, on in _whiles(problem):
        yield _in(problem, rows, (measured[rows, :, None] * on[:, None, :])[..., None])


def _times(problem: Problem) -> Iterator[tuple[slice, Array]]:
    """Yield the bins of a recording, and times (K,) s in it."""
    for rows in problem.rows_of:
        time = problem.time[rows]
        count = min(TIMES, len(time) // 2)
        at = np.linspace(time[0], time[-1], count + 2)[1:-1]
        for part in np.array_split(at, max(1, -(-count // AT_ONCE))):
            yield rows, part


def _whiles(problem: Problem) -> Iterator[tuple[slice, Array]]:
    """Yield the bins of a recording, and passages (M, K) of one length at half-overlapping times."""
    for rows in problem.rows_of:
        time = problem.time[rows]
        for length in LENGTHS_S:
            at = np.arange(time[0] + 0.5 * length, time[-1] - 0.5 * length, 0.5 * length)
            for part in np.array_split(at, max(1, -(-len(at) // AT_ONCE))):
                if len(part):
                    yield rows, np.maximum(1.0 - np.abs(time[:, None] - part) / length, 0.0)


def _in(problem: Problem, rows: slice, values: Array) -> Array:
    """Return values (m, A, K, c) of some bins among zeros (M, A, K, c)."""
    whole = np.zeros((len(problem.time), *values.shape[1:]))
    whole[rows] = values
    return whole


# What yields the columns of all times, by what the residual is said to follow
EVENTS = {"a step in time": _steps, "a stretch of time": _passages, "a passage that turns the heading": _turned}
