"""`full` beside the other models: fed from the aligner, in blocks of time that stamps decide.

A delay of 3 s needs what comes 3 s later, so its samples are used when the others' have long been. What
the aligner holds of a block is copied as soon as all that may belong to it has come or is overdue, and solved: at once,
or by a worker while the node goes on receiving. Either way the outcome takes effect when the stamps have gone on by
SOLVED_WITHIN_NS, so that a live run and a replay of its recording agree whatever the machine was doing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar

import numpy as np

from ...verdict.reasons import Reason, finding
from ..assessment.model_selection import Evidence
from ..filters.cross_validation import FOLDS, HeldOutError, Moments
from ..filters.filter_bank import ModelCounts
from ..filters.filter_setup import prior
from ..filters.state_history import Counts, Numbers, StateTrace
from ..models.own import BIAS, DELAY, LEVER_ARM, N_STATE, PHI, REFERENCE_ERROR
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, SampleUse, Stamps
from ..numerics.tables import RowTable
from ..registration.registration import Registration
from ..results.bias_covariance import BiasCovariance
from ..results.results import Day
from ..results.thinned_recording import NO_TERMS, Terms, ThinnedBlock, ThinnedRecording
from ..streams.interpolation import LONGEST_DELAY_S
from ..streams.stream_order import LONG_AGO_NS, LONGEST_NS
from .block_preprocessing import MARGIN_NS, Block, DvlSamples, ImuSamples, ReferenceSamples
from .block_solver import BlockSolver, Outcome
from .estimator import AtOnce, Estimator, EstimatorSetup, Rest, Solved
from .full_forward_model import deviation_of

BLOCK_NS = 10_000_000_000
# How fast the DVL is shows after so long; room for so many times as many of its samples is taken then.
RATE_FROM_NS, ROOM = 3_000_000_000, 1.1
LONGEST_DELAY_NS = round(LONGEST_DELAY_S * 1e9)
# From a block's last data until its outcome takes effect, in stamps. A worker needs a hundredth of it; the stamps of a
# recording that is played fast come sooner, and then the node waits for the worker.
SOLVED_WITHIN_NS = 1_000_000_000
# A DVL that is late by more may find no reference at the stamps as they are, s.
PAIRED_WITHIN_S = 0.3
# A state is shown by the data once these have halved its prior σ.
SHOWN_SHARE = 0.5
# The lever arm is said to look like an angle when that makes so many times the rest of the angle's variance.
ARM_SHARE = 30.0
# What the reference's clock leaves open, in the order of `Registration.left_open`.
_OPEN: Index = np.r_[PHI, LEVER_ARM, DELAY]


class _PendingDvl(RowTable):
    """Usable DVL samples that blocks to come need."""

    IS_REUSED = True  # blocks have copies
    LAYOUT: ClassVar = {
        "stamps_ns": (np.int64, ()),
        "velocity": (np.float64, (3,)),
        "covariance": (np.float64, (3, 3)),
    }
    stamps_ns: Stamps
    velocity: Array
    covariance: Array


class FullEstimator(Estimator):
    """Feeds a `BlockSolver` from an aligner; tells the aligner which past of its tracks is still wanted."""

    def __init__(self, given: EstimatorSetup) -> None:
        """Start from the prior of the states."""
        model, parameters, aligner = given.model, given.parameters, given.aligner
        self._parameters = parameters
        self._aligner = aligner
        self._on_block = given.on_evidence
        self._unknown = prior(model, parameters)
        self._prior = given.initial or self._unknown
        self._solver = BlockSolver(
            parameters, self._prior, self._unknown, given.verified, live=given.worker is not None,
            registration=given.registration,
        )  # fmt: skip
        self._worker = AtOnce() if given.worker is None else given.worker
        # until a block is complete: what it needs of the others, later than it can still come, and judged by the IMU
        self._wait_ns = MARGIN_NS + aligner.lag_ns + round(parameters.imu_timeout * 1e9)
        self._dvl = _PendingDvl()
        self._has_room = False
        self._n_taken = 0  # rows of the aligner that have been looked at
        self._block_ns: int | None = None  # start of the next block
        self._day_starts_ns: list[int] = []  # of the blocks that days after the first began with
        self._last_told = self._solver.outcome()
        self._n_told = 0
        self._together = given.together
        self._gathered: list[Block] = []
        # by the stamp from which on they are told: those that are being solved, and the number of each among them
        self._coming: deque[tuple[int, Solved[list[Outcome]], int]] = deque()
        self._gathered_ns: list[int] = []  # the same of those that are not
        self._is_telling = self._is_settled = False
        self._recording: tuple[ThinnedBlock, ThinnedRecording] | None = None  # asked for by each model's verification
        self._suggested: tuple[Outcome, Reason | None] | None = None
        self._remembered: list[tuple[int, GaussianState, int, float]] = []
        for track in (aligner.reference, aligner.imu):
            track.needed_from[self] = LONG_AGO_NS  # until the first block is known

    # ------------------------------------------------------------------ what is known

    @property
    def _told(self) -> Outcome:
        """The newest outcome whose time has come."""
        self.settle()
        return self._last_told

    @property
    def n_taken(self) -> int:
        """Number of the first row of the aligner that it has not copied yet."""
        return self._n_taken

    @property
    def told_until_ns(self) -> int | None:
        """Stamp of the first DVL sample that may go by a block that has been gathered only; None for none."""
        return self._gathered_ns[0] if self._gathered_ns else None

    def settle(self) -> None:
        """Have blocks solved that are gathered, and let those take effect whose time has come."""
        if self._gathered and not self._is_telling:
            self._solve_gathered()
            self._let_take_effect(self._aligner.reached_ns)

    @property
    def counts(self) -> ModelCounts:
        """Samples used, spikes and those far from all others, and their mean squared misfit."""
        return self._told.counts

    @property
    def claims(self) -> bool:
        """Whether there are any data."""
        return bool(self._told.days)

    @property
    def heading_deviation(self) -> GaussianState | None:
        """As `Estimator`."""
        return deviation_of(self.state()) if self.claims else None

    def state(self) -> GaussianState:
        """The state by the blocks so far."""
        days = self._told.days
        return days[-1] if days else self._prior

    def of_recording(self) -> GaussianState:
        """As `state`: σ holds all that is known of noise, and what the reference's clock leaves open."""
        x, p = self.state()
        return GaussianState(x, p + self.left_open)

    @property
    def left_open(self) -> Array:
        """As `Estimator`: attitudes of another time look like an arm at one speed, and like a yaw in a steady turn."""
        found: Array = np.zeros((N_STATE, N_STATE))
        if not self.claims:
            return found
        registration = self._solver.registration() if self._is_settled else self._told.looked.registration
        if registration is not None:
            own = np.eye(len(_OPEN))
            own[:3, :3] = -self._parameters.rotation_dvl_from_body  # a turn is a misalignment the other way round
            if any(self._parameters.lever_arm):
                own[3:] = 0.0
            found[np.ix_(_OPEN, _OPEN)] = own @ registration.left_open @ own.T
        return 0.5 * (found + found.T)

    @property
    def of_bias(self) -> BiasCovariance:
        """As `Estimator`."""
        p = self.state().p
        values, vectors = np.linalg.eigh(p[BIAS, BIAS])
        root = np.sqrt(np.maximum(values, 1e-300))
        columns = np.where(values > 0.0, p[:, BIAS] @ vectors / root, 0.0)
        return BiasCovariance((1.0 - 1e-6) * columns)  # what is left of a bias itself is positive, rounding aside

    @property
    def suggestion(self) -> Reason | None:
        """What configuration the data fit, where the one given is grossly wrong."""
        newest = self._newest()
        if self._suggested is None or self._suggested[0] is not newest:  # asked for more often than there is a block
            self._suggested = newest, self._solver.suggestion()
        return self._suggested[1]

    @property
    def registration(self) -> Registration | None:
        """How the instruments stand, by their data alone; None where these do not show it."""
        self._newest()
        return self._solver.registration()

    @property
    def is_level(self) -> bool:
        """As `Estimator`."""
        return self._idle_solver().is_level

    @property
    def is_horizontal(self) -> bool:
        """As `Estimator`."""
        return self._idle_solver().is_horizontal

    def rest(self, *, fresh: bool) -> Rest | None:
        """As `Estimator`."""
        return self._idle_solver().rest() if fresh else self._told.looked.rest

    @property
    def registration_so_far(self) -> Registration | None:
        """The same, as it was seen a little ago, which stamps decide."""
        return self._told.looked.registration

    @property
    def suggestion_so_far(self) -> Reason | None:
        """The same, as of the newest block that has taken effect: messages do not wait for one that is being solved."""
        return self._told.suggestion

    @property
    def n_told(self) -> int:
        """As `Estimator`: blocks."""
        return self._n_told

    @property
    def evidence(self) -> Evidence:
        """As `Estimator`."""
        return Evidence(pairs_elsewhere=self.claims and abs(float(self.state().x[DELAY])) > PAIRED_WITHIN_S)

    @property
    def doubt(self) -> Reason | None:
        """How much of an angle is the lever arm's; None if the motion tells them apart.

        On a circle at one speed a DVL that sits elsewhere looks like a turned one, and σ of a model that takes the
        lever arm as known is worth nothing.
        """
        p = self.state().p
        turns = np.linalg.solve(p[LEVER_ARM, LEVER_ARM], p[LEVER_ARM, PHI])  # (lever arm, misalignment)
        by_arm = (p[PHI, LEVER_ARM] * turns.T).sum(axis=1)
        rest = np.maximum(np.diag(p)[PHI] - by_arm, 1e-12)
        if not self.claims or (by_arm / rest).max() < ARM_SHARE:
            return None
        index = int(np.argmax(by_arm / rest))
        degrees = abs(0.1 * math.degrees(np.abs(turns[:, index]).max()))
        return finding("ARM_LOOKS_LIKE_ANGLE", metres=0.1, degrees=degrees, angle=("roll", "pitch", "yaw")[index])

    def remember(self, from_ns: int) -> None:
        """Keep the state as of now, for `states_at`."""
        used, _, mean_nis, _, _ = self._told.counts
        self._remembered.append((from_ns, self.state(), used, used * mean_nis if used else 0.0))

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> tuple[GaussianState, Counts, Array]:
        """As `Estimator`."""
        rows = [(LONG_AGO_NS, self._prior, 0, 0.0), *self._remembered]
        at = np.searchsorted([row[0] for row in rows], stamps_ns, side="right") - 1
        told = [rows[index] for index in at.tolist()]
        states = GaussianState(np.array([row[1].x for row in told]), np.array([row[1].p for row in told]))
        return states, np.array([row[2] for row in told]), np.array([row[3] for row in told])

    @contextmanager
    def settled(self) -> Iterator[None]:
        """All blocks that are complete have taken effect, in here: for a result, which no later sample decides on."""
        told = self._told
        self._last_told, self._is_settled = self._newest(), True
        try:
            yield
        finally:
            self._last_told, self._is_settled = told, False

    def _newest(self) -> Outcome:
        """The outcome of the last block that is complete; nothing is being solved then."""
        self._solve_gathered()
        if not self._coming:
            return self._last_told
        _, solved, number = self._coming[-1]
        return solved.result()[number]

    # ------------------------------------------------------------------ blocks

    def advance(self) -> None:
        """Copy the blocks that are complete, and let those take effect whose time has come."""
        aligner = self._aligner
        if self._block_ns is None:
            if aligner.first_ns is None:
                return
            self._block_ns = self._solver.epoch_ns = aligner.first_ns // BLOCK_NS * BLOCK_NS
            self._tell_needed()
        self._let_take_effect(aligner.reached_ns)
        last_ns = aligner.reached_ns - self._wait_ns - BLOCK_NS
        if self._block_ns > last_ns:
            return
        self.take_rows()
        while self._block_ns <= last_ns:
            self._submit(self._block_ns)
            self._let_take_effect(aligner.reached_ns)
            self._block_ns = self._next_block(self._block_ns, last_ns)
        self._tell_needed()
        self._dvl.forget_before(
            self._dvl.begin
            + int(np.searchsorted(self._dvl.stamps_ns[self._dvl.begin : self._dvl.size], self._block_ns - MARGIN_NS))
        )

    def finish(self) -> None:
        """No samples come any more: all blocks that are complete take effect."""
        self.settle()
        while self._coming:
            self._let_take_effect(self._coming[-1][0])

    def _submit(self, block_ns: int) -> None:
        """Have a block solved, by itself or with some more."""
        block = self._copied(block_ns)
        from_ns = block.end_ns + self._wait_ns + SOLVED_WITHIN_NS
        if self._together == 1:  # live, where other threads may look at what is known meanwhile
            self._solve([block], [from_ns])
            return
        self._gathered.append(block)
        self._gathered_ns.append(from_ns)
        if len(self._gathered) >= self._together:
            self._solve_gathered()

    def _solve_gathered(self) -> None:
        if self._gathered:
            blocks, told_ns = self._gathered, self._gathered_ns
            self._gathered, self._gathered_ns = [], []
            self._solve(blocks, told_ns)

    def _solve(self, blocks: list[Block], told_ns: list[int]) -> None:
        """Have blocks solved. told_ns: stamps from which on each is told."""
        solver = self._solver
        solved = self._worker.submit(lambda: solver.solve(blocks))
        self._coming.extend((from_ns, solved, number) for number, from_ns in enumerate(told_ns))

    def _let_take_effect(self, reached_ns: int) -> None:
        if not self._coming or self._coming[0][0] > reached_ns:
            return
        self._is_telling = True
        try:
            while self._coming and self._coming[0][0] <= reached_ns:
                from_ns, solved, number = self._coming.popleft()
                self._last_told = solved.result()[number]
                self._n_told += 1
                if self._last_told.has_rows:
                    self._on_block(from_ns)
        finally:
            self._is_telling = False

    def _copied(self, block_ns: int) -> Block:
        dvl, reference, imu = self._dvl, self._aligner.reference, self._aligner.imu
        end_ns = block_ns + BLOCK_NS
        from_ns, to_ns = block_ns - MARGIN_NS, end_ns + MARGIN_NS
        rows = dvl.between(dvl.stamps_ns, from_ns, to_ns)
        at, turned = reference.in_time(from_ns, to_ns), imu.in_time(from_ns, to_ns)
        return Block(
            block_ns,
            end_ns,
            self._new_days(block_ns),
            self._dvl_is_silent(end_ns),
            DvlSamples(dvl.stamps_ns[rows].copy(), dvl.velocity[rows].copy(), dvl.covariance[rows].copy()),
            ReferenceSamples(
                reference.stamps_ns[at], reference.values[at], reference.frames[at], reference.unmeasured[at]
            ),
            ImuSamples(imu.stamps_ns[turned], imu.values[turned]),
        )

    def _new_days(self, block_ns: int) -> int:
        """How many days start with the block: it may have references of their first DVL sample, however late."""
        before, starts_ns = len(self._day_starts_ns), self._aligner.day_starts_ns
        while len(self._day_starts_ns) < len(starts_ns):
            if starts_ns[len(self._day_starts_ns)] - LONGEST_DELAY_NS >= block_ns + BLOCK_NS:
                break
            self._day_starts_ns.append(block_ns)
        return len(self._day_starts_ns) - before

    def _next_block(self, block_ns: int, last_ns: int) -> int:
        """The next block that has a reference; else the first one that is not complete."""
        track = self._aligner.reference
        stamps_ns = track.stamps_ns[track.begin : track.size]
        at = int(np.searchsorted(stamps_ns, block_ns + BLOCK_NS))
        incomplete_ns = last_ns // BLOCK_NS * BLOCK_NS + BLOCK_NS
        if at == len(stamps_ns):
            return incomplete_ns
        return min(int(stamps_ns[at]) // BLOCK_NS * BLOCK_NS, incomplete_ns)

    def _tell_needed(self) -> None:
        assert self._block_ns is not None
        for track in (self._aligner.reference, self._aligner.imu):
            track.needed_from[self] = self._block_ns - MARGIN_NS

    def take_rows(self) -> None:
        """Copy the DVL samples that are judged, before the aligner forgets them."""
        aligner, rows = self._aligner, self._aligner.rows
        first, end = self._n_taken - rows.base, aligner.partners.n_judged - rows.base
        if end <= first:
            return
        at = np.flatnonzero((rows.verdict[first:end] != SampleUse.FROZEN) & ~rows.late[first:end]) + first
        slots = self._dvl.extend(len(at))
        self._dvl.stamps_ns[slots] = rows.stamps_ns[at]
        self._dvl.velocity[slots] = rows.velocity_dvl[at]
        self._dvl.covariance[slots] = rows.covariance[at]
        self._n_taken = aligner.partners.n_judged
        if not self._has_room:
            self._take_room()

    def _take_room(self) -> None:
        """Take all room that the DVL's samples will need at once, as soon as it is known how fast they come."""
        stamps_ns = self._dvl.stamps_ns[self._dvl.begin : self._dvl.size]
        span_ns = int(stamps_ns[-1] - stamps_ns[0]) if len(stamps_ns) else 0
        if span_ns >= RATE_FROM_NS:
            self._has_room = True
            longest_ns = BLOCK_NS + MARGIN_NS + self._wait_ns
            self._dvl.reserve(round(ROOM * len(stamps_ns) * longest_ns / span_ns))

    def _dvl_is_silent(self, stamp_ns: int) -> bool:
        """Whether the DVL stops here for so long that tracks forget what was before."""
        stamps_ns = self._dvl.stamps_ns[self._dvl.begin : self._dvl.size]
        at = int(np.searchsorted(stamps_ns, stamp_ns))
        return at == len(stamps_ns) or int(stamps_ns[at]) - stamp_ns > LONGEST_NS // 2

    # ------------------------------------------------------------------ verification

    @property
    def reference_claims(self) -> bool:
        """Whether it is the reference's messages that say how noisy it is, and no parameter."""
        return self._told.claims > 0

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """All that was kept for verification, and the stamp (ns) of its time 0; None for nothing."""
        solver = self._idle_solver()
        if not solver.kept:
            return None
        newest = solver.kept[-1]  # another one once anything is kept or left out
        if self._recording is None or self._recording[0] is not newest:
            self._recording = newest, ThinnedRecording.of(solver.kept)
        return self._recording[1], solver.epoch_ns

    @property
    def n_days(self) -> int:
        """Number of days so far."""
        return 1 + len(self._day_starts_ns)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Which day (N,) stamps are of, from 0."""
        return np.searchsorted(np.array(self._day_starts_ns, dtype=np.int64), stamps_ns, side="right")

    def days_from(self, first_ns: Sequence[int]) -> tuple[Day, ...]:
        """As `Estimator`."""
        nominal, days = self._parameters.dvl_time_offset, []
        known, offset = self._unknown.p[DELAY, DELAY], np.arange(N_STATE)[REFERENCE_ERROR][:2]
        states = self._told.days if self._day_starts_ns else ()
        for begins_ns, (x, p) in zip(first_ns, states, strict=False):
            std = np.sqrt(np.diag(p))
            (east, north), (east_std, north_std) = x[offset].tolist(), std[offset].tolist()
            shown = bool(p[DELAY, DELAY] <= SHOWN_SHARE**2 * known)
            late = nominal + float(x[DELAY])
            days.append(Day(begins_ns, late, float(std[DELAY]), shown, (east, north), (east_std, north_std)))
        return tuple(days)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """For every fold what it corrects on every day, had it not seen that fold."""
        if not self.claims:
            return [[NO_TERMS] * n_days] * FOLDS
        return [[Terms.of_state(state.x) for state in states] for states in self._idle_solver().fit.without_folds()]

    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """Velocity error on every fold by the state that has not seen it; None if there is too little to judge by."""
        try:
            return self._idle_solver().fit.held_out_error()
        except np.linalg.LinAlgError:
            return None

    def _idle_solver(self) -> BlockSolver:
        self._newest()
        return self._solver
