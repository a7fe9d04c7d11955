"""Estimator of `positions` from displacements, its verification on held-out legs, and its track.

All legs so far are solved together at scheduled stamps. Each solution uses only earlier rows and fixes, minus the delay
that a fix may have, and takes effect one second later in stamps. So a live run and a replay agree.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from ..assessment.dead_reckoning import MAP_POINTS, SHORTEST_M, Navigation, drift_over, ends_of_stretches
from ..assessment.model_selection import NO_EVIDENCE, Evidence
from ..filters.cross_validation import FOLDS, HeldOutError, Moments, held_out_from_sums
from ..filters.filter_bank import ModelCounts
from ..filters.filter_setup import prior
from ..filters.state_history import Counts, Numbers, StateTrace
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, SampleUse, Stamps
from ..results.thinned_recording import Terms
from ..streams.position_velocities import NOISY_MPS, are_positions
from .displacement_least_squares import (
    N_ERRORS,
    DeadReckoning,
    DisplacementFit,
    Fixes,
    Legs,
    linear_about,
    solve,
    white_noise,
)
from .estimator import NEVER, SOLVED_WITHIN_NS, AtOnce, Estimator, EstimatorSetup

# Time of the first solution, s, and growth of the run between solutions.
FIRST_LOOK_S, GROWTH = 60.0, 1.2
# Velocities from positions are too noisy beyond NOISY_MPS. They do not exist for fixes further apart than this number
# of windows (position_velocities.py).
MAX_WINDOWS = 3.0


class _Look(NamedTuple):
    """Fit of the legs so far, None if not needed or too few, and noise of velocities from positions, or inf."""

    fit: DisplacementFit | None
    noise_mps: float


NO_LOOK = _Look(None, 0.0)


class Displacements(Estimator):
    """Estimator of `positions`, which collects dead reckoning and fixes and has them solved."""

    def __init__(self, given: EstimatorSetup) -> None:
        """Start from the prior of its states."""
        self._model, self._parameters, self._aligner = given.model, given.parameters, given.aligner
        self._start = given.initial or prior(given.model, given.parameters)
        self._on_look = given.on_evidence
        self._worker = AtOnce() if given.worker is None else given.worker
        self._is_asked = are_positions(given.parameters)
        self._reckoning = DeadReckoning(given.parameters.rotation_dvl_from_body, 1e-9 * given.aligner.lag_ns)
        self._n_taken = 0
        self._first_ns: int | None = None
        self._next_ns = self._oriented_ns = 0
        self._coming: deque[tuple[int, Future[_Look]]] = deque()
        self._last_result = NO_LOOK
        self._n_updates = 0
        self._newest: tuple[int, DisplacementFit | None] = (0, None)  # of all legs, with their number
        self._folds: tuple[int, tuple[Legs, Index, list[GaussianState]]] | None = None  # with the number of fixes
        self._is_settled = False
        self._remembered: list[tuple[int, GaussianState, int]] = []

    # ------------------------------------------------------------------ input

    @property
    def n_taken(self) -> int:
        """See `Estimator`."""
        return self._n_taken if self._is_asked else NEVER

    def take_fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """See `Estimator`."""
        stamp_ns -= round(self._parameters.reference_time_offset * 1e9)
        self._reckoning.add_fixes(Fixes(np.array([stamp_ns]), position[None], variance[None]))

    def take_rows(self) -> None:
        """See `Estimator`."""
        rows, end = self._aligner.rows, self._aligner.partners.n_oriented
        if not self._is_asked or end <= self._n_taken:
            return
        first, last = self._n_taken - rows.base, end - rows.base
        at = np.flatnonzero((rows.verdict[first:last] != SampleUse.FROZEN) & ~rows.late[first:last]) + first
        self._n_taken, self._oriented_ns = end, int(rows.stamps_ns[last - 1])
        if len(at):
            if self._first_ns is None:
                self._first_ns = int(rows.stamps_ns[at[0]])
                self._next_ns = self._first_ns + round(FIRST_LOOK_S * 1e9)
            self._reckoning.add_rows(rows.stamps_ns[at], rows.velocity_dvl[at], rows.attitude[at, :4])

    def advance(self) -> None:
        """See `Estimator`."""
        self.take_rows()
        while self._first_ns is not None and self._next_ns <= self._oriented_ns:
            self._look(self._next_ns)
            passed_s = 1e-9 * (self._next_ns - self._first_ns)
            self._next_ns = self._first_ns + round(1e9 * math.ceil(passed_s * GROWTH))
        self._let_take_effect(self._oriented_ns)

    def _look(self, at_ns: int) -> None:
        """Solve the legs that are complete at a stamp, whatever has arrived since."""
        assert self._first_ns is not None
        legs = self._reckoning.legs()
        passed_s = 1e-9 * (at_ns - self._aligner.lag_ns - self._first_ns)  # later fixes may still arrive
        known = legs.part(slice(int(np.searchsorted(legs.seconds, passed_s))))
        parameters, start = self._parameters, self._start

        def looked() -> _Look:
            noise_mps = _noise_of_velocities(known, parameters)
            return _Look(solve(known, parameters, start) if noise_mps > NOISY_MPS else None, noise_mps)

        self._coming.append((at_ns + SOLVED_WITHIN_NS, self._worker.submit(looked)))

    def _let_take_effect(self, reached_ns: int) -> None:
        """Publish the solutions that take effect up to a stamp (ns)."""
        while self._coming and self._coming[0][0] <= reached_ns:
            from_ns, solved = self._coming.popleft()
            self._last_result = solved.result()
            self._n_updates += 1
            if self._last_result.fit is not None:
                self._on_look(from_ns)

    def finish(self) -> None:
        """See `Estimator`."""
        self.take_rows()
        if self._coming:
            self._let_take_effect(self._coming[-1][0])

    @contextmanager
    def settled(self) -> Iterator[None]:
        """Use all legs inside this context, not only those of the latest solution."""
        self._is_settled = True
        try:
            yield
        finally:
            self._is_settled = False

    # ------------------------------------------------------------------ what is known

    def _fit(self) -> DisplacementFit | None:
        """Return the fit of all legs inside `settled`, else the latest published fit."""
        if not self._is_settled:
            return self._last_result.fit
        self.take_rows()
        legs = self._reckoning.legs()
        if self._newest[0] != len(legs.seconds):
            self._newest = len(legs.seconds), solve(legs, self._parameters, self._start)
        return self._newest[1]

    def state(self) -> GaussianState:
        """See `Estimator`."""
        fit = self._fit()
        return self._start if fit is None else fit.errors

    def of_recording(self) -> GaussianState:
        """Return `state`, whose σ already includes correlated noise."""
        return self.state()

    @property
    def counts(self) -> ModelCounts:
        """Fixes used and outliers; the mean squared residual is nominal, as the noise is estimated from it."""
        fit = self._fit()
        used = 0 if fit is None else int(np.count_nonzero(fit.used))
        gated = 0 if fit is None else len(fit.used) - used
        return ModelCounts(used, gated, 2.0 if used else math.nan, 2.0, 0)

    @property
    def n_results(self) -> int:
        """Number of solutions in effect."""
        return self._n_updates

    @property
    def evidence(self) -> Evidence:
        """Evidence that positions are too noisy or too sparse for velocities, once there is a fit."""
        if self._last_result.fit is None:
            return NO_EVIDENCE
        noise = self._last_result.noise_mps
        return Evidence("POSITIONS_NOISY", {"noise": noise}) if noise < math.inf else Evidence("POSITIONS_SELDOM")

    def remember(self, from_ns: int) -> None:
        """See `Estimator`."""
        self._remembered.append((from_ns, self.state(), self.counts.used))

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> tuple[GaussianState, Counts, Array]:
        """See `Estimator`."""
        at = np.searchsorted([row[0] for row in self._remembered], stamps_ns, side="right")
        known = [(self._start, 0), *((state, used) for _, state, used in self._remembered)]
        states, used = zip(*(known[place] for place in at.tolist()), strict=True)
        of_each: Counts = np.array(used, dtype=np.int64)
        return (
            GaussianState(np.array([each.x for each in states]), np.array([each.p for each in states])),
            of_each,
            2.0 * of_each,  # the expected sum of two components per sample: no innovations are kept
        )

    # ------------------------------------------------------------------ verification

    def _without_folds(self) -> tuple[Legs, Index, list[GaussianState]]:
        """Return all fixes, the leg (N,) of each, and the errors estimated without each fold (every fifth leg)."""
        self.take_rows()
        legs = self._reckoning.legs()
        if self._folds is None or self._folds[0] != len(legs.seconds):
            numbers = np.floor(legs.seconds / leg_length_s(legs)).astype(np.intp)
            fits = [
                solve(legs.part(np.flatnonzero(numbers % FOLDS != fold)), self._parameters, self._start)
                for fold in range(FOLDS)
            ]
            states = [self._start if fit is None else fit.errors for fit in fits]
            self._folds = len(legs.seconds), (legs, numbers, states)
        return self._folds[1]

    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """Return the held-out error of mean velocities over legs of positions; None without a fit."""
        fit = self._fit()
        if fit is None:
            return None
        legs, numbers, states = self._without_folds()
        return held_out(legs, numbers, states, fit, self._parameters)

    def navigation(self) -> Navigation | None:
        """Return the drift of dead reckoning by positions; None without a fit."""
        fit = self._fit()
        if fit is None or self._first_ns is None:
            return None
        legs, numbers, states = self._without_folds()
        return navigated(legs, numbers, states, fit, self._parameters, self._first_ns)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """See `Estimator`."""
        terms = self._model.error_terms_from_state
        _, _, states = self._without_folds()
        return [[Terms(terms @ state.x, np.zeros(3), 0.0)] * n_days for state in states]


def _noise_of_velocities(legs: Legs, parameters: Parameters) -> float:
    """Return the noise of velocities from positions, m/s; inf if fixes are too sparse, 0 if too few."""
    if len(legs.seconds) < N_ERRORS:
        return 0.0
    interval, window_s = float(np.median(np.diff(legs.seconds))), parameters.position_window
    if interval > MAX_WINDOWS * window_s:
        return math.inf
    return math.sqrt(2.0) * white_noise(legs, np.array(parameters.lever_arm)) / max(window_s, interval)


# Time before a fix over which a velocity error is averaged, and longest held-out leg, s: over less, position noise
# dominates.
LEG_S = 60.0


def navigated(
    legs: Legs,
    numbers: Index,
    states: Sequence[GaussianState],
    fit: DisplacementFit,
    parameters: Parameters,
    first_ns: int,
) -> Navigation | None:
    """Return the track at all fixes without outliers; None with hardly any motion.

    numbers, states: see `held_out`. first_ns: stamp of the legs' time 0. Lever arm, delay and heading deviation are
    from all data in both tracks, so they differ by mounting and scale only.
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
    distance = np.cumsum(np.linalg.norm(moved, axis=1))
    if distance[-1] < SHORTEST_M:
        return None
    ends = ends_of_stretches(distance)
    astray = [np.cumsum(each, axis=0) for each in (before, after)]
    reference = np.cumsum(steps(legs.position), axis=0)
    stretch_m = float(distance[-1] if len(ends) == 2 else distance[ends[1]] - distance[ends[0]])
    noise = float(np.sqrt(2.0 * np.var(of_all[at, :2], axis=0).sum()))
    kept = np.round(np.linspace(0, len(at) - 1, min(MAP_POINTS, len(at)))).astype(np.intp)
    in_body = [_velocities(each, seconds, legs.rotation[at])[kept] for each in astray]
    return Navigation(
        distance_m=float(distance[-1]),
        seconds=float(step_s.sum()),
        stretch_m=stretch_m,
        stretches=len(ends) - 1,
        before=drift_over(astray[0], distance, ends),
        after=drift_over(astray[1], distance, ends),
        noise_per_km=1000.0 * noise / stretch_m,
        on_a_map=True,
        stamps_ns=first_ns + np.round(seconds[kept] * 1e9).astype(np.int64),
        distances=distance[kept],
        reference=reference[kept],
        track_before=(reference - astray[0])[kept],
        track_after=(reference - astray[1])[kept],
        error_before=in_body[0],
        error_after=in_body[1],
    )


def _velocities(astray: Array, seconds: Array, rotation_enu_from_body: Array) -> Array:
    """Return mean velocity errors (N, 3) m/s, body axes, over `LEG_S` before each fix, from track errors (N, 2) m."""
    since = np.searchsorted(seconds, seconds - LEG_S)
    passed = np.maximum(seconds - seconds[since], 1.0)[:, None]
    enu = np.concatenate([(astray - astray[since]) / passed, np.zeros((len(seconds), 1))], axis=1)
    return np.asarray(np.einsum("nji,nj->ni", rotation_enu_from_body, enu))


# Length of a held-out leg, s: at most LEG_S against position noise, and shorter to have LEGS of them; at least
# SHORTEST_LEG_S, and no more than MOST_LEGS legs.
SHORTEST_LEG_S, LEGS, MOST_LEGS = 20.0, 30.0, 200.0
# Share of a leg at each end whose fixes are averaged.
END_SHARE = 0.25


def leg_length_s(legs: Legs) -> float:
    """Return the length of held-out legs, s."""
    span_s = float(np.ptp(legs.seconds)) if len(legs.seconds) else 0.0
    return max(SHORTEST_LEG_S, span_s / MOST_LEGS, min(LEG_S, span_s / LEGS))


def held_out(
    legs: Legs, numbers: Index, states: Sequence[GaussianState], fit: DisplacementFit, parameters: Parameters
) -> HeldOutError | None:
    """Return the error of mean velocities over legs, m/s, each by the state of `states` fitted without it.

    numbers: (N,) leg of each fix; legs are assigned to the states in turn. The predicted error holds the residual of
    the fit of all data, and the estimate's covariance.
    """
    ends = _ends(legs, numbers, fit)
    if not len(ends):
        return None
    sums = np.zeros(5)
    rest = fit.state.x.copy()
    rest[:N_ERRORS] = 0.0  # lever arm, delay and heading from all data; only mounting and scale are tested
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
    """Return the fixes at both ends of each leg, in one stretch and without outliers."""
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
    """Return the change per second of values (N, ...) from start to end of each leg."""
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
    """Return the derivative (L, 2, 4) of leg velocities by the errors."""
    columns = linear_about(legs, theta, parameters).columns[:, :2, :N_ERRORS]
    return _between(columns, legs, ends)
