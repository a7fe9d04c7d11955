"""D1 beside the other models: fed with aligned rows and with positions, solved when stamps have gone on by a fifth.

All legs so far are solved at once. What is known at a stamp goes by rows and fixes before it alone, less by what a fix
may be late, so a live run and a replay of its recording agree; the outcome takes effect a second later, in stamps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from ..delay.workers import AtOnce, Solved
from ..estimator import NEVER, Estimator, EstimatorSetup
from ..filters.cross_validation import FOLDS, HeldOutError, Moments
from ..filters.filter_bank import ModelCounts
from ..filters.filter_setup import prior
from ..filters.state_history import Counts, Numbers, StateTrace
from ..navigation import Navigation
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, SampleUse, Stamps
from ..results.thinned_recording import Terms
from ..selection import NO_EVIDENCE, Evidence
from ..streams.position_velocities import NOISY_MPS, are_positions
from .judge import held_out, leg_length_s
from .legs import DeadReckoning, Fixes, Legs
from .solve import N_ERRORS, DisplacementFit, solve, white_noise
from .track import navigated

# The first look, and then as often as the run has grown by a share; s.
FIRST_LOOK_S, GROWN = 60.0, 1.2
# From a look's stamp until its outcome takes effect, in stamps.
SOLVED_WITHIN_NS = 1_000_000_000
# Velocities made of positions are of no use beyond NOISY_MPS, and there are none of fixes further apart than so many
# windows (fixes.py).
LONGEST_WINDOWS = 3.0


class _Look(NamedTuple):
    """What a look at the legs so far found. fit: None where positions are good enough for velocities, or are too few.
    noise_mps: of velocities made of the positions; inf where there are none."""

    fit: DisplacementFit | None
    noise_mps: float


NO_LOOK = _Look(None, 0.0)


class Displacements(Estimator):
    """Keeps the way and the fixes, and has them solved."""

    def __init__(self, given: EstimatorSetup) -> None:
        """Start from the prior of D1's states."""
        self._model, self._parameters, self._aligner = given.model, given.parameters, given.aligner
        self._start = given.initial or prior(given.model, given.parameters)
        self._on_look = given.on_evidence
        self._worker = AtOnce() if given.worker is None else given.worker
        self._is_asked = are_positions(given.parameters)
        self._reckoning = DeadReckoning(given.parameters.rotation_dvl_from_body, 1e-9 * given.aligner.lag_ns)
        self._n_taken = 0
        self._first_ns: int | None = None
        self._next_ns = self._oriented_ns = 0
        self._coming: deque[tuple[int, Solved[_Look]]] = deque()
        self._told = NO_LOOK
        self._n_told = 0
        self._newest: tuple[int, DisplacementFit | None] = (0, None)  # of all legs, by their number
        self._folds: tuple[int, tuple[Legs, Index, list[GaussianState]]] | None = None  # by the number of fixes
        self._is_settled = False
        self._remembered: list[tuple[int, GaussianState, int]] = []

    # ------------------------------------------------------------------ input

    @property
    def n_taken(self) -> int:
        """As `Estimator`."""
        return self._n_taken if self._is_asked else NEVER

    def take_fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """As `Estimator`."""
        stamp_ns -= round(self._parameters.reference_time_offset * 1e9)
        self._reckoning.add_fixes(Fixes(np.array([stamp_ns]), position[None], variance[None]))

    def take_rows(self) -> None:
        """As `Estimator`."""
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
        """As `Estimator`."""
        self.take_rows()
        while self._first_ns is not None and self._next_ns <= self._oriented_ns:
            self._look(self._next_ns)
            passed_s = 1e-9 * (self._next_ns - self._first_ns)
            self._next_ns = self._first_ns + round(1e9 * math.ceil(passed_s * GROWN))
        self._let_take_effect(self._oriented_ns)

    def _look(self, at_ns: int) -> None:
        """Have the legs looked at that are known at a stamp, whatever else has come by now."""
        assert self._first_ns is not None
        legs = self._reckoning.legs()
        passed_s = 1e-9 * (at_ns - self._aligner.lag_ns - self._first_ns)  # later ones may still come
        known = legs.part(slice(int(np.searchsorted(legs.seconds, passed_s))))
        parameters, start = self._parameters, self._start

        def looked() -> _Look:
            noise_mps = _noise_of_velocities(known, parameters.position_window)
            return _Look(solve(known, parameters, start) if noise_mps > NOISY_MPS else None, noise_mps)

        self._coming.append((at_ns + SOLVED_WITHIN_NS, self._worker.submit(looked)))

    def _let_take_effect(self, reached_ns: int) -> None:
        while self._coming and self._coming[0][0] <= reached_ns:
            from_ns, solved = self._coming.popleft()
            self._told = solved.result()
            self._n_told += 1
            if self._told.fit is not None:
                self._on_look(from_ns)

    def finish(self) -> None:
        """As `Estimator`."""
        self.take_rows()
        if self._coming:
            self._let_take_effect(self._coming[-1][0])

    @contextmanager
    def settled(self) -> Iterator[None]:
        """As `Estimator`: by all legs, not those alone that were looked at."""
        self._is_settled = True
        try:
            yield
        finally:
            self._is_settled = False

    # ------------------------------------------------------------------ what is known

    def _fit(self) -> DisplacementFit | None:
        if not self._is_settled:
            return self._told.fit
        self.take_rows()
        legs = self._reckoning.legs()
        if self._newest[0] != len(legs.seconds):
            self._newest = len(legs.seconds), solve(legs, self._parameters, self._start)
        return self._newest[1]

    def state(self) -> GaussianState:
        """As `Estimator`."""
        fit = self._fit()
        return self._start if fit is None else fit.errors

    def of_recording(self) -> GaussianState:
        """As `Estimator`: σ is by noise that lasts already."""
        return self.state()

    @property
    def counts(self) -> ModelCounts:
        """Fixes used, and outliers; what they leave is what their noise is said to be."""
        fit = self._fit()
        used = 0 if fit is None else int(np.count_nonzero(fit.used))
        gated = 0 if fit is None else len(fit.used) - used
        return ModelCounts(used, gated, 2.0 if used else math.nan, 2.0, 0)

    @property
    def n_told(self) -> int:
        """As `Estimator`: looks."""
        return self._n_told

    @property
    def evidence(self) -> Evidence:
        """How noisy velocities made of the positions are, where that is why they are not used."""
        if self._told.fit is None:
            return NO_EVIDENCE
        noise = self._told.noise_mps
        return Evidence(noise, "POSITIONS_NOISY", {"noise": noise}) if noise < math.inf else Evidence(
            noise, "POSITIONS_SELDOM"
        )  # fmt: skip

    def remember(self, from_ns: int) -> None:
        """As `Estimator`."""
        self._remembered.append((from_ns, self.state(), self.counts.used))

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> tuple[GaussianState, Counts, Array]:
        """As `Estimator`."""
        at = np.searchsorted([row[0] for row in self._remembered], stamps_ns, side="right")
        known = [(self._start, 0), *((state, used) for _, state, used in self._remembered)]
        states, used = zip(*(known[place] for place in at.tolist()), strict=True)
        of_each: Counts = np.array(used, dtype=np.int64)
        return (
            GaussianState(np.array([each.x for each in states]), np.array([each.p for each in states])),
            of_each,
            2.0 * of_each,
        )

    # ------------------------------------------------------------------ verification

    def _without_folds(self) -> tuple[Legs, Index, list[GaussianState]]:
        """All fixes, the leg (N,) of each, and the errors had each fold not been seen, which is every fifth leg."""
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
        """As `Estimator`: of mean velocities over legs of a minute and more, by positions."""
        fit = self._fit()
        if fit is None:
            return None
        legs, numbers, states = self._without_folds()
        return held_out(legs, numbers, states, fit, self._parameters)

    def navigation(self) -> Navigation | None:
        """As `Estimator`: by positions."""
        fit = self._fit()
        if fit is None or self._first_ns is None:
            return None
        legs, numbers, states = self._without_folds()
        return navigated(legs, numbers, states, fit, self._parameters, self._first_ns)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """As `Estimator`."""
        terms = self._model.error_terms_from_state
        _, _, states = self._without_folds()
        return [[Terms(terms @ state.x, np.zeros(3), 0.0)] * n_days for state in states]


def _noise_of_velocities(legs: Legs, window_s: float) -> float:
    """Of velocities that are made of the positions, m/s; inf where these come too seldom, 0 of too few to tell."""
    if len(legs.seconds) < N_ERRORS:
        return 0.0
    interval = float(np.median(np.diff(legs.seconds)))
    if interval > LONGEST_WINDOWS * window_s:
        return math.inf
    return math.sqrt(2.0) * white_noise(legs) / max(window_s, interval)
