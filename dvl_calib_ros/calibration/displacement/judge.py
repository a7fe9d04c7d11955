"""D1 verified: where dead reckoning leads on legs that an estimate has not seen, against positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..filters.cross_validation import HeldOutError, held_out_from_sums
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index
from .legs import Legs
from .solve import N_ERRORS, DisplacementFit, linear_about

# Legs that are judged are so long, s: noise of positions is the less the longer they are, but there are to be so many.
LEG_S, SHORTEST_LEG_S, LEGS, MOST_LEGS = 60.0, 20.0, 30.0, 200.0
# Fixes whose mean is one end of a leg are of so much of it.
END_SHARE = 0.25


def leg_length_s(legs: Legs) -> float:
    """How long legs are that are judged."""
    span_s = float(np.ptp(legs.seconds)) if len(legs.seconds) else 0.0
    return max(SHORTEST_LEG_S, span_s / MOST_LEGS, min(LEG_S, span_s / LEGS))


def held_out(
    legs: Legs, numbers: Index, states: Sequence[GaussianState], fit: DisplacementFit, parameters: Parameters
) -> HeldOutError | None:
    """Error of mean velocity over legs, m/s: by the state of `states` that had not seen it.

    numbers (N,): of the leg of each fix, which are dealt out to the states in turn. What is predicted is what noise
    leaves with the estimate of all data, and the estimate's σ.
    """
    ends = _ends(legs, numbers, fit)
    if not len(ends):
        return None
    sums = np.zeros(5)
    rest = fit.state.x.copy()
    rest[:N_ERRORS] = 0.0  # lever arm, clock and heading, by all data: what is judged is the mounting
    of_all = _velocity_errors(legs, ends, fit.state.x, parameters)
    before = _velocity_errors(legs, ends, rest, parameters)
    for fold, state in enumerate(states):
        own = np.array([numbers[first[0]] % len(states) == fold for first, _ in ends])
        if not own.any():
            continue
        theta = fit.state.x.copy()
        theta[:N_ERRORS] = state.x
        after = _velocity_errors(legs, ends, theta, parameters)[own]
        jacobian = _jacobian(legs, [each for each, is_own in zip(ends, own, strict=True) if is_own], theta, parameters)
        calibration = float(np.einsum("nij,jk,nik->", jacobian, state.p, jacobian))
        noise = float((of_all[own] ** 2).sum())
        sums += [float((before[own] ** 2).sum()), float((after**2).sum()), noise + calibration, calibration, 0.0]
    return held_out_from_sums(len(ends), sums)


def _ends(legs: Legs, numbers: Index, fit: DisplacementFit) -> list[tuple[Index, Index]]:
    """Fixes at the beginning and at the end of each leg: of one stretch, no outliers."""
    length = leg_length_s(legs)
    at = np.flatnonzero(fit.used)
    key = np.stack([legs.stretch[at], numbers[at]])
    found = []
    for part in np.split(at, np.flatnonzero((np.diff(key, axis=1) != 0).any(axis=0)) + 1):
        seconds = legs.seconds[part]
        if len(part) < 2 or seconds[-1] - seconds[0] < 0.5 * length:
            continue
        reach = END_SHARE * (seconds[-1] - seconds[0])
        found.append((part[seconds <= seconds[0] + reach], part[seconds >= seconds[-1] - reach]))
    return found


def _between(values: Array, legs: Legs, ends: Sequence[tuple[Index, Index]]) -> Array:
    """Change of values (N, ...) per second from the beginning of each leg to its end."""
    return np.array(
        [
            (values[last].mean(axis=0) - values[first].mean(axis=0))
            / (legs.seconds[last].mean() - legs.seconds[first].mean())
            for first, last in ends
        ]
    )


def _velocity_errors(legs: Legs, ends: Sequence[tuple[Index, Index]], theta: Array, parameters: Parameters) -> Array:
    linear = linear_about(legs, theta, parameters)
    return _between((linear.y - linear.columns @ theta)[:, :2], legs, ends)


def _jacobian(legs: Legs, ends: Sequence[tuple[Index, Index]], theta: Array, parameters: Parameters) -> Array:
    """(L, 2, 4) of velocities by the errors."""
    columns = linear_about(legs, theta, parameters).columns[:, :2, :N_ERRORS]
    return _between(columns, legs, ends)
