"""What D1 is worth to navigation: the track of dead reckoning beside positions, legs corrected that it had not seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..models.parameters import Parameters
from ..navigation import POINTS, SHORTEST_M, Navigation, drift_over, ends_of_stretches
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index
from .legs import Legs
from .solve import N_ERRORS, DisplacementFit, linear_about

# A velocity error is that over so long before a fix, s: of a moment, noise of positions is all there is.
OVER_S = 60.0


def navigated(
    legs: Legs,
    numbers: Index,
    states: Sequence[GaussianState],
    fit: DisplacementFit,
    parameters: Parameters,
    first_ns: int,
) -> Navigation | None:
    """The track at all fixes that are no outliers; None with hardly any motion.

    numbers, states: as for `judge.held_out`. first_ns: stamp that the legs' seconds count from. Lever arm, clock and
    heading are as found by all data, before and after: what is told apart is the mounting.
    """
    at = np.flatnonzero(fit.used)
    if len(at) < 2:
        return None
    seconds = legs.seconds[at]
    goes_on = np.diff(legs.stretch[at]) == 0
    step_s = np.append(0.0, np.where(goes_on, np.diff(seconds), 0.0))

    def steps(values: Array) -> Array:
        return np.concatenate([np.zeros((1, 2)), np.diff(values[at, :2], axis=0) * goes_on[:, None]])

    def left(errors: Array) -> Array:
        theta = np.concatenate([errors, fit.state.x[N_ERRORS:]])
        linear = linear_about(legs, theta, parameters)
        return linear.y - linear.columns @ theta

    of_all = left(fit.errors.x)
    before, after = steps(left(np.zeros(N_ERRORS))), np.zeros((len(at), 2))
    for fold, state in enumerate(states):
        own = numbers[at] % len(states) == fold
        after[own] = steps(left(state.x))[own]
    moved = steps(np.einsum("nabc,bc->na", legs.way, parameters.rotation_dvl_from_body.T))
    along = np.cumsum(np.linalg.norm(moved, axis=1))
    if along[-1] < SHORTEST_M:
        return None
    ends = ends_of_stretches(along)
    astray = [np.cumsum(each, axis=0) for each in (before, after)]
    reference = np.cumsum(steps(legs.position), axis=0)
    stretch_m = float(along[-1] if len(ends) == 2 else along[ends[1]] - along[ends[0]])
    noise = float(np.sqrt(2.0 * np.var(of_all[at, :2], axis=0).sum()))
    kept = np.round(np.linspace(0, len(at) - 1, min(POINTS, len(at)))).astype(np.intp)
    in_body = [_velocities(each, seconds, legs.rotation[at])[kept] for each in astray]
    return Navigation(
        distance_m=float(along[-1]),
        seconds=float(step_s.sum()),
        stretch_m=stretch_m,
        stretches=len(ends) - 1,
        before=drift_over(astray[0], along, ends),
        after=drift_over(astray[1], along, ends),
        noise_per_km=1000.0 * noise / stretch_m,
        on_a_map=True,
        stamps_ns=first_ns + np.round(seconds[kept] * 1e9).astype(np.int64),
        distances=along[kept],
        reference=reference[kept],
        track_before=(reference - astray[0])[kept],
        track_after=(reference - astray[1])[kept],
        error_before=in_body[0],
        error_after=in_body[1],
    )


def _velocities(astray: Array, seconds: Array, rotation_enu_from_body: Array) -> Array:
    """Mean velocity error (N, 3) m/s, body, over `OVER_S` before each of N fixes, by how far it led astray (N, 2) m."""
    since = np.searchsorted(seconds, seconds - OVER_S)
    passed = np.maximum(seconds - seconds[since], 1.0)[:, None]
    enu = np.concatenate([(astray - astray[since]) / passed, np.zeros((len(seconds), 1))], axis=1)
    return np.asarray(np.einsum("nji,nj->ni", rotation_enu_from_body, enu))
