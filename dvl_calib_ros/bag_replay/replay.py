"""Calibration with recorded bags by the node's estimator, and its JSON document."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.assessment.dead_reckoning import Navigation, doubts, navigation_document, objections
from ..calibration.assessment.manoeuvre_planner import drift_left_open
from ..calibration.calibrator import Calibrator
from ..calibration.checks.data_warnings import gate_warnings, message_warnings, recording_warnings, reference_warnings
from ..calibration.checks.speed_of_sound import CauseOfScale, Water, cause_of_scale, water_document
from ..calibration.comparison.mounting_change import Comparison, comparison_document
from ..calibration.filters.build_observations import Observer
from ..calibration.filters.state_history import StateTrace
from ..calibration.models import MODELS, Needs
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import ENU_FROM_NED, Array, rotation_from_quaternion
from ..calibration.numerics.samples import (
    FRAME_CODES,
    AlignedBlock,
    Codes,
    Pairing,
    SampleBlock,
    Stamps,
    Stream,
    VelocityFrame,
    no_samples,
)
from ..calibration.numerics.tables import return_memory
from ..calibration.results.extrinsics import Extrinsics, dvl_in_words, extrinsics_of, rejection
from ..calibration.results.held_out_verification import verification_document
from ..calibration.results.results import Day, Estimate, Result
from ..calibration.streams.screening import are_valid_velocities, unit_quaternions
from ..calibration.streams.stream_order import SHORTEST_PAUSE_NS
from ..errors import InputError
from ..files.result_file import days_document, estimate_document, load_initial_calibration
from ..messages.decode import MessageDecoder
from ..messages.drivers import TWIST_TYPE
from ..recordings.recording import Recording, check_topics, missing_imu, open_recording
from ..recordings.topics import Topics
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding, of_consequence
from ..version import __version__

# Estimates and velocities over a run, thinned so that a run of any length fits in memory.

# largest number of rows per series; a figure has no finer detail
KEPT_STATES, KEPT_VELOCITIES = 300, 800


@dataclass(frozen=True)
class ModelHistory:
    """One model over time, at the N stamps of its `RunHistory`.

    state: (N, n), misalignment in rad in the DVL frame, then as the model's state_names.
    std: (N, n).
    misalignment_covariance: (N, 3, 3) rad².
    nis: (N,) mean νᵀS⁻¹ν per measurement row over the samples used since the previous stamp (about 1 for a consistent
      filter), nan if none was used.
    """

    state: Array
    std: Array
    misalignment_covariance: Array
    nis: Array


@dataclass(frozen=True)
class RunHistory:
    """A run over time.

    stamps_ns: (N,) of the rows of `models` and paired_share; a model's state includes all samples up to the stamp.
    paired_share: (N,) share of the DVL samples since the previous stamp with a reference, nan if none was decided.
    dvl_ns (M,), dvl_velocity (M, 3): usable DVL samples, m/s, DVL frame, corrected to the reference point.
    paired_ns (P,), reference_velocity (P, 3): DVL samples with a reference, and the reference, m/s, body frame.
    """

    stamps_ns: Stamps
    models: Mapping[str, ModelHistory]
    paired_share: Array
    dvl_ns: Stamps
    dvl_velocity: Array
    paired_ns: Stamps
    reference_velocity: Array


class Thinned:
    """Evenly spread rows of an endless series: every stride-th row; the stride doubles at the limit.

    limit: largest number of rows. expected: length of the series, if known.
    """

    def __init__(self, limit: int, expected: int = 0) -> None:
        self._limit = limit
        self._stride = max(1, -(-expected // limit))
        self._seen = 0
        self._rows: list[tuple[Any, ...]] = []

    def add(self, *columns: Array | Stamps) -> None:
        """Add the next rows, as columns (N, ...)."""
        n = len(columns[0])
        at = slice(-self._seen % self._stride, n, self._stride)
        self._seen += n
        self._rows += zip(*(column[at].copy() for column in columns), strict=True)
        while len(self._rows) > self._limit:
            self._rows = self._rows[::2]
            self._stride *= 2

    def columns(self, *shapes: tuple[int, ...]) -> list[Array]:
        """Return the kept rows as columns of rows with these shapes."""
        columns = zip(*self._rows, strict=True) if self._rows else ((),) * len(shapes)
        return [np.array(column).reshape(-1, *shape) for column, shape in zip(columns, shapes, strict=True)]


class Recorder:
    """Collector of a `RunHistory` from a calibrator, whose results it does not change.

    Give `take` to the calibrator as its on_rows, `start` as its on_restart and `trace` as its trace. expected:
    approximate number of DVL samples.
    """

    def __init__(self, parameters: Parameters, expected: int = 0) -> None:
        self._observer = Observer(parameters)
        self._expected = expected
        self.trace = StateTrace(KEPT_STATES, expected)
        self.start()

    def start(self) -> None:
        """Restart together with the calibration."""
        self._stamps_ns: list[Stamps] = []
        self._pairing: list[Codes] = []
        self._dvl = Thinned(KEPT_VELOCITIES, self._expected)
        self._paired = Thinned(KEPT_VELOCITIES, self._expected)

    def take(self, block: AlignedBlock) -> None:
        """Add aligned rows: stamps and pairing of all, DVL and reference velocities of the usable and paired ones."""
        self._stamps_ns.append(block.stamps_ns)
        self._pairing.append(block.pairing)
        usable, paired = block.part(block.usable), block.part(block.paired)
        if len(usable):
            observed = self._observer.observe(usable, Needs.NOTHING, np.zeros(2))
            self._dvl.add(usable.stamps_ns, observed.velocity_at_reference)
        if len(paired):
            observed = self._observer.observe(paired, Needs.REFERENCE, np.zeros(2))
            assert observed.reference_body is not None
            self._paired.add(paired.stamps_ns, observed.reference_body)

    def history(self, calibrator: Calibrator, estimates: Mapping[str, Estimate]) -> RunHistory:
        """Return the history after `Calibrator.finish`, ending with the estimates of its result."""
        numbers = self.trace.numbers()
        stamps_ns = np.concatenate([*self._stamps_ns, np.zeros(0, dtype=np.int64)])
        pairing = np.concatenate([*self._pairing, np.zeros(0, dtype=np.uint8)])
        numbers = numbers[numbers < len(stamps_ns)]
        decided, paired = np.cumsum(pairing != Pairing.AWAITING), np.cumsum(pairing == Pairing.PAIRED)
        at = np.append(numbers, len(stamps_ns) - 1) if len(stamps_ns) else np.zeros(0, dtype=np.int64)
        dvl_ns, dvl_velocity = self._dvl.columns((), (3,))
        paired_ns, reference_velocity = self._paired.columns((), (3,))
        return RunHistory(
            stamps_ns=np.append(stamps_ns[numbers], calibrator.last_ns or 0),
            models={
                name: _model_history(estimates[name], calibrator, self.trace, numbers, stamps_ns[numbers])
                for name in estimates
            },
            paired_share=_share(np.column_stack([paired[at], decided[at]])) if len(at) else np.full(1, np.nan),
            dvl_ns=dvl_ns.astype(np.int64),
            dvl_velocity=dvl_velocity,
            paired_ns=paired_ns.astype(np.int64),
            reference_velocity=reference_velocity,
        )


def _model_history(
    estimate: Estimate, calibrator: Calibrator, trace: StateTrace, numbers: Stamps, stamps_ns: Stamps
) -> ModelHistory:
    """Return a model's state, σ and NIS at the given times and at the end.

    numbers: (N,) numbers of the rows after which the state is shown.
    stamps_ns: (N,) their stamps.
    """
    name = estimate.model
    nis_sum = estimate.used * estimate.mean_nis if estimate.used else 0.0
    states, covariances = [estimate.state[None]], [estimate.recording_covariance[None]]
    sums = [[(nis_sum, estimate.used)]]
    if len(numbers):
        state, used, nis_sums = calibrator.states_at(name, trace, numbers, stamps_ns)
        states.insert(0, state.x)
        covariances.insert(0, state.p)
        sums.insert(0, list(zip(nis_sums.tolist(), used.tolist(), strict=True)))
    return ModelHistory(
        state=np.concatenate(states),
        std=np.sqrt(np.concatenate([np.diagonal(covariance, axis1=1, axis2=2) for covariance in covariances])),
        misalignment_covariance=np.concatenate([covariance[:, :3, :3] for covariance in covariances]),
        nis=_share(np.concatenate(sums)) / MODELS[name].n_measurement,
    )


def _share(sums: Array) -> Array:
    """Divide the increments of cumulative sums (N, 2): first column by second, since the previous row (N,)."""
    gained = np.diff(sums.astype(float), axis=0, prepend=0.0)
    return np.divide(gained[:, 0], gained[:, 1], out=np.full(len(sums), np.nan), where=gained[:, 1] > 0)


# samples per update of the models; larger arrays do not fit the processor's caches
BLOCK_SIZE = 1024


@dataclass(frozen=True)
class Replayed:
    """Result of a replay.

    notes: all messages to the user, including the findings.
    history: estimates over time, if requested.
    reference_frame: of the reference's messages, None without any.
    dvl_frame: frame_id of the DVL.
    dvl_type: message type of its topic.
    turned: whether its data were converted from forward-right-down.
    recordings: comparison of several recordings; None without one.
    pause_s: time between recordings within the first to the last sample.
    navigation: dead reckoning without and with the selected model's correction, on held-out data; None without a
      reference.
    water: its properties in the recording, if any.
    """

    result: Result
    notes: tuple[str, ...]
    findings: tuple[Reason, ...]
    dvl_frame: str
    history: RunHistory | None = None
    reference_frame: VelocityFrame | None = None
    dvl_type: str = TWIST_TYPE
    turned: bool = False
    recordings: Comparison | None = None
    pause_s: float = 0.0
    navigation: Navigation | None = None
    water: Water | None = None

    @property
    def dvl_data(self) -> str:
        """Type and axes of the DVL's data, in words."""
        return self.dvl_type + (", converted from forward-right-down to forward-left-up" if self.turned else "")

    @property
    def cause_of_scale(self) -> CauseOfScale | None:
        """The scale error as explained by the speed of sound; None if the recording has no information."""
        estimate, parameters = self.result.estimate, Parameters.from_mapping(self.result.parameters)
        return cause_of_scale(MODELS[estimate.model], estimate.of_recording, parameters, self.water)


@contextmanager
def memory_given_back() -> Iterator[None]:
    """At the end, return unused memory to the system.

    A calibrator and its estimators refer to each other, so only the garbage collector frees them, and by itself rarely.
    """
    kept = not gc.get_freeze_count()  # unless other code uses the freezing
    if kept:
        gc.freeze()  # examining all imported objects takes a quarter of a short replay's time
    try:
        yield
    finally:
        gc.collect()
        return_memory()
        if kept:
            gc.unfreeze()


@memory_given_back()
def replay(
    recording: Recording | Sequence[Path],
    parameters: Parameters,
    topics: Topics | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    *,
    with_history: bool = False,
    judged: bool = True,
    on_rows: Callable[[AlignedBlock], None] | None = None,
    on_restart: Callable[[], None] = lambda: None,
    on_finished: Callable[[Calibrator], None] = lambda _: None,
) -> Replayed:
    """Calibrate with a recording, or with bags that are read as one in order of log time.

    on_progress: receives the share (0..1) read.
    with_history: collect a `RunHistory`; else on_rows receives the aligned rows and on_restart is called, as by
      `Calibrator`.
    judged: verify on held-out data, including dead reckoning.
    on_finished: receives the calibrator at the end. Raises InputError if there is no bag or no usable DVL topic.
    """
    saved = parameters.initial_calibration
    initial = load_initial_calibration(Path(saved), parameters.mounting_rpy) if saved else None
    topics = topics or Topics()
    if not isinstance(recording, Recording):
        recording = open_recording(recording, topics, parameters)
    chosen = topics.found_in(recording.types)
    found: list[Reason] = []
    events: list[str] = []
    if parameters.prior_source == "initial_window":
        found.append(finding("PRIOR_HOLDS_ERROR"))
    check_topics(recording, chosen, found)
    of_types = recording.of_types(chosen, parameters)
    recorder = Recorder(parameters, recording.counts[chosen.dvl]) if with_history else None
    calibrator = Calibrator(
        of_types,
        prior_sway_heave=reference_prior(recording, of_types, chosen) if of_types.prior_source == "reference" else None,
        initial=initial,
        block_size=BLOCK_SIZE,
        on_event=events.append,
        on_rows=recorder.take if recorder else on_rows,
        on_restart=recorder.start if recorder else on_restart,
        verified=judged,
        trace=recorder.trace if recorder else None,
        recordings_ns=recording.between_ns,
    )
    decoder = MessageDecoder(calibrator.parameters)
    decoder.on_fix = calibrator.feed_fix
    _feed_all(recording, chosen, decoder, calibrator, on_progress)
    calibrator.finish()
    on_finished(calibrator)
    found += [*missing_imu(recording, chosen, decoder.frame_of_reference), *decoder.problems.values()]
    result = calibrator.result()
    result = replace(result, days=_days_by_recording(result.days, recording))
    found += _warnings(result, topics, decoder)
    history = recorder.history(calibrator, result.estimates) if recorder else None
    navigation = calibrator.navigation(result.selected) if judged else None
    against = doubts(
        result.estimate,
        result.estimates.values(),
        navigation,
        calibrator.parameters,
        suggested=result.suggestion is not None,
        in_earth=decoder.frame_of_reference is not VelocityFrame.BODY,
        is_level=calibrator.is_level,
    )
    found += [reason.weighed(Severity.WARNING) for reason in against]
    of_drift = objections(navigation, drift_left_open(result.estimate, calibrator.parameters))
    of_all = calibrator.clock_objections(fresh=True) + [
        reason for reason in against if reason.severity is not Severity.WARNING
    ]
    if chosen.imu not in recording.types and result.counts["reference"]["received"]:
        of_all += [] if result.counts["pairing"]["paired"] else [finding("NOTHING_COMPARED")]
    verifications = {
        name: verification.with_objections([*of_all, *(of_drift if name == result.selected else [])])
        for name, verification in result.verifications.items()
    }
    if judged and verifications[result.selected].verdict is Severity.ACCEPT:
        found = of_consequence(found, calibrator.parameters.target_drift)
    return Replayed(
        replace(result, verifications=verifications),
        (*recording.notes, *events, *map(str, found)),
        tuple(found),
        decoder.dvl_frame or "dvl_link",
        history,
        decoder.frame_of_reference,
        decoder.dvl_type.name,
        decoder.turns_dvl,
        navigation=navigation,
        water=recording.water(topics),
    )


def _days_by_recording(days: Sequence[Day], recording: Recording) -> tuple[Day, ...]:
    """Name days by their first recording if each has its own, else by date."""
    names = []
    for day in days:
        names_of_day = [
            path.name
            for path, span_ns in zip(recording.paths, recording.path_spans_ns, strict=True)
            if span_ns is not None and span_ns[0] - SHORTEST_PAUSE_NS <= day.first_ns <= span_ns[1]
        ]
        names.append(names_of_day[0] if names_of_day else "")
    if len(set(names)) < len(days) or not all(names):
        return tuple(days)
    return tuple(replace(day, name=name) for day, name in zip(days, names, strict=True))


def extrinsics_of_replay(replayed: Replayed, name: str) -> Extrinsics | None:
    """Return the selected model's estimate for a comparison; None if it used no sample."""
    result = replayed.result
    estimate, judged = result.estimate, result.verifications.get(result.selected)
    if not estimate.used or result.first_ns is None or result.last_ns is None:
        return None
    rejected = "" if judged is None else rejection(reason.as_dict() for reason in judged.reasons)
    return extrinsics_of(
        name,
        MODELS[estimate.model],
        estimate.of_recording,
        Parameters.from_mapping(result.parameters),
        (result.first_ns, result.last_ns),
        estimate.used,
        dvl=dvl_in_words(result.parameters["dvl_frame"] or replayed.dvl_frame, replayed.turned),
        by_bias=estimate.of_bias.columns,
        remarks=[f"its verdict is reject: {rejected}"] if rejected else (),
        rejected=rejected,
    )


def _feed_all(
    recording: Recording,
    topics: Topics,
    decoder: MessageDecoder,
    calibrator: Calibrator,
    on_progress: Callable[[float], None],
) -> None:
    """Feed all samples to a calibrator in order of arrival. on_progress: receives the share (0..1) fed."""
    start_ns, end_ns = recording.span_ns
    streams = {topics.imu: Stream.IMU, topics.gnss: Stream.REFERENCE, topics.dvl: Stream.DVL}
    for stretch in recording.stretches(streams, decoder):
        calibrator.feed(stretch.streams)
        on_progress((stretch.log_ns - start_ns) / max(end_ns - start_ns, 1))
    on_progress(1.0)


def reference_prior(recording: Recording, parameters: Parameters, topics: Topics) -> tuple[float, float]:
    """Return the mean sway and heave (m/s, body frame) of the reference in the first prior_window. Raises InputError.

    A velocity in an earth frame is rotated by the last attitude before it.
    """
    velocities: list[Array] = []
    first_ns: int | None = None
    attitude = no_samples(Stream.IMU)
    decoder = MessageDecoder(parameters)
    for stretch in recording.stretches({topics.gnss: Stream.REFERENCE, topics.imu: Stream.IMU}, decoder):
        _, reference, imu = stretch.streams
        given = (imu.refused == 0) & ~np.isnan(unit_quaternions(imu.orientation)[:, 0])
        attitude = attitude.joined(imu.part(given))
        reference = reference.part(
            (reference.refused == 0) & are_valid_velocities(reference.values, parameters.max_speed)
        )
        if not len(reference):
            continue
        first_ns = int(reference.stamps_ns[0]) if first_ns is None else first_ns
        over = reference.stamps_ns - first_ns >= parameters.prior_window * 1e9
        is_over = bool(over.any())
        velocities.append(_in_body(reference.part(slice(int(np.argmax(over))) if is_over else slice(None)), attitude))
        if is_over:
            break
        attitude = attitude.part(slice(-1, None))
    mean = np.concatenate([*velocities, np.zeros((0, 3))])
    if not len(mean):
        raise InputError(
            f"prior_source reference: topic {topics.gnss} has no velocity that can be rotated to the body frame in "
            f"its first {parameters.prior_window:g} s; set --gnss-topic, or use prior_source fixed"
        )
    _, sway, heave = mean.mean(axis=0).tolist()
    return sway, heave


def _in_body(reference: SampleBlock, attitude: SampleBlock) -> Array:
    """Return the reference velocities (N, 3) m/s in the body frame.

    A velocity that needs an attitude is omitted if none came before it. All attitudes must have an orientation.
    """
    before = np.searchsorted(attitude.arrival, reference.arrival) - 1
    is_body = reference.frames == FRAME_CODES[VelocityFrame.BODY]
    is_ned = reference.frames == FRAME_CODES[VelocityFrame.NED]
    if not len(attitude):
        return reference.values[is_body]
    enu = np.where(is_ned[:, None], reference.values @ ENU_FROM_NED.T, reference.values)
    rotation_enu_from_body = rotation_from_quaternion(unit_quaternions(attitude.orientation))[before]
    rotated = np.matmul(enu[:, None], rotation_enu_from_body)[:, 0]
    velocity: Array = np.where(is_body[:, None], reference.values, rotated)[is_body | (before >= 0)]
    return velocity


def _warnings(result: Result, topics: Topics, decoder: MessageDecoder) -> list[Reason]:
    """Return warnings from the counts."""
    dvl = result.counts["dvl"]
    if not dvl["accepted"]:
        raise InputError(f"no valid sample on {topics.dvl}: {_counts_in_words(dvl)}. {_refusal_advice(decoder, dvl)}")
    found = message_warnings(result.counts) + decoder.dvl_type.advice(dvl) + recording_warnings(result.counts)
    if decoder.zero_stamps:
        found.append(finding("STAMPS_MISSING_IN_BAG", count=decoder.zero_stamps))
    for estimate in result.estimates.values():
        found += gate_warnings(estimate)
    return found + reference_warnings(result.estimate)


def _refusal_advice(decoder: MessageDecoder, counts: Mapping[str, int]) -> str:
    """Return the likely cause of refused DVL messages."""
    known = [str(found) for kind, found in decoder.problems.items() if kind.startswith("dvl")]
    known += map(str, decoder.dvl_type.advice(counts))
    return ". ".join(known) or "Valid is finite, with variances that are not negative, and not above max_speed."


def _counts_in_words(counts: Any) -> str:
    return ", ".join(f"{value} {name}" for name, value in counts.items() if value) or "none received"


def replay_document(replayed: Replayed, models: Sequence[str]) -> dict[str, Any]:
    """Return plain data of a replay for the requested models. Segments are in s since the first DVL sample."""
    result = replayed.result
    estimated = [name for name in models if name in result.estimates]
    segments = []
    if result.first_ns is not None and result.last_ns is not None:
        ends = [segment.from_ns for segment in result.segments[1:]] + [result.last_ns]
        segments = [
            {
                "from_s": (segment.from_ns - result.first_ns) * 1e-9,
                "to_s": (end - result.first_ns) * 1e-9,
                "model": segment.model,
            }
            for segment, end in zip(result.segments, ends, strict=True)
        ]
    return {
        "models": {name: estimate_document(result.estimates[name]) for name in estimated},
        "verification": {name: verification_document(result.verifications[name]) for name in estimated},
        "selected": segments,
        **days_document(result),
        "counts": {name: dict(counts) for name, counts in result.counts.items()},
        "parameters": dict(result.parameters),
        "version": __version__,
        "dvl": {"type": replayed.dvl_type, "turned_from_frd": replayed.turned},
        "findings": [found.as_dict() for found in replayed.findings],
        "recordings": None if replayed.recordings is None else comparison_document(replayed.recordings),
        "navigation": navigation_document(replayed.navigation),
        **({} if replayed.water is None else {"water": water_document(replayed.water)}),
    }
