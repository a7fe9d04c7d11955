"""Scan of a residual for one event: a step that stays, or a pulse that ends.

A beam that drops out switches an error on or off. A magnetic anomaly rotates the heading while the vehicle passes. The
slow noise absorbs such an error unless the time of the event is searched.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ..fit.gauss_newton import Fit
from ..model.forward_model import Problem
from ..model.hypothesis import is_time_of_run
from ..noise.whitened_least_squares import ScoreTest
from .alternative_regressors import Regressor

# Largest number of times of a step or of a pulse of one width, so that an hour costs as much per sample as minutes;
# events whitened together, whose columns share one Gram matrix
TIMES, BATCH = 150, 10
# A time of the run is known to this, s: clocks and gaps move it
TIME_TOLERANCE_S = 4.0
# Half widths of triangular pulses, s
HALF_WIDTHS_S = (8.0, 24.0, 72.0)


def events(problem: Problem, fit: Fit, basis: Array, white: Array) -> list[Regressor]:
    """Return the most significant step and pulses of a residual.

    basis: orthonormal (m, k) of the fit's whitened columns, with its prior rows. white: (m,) whitened residual of unit
    variance, orthogonal to it.
    """
    found, excluded, memory_samples = [], _near_fitted_times(problem, fit), fit.noise.memory_samples
    for about, (profiles_of, error_of) in EVENTS.items():
        error = error_of(problem, fit)
        if error is None:
            continue
        best, tried = Regressor(about, error, 0.0, 0), 0
        for rows in problem.rows_of:
            profiles = profiles_of(problem.time[rows])
            tried += profiles.shape[1]
            for first in range(0, profiles.shape[1], BATCH):
                profile = profiles[:, first : first + BATCH]
                acts = rows.start + np.flatnonzero(profile.any(axis=1))
                if not len(acts):  # all within a gap
                    continue
                part = slice(max(rows.start, acts[0] - 1), min(rows.stop, acts[-1] + 1 + memory_samples))
                profile = profile[part.start - rows.start : part.stop - rows.start]
                columns = error[part, :, None] * profile[:, None, :, None]
                columns[excluded[part]] = 0.0
                energies, ranks = _energies(fit, basis, white, columns, part)
                at = int(np.argmax(energies))
                if energies[at] > best.energy:
                    event = np.zeros_like(error)
                    event[part] = columns[:, :, at]
                    best = Regressor(about, event, float(energies[at]), int(ranks[at]))
        if best.energy > 0.0:
            found.append(best._replace(log_tried=float(np.log(tried))))
    return found


def _near_fitted_times(problem: Problem, fit: Fit) -> NDArray[np.bool_]:
    """Return (M,) bins next to the beginning or end of a fit's effects, which is known to some seconds."""
    excluded = np.zeros(len(problem.time), dtype=bool)
    for effect in fit.effects:
        for rows, values in zip(problem.rows_of, fit.values[effect.name], strict=True):
            for spec in filter(is_time_of_run, effect.parameters):
                excluded[rows] |= np.abs(problem.time[rows] - values[spec.name]) < TIME_TOLERANCE_S
    return excluded


def _energies(fit: Fit, basis: Array, white: Array, columns: Array, part: slice) -> tuple[Array, NDArray[np.intp]]:
    """Return energy and rank (K,) of events with columns (m, A, K, c) in a part of the bins, zero in others."""
    m, axes, k, c = columns.shape
    whitened = fit.noise.part(part).whiten(columns.reshape(m, axes, k * c))
    test = ScoreTest.of(basis, whitened, white, axes * part.start)
    return test.energies(np.arange(k * c).reshape(k, c))


def _steps(time: Array) -> Array:
    """Return K unit steps (m, K) at equal intervals."""
    count = min(TIMES, len(time) // 2)
    return (time[:, None] >= np.linspace(time[0], time[-1], count + 2)[1:-1]).astype(float)


def _pulses(time: Array) -> Array:
    """Return K triangular pulses (m, K) of height 1, spaced by half their half width, or more in long recordings."""
    each = []
    for half_width in HALF_WIDTHS_S:
        step = max(0.5 * half_width, float(time[-1] - time[0]) / TIMES)
        each.append(np.arange(time[0] + 0.5 * half_width, time[-1] - 0.5 * half_width, step))
    widths = np.repeat(HALF_WIDTHS_S, [len(at) for at in each])
    return np.asarray(np.maximum(1.0 - np.abs(time[:, None] - np.concatenate(each)) / widths, 0.0))


def _of_each_axis(problem: Problem, _: Fit) -> Array:
    """Return a constant error (M, A, A) in each axis."""
    return np.tile(np.eye(problem.axes), (len(problem.time), 1, 1))


def _of_heading(problem: Problem, fit: Fit) -> Array | None:
    """Return the error (M, A, 1) by a turned heading, None without attitude."""
    across = []
    for grid, seen in zip(problem.grids, fit.seen, strict=True):
        rotation = seen.motion.rotation_enu_from_body
        if rotation is None:
            return None
        across.append(grid.averaged(np.cross(rotation[:, 2], seen.motion.velocity_body)))
    return np.concatenate(across)[:, np.array(problem.measured), None]


# Time profiles and error of each event, by its name in the sentence on the residual
EVENTS: dict[str, tuple[Callable[[Array], Array], Callable[[Problem, Fit], Array | None]]] = {
    "a step in time": (_steps, _of_each_axis),
    "a stretch of time": (_pulses, _of_each_axis),
    "a passage that turns the heading": (_pulses, _of_heading),
}
