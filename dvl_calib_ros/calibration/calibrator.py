"""Calibration of one DVL: takes samples, returns estimates.

    samples ─► Aligner: rows of DVL samples with the other streams' values ─► groups of models ─► estimates
                                        └─► Selection: GNSS availability, selected model

The node, the replay and the evaluation all use this class. The node feeds single samples, recordings feed columns.
Neither that nor block_size changes the results, only the speed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from functools import partial

import numpy as np

from ..verdict.kinds import Severity
from ..verdict.reasons import Reason
from .assessment.dead_reckoning import Navigation
from .assessment.manoeuvre_planner import RecentMotion, recent_motion
from .assessment.model_selection import Selection
from .assessor import Assessor, Estimates, NonlinearEstimators
from .estimators.estimator import Estimator, EstimatorSetup, LinearEstimator, kind_of
from .filters.build_observations import ROWS_WITH, Observer, RowsSeen, own_copy
from .filters.filter_bank import Group, groups_of
from .filters.state_history import Numbers, PastStates, StateTrace
from .models import BROKEN, LINEAR_MODELS, MODELS, POSITIONS, Model, Needs
from .models.parameters import IAC, ParameterError, Parameters
from .numerics.frames import Array, Vector
from .numerics.kalman import GaussianState
from .numerics.samples import (
    AlignedBlock,
    DvlSample,
    ImuSample,
    Index,
    Pairing,
    ReferenceSample,
    Stamps,
    Stream,
    Streams,
)
from .registration.clock_domains import StreamClocks
from .registration.registration import Registration
from .results.results import Day, Estimate, Result, Verification
from .results.thinned_recording import Terms, ThinnedRecording
from .streams.aligner import Aligner, counted
from .streams.position_velocities import are_positions, check_model
from .streams.stream_order import parts_by_day

# DVL rows that are copied together for the full model; copying them singly costs ten times as much.
COPIED_AT_ONCE = 64
# Rows, and blocks of samples, that may wait for a model that has no use for them yet, for example without an IMU.
ROWS_HELD, ROWS_HELD_BLOCKS = 1024, 4
# Samples that one 10 s block of the full model counts for when blocks are gathered.
SAMPLES_OF_A_BLOCK = 128

# Imported here because no live message may wait for an import.
_KINDS = {model.name: kind_of(model) for model in MODELS.values() if model.estimator}


class Calibrator:
    """Calibration with all models in parallel; the module docstring has the data flow.

    models: names of the models to run; each costs time, and the others have no estimate.
    prior_sway_heave: prior for ``prior_source: reference`` (m/s), from the caller.
    initial: initial states by model name.
    block_size: number of samples gathered before an update, unless a state is requested earlier.
    on_event: receives a sentence at every restart.
    on_rows: receives the aligned rows in order, once all models have had them.
    on_restart: called at a restart, which forgets all samples.
    verified: keep what hold-out verification needs.
    trace: filled with the models' states over time.
    recordings_ns: stamps between recordings; each recording is a day of its own.
    worker: runs slow work in a thread so that live messages do not wait; None runs it immediately, with the same
      results.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        prior_sway_heave: tuple[float, float] | None = None,
        initial: Mapping[str, GaussianState] | None = None,
        block_size: int = 1,
        on_event: Callable[[str], None] = lambda _: None,
        on_rows: Callable[[AlignedBlock], None] | None = None,
        on_restart: Callable[[], None] = lambda: None,
        verified: bool = False,
        trace: StateTrace | None = None,
        recordings_ns: Sequence[int] = (),
        worker: Executor | None = None,
        models: Collection[str] = tuple(MODELS),
    ) -> None:
        """Check the configuration and build the alignment, the filters and the nonlinear estimators."""
        if BROKEN:
            raise ParameterError(BROKEN[0])
        if parameters.prior_source == "reference" and prior_sway_heave is None:
            raise ParameterError("prior_source: reference needs recorded data; live, use fixed or initial_window")
        self.parameters = parameters
        self._models = tuple(name for name in MODELS if name in models)
        # without positions the position model is not reported
        unknown = () if are_positions(parameters) else (POSITIONS.name,)
        self._reported_models = tuple(name for name in self._models if name not in unknown)
        check_model(parameters)
        self._initial = initial
        self._block_size = block_size
        self._rows_held = max(ROWS_HELD, ROWS_HELD_BLOCKS * block_size)
        self._on_event = on_event
        self._on_rows = on_rows
        self._on_restart = on_restart
        self._verified, self._clocks = verified, StreamClocks()
        self._trace = trace
        self._worker = worker
        self._recordings_ns = recordings_ns
        self._observer = Observer(parameters)
        self._aligner = Aligner(parameters, prior_sway_heave, self._restart, recordings_ns)
        self.reset()

    # ------------------------------------------------------------------ state

    def reset(self) -> None:
        """Forget all samples and estimates."""
        self.restarts = 0
        self._aligner.reset()
        self._start()

    def _start(self) -> None:
        """Make filters, estimators and selection from the current parameters."""
        self._selection = Selection()
        self._n_selected = 0  # rows given to the selection
        wanted = {*self._models}
        if self._verified:  # every model is verified with the samples of an aided one
            aided = (model.name for model in LINEAR_MODELS if model.aided and model.name in wanted)
            wanted.add(next(aided, "M1"))
        linear = [model for model in LINEAR_MODELS if model.name in wanted]
        self._groups = groups_of(linear, self.parameters, self._initial, self._verified)
        self._aligner.before_clearing = self._before_clearing
        for track in (self._aligner.reference, self._aligner.imu):
            track.needed_from.clear()
        group_of = {name: group for group in self._groups for name in group.index}
        self._estimators: dict[str, Estimator] = {
            model.name: LinearEstimator(model, group_of[model.name], self._update) for model in linear
        }
        for name in self._models:
            if MODELS[name].estimator:
                self._estimators[name] = self._new_estimator(MODELS[name])
        # estimators beyond the linear filter
        self._further = NonlinearEstimators([self._estimators[name] for name in self._models if MODELS[name].estimator])
        self._estimates = Estimates(self._estimators, self._further, self._models, self.parameters)
        self._judge = Assessor(self._estimates)
        self._seen: dict[Needs, RowsSeen] = {}
        self._doubted: tuple[tuple[object, ...], Sequence[Reason]] | None = None
        if self._trace is not None:
            self._trace.start(self._groups)

    def _new_estimator(self, model: Model) -> Estimator:
        """Make the estimator that a model names."""
        together = 1 if self._worker is not None else max(1, self._block_size // SAMPLES_OF_A_BLOCK)
        setup = EstimatorSetup(
            model=model, parameters=self.parameters, aligner=self._aligner,
            initial=(self._initial or {}).get(model.name), on_evidence=partial(self._on_evidence, model),
            verified=self._verified, worker=self._worker, together=together,
        )  # fmt: skip
        return _KINDS[model.name](setup)

    def _before_clearing(self) -> None:
        for estimator in self._further:
            estimator.advance()

    def _restart(self, back_s: float) -> None:
        """Restart after a clock step, by `back_s` backward (s), negative if forward."""
        self.restarts += 1
        how = f"back by {back_s:.1f} s" if back_s > 0.0 else f"ahead by {-back_s / 86_400.0:.0f} days"
        self._on_event(f"DVL stamps went {how}: the calibration starts anew")
        self._on_restart()
        self._start()

    # ------------------------------------------------------------------ input

    def feed_dvl(self, sample: DvlSample) -> DvlSample | None:
        """Take a DVL sample. Return it time-corrected and with screened covariance; None if invalid or out of order."""
        self._clocks.arrived(Stream.DVL, sample.stamp_ns)
        taken = self._aligner.take_dvl(sample)
        if taken is not None:
            self._advance()
        return taken

    def feed_reference(self, sample: ReferenceSample) -> None:
        """Take a reference (GNSS) velocity."""
        self._clocks.arrived(Stream.REFERENCE, sample.stamp_ns)
        self._aligner.take_reference(sample)
        self._advance()

    def feed_imu(self, sample: ImuSample) -> None:
        """Take attitude and angular velocity."""
        self._clocks.arrived(Stream.IMU, sample.stamp_ns)
        self._aligner.take_imu(sample)
        self._advance()

    def feed(self, streams: Streams) -> None:
        """Take a stretch of a recording with all streams."""
        if self._verified or self._worker is not None:
            self._clocks.add(streams)
        self._aligner.take(streams)
        self._advance()
        self._aligner.forget_old()

    def feed_fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """Take a position (3,) m of the reference point, ENU from any origin, and variances (3,) m², nan if unknown."""
        for estimator in self._further:
            estimator.take_fix(stamp_ns, position, variance)

    def refuse(self, stream: str, reason: str) -> None:
        """Count a message of a stream (dvl, reference, imu) that is no valid sample, under its reason."""
        self._aligner.refuse(Stream(stream), reason)

    def _advance(self) -> None:
        """Pass new pairings to the selection, and update the models that have enough samples."""
        aligner = self._aligner
        for estimator in self._further:
            if aligner.partners.n_judged - estimator.n_taken >= COPIED_AT_ONCE:
                estimator.take_rows()
            estimator.advance()
        if aligner.partners.n_paired > self._n_selected:
            self._select()
        due = [group for group in self._groups if self._is_due(group)]
        if due:
            for group in due:
                self._give_decided(group)
            self._forget_rows()

    def _is_due(self, group: Group) -> bool:
        """Return whether a group has a full block of samples, or too many rows without samples to keep."""
        if self._aligner.partners.given[group.needs] - group.n_given >= self._block_size:
            return True
        return self._decided(group.needs) - group.next_row >= self._rows_held

    def _select(self) -> None:
        """Pass new pairings to the selection, up to the first sample that gathered blocks may still affect."""
        rows, end = self._aligner.rows, self._aligner.partners.n_paired
        first = self._n_selected - rows.base
        stamps_ns = rows.stamps_ns[first : end - rows.base]
        until_ns = self._further.affected_from_ns
        if until_ns is not None:
            stamps_ns = stamps_ns[: int(np.searchsorted(stamps_ns, until_ns))]
        if len(stamps_ns):
            paired = rows.pairing[first : first + len(stamps_ns)] == Pairing.PAIRED
            self._selection.update(stamps_ns, paired, self.parameters)
            self._n_selected += len(stamps_ns)

    def _on_evidence(self, model: Model, from_ns: int) -> None:
        """Pass an estimator's new evidence to the selection and its state to the trace."""
        estimator = self._estimators[model.name]
        self._selection.take(from_ns, estimator.evidence)
        if self._trace is not None:
            estimator.remember(from_ns)

    # ------------------------------------------------------------------ models

    def _update(self, group: Group) -> None:
        """Give a group's models the decided rows that they have not had."""
        if self._give_decided(group):
            self._forget_rows()

    def _give_decided(self, group: Group) -> bool:
        """Do as `_update` without forgetting rows. Return whether there were any."""
        decided = self._decided(group.needs)
        first, group.next_row = group.next_row, decided
        if decided == first:
            return False
        for start, end, is_new_day in parts_by_day(self._aligner.day_rows, first, decided):
            if is_new_day:
                group.end_day()
            self._give(group, start, end)
        return True

    def _give(self, group: Group, first: int, decided: int) -> None:
        """Give a group's models the rows first .. decided - 1, all of one day."""
        seen = self._observed(group.needs, first, decided)
        wanted = None if self._trace is None else self._trace.wanted(first, decided)
        ends = None if wanted is None or not len(wanted) else np.searchsorted(seen.numbers, wanted, side="right")
        after = None
        if seen.observations is not None:
            block = seen.block
            share = block.share(group.needs is Needs.REFERENCE)
            after = group.update(block.stamps_ns, seen.observations, share, block.prior_known, ends)
        elif ends is not None:
            after = group.snapshot(len(ends))
        if self._trace is not None and wanted is not None and after is not None:
            self._trace.add(wanted, group, after)

    def _decided(self, needs: Needs) -> int:
        """Return the number of the first row that is not decided for models with these needs."""
        partners = self._aligner.partners
        return {
            Needs.NOTHING: partners.n_judged, Needs.REFERENCE: partners.n_paired,
        }.get(needs, partners.n_oriented)  # fmt: skip

    def _observed(self, needs: Needs, first: int, decided: int) -> RowsSeen:
        """Return observations of rows first .. decided - 1 for models with these needs, cached for other groups."""
        seen = self._seen.get(needs)
        if seen is None or (seen.first, seen.decided) != (first, decided):
            block = self._aligner.rows.block(first, decided)
            has = ROWS_WITH[needs](block)
            numbers = np.arange(first, decided)
            if not has.all():
                block, numbers = block.part(has), numbers[has]
            found = (
                self._observer.observe(block, needs, self._aligner.partners.prior.sway_heave) if len(block) else None
            )
            seen = self._seen[needs] = RowsSeen(first, decided, block, numbers, found)
        return seen

    def _forget_rows(self) -> None:
        """Forget the rows that all models have had."""
        rows = self._aligner.rows
        done = min(self._n_selected, self._further.n_taken, *(group.next_row for group in self._groups))
        if done - rows.base > rows.begin:
            if self._on_rows is not None:
                self._on_rows(own_copy(rows.block(rows.begin + rows.base, done)))
            rows.forget_before(done - rows.base)

    def finish(self) -> None:
        """Update all models with the decided rows, and give all remaining rows to on_rows."""
        for estimator in self._further:
            estimator.finish()
        for group in self._groups:
            self._update(group)
        rows = self._aligner.rows
        if self._on_rows is not None and rows.size > rows.begin:
            self._on_rows(own_copy(rows.block(rows.begin + rows.base, rows.end)))

    # ------------------------------------------------------------------ output

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Message counters since the start or the last restart, see `counted`."""
        restarted = {name: self._estimators[name].counts.restarted for name in self._models}
        return counted(self._aligner, self.selection.gnss.losses, self.restarts, restarted)

    @property
    def refusal_counters(self) -> Mapping[str, set[str]]:
        """Names of the counters that hold refused messages, by stream."""
        return self._aligner.refusal_counters

    @property
    def first_ns(self) -> int | None:
        """Stamp of the first DVL sample, of those sorted by stamp; None before it."""
        return self._aligner.first_ns

    @property
    def last_ns(self) -> int | None:
        """Stamp of the newest DVL sample, of those sorted by stamp; None before the first."""
        return self._aligner.last_ns

    @property
    def longest_dropout_ns(self) -> int:
        """Longest DVL dropout (ns) since the start or the last restart."""
        return self._aligner.dropouts.longest_ns

    @property
    def newest_ns(self) -> dict[str, int | None]:
        """Stamp of the newest sample of each stream; None before the first."""
        return self._aligner.newest_ns

    def latest_angular_velocity(self, stamp_ns: int) -> Vector | None:
        """Return the newest angular velocity (rad/s, body) for output without delay; None if older than imu_timeout."""
        return self._aligner.latest_angular_velocity(stamp_ns)

    def latest_motion(self) -> RecentMotion | None:
        """Return the motion by the newest samples, its noise unknown (nan); None before the first sample."""
        return recent_motion(self._aligner)

    @property
    def selection(self) -> Selection:
        """Model selection over time."""
        if self._worker is None:  # with a worker nothing is gathered, and other threads may read
            for estimator in self._further:
                estimator.settle()
            self._select()
        return self._selection

    @property
    def selected(self) -> str:
        """Name of the selected model."""
        return self.selection.model(self.parameters)

    def set_parameters(self, parameters: Parameters) -> None:
        """Change parameters that can change at run time (`ParameterSpec.read_only` False)."""
        check_model(parameters)
        selection = self.selection  # with the old parameters
        self.parameters = self._aligner.parameters = self._estimates.parameters = parameters
        self._doubted = None
        if self._n_selected:
            selection.record(self._aligner.partners.decided_ns, parameters)

    def n_given(self, name: str) -> int:
        """Return the number of samples given to a model; it grows when there may be a new estimate."""
        return self._aligner.partners.given[MODELS[name].needs]

    def state(self, name: str) -> GaussianState:
        """Return state and covariance of one model."""
        return self._estimators[name].state()

    def published(self, name: str) -> GaussianState:
        """Return the published state of one model: `next_recording`, or `state` with the parameter ``model: iac``."""
        if self.parameters.model == IAC:
            return self.state(name)
        return self.next_recording(name)

    def next_recording(self, name: str) -> GaussianState:
        """Return `of_recording` with day-to-day variation added, as σ for the next recording."""
        return self._estimates.next_recording(name)

    def of_recording(self, name: str) -> GaussianState:
        """Return the state with σ for this recording: the larger of the filter's and of the scatter of time blocks."""
        return self._estimates.of_recording(name)

    def states_at(self, name: str, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> PastStates:
        """Return the states of a model after E rows of a trace, see `Estimator.states_at`."""
        return self._estimators[name].states_at(trace, numbers, stamps_ns)

    def estimate(self, name: str | None = None) -> Estimate:
        """Return the complete estimate of one model, by default the selected one."""
        return self._estimates.estimate(name or self.selected)

    def verification(self, name: str) -> Verification:
        """Return the hold-out verdict on one model's calibration; needs ``verified``."""
        judge = next(group for group in self._groups if group.needs is Needs.REFERENCE)
        self._update(judge)
        return self._judge.verification(name, judge.moments)

    def navigation(self, name: str) -> Navigation | None:
        """Return the drift of dead reckoning on held-out data; None without motion or reference. Needs ``verified``."""
        return self._judge.navigation(name, self.heading_deviation)

    def held_out_terms(self, name: str) -> list[list[Terms]]:
        """Return, per fold and day, one model's corrections estimated without that fold; needs ``verified``.

        Raises numpy.linalg.LinAlgError if a grossly wrong configuration leaves no estimate without a fold.
        """
        return self._judge.held_out_terms(name)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Return the day (N,), from 0, of each stamp (ns), for stamps within `recording`."""
        return self._further.day_of(stamps_ns)

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """Streams kept for verification, and the stamp (ns) of their time 0; None if nothing was kept."""
        return self._further.recording

    def result(self) -> Result:
        """Return all results, including those that would take effect only at later stamps."""
        with self.settled():
            return self._result()

    def settled(self) -> AbstractContextManager[None]:
        """Let all complete blocks, and the recording's incomplete end, take effect inside this context."""
        return self._further.settled()

    def _result(self) -> Result:
        """Collect all results as of now."""
        doubts = [] if self._worker is None else self.doubts(fresh=True)
        return Result(
            selected=self.selected, iac_model=self.selection.iac_model(self.parameters),
            selected_because=self.selection.reason(self.parameters),
            estimates={name: self._estimates.without_tilt(self.estimate(name)) for name in self._reported_models},
            segments=tuple(self.selection.segments), counts=self.counts, first_ns=self.first_ns, last_ns=self.last_ns,
            parameters=self.parameters.as_dict(), verifications=self._verifications(doubts),
            suggestion=self.suggestion, days=self.days,
            days_of=next((name for name in self._models if self._days_of(name)), ""), doubts=tuple(doubts),
        )  # fmt: skip

    def _verifications(self, doubts: Sequence[Reason]) -> dict[str, Verification]:
        """Return verdicts by model; live, only of the selected model, with all reasons against it."""
        if self._verified:
            return {name: self.verification(name) for name in self._reported_models}
        if self._worker is None:
            return {}
        verification = self._judge.so_far(self.selected, fresh=True)
        known = {reason.code for reason in verification.reasons}
        against = [doubt for doubt in doubts if doubt.severity is not Severity.WARNING and doubt.code not in known]
        return {self.selected: verification.with_objections(against)}

    @property
    def verdict_so_far(self) -> Severity:
        """Verdict on the selected model's calibration, by the worker's latest evaluation."""
        return self._judge.so_far(self.selected, fresh=False).verdict

    def doubts(self, *, fresh: bool) -> list[Reason]:
        """Return the reasons against the calibration, weighed by their effect on the verdict; needs a worker.

        fresh: evaluate all data now, which takes time; else use the worker's latest evaluation.
        """
        return self._judge.doubts(self.selected, self.clock_objections(fresh=fresh), fresh=fresh)

    @property
    def doubts_so_far(self) -> Sequence[Reason]:
        """`doubts` by the latest evaluation, recomputed (some milliseconds) only when its inputs have changed."""
        clocks = self.clock_objections(fresh=False)  # clocks too far apart to be paired do not raise n_results
        of = (self.selected, *self._further.n_results, *(clock.code for clock in clocks))
        if self._doubted is None or self._doubted[0] != of:
            self._doubted = of, self._judge.doubts(self.selected, clocks, fresh=False)
        return self._doubted[1]

    @property
    def is_level(self) -> bool:
        """Return whether the IMU gives a heading only, so that roll and pitch hold the vehicle's trim."""
        return self._further.is_level

    def _days_of(self, name: str) -> tuple[Day, ...]:
        return self._estimators[name].days_from((self.first_ns or 0, *self._aligner.day_starts_ns))

    @property
    def days(self) -> tuple[Day, ...]:
        """Values estimated per day; empty with one day or without an estimator that has them."""
        return next((days for name in self._models if (days := self._days_of(name))), ())

    @property
    def heading_deviation(self) -> GaussianState | None:
        """Heading deviation, see `Estimate.heading_deviation`, by the last model that has one; else None."""
        each = [estimator.heading_deviation for estimator in reversed(self._estimators.values())]
        return next((found for found in each if found is not None), None)

    @property
    def suggestion(self) -> Reason | None:
        """Configuration that fits the data, if the given one is grossly wrong."""
        return self._further.suggestion

    @property
    def are_clocks_known(self) -> bool:
        """Return whether the data determine the clock offsets, zero or not."""
        return self._further.are_clocks_known

    def clock_objections(self, *, fresh: bool) -> list[Reason]:
        """Return reasons against large clock offsets; none if the data determine the offsets. fresh: see `doubts`."""
        seen = self.registration_so_far
        is_known = self.are_clocks_known if fresh else seen is not None and seen.are_known
        return [] if is_known else self._clocks.objections(self.parameters)

    @property
    def registration_so_far(self) -> Registration | None:
        """Registration of clocks and frames by the latest evaluation; None if not known."""
        return self._further.registration_so_far

    @property
    def suggestion_so_far(self) -> Reason | None:
        """`suggestion` by the latest live evaluation, which is not repeated for every message."""
        return self._further.suggestion_so_far
