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
from ..filters.state_history import Numbers, PastStates, StateTrace
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, SampleUse, Stamps
from ..results.thinned_recording import Terms
from ..streams.position_velocities import NOISY_MPS, are_positions
from ..streams.stream_order import LONG_AGO_NS
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
from .estimator import NEVER, SOLVED_WITHIN_NS, AtOnce, Estimator, EstimatorSetup, Remembered, states_in_effect

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


class HeldOutLegs(NamedTuple):
    """N fixes, the number (N,) of the held-out leg of each, and the errors (4,) estimated without each fold.

    Held-out legs are assigned to the folds in turn.
    """

    legs: Legs
    numbers: Index
    states: Sequence[GaussianState]

    @property
    def folds(self) -> Index:
        """Fold (N,) of each fix."""
        return self.numbers % len(self.states)


class Displacements(Estimator):
    """Estimator of `positions`, which collects dead reckoning and fixes and has them solved."""

    def __init__(self, setup: EstimatorSetup) -> None:
        """Start from the prior of its states."""
        self._model, self._parameters, self._aligner = setup.model, setup.parameters, setup.aligner
        self._start = setup.initial or prior(setup.model, setup.parameters)
        self._on_look = setup.on_evidence
        self._worker = AtOnce() if setup.worker is None else setup.worker
        self._is_asked = are_positions(setup.parameters)
        self._reckoning = DeadReckoning(setup.parameters.rotation_dvl_from_body, 1e-9 * setup.aligner.lag_ns)
        self._n_taken = 0
        self._first_ns: int | None = None
        self._next_ns = self._oriented_ns = 0
        self._coming: deque[tuple[int, Future[_Look]]] = deque()
        self._last_result = NO_LOOK
        self._n_updates = 0
        self._newest: tuple[int, DisplacementFit | None] = (0, None)  # number of legs, and their fit
        self._held_out: HeldOutLegs | None = None  # cached for the number of fixes
        self._is_settled = False
        self._remembered = [Remembered(LONG_AGO_NS, self._start, 0, 0.0)]

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
            self._solve_complete_legs(self._next_ns)
            passed_s = 1e-9 * (self._next_ns - self._first_ns)
            self._next_ns = self._first_ns + round(1e9 * math.ceil(passed_s * GROWTH))
        self._let_take_effect(self._oriented_ns)

    def _solve_complete_legs(self, at_ns: int) -> None:
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
        used = self.counts.used
        # no innovations are kept: the expected νᵀS⁻¹ν of two components, as in `counts`
        self._remembered.append(Remembered(from_ns, self.state(), used, 2.0 * used))

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> PastStates:
        """See `Estimator`."""
        return states_in_effect(self._remembered, stamps_ns)

    # ------------------------------------------------------------------ verification

    def _without_folds(self) -> HeldOutLegs:
        """Return all fixes with the errors estimated without each fold, computed once per number of fixes."""
        self.take_rows()
        legs = self._reckoning.legs()
        if self._held_out is None or len(self._held_out.legs.seconds) != len(legs.seconds):
            numbers = np.floor(legs.seconds / leg_length_s(legs)).astype(np.intp)
            states = []
            for fold in range(FOLDS):
                fit = solve(legs.part(np.flatnonzero(numbers % FOLDS != fold)), self._parameters, self._start)
                states.append(self._start if fit is None else fit.errors)
            self._held_out = HeldOutLegs(legs, numbers, states)
        return self._held_out

    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """Return the held-out error of mean velocities over legs of positions; None without a fit."""
        fit = self._fit()
        if fit is None:
            return None
        return held_out(self._without_folds(), fit, self._parameters)

    def navigation(self) -> Navigation | None:
        """Return the drift of dead reckoning by positions; None without a fit."""
        fit = self._fit()
        if fit is None or self._first_ns is None:
            return None
        return navigated(self._without_folds(), fit, self._parameters, self._first_ns)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """See `Estimator`."""
        terms = self._model.error_terms_from_state
        return [[Terms(terms @ state.x, np.zeros(3), 0.0)] * n_days for state in self._without_folds().states]


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


def navigated(held: HeldOutLegs, fit: DisplacementFit, parameters: Parameters, first_ns: int) -> Navigation | None:
    """Return the track at all fixes without outliers; None with hardly any motion.

    first_ns: stamp of the legs' time 0. Lever arm, delay and heading deviation are from all data in both tracks, so
    they differ by mounting and scale only.
    """
    legs, used = held.legs, np.flatnonzero(fit.used)
    if len(used) < 2:
        return None
    seconds = legs.seconds[used]
    in_stretch = np.diff(legs.stretch[used]) == 0

    def steps(values: Array) -> Array:
        """Return the horizontal change (K, 2) of values (N, 3) since the fix before; zero between stretches."""
        return np.concatenate([np.zeros((1, 2)), np.diff(values[used, :2], axis=0) * in_stretch[:, None]])

    moved = steps(np.einsum("nabc,bc->na", legs.way, parameters.rotation_dvl_from_body.T))
    distance = np.cumsum(np.linalg.norm(moved, axis=1))
    if distance[-1] < SHORTEST_M:
        return None
    before = steps(_position_errors(legs, fit, np.zeros(N_ERRORS), parameters))
    after = np.zeros((len(used), 2))
    for fold, state in enumerate(held.states):
        in_fold = held.folds[used] == fold
        after[in_fold] = steps(_position_errors(legs, fit, state.x, parameters))[in_fold]
    error_before, error_after = np.cumsum(before, axis=0), np.cumsum(after, axis=0)
    residual = _position_errors(legs, fit, fit.errors.x, parameters)[used, :2]
    reference = np.cumsum(steps(legs.position), axis=0)
    ends = ends_of_stretches(distance)
    stretch_m = float(distance[-1] if len(ends) == 2 else distance[ends[1]] - distance[ends[0]])
    shown = np.round(np.linspace(0, len(used) - 1, min(MAP_POINTS, len(used)))).astype(np.intp)
    return Navigation(
        distance_m=float(distance[-1]), stretch_m=stretch_m,
        seconds=float(np.append(0.0, np.where(in_stretch, np.diff(seconds), 0.0)).sum()),
        stretches=len(ends) - 1, before=drift_over(error_before, distance, ends),
        after=drift_over(error_after, distance, ends),
        noise_per_km=1000.0 * float(np.sqrt(2.0 * np.var(residual, axis=0).sum())) / stretch_m, on_a_map=True,
        stamps_ns=first_ns + np.round(seconds[shown] * 1e9).astype(np.int64), distances=distance[shown],
        reference=reference[shown], track_before=(reference - error_before)[shown],
        track_after=(reference - error_after)[shown],
        error_before=_velocities(error_before, seconds, legs.rotation[used])[shown],
        error_after=_velocities(error_after, seconds, legs.rotation[used])[shown],
    )  # fmt: skip


def _position_errors(legs: Legs, fit: DisplacementFit, errors: Array, parameters: Parameters) -> Array:
    """Return fixes minus corrected dead reckoning (N, 3) m, constant per stretch included.

    errors: (4,) misalignment and scale; all other corrections are from the fit.
    """
    theta = np.concatenate([errors, fit.state.x[N_ERRORS:]])
    linear = linear_about(legs, theta, parameters)
    return linear.y - linear.columns @ theta


def _velocities(track_error: Array, seconds: Array, rotation_enu_from_body: Array) -> Array:
    """Return mean velocity errors (N, 3) m/s, body axes, over `LEG_S` before each fix, from track errors (N, 2) m."""
    since = np.searchsorted(seconds, seconds - LEG_S)
    passed = np.maximum(seconds - seconds[since], 1.0)[:, None]
    enu = np.concatenate([(track_error - track_error[since]) / passed, np.zeros((len(seconds), 1))], axis=1)
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


class _LegEnds(NamedTuple):
    """Indices of the fixes at the beginning and at the end of a held-out leg."""

    first: Index
    last: Index


def held_out(held: HeldOutLegs, fit: DisplacementFit, parameters: Parameters) -> HeldOutError | None:
    """Return the error of mean velocities over held-out legs, m/s, each by the errors fitted without its fold.

    The predicted error holds the residual of the fit of all data, and the estimate's covariance. Lever arm, delay and
    heading are from all data: only mounting and scale are tested.
    """
    legs, ends = held.legs, _ends(held, fit)
    if not len(ends):
        return None
    fold_of_leg = held.folds[[end.first[0] for end in ends]]
    of_all = _velocity_errors(legs, ends, fit, fit.errors.x, parameters)
    before = _velocity_errors(legs, ends, fit, np.zeros(N_ERRORS), parameters)
    sums = np.zeros(5)
    for fold, state in enumerate(held.states):
        in_fold = fold_of_leg == fold
        if not in_fold.any():
            continue
        fold_ends = [end for end, is_in_fold in zip(ends, in_fold, strict=True) if is_in_fold]
        after = _velocity_errors(legs, ends, fit, state.x, parameters)[in_fold]
        jacobian = _jacobian(legs, fold_ends, fit, state.x, parameters)
        calibration = float(np.einsum("nij,jk,nik->", jacobian, state.p, jacobian))
        noise = float((of_all[in_fold] ** 2).sum())
        sums += [float((before[in_fold] ** 2).sum()), float((after**2).sum()), noise + calibration, calibration, 0.0]
    return held_out_from_sums(len(ends), sums)


def _ends(held: HeldOutLegs, fit: DisplacementFit) -> list[_LegEnds]:
    """Return the fixes at both ends of each held-out leg, in one stretch and without outliers."""
    legs = held.legs
    length_s = leg_length_s(legs)
    used = np.flatnonzero(fit.used)
    leg_of_fix = np.stack([legs.stretch[used], held.numbers[used]])
    ends = []
    for fixes in np.split(used, np.flatnonzero((np.diff(leg_of_fix, axis=1) != 0).any(axis=0)) + 1):
        seconds = legs.seconds[fixes]
        if len(fixes) < 2 or seconds[-1] - seconds[0] < 0.5 * length_s:
            continue
        reach_s = END_SHARE * (seconds[-1] - seconds[0])
        ends.append(_LegEnds(fixes[seconds <= seconds[0] + reach_s], fixes[seconds >= seconds[-1] - reach_s]))
    return ends


def _rates(values: Array, legs: Legs, ends: Sequence[_LegEnds]) -> Array:
    """Return the change per second (L, ...) of values (N, ...) of fixes, from start to end of each leg."""
    rates = []
    for first, last in ends:
        seconds = legs.seconds[last].mean() - legs.seconds[first].mean()
        rates.append((values[last].mean(axis=0) - values[first].mean(axis=0)) / seconds)
    return np.array(rates)


def _velocity_errors(
    legs: Legs, ends: Sequence[_LegEnds], fit: DisplacementFit, errors: Array, parameters: Parameters
) -> Array:
    """Return the error (L, 2) m/s of each leg's mean velocity, east and north. errors: see `_position_errors`."""
    return _rates(_position_errors(legs, fit, errors, parameters)[:, :2], legs, ends)


def _jacobian(
    legs: Legs, ends: Sequence[_LegEnds], fit: DisplacementFit, errors: Array, parameters: Parameters
) -> Array:
    """Return the derivative (L, 2, 4) of leg velocities by the errors, about errors (4,)."""
    theta = np.concatenate([errors, fit.state.x[N_ERRORS:]])
    return _rates(linear_about(legs, theta, parameters).columns[:, :2, :N_ERRORS], legs, ends)
