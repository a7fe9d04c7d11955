"""Calibration with recorded bags by the node's estimator, and its JSON document."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.assessment.dead_reckoning import Navigation, doubts, navigation_document, objections
from ..calibration.assessment.manoeuvre_planner import drift_left_open
from ..calibration.calibrator import Calibrator
from ..calibration.checks.data_warnings import gate_warnings, message_warnings, recording_warnings, reference_warnings
from ..calibration.checks.speed_of_sound import CauseOfScale, Water, cause_of_scale, water_document
from ..calibration.comparison.mounting_change import Comparison
from ..calibration.comparison.mounting_change_reasons import comparison_document
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import ENU_FROM_NED, Array, rotation_from_quaternion
from ..calibration.numerics.samples import FRAME_CODES, AlignedBlock, SampleBlock, Stream, VelocityFrame, no_samples
from ..calibration.results.extrinsics import Extrinsics, dvl_in_words, extrinsics_of, rejection
from ..calibration.results.held_out_verification import verification_document
from ..calibration.results.results import Day, Result
from ..calibration.streams.screening import are_valid_velocities, unit_quaternions
from ..calibration.streams.stream_order import SHORTEST_PAUSE_NS
from ..errors import InputError
from ..files.result_file import days_document, estimate_document, load_initial_calibration
from ..messages.decode import MessageDecoder
from ..messages.drivers import TWIST_TYPE
from ..recordings.recording import Recording, open_recording
from ..recordings.requirements import check_topics, missing_imu
from ..recordings.topics import Topics
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding, of_consequence
from ..version import __version__
from .run_history import Recorder, RunHistory

# samples per update of the models; larger arrays do not fit the processor's caches
BLOCK_SIZE = 2048


@dataclass(frozen=True)
class Replayed:
    """Result of a replay.

    notes: all messages to the user, including the findings. history: estimates over time, if requested.
    reference_frame: of the reference's messages, None without any. dvl_frame: frame_id of the DVL. dvl_type: message
    type of its topic. turned: whether its data were converted from forward-right-down. recordings: comparison of
    several recordings; None without one. pause_s: time between recordings within the first to the last sample.
    navigation: dead reckoning without and with the selected model's correction, on held-out data; None without a
    reference. water: its properties in the recording, if any.
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
        return self.dvl_type + (", turned from forward-right-down to forward-left-up" if self.turned else "")

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
        with suppress(OSError, AttributeError):  # another C library; glibc keeps an additional megabyte per recording
            ctypes.CDLL(None).malloc_trim(0)
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

    on_progress: receives the share (0..1) read. with_history: collect a `RunHistory`; else on_rows receives the aligned
    rows and on_restart is called, as by `Calibrator`. judged: verify on held-out data, including dead reckoning.
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
    found += [each.weighed(Severity.WARNING) for each in against]
    of_drift = objections(navigation, drift_left_open(result.estimate, calibrator.parameters))
    of_all = calibrator.clock_objections(fresh=True) + [
        each for each in against if each.severity is not Severity.WARNING
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
        own = [
            path.name
            for path, span_ns in zip(recording.paths, recording.path_spans_ns, strict=True)
            if span_ns is not None and span_ns[0] - SHORTEST_PAUSE_NS <= day.first_ns <= span_ns[1]
        ]
        names.append(own[0] if own else "")
    if len(set(names)) < len(days) or not all(names):
        return tuple(days)
    return tuple(replace(day, name=name) for day, name in zip(days, names, strict=True))


def extrinsics_of_replay(replayed: Replayed, name: str) -> Extrinsics | None:
    """Return the selected model's estimate for a comparison; None if it used no sample."""
    result = replayed.result
    estimate, judged = result.estimate, result.verifications.get(result.selected)
    if not estimate.used or result.first_ns is None or result.last_ns is None:
        return None
    rejected = "" if judged is None else rejection(each.as_dict() for each in judged.reasons)
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
            f"prior_source reference: topic {topics.gnss} has no velocity that can be turned into the body frame in "
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
    turned = np.matmul(enu[:, None], rotation_enu_from_body)[:, 0]
    velocity: Array = np.where(is_body[:, None], reference.values, turned)[is_body | (before >= 0)]
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
    return found + reference_warnings(result.estimate, result.own_days)


def _refusal_advice(decoder: MessageDecoder, counts: Mapping[str, int]) -> str:
    """Return what is known about refused DVL messages."""
    known = [str(found) for kind, found in decoder.problems.items() if kind.startswith("dvl")]
    known += map(str, decoder.dvl_type.advice(counts))
    return ". ".join(known) or "Valid is finite, with variances that are not negative, and not above max_speed."


def _counts_in_words(counts: Any) -> str:
    return ", ".join(f"{value} {name}" for name, value in counts.items() if value) or "none received"


def replay_document(replayed: Replayed, models: Sequence[str]) -> dict[str, Any]:
    """Return plain data of a replay for the requested models. Segments are in s since the first DVL sample."""
    result = replayed.result
    told = [name for name in models if name in result.estimates]
    segments = []
    with suppress(TypeError):  # no sample at all: first_ns is None and there are no segments
        ends = [segment.from_ns for segment in result.segments[1:]] + [result.last_ns]
        segments = [
            {
                "from_s": (segment.from_ns - result.first_ns) * 1e-9,  # type: ignore[operator]
                "to_s": (end - result.first_ns) * 1e-9,  # type: ignore[operator]
                "model": segment.model,
            }
            for segment, end in zip(result.segments, ends, strict=True)
        ]
    return {
        "models": {name: estimate_document(result.estimates[name]) for name in told},
        "verification": {name: verification_document(result.verifications[name]) for name in told},
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
