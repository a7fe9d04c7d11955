"""The calibration of one DVL: feed it samples, read estimates.

    samples ─► Aligner: rows of DVL samples with what the other streams say ─► groups of models ─► estimates
                                        └─► Selection: is there GNSS, which model is the one

The node, the replay and the evaluation all use this class. The node feeds it sample by sample, recordings come as
columns; that, and block_size, change nothing but the speed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np

from ..verdict.kinds import Severity
from ..verdict.reasons import Reason
from .assessment.dead_reckoning import Navigation
from .assessment.manoeuvre_planner import RecentMotion, recent_motion
from .assessment.model_selection import Selection
from .assessor import Assessor, Estimates, NonlinearEstimators
from .estimators.estimator import Estimator, EstimatorSetup, LinearEstimator, Worker, kind_of
from .filters.build_observations import Observer, RowsSeen, own_copy
from .filters.filter_bank import Group, groups_of
from .filters.heading_diversity import EVERY_NS, Headings
from .filters.state_history import Counts, Numbers, StateTrace
from .models import BROKEN, LINEAR_MODELS, MODELS, WITH_POSITIONS, Model, Needs
from .models.parameter_spec import ParameterError
from .models.parameters import IAC, Parameters
from .numerics.frames import Array, Vector
from .numerics.kalman import GaussianState
from .numerics.samples import (
    AlignedBlock,
    DvlSample,
    ImuSample,
    Index,
    Mask,
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

# DVL rows that wait to be copied for the full model: by the dozen that costs a tenth of one by one.
COPIED_AT_ONCE = 64
# Rows, and blocks of samples, that may wait for who has no use for them yet: without an IMU some never have.
ROWS_HELD, ROWS_HELD_BLOCKS = 1024, 4
# the full model's blocks are gathered like samples: one of 10 s counts for so many of these.
SAMPLES_OF_A_BLOCK = 128

_HAS: Mapping[Needs, Callable[[AlignedBlock], Mask]] = {
    Needs.NOTHING: lambda block: block.usable,
    Needs.ATTITUDE: lambda block: block.oriented,
    Needs.REFERENCE: lambda block: block.paired,
}
# Imported now, for no live message waits for an import.
_KINDS = {model.name: kind_of(model) for model in MODELS.values() if model.estimator}


class Calibrator:
    """Calibrates with all models at once, see the module's picture.

    models: names of those that it calibrates with, where not all are wanted: each costs. Of others nothing is known.
    prior_sway_heave: prior for ``prior_source: reference`` (m/s), found by the caller. initial: states to start from,
    by model name. block_size: samples that are gathered before the models are updated, if nobody asks for their state
    earlier. on_event: told of restarts in words. on_rows: given the aligned rows, in order, once all models have had
    them. on_restart: called when all of them are to be forgotten. verified: keep what hold-out verification needs.
    trace: filled with the models' states over time. recordings_ns: stamps between one recording and the next, each of
    which is a day of its own. worker: does what would hold up live messages; None: all is done at once, and comes to
    the same. registration: how the instruments stand, where it was asked of the data before.
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
        worker: Worker | None = None,
        models: Collection[str] = tuple(MODELS),
        registration: Registration | None = None,
    ) -> None:
        if BROKEN:
            raise ParameterError(BROKEN[0])
        if parameters.prior_source == "reference" and prior_sway_heave is None:
            raise ParameterError("prior_source: reference needs recorded data; live, use fixed or initial_window")
        self.parameters = parameters
        self._models = tuple(name for name in MODELS if name in models)
        # of positions nothing is to be said where there are none
        unknown = () if are_positions(parameters) else (WITH_POSITIONS,)
        self._told = tuple(name for name in self._models if name not in unknown)
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
        self._registration = registration
        self._recordings_ns = recordings_ns
        self._observer = Observer(parameters)
        self._aligner = Aligner(parameters, prior_sway_heave, self._restart, recordings_ns)
        self.reset()

    # ------------------------------------------------------------------ state

    def reset(self) -> None:
        """Forget all samples and what was learnt from them."""
        self.restarts = 0
        self._aligner.reset()
        self._start()

    def _start(self) -> None:
        self._selection = Selection()
        self._n_selected = 0  # rows that the selection knows of
        wanted = {*self._models}
        if self._verified:  # every model is judged by the samples of one with a reference
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
                self._estimators[name] = self._made(MODELS[name])
        # those that are more than the linear filter
        self._further = NonlinearEstimators([self._estimators[name] for name in self._models if MODELS[name].estimator])
        self._estimates = Estimates(self._estimators, self._further, self._models, self.parameters)
        self._judge = Assessor(self._estimates)
        self._headings = Headings(self.parameters)
        self._n_headings = 0  # rows that it has had
        self._seen: dict[Needs, RowsSeen] = {}
        self._doubted: tuple[tuple[object, ...], Sequence[Reason]] | None = None
        if self._trace is not None:
            self._trace.start(self._groups)

    def _made(self, model: Model) -> Estimator:
        """The estimator that a model names."""
        together = 1 if self._worker is not None else max(1, self._block_size // SAMPLES_OF_A_BLOCK)
        return _KINDS[model.name](
            EstimatorSetup(
                model=model,
                parameters=self.parameters,
                aligner=self._aligner,
                initial=(self._initial or {}).get(model.name),
                on_evidence=partial(self._on_evidence, model),
                verified=self._verified,
                worker=self._worker,
                together=together,
                registration=self._registration,
            )
        )

    def _before_clearing(self) -> None:
        for each in self._further:
            each.advance()

    def _restart(self, back_s: float) -> None:
        self.restarts += 1
        how = f"back by {back_s:.1f} s" if back_s > 0.0 else f"ahead by {-back_s / 86_400.0:.0f} days"
        self._on_event(f"DVL stamps went {how}: the calibration starts anew")
        self._on_restart()
        self._start()

    # ------------------------------------------------------------------ input

    def feed_dvl(self, sample: DvlSample) -> DvlSample | None:
        """Take a DVL sample; None unless it is valid and in order, else as it goes on: in time, covariance screened."""
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
        """Take a stretch of a recording, all streams."""
        if self._verified or self._worker is not None:
            self._clocks.add(streams)
        self._aligner.take(streams)
        self._advance()
        self._aligner.forget_old()

    def feed_fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """Take a position of the reference point (3,) m, ENU from anywhere, and its variances (3,), nan if unknown."""
        for each in self._further:
            each.take_fix(stamp_ns, position, variance)

    def refuse(self, stream: str, reason: str) -> None:
        """Count a message of a stream (dvl, reference, imu) that could not be made a sample of, and why."""
        self._aligner.refuse(Stream(stream), reason)

    def _advance(self) -> None:
        """Let the selection know what is paired, and update the models if enough samples have come together."""
        aligner = self._aligner
        for each in self._further:
            if aligner.partners.n_judged - each.n_taken >= COPIED_AT_ONCE:
                each.take_rows()
            each.advance()
        self._look_at_headings()
        if aligner.partners.n_paired > self._n_selected:
            self._select()
        due = [group for group in self._groups if self._is_due(group)]
        if due:
            for group in due:
                self._give_decided(group)
            self._forget_rows()

    def _is_due(self, group: Group) -> bool:
        """Whether enough samples have come together for a group, or rows that hold none, which nobody can forget."""
        if self._aligner.partners.given[group.needs] - group.n_given >= self._block_size:
            return True
        return self._decided(group.needs) - group.next_row >= self._rows_held

    def _select(self) -> None:
        """Let the selection know what is paired, but for what may go by what is only gathered."""
        rows, end = self._aligner.rows, self._aligner.partners.n_paired
        first = self._n_selected - rows.base
        stamps_ns = rows.stamps_ns[first : end - rows.base]
        until_ns = self._further.told_until_ns
        if until_ns is not None:
            stamps_ns = stamps_ns[: int(np.searchsorted(stamps_ns, until_ns))]
        if len(stamps_ns):
            paired = rows.pairing[first : first + len(stamps_ns)] == Pairing.PAIRED
            self._selection.update(stamps_ns, paired, self.parameters)
            self._n_selected += len(stamps_ns)

    def _look_at_headings(self) -> None:
        """Let the selection know once headings show the current: later than the last row could be decided."""
        aligner, rows = self._aligner, self._aligner.rows
        first, decided = self._n_headings, aligner.partners.n_oriented
        if self._headings.shown or decided == first:
            return
        is_judged = self._headings.waits_for(int(rows.stamps_ns[decided - 1 - rows.base]))
        if not is_judged and decided - first < self._rows_held:
            return
        self._n_headings = decided
        for start, end, is_new_day in parts_by_day(self._aligner.day_rows, first, decided):
            if is_new_day:
                self._headings.end_day()
            seen = self._observed(Needs.ATTITUDE, start, end)
            oriented = np.zeros(end - start, dtype=bool)
            oriented[seen.numbers - start] = True
            stamps_ns = rows.stamps_ns[start - rows.base : end - rows.base]
            shown_ns = self._headings.add(stamps_ns, oriented, seen.observations)
            if shown_ns is not None:
                wait_ns = aligner.lag_ns + round(self.parameters.imu_timeout * 1e9) + EVERY_NS
                self._selection.headings_show_the_current(shown_ns + wait_ns, self._headings.trimmed)

    def _on_evidence(self, model: Model, from_ns: int) -> None:
        """Let the selection, and the trace, know what an estimator says by now."""
        estimator = self._estimators[model.name]
        self._selection.take(from_ns, estimator.evidence)
        if self._trace is not None:
            estimator.remember(from_ns)

    # ------------------------------------------------------------------ models

    def _update(self, group: Group) -> None:
        """Give a group's models the rows that are decided and that they have not had."""
        if self._give_decided(group):
            self._forget_rows()

    def _give_decided(self, group: Group) -> bool:
        """`_update` that forgets nothing; whether there were any."""
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
        """Give a group's models the rows first .. decided - 1, of one day."""
        seen = self._observed(group.needs, first, decided)
        wanted = None if self._trace is None else self._trace.wanted(first, decided)
        ends = None if wanted is None or not len(wanted) else np.searchsorted(seen.numbers, wanted, side="right")
        after = None
        if seen.observations is not None:
            block = seen.block
            share = block.share(group.needs is Needs.REFERENCE)
            after = group.update(block.stamps_ns, seen.observations, share, block.prior_known, ends)
        elif ends is not None:
            after = group.standing(len(ends))
        if self._trace is not None and wanted is not None and after is not None:
            self._trace.add(wanted, group, after)

    def _decided(self, needs: Needs) -> int:
        """Number of the first row that is not decided for models with these needs."""
        partners = self._aligner.partners
        return {
            Needs.NOTHING: partners.n_judged, Needs.ATTITUDE: partners.n_oriented, Needs.REFERENCE: partners.n_paired,
        }[needs]  # fmt: skip

    def _observed(self, needs: Needs, first: int, decided: int) -> RowsSeen:
        """Rows first .. decided - 1 as models with these needs see them; several groups ask for the same."""
        seen = self._seen.get(needs)
        if seen is None or (seen.first, seen.decided) != (first, decided):
            block = self._aligner.rows.block(first, decided)
            has = _HAS[needs](block)
            numbers = np.arange(first, decided)
            if not has.all():
                block, numbers = block.part(has), numbers[has]
            found = (
                self._observer.observe(block, needs, self._aligner.partners.prior.sway_heave) if len(block) else None
            )
            seen = self._seen[needs] = RowsSeen(first, decided, block, numbers, found)
        return seen

    def _forget_rows(self) -> None:
        """Give up the rows that all have had."""
        rows = self._aligner.rows
        done = min(self._n_selected, self._further.n_taken, *(group.next_row for group in self._groups))
        done = done if self._headings.shown else min(done, self._n_headings)
        if done - rows.base > rows.begin:
            if self._on_rows is not None:
                self._on_rows(own_copy(rows.block(rows.begin + rows.base, done)))
            rows.forget_before(done - rows.base)

    def finish(self) -> None:
        """Update all models with what is decided at the end, and tell on_rows of the rest, which may still wait."""
        for each in self._further:
            each.finish()
        for group in self._groups:
            self._update(group)
        rows = self._aligner.rows
        if self._on_rows is not None and rows.size > rows.begin:
            self._on_rows(own_copy(rows.block(rows.begin + rows.base, rows.end)))

    # ------------------------------------------------------------------ output

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Where the messages went, since the start or the last restart, see `counted`."""
        restarted = {name: self._estimators[name].counts.restarted for name in self._models}
        return counted(self._aligner, self.selection.gnss.losses, self.restarts, restarted)

    @property
    def refused_as(self) -> Mapping[str, set[str]]:
        """By stream, those of its counters that refused messages are under."""
        return self._aligner.refused_as

    @property
    def first_ns(self) -> int | None:
        """Stamp of the first DVL sample in order; None before."""
        return self._aligner.first_ns

    @property
    def last_ns(self) -> int | None:
        """Stamp of the newest DVL sample in order; None before the first."""
        return self._aligner.last_ns

    @property
    def longest_dropout_ns(self) -> int:
        """The longest dropout of the DVL since the start or the last restart."""
        return self._aligner.dropouts.longest_ns

    @property
    def newest_ns(self) -> dict[str, int | None]:
        """Stamp of the newest sample of each stream; None before the first."""
        return self._aligner.newest_ns

    def latest_angular_velocity(self, stamp_ns: int) -> Vector | None:
        """Newest angular velocity (rad/s, body), if not older than imu_timeout: for output without delay."""
        return self._aligner.latest_angular_velocity(stamp_ns)

    def latest_motion(self) -> RecentMotion | None:
        """How the vehicle moves, by its newest samples; None before the first. Its noise is not known here."""
        return recent_motion(self._aligner)

    @property
    def selection(self) -> Selection:
        """Which model is the one, over time."""
        if self._worker is None:  # else nothing is gathered, and other threads may look
            for each in self._further:
                each.settle()
            self._select()
        return self._selection

    @property
    def selected(self) -> str:
        """Name of the selected model."""
        return self.selection.model(self.parameters)

    def set_parameters(self, parameters: Parameters) -> None:
        """Change parameters that can change at run time (`ParameterSpec.read_only` False)."""
        check_model(parameters)
        selection = self.selection  # by what was so far
        self.parameters = self._aligner.parameters = self._estimates.parameters = parameters
        self._doubted = None
        if self._n_selected:
            selection.record(self._aligner.partners.decided_ns, parameters)

    def n_given(self, name: str) -> int:
        """Number of samples that a model was given so far; it grows when there may be a new estimate."""
        return self._aligner.partners.given[MODELS[name].needs]

    def state(self, name: str) -> GaussianState:
        """State and covariance of one model."""
        return self._estimators[name].state()

    def published(self, name: str) -> GaussianState:
        """As `of_recording`, with σ worth believing of the next recording: with what another day makes of it.

        Under the parameter ``model: iac`` as the paper's filters say it, which is `state`.
        """
        if self.parameters.model == IAC:
            return self.state(name)
        return self.next_recording(name)

    def next_recording(self, name: str) -> GaussianState:
        """As `of_recording`, with σ worth believing of the next recording, whatever is published."""
        return self._estimates.next_recording(name)

    def of_recording(self, name: str) -> GaussianState:
        """As `state`, with σ as of the same day: the larger of what the filter claims and what blocks of time show."""
        return self._estimates.of_recording(name)

    def states_at(
        self, name: str, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps
    ) -> tuple[GaussianState, Counts, Array]:
        """Return states x (E, n), P (E, n, n), samples used (E,) and their sum of νᵀS⁻¹ν (E,) of one model after E rows
        of a trace, with their stamps (E,)."""
        return self._estimators[name].states_at(trace, numbers, stamps_ns)

    def estimate(self, name: str | None = None) -> Estimate:
        """Estimate of one model, by default the selected one, with all that is known about it."""
        return self._estimates.estimate(name or self.selected)

    def verification(self, name: str) -> Verification:
        """The verdict on one model's calibration, by hold-out; for a calibrator made with ``verified``."""
        judge = next(group for group in self._groups if group.needs is Needs.REFERENCE)
        self._update(judge)
        return self._judge.verification(name, judge.moments)

    def navigation(self, name: str) -> Navigation | None:
        """Return the drift of dead reckoning on unseen data, None without motion or reference; for ``verified``."""
        return self._judge.navigation(name, self.heading_deviation)

    def held_out_terms(self, name: str) -> list[list[Terms]]:
        """For every fold what one model corrects on every day, had it not seen that fold; for one made ``verified``.

        Raises numpy.linalg.LinAlgError for a configuration so wrong that there is no estimate without a fold.
        """
        return self._judge.held_out_terms(name)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Which day (N,) stamps are of, from 0, as far as `recording` goes."""
        return self._further.day_of(stamps_ns)

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """What was kept for verification of all streams, and the stamp (ns) of its time 0; None for nothing."""
        return self._further.recording

    def result(self) -> Result:
        """Everything that the samples so far tell, also where it takes effect only when later ones have come."""
        with self._further.settled():
            return self._result()

    def _result(self) -> Result:
        doubts = [] if self._worker is None else self.doubts(fresh=True)
        return Result(
            selected=self.selected,
            iac_model=self.selection.iac_model(self.parameters),
            selected_because=self.selection.reason(self.parameters),
            estimates={name: self._estimates.without_tilt(self.estimate(name)) for name in self._told},
            segments=tuple(self.selection.segments),
            counts=self.counts,
            first_ns=self.first_ns,
            last_ns=self.last_ns,
            parameters=self.parameters.as_dict(),
            verifications=self._verifications(doubts),
            suggestion=self.suggestion,
            days=self.days,
            days_of=next((name for name in self._models if self._days_of(name)), ""),
            doubts=tuple(doubts),
        )

    def _verifications(self, doubts: Sequence[Reason]) -> dict[str, Verification]:
        """Verdicts by model: live that of the selected one, with all that speaks against it."""
        if self._verified:
            return {name: self.verification(name) for name in self._told}
        if self._worker is None:
            return {}
        verification = self._judge.so_far(self.selected, fresh=True)
        known = {each.code for each in verification.reasons}
        against = [each for each in doubts if each.severity is not Severity.WARNING and each.code not in known]
        return {self.selected: verification.with_objections(against)}

    @property
    def verdict_so_far(self) -> Severity:
        """Verdict on the selected model's calibration, by what the worker looked at a little ago."""
        return self._judge.so_far(self.selected, fresh=False).verdict

    def doubts(self, *, fresh: bool) -> list[Reason]:
        """What the data say against the calibration, as bad as that is to a verdict; of one with a worker.

        fresh: by a look at all there is, for which a result waits; else by one that the worker took a little ago.
        """
        return self._judge.doubts(self.selected, self.clock_objections(fresh=fresh), fresh=fresh)

    @property
    def doubts_so_far(self) -> Sequence[Reason]:
        """`doubts` that are not fresh, thought of anew only where there may be others: it takes a few milliseconds."""
        clocks = self.clock_objections(fresh=False)  # of clocks that are apart nothing is told
        of = (self.selected, *self._further.n_told, *(each.code for each in clocks))
        if self._doubted is None or self._doubted[0] != of:
            self._doubted = of, self._judge.doubts(self.selected, clocks, fresh=False)
        return self._doubted[1]

    @property
    def is_level(self) -> bool:
        """Whether references were turned into the body by a heading alone: roll and pitch then hold the trim."""
        return self._further.is_level

    def _days_of(self, name: str) -> tuple[Day, ...]:
        return self._estimators[name].days_from((self.first_ns or 0, *self._aligner.day_starts_ns))

    @property
    def days(self) -> tuple[Day, ...]:
        """What belongs to each day, where there are several and an estimator finds something of each; else none."""
        return next((days for name in self._models if (days := self._days_of(name))), ())

    @property
    def heading_deviation(self) -> GaussianState | None:
        """How the heading deviates, as `Estimate.heading_deviation`, by the model that knows most of it."""
        each = [estimator.heading_deviation for estimator in reversed(self._estimators.values())]
        return next((found for found in each if found is not None), None)

    @property
    def suggestion(self) -> Reason | None:
        """What configuration the data fit, where the one given is grossly wrong."""
        return self._further.suggestion

    @property
    def are_clocks_known(self) -> bool:
        """Whether the data show how the clocks stand, in time or not."""
        return self._further.are_clocks_known

    def clock_objections(self, *, fresh: bool) -> list[Reason]:
        """What stamps say that are far apart, unless the data show how the clocks stand: then it does not matter when
        messages arrived. fresh: as of `doubts`."""
        seen = self.registration_so_far
        is_known = self.are_clocks_known if fresh else seen is not None and seen.are_known
        return [] if is_known else self._clocks.objections(self.parameters)

    @property
    def registration_so_far(self) -> Registration | None:
        """How the instruments stand, as it was seen a little ago; None where that is not known."""
        return self._further.registration_so_far

    @property
    def suggestion_so_far(self) -> Reason | None:
        """`suggestion`, live: what a look that is not made anew for every message says."""
        return self._further.suggestion_so_far
