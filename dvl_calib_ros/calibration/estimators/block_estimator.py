"""Estimator of `full`: copies time blocks from the aligner, and has them solved.

A delay of up to 3 s needs later samples, so `full` uses samples later than the other models. A block is copied once all
its data have arrived or are overdue, and is solved immediately or by a worker. The result takes effect when stamps have
advanced by SOLVED_WITHIN_NS, so a live run and a replay agree at any machine speed.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager

import numpy as np

from ...verdict.reasons import Reason, finding
from ..assessment.dead_reckoning import SlowNoise
from ..assessment.model_selection import NO_EVIDENCE, Evidence
from ..checks.beam_faults import BeamFault
from ..filters.cross_validation import FOLDS, HeldOutError, Moments
from ..filters.filter_bank import ModelCounts
from ..filters.filter_setup import prior
from ..filters.observability import OBSERVED_SHARE, body_angle_std
from ..filters.state_history import Numbers, PastStates, StateTrace
from ..models.own import BIAS, DELAY, LEVER_ARM, N_STATE, PHI, REFERENCE_ERROR
from ..numerics.block_covariance import BLOCK_NS
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, SampleUse, Stamps
from ..numerics.tables import RowTable, column
from ..registration.registration import Registration
from ..results.results import BiasCovariance, Day
from ..results.thinned_recording import NO_TERMS, Terms, ThinnedBlock, ThinnedRecording
from ..streams.interpolation import LONGEST_DELAY_S
from ..streams.stream_order import LONG_AGO_NS, LONGEST_NS
from .block_preprocessing import MARGIN_NS, Block, DvlSamples, ImuSamples, ReferenceSamples
from .block_solver import BlockSolver, Outcome
from .estimator import SOLVED_WITHIN_NS, AtOnce, Estimator, EstimatorSetup, Remembered, Residuals, states_in_effect
from .full_forward_model import deviation_of
from .slow_errors import Priors

# Time after which the DVL's rate is known, ns; memory is then reserved for this multiple of its samples.
RATE_FROM_NS, ROOM = 3_000_000_000, 1.1
LONGEST_DELAY_NS = round(LONGEST_DELAY_S * 1e9)
# Delay of the DVL, s, beyond which pairing at the uncorrected stamps may find no reference.
PAIRED_WITHIN_S = 0.3
# The lever arm is reported to look like an angle if it causes this multiple of the angle's other variance.
ARM_SHARE = 30.0
# States that the reference's clock offset makes uncertain, in the order of `Registration.left_open`.
_OPEN: Index = np.r_[PHI, LEVER_ARM, DELAY]


class _PendingDvl(RowTable):
    """Usable DVL samples that later blocks need."""

    IS_REUSED = True  # blocks have copies
    stamps_ns: Stamps = column(np.int64)
    velocity: Array = column(np.float64, 3)
    covariance: Array = column(np.float64, 3, 3)


class FullEstimator(Estimator):
    """Estimator of `full`, which feeds a `BlockSolver` and tells the aligner which data it still needs."""

    def __init__(self, setup: EstimatorSetup) -> None:
        """Start from the prior of the states."""
        model, parameters, aligner = setup.model, setup.parameters, setup.aligner
        self._parameters = parameters
        self._aligner = aligner
        self._on_block = setup.on_evidence
        self._unknown = prior(model, parameters)
        self._prior = setup.initial or self._unknown
        is_live = setup.worker is not None
        self._solver = BlockSolver(parameters, self._prior, self._unknown, setup.verified, live=is_live)
        self._worker = AtOnce() if setup.worker is None else setup.worker
        # a block is complete after its margin, the longest lag of a stream, and the IMU's timeout
        self._wait_ns = MARGIN_NS + aligner.lag_ns + round(parameters.imu_timeout * 1e9)
        self._dvl = _PendingDvl()
        self._has_room = False
        self._n_taken = 0  # aligned rows copied so far
        self._block_ns: int | None = None  # start of the next block
        self._day_starts_ns: list[int] = []  # start of the first block of each day after the first
        self._last_result = self._solver.outcome()
        self._n_updates = 0
        self._together = setup.together
        self._gathered: list[Block] = []
        # blocks being solved: stamp of effect, result, index in the result
        self._coming: deque[tuple[int, Future[list[Outcome]], int]] = deque()
        self._gathered_ns: list[int] = []  # stamps of effect of the gathered blocks
        self._is_updating = self._is_settled = False
        self._recording: tuple[ThinnedBlock, ThinnedRecording] | None = None  # cached for each model's verification
        self._suggested: tuple[Outcome, Reason | None] | None = None
        self._remembered = [Remembered(LONG_AGO_NS, self._prior, 0, 0.0)]
        for track in (aligner.reference, aligner.imu):
            track.needed_from[self] = LONG_AGO_NS  # until the first block is known

    # ------------------------------------------------------------------ what is known

    @property
    def _result_in_effect(self) -> Outcome:
        """Newest result in effect."""
        self.settle()
        return self._last_result

    @property
    def n_taken(self) -> int:
        """Number of the first aligned row that it has not copied."""
        return self._n_taken

    @property
    def affected_from_ns(self) -> int | None:
        """Stamp of the first DVL sample that a gathered block may still affect; None without any."""
        return self._gathered_ns[0] if self._gathered_ns else None

    def settle(self) -> None:
        """Solve the gathered blocks and put due results into effect; do nothing if called by that."""
        if self._gathered and not self._is_updating:
            self._solve_gathered()
            self._let_take_effect(self._aligner.reached_ns)

    @property
    def counts(self) -> ModelCounts:
        """Samples used, outliers (spikes and rejected residuals), and mean squared residual."""
        return self._result_in_effect.counts

    @property
    def claims(self) -> bool:
        """Return whether it has used any data."""
        return bool(self._result_in_effect.days)

    @property
    def heading_deviation(self) -> GaussianState | None:
        """See `Estimator`."""
        return deviation_of(self.state()) if self.claims else None

    def state(self) -> GaussianState:
        """Return the state of the newest day."""
        days = self._result_in_effect.days
        return days[-1] if days else self._prior

    def of_recording(self) -> GaussianState:
        """Return `state` with the covariance of the reference's clock offset added."""
        x, p = self.state()
        return GaussianState(x, p + self.left_open)

    @property
    def left_open(self) -> Array:
        """Covariance (n, n) due to the reference's clock offset, which looks like a lever arm, or like yaw in turns."""
        covariance: Array = np.zeros((N_STATE, N_STATE))
        if not self.claims:
            return covariance
        registration = self._solver.registration() if self._is_settled else self._result_in_effect.clocks.registration
        if registration is not None:
            states_from_open = np.eye(len(_OPEN))
            # rotation and misalignment have opposite signs
            states_from_open[:3, :3] = -self._parameters.rotation_dvl_from_body
            if any(self._parameters.lever_arm):  # only the angles remain open
                states_from_open[3:] = 0.0
            covariance[np.ix_(_OPEN, _OPEN)] = states_from_open @ registration.left_open @ states_from_open.T
        return 0.5 * (covariance + covariance.T)

    @property
    def of_bias(self) -> BiasCovariance:
        """See `Estimator`."""
        p = self.state().p
        values, vectors = np.linalg.eigh(p[BIAS, BIAS])
        root = np.sqrt(np.maximum(values, 1e-300))
        columns = np.where(values > 0.0, p[:, BIAS] @ vectors / root, 0.0)
        return BiasCovariance((1.0 - 1e-6) * columns)  # keeps the remaining variance positive despite rounding

    @property
    def suggestion(self) -> Reason | None:
        """Configuration that fits the data, if the given one is grossly wrong."""
        newest = self._newest()
        if self._suggested is None or self._suggested[0] is not newest:  # requested more often than once per block
            self._suggested = newest, self._solver.suggestion()
        return self._suggested[1]

    @property
    def registration(self) -> Registration | None:
        """Registration of clocks and frames from the data alone; None if they do not determine it."""
        self._newest()
        return self._solver.registration()

    @property
    def is_level(self) -> bool:
        """See `Estimator`."""
        return self._idle_solver().is_level

    @property
    def arm_effect(self) -> float | None:
        """See `Estimator`. Without turn rates the lever arm's velocity appears as slow noise.

        Its mean over a recording is taken to be as large as the slow variance beyond the prior.
        """
        slow = None if self._idle_solver().has_imu else self.slow_noise
        if slow is None:
            return None
        count, squares = self._idle_solver().speeds
        return math.sqrt(max(slow.velocity**2 - Priors().horizontal.mean_square, 0.0) * count / max(squares, 1e-12))

    @property
    def is_horizontal(self) -> bool:
        """See `Estimator`."""
        return self._idle_solver().is_horizontal

    def residuals(self, *, fresh: bool) -> Residuals | None:
        """See `Estimator`."""
        return self._idle_solver().residuals() if fresh else self._result_in_effect.clocks.residuals

    @property
    def registration_so_far(self) -> Registration | None:
        """Registration by the newest result in effect."""
        return self._result_in_effect.clocks.registration

    @property
    def suggestion_so_far(self) -> Reason | None:
        """Suggestion by the newest result in effect, so that messages do not wait for a block being solved."""
        return self._result_in_effect.suggestion

    @property
    def n_results(self) -> int:
        """Number of blocks in effect."""
        return self._n_updates

    @property
    def evidence(self) -> Evidence:
        """See `Estimator`. The calibration is known once the data have halved the prior σ of yaw."""
        if not self.claims:
            return NO_EVIDENCE
        x, p = self.state()
        yaw_std, prior_std = body_angle_std(p, self._parameters)[2], self._parameters.initial_std_misalignment
        return Evidence(
            pairs_elsewhere=abs(float(x[DELAY])) > PAIRED_WITHIN_S, is_known=bool(yaw_std <= OBSERVED_SHARE * prior_std)
        )

    @property
    def doubt(self) -> Reason | None:
        """Reason that the lever arm cannot be separated from an angle; None if the motion separates them.

        On a circle at constant speed a displaced DVL looks like a rotated one. A model that assumes the lever arm then
        claims a σ that is too small.
        """
        p = self.state().p
        angle_per_metre = np.linalg.solve(p[LEVER_ARM, LEVER_ARM], p[LEVER_ARM, PHI])  # (lever arm, misalignment)
        variance_by_arm = (p[PHI, LEVER_ARM] * angle_per_metre.T).sum(axis=1)
        arm_share = variance_by_arm / np.maximum(np.diag(p)[PHI] - variance_by_arm, 1e-12)
        if not self.claims or arm_share.max() < ARM_SHARE:
            return None
        index = int(np.argmax(arm_share))
        degrees = abs(0.1 * math.degrees(np.abs(angle_per_metre[:, index]).max()))
        return finding("ARM_LOOKS_LIKE_ANGLE", metres=0.1, degrees=degrees, angle=("roll", "pitch", "yaw")[index])

    def remember(self, from_ns: int) -> None:
        """Keep the current state for `states_at`."""
        counts = self._result_in_effect.counts
        nis_sum = counts.used * counts.mean_nis if counts.used else 0.0
        self._remembered.append(Remembered(from_ns, self.state(), counts.used, nis_sum))

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> PastStates:
        """See `Estimator`."""
        return states_in_effect(self._remembered, stamps_ns)

    @contextmanager
    def settled(self) -> Iterator[None]:
        """Let all samples so far take effect inside this context, as if the run ended here.

        Blocks that are not complete yet are solved in a copy, because later samples belong to them.
        """
        if self._is_settled:
            yield
            return
        before, solver, starts_ns = self._result_in_effect, self._solver, [*self._day_starts_ns]
        self._last_result, self._is_settled = self._newest(), True
        try:
            if incomplete := [self._copied(block_ns, is_last=True) for block_ns in self._incomplete()]:
                self._solver = copy.deepcopy(solver)
                self._last_result = self._solver.solve(incomplete)[-1]
            yield
        finally:
            self._last_result, self._is_settled = before, False
            self._solver, self._day_starts_ns = solver, starts_ns

    def _newest(self) -> Outcome:
        """Wait for the last complete block and return its result."""
        if self._is_settled:
            return self._last_result
        self._solve_gathered()
        if not self._coming:
            return self._last_result
        _, solved, number = self._coming[-1]
        return solved.result()[number]

    # ------------------------------------------------------------------ blocks

    def advance(self) -> None:
        """Copy the complete blocks, and let due results take effect."""
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
        """Let all blocks take effect after the last sample."""
        for block_ns in self._incomplete():
            self._submit(block_ns, is_last=True)
            self._block_ns = block_ns + BLOCK_NS
        self.settle()
        while self._coming:
            self._let_take_effect(self._coming[-1][0])

    def _incomplete(self) -> list[int]:
        """Return the starts of the blocks with a reference that wait for later samples."""
        track = self._aligner.reference
        if self._block_ns is None:
            return []
        self.take_rows()
        stamps_ns = track.stamps_ns[track.begin : track.size]
        starts_ns = stamps_ns[stamps_ns >= self._block_ns] // BLOCK_NS * BLOCK_NS
        return sorted(set(starts_ns.tolist()))

    def _submit(self, block_ns: int, *, is_last: bool = False) -> None:
        """Solve a block now, or gather it. is_last: whether the run has ended."""
        block = self._copied(block_ns, is_last=is_last)
        from_ns = block.end_ns + self._wait_ns + SOLVED_WITHIN_NS
        if self._together == 1:  # live, other threads may read the results meanwhile
            self._solve([block], [from_ns])
            return
        self._gathered.append(block)
        self._gathered_ns.append(from_ns)
        if len(self._gathered) >= self._together:
            self._solve_gathered()

    def _solve_gathered(self) -> None:
        """Solve the gathered blocks, if any."""
        if self._gathered:
            blocks, effect_ns = self._gathered, self._gathered_ns
            self._gathered, self._gathered_ns = [], []
            self._solve(blocks, effect_ns)

    def _solve(self, blocks: list[Block], effect_ns: list[int]) -> None:
        """Submit blocks to the worker. effect_ns: stamps from which their results take effect."""
        solver = self._solver
        solved = self._worker.submit(lambda: solver.solve(blocks))
        self._coming.extend((from_ns, solved, number) for number, from_ns in enumerate(effect_ns))

    def _let_take_effect(self, reached_ns: int) -> None:
        """Let results take effect that are due at a stamp, waiting for the worker if necessary."""
        if not self._coming or self._coming[0][0] > reached_ns:
            return
        self._is_updating = True
        try:
            while self._coming and self._coming[0][0] <= reached_ns:
                from_ns, solved, number = self._coming.popleft()
                self._last_result = solved.result()[number]
                self._n_updates += 1
                if self._last_result.has_rows:
                    self._on_block(from_ns)
        finally:
            self._is_updating = False

    def _copied(self, block_ns: int, *, is_last: bool = False) -> Block:
        """Copy a block with its margins from the aligner. is_last: whether the run has ended."""
        dvl, reference, imu = self._dvl, self._aligner.reference, self._aligner.imu
        end_ns = block_ns + BLOCK_NS
        from_ns, to_ns = block_ns - MARGIN_NS, end_ns + MARGIN_NS
        rows = dvl.between(dvl.stamps_ns, from_ns, to_ns)
        at, turned = reference.in_time(from_ns, to_ns), imu.in_time(from_ns, to_ns)
        columns = reference.stamps_ns, reference.values, reference.frames, reference.unmeasured
        return Block(
            block_ns, end_ns, self._new_days(block_ns), not is_last and self._dvl_is_silent(end_ns),
            DvlSamples(dvl.stamps_ns[rows].copy(), dvl.velocity[rows].copy(), dvl.covariance[rows].copy()),
            ReferenceSamples(*columns).part(at), ImuSamples(imu.stamps_ns[turned], imu.values[turned]),
        )  # fmt: skip

    def _new_days(self, block_ns: int) -> int:
        """Count the days that begin with a block, which may hold delayed references of a day's first DVL sample."""
        before, starts_ns = len(self._day_starts_ns), self._aligner.day_starts_ns
        while len(self._day_starts_ns) < len(starts_ns):
            if starts_ns[len(self._day_starts_ns)] - LONGEST_DELAY_NS >= block_ns + BLOCK_NS:
                break
            self._day_starts_ns.append(block_ns)
        return len(self._day_starts_ns) - before

    def _next_block(self, block_ns: int, last_ns: int) -> int:
        """Return the start of the next block with a reference, or of the first incomplete block."""
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
        """Copy the judged DVL samples before the aligner forgets them."""
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
        """Reserve memory for the DVL's samples once their rate is known."""
        stamps_ns = self._dvl.stamps_ns[self._dvl.begin : self._dvl.size]
        span_ns = int(stamps_ns[-1] - stamps_ns[0]) if len(stamps_ns) else 0
        if span_ns >= RATE_FROM_NS:
            self._has_room = True
            longest_ns = BLOCK_NS + MARGIN_NS + self._wait_ns
            self._dvl.reserve(round(ROOM * len(stamps_ns) * longest_ns / span_ns))

    def _dvl_is_silent(self, stamp_ns: int) -> bool:
        """Return whether the DVL pauses here so long that tracks drop earlier data."""
        stamps_ns = self._dvl.stamps_ns[self._dvl.begin : self._dvl.size]
        at = int(np.searchsorted(stamps_ns, stamp_ns))
        return at == len(stamps_ns) or int(stamps_ns[at]) - stamp_ns > LONGEST_NS // 2

    # ------------------------------------------------------------------ verification

    @property
    def reference_claims(self) -> bool:
        """Return whether the reference's noise comes from its messages instead of a parameter."""
        return self._result_in_effect.claims > 0

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """Streams kept for verification, and the stamp (ns) of their time 0; None if nothing was kept."""
        solver = self._idle_solver()
        if not solver.kept:
            return None
        newest = solver.kept[-1]  # changes with every kept block
        if self._recording is None or self._recording[0] is not newest:
            self._recording = newest, ThinnedRecording.of(solver.kept)
        return self._recording[1], solver.epoch_ns

    @property
    def n_days(self) -> int:
        """Number of days so far."""
        return 1 + len(self._day_starts_ns)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Return the day (N,), from 0, of each stamp."""
        return np.searchsorted(np.array(self._day_starts_ns, dtype=np.int64), stamps_ns, side="right")

    def days_from(self, first_ns: Sequence[int]) -> tuple[Day, ...]:
        """See `Estimator`."""
        days = []
        states = self._result_in_effect.days if self._day_starts_ns else ()
        for begins_ns, (x, p) in zip(first_ns, states, strict=False):  # the newest day may have no estimate yet
            std = np.sqrt(np.diag(p))
            east, north, _ = x[REFERENCE_ERROR].tolist()
            east_std, north_std, _ = std[REFERENCE_ERROR].tolist()
            day = Day(
                first_ns=begins_ns, dvl_time_offset=self._parameters.dvl_time_offset + float(x[DELAY]),
                dvl_time_offset_std=float(std[DELAY]),
                shown=bool(p[DELAY, DELAY] <= OBSERVED_SHARE**2 * self._unknown.p[DELAY, DELAY]),
                reference_offset=(east, north), reference_offset_std=(east_std, north_std),
            )  # fmt: skip
            days.append(day)
        return tuple(days)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """Return, per fold and day, the corrections estimated without that fold."""
        if not self.claims:
            return [[NO_TERMS] * n_days] * FOLDS
        terms = []
        for states_of_days in self._idle_solver().fit.without_folds():
            terms.append([Terms.of_state(state.x) for state in states_of_days])
        return terms

    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """Return the velocity error on every fold, each by the state without it; None for too few samples."""
        try:
            return self._idle_solver().fit.held_out_error()
        except np.linalg.LinAlgError:
            return None

    @property
    def slow_noise(self) -> SlowNoise | None:
        """See `Estimator`."""
        return self._idle_solver().fit.slow_noise

    @property
    def dvl_bias(self) -> GaussianState | None:
        """See `Estimator`."""
        return self._idle_solver().fit.dvl_bias

    @property
    def beam_fault(self) -> BeamFault | None:
        """See `Estimator`."""
        return self._idle_solver().fit.beam_fault()

    def _idle_solver(self) -> BlockSolver:
        self._newest()
        return self._solver
