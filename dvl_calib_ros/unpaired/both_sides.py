"""The two sides of a comparison: recordings of a vehicle or of a simulator, each diagnosed by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import SampleBlock, Stamps
from ..diagnosis.answer.results import Diagnosis
from ..diagnosis.answer.simulated_twin import simulated, with_denoised_reference
from ..diagnosis.diagnose import diagnose_recordings
from ..diagnosis.model.recorded_streams import RecordedStreams, load_recordings, zeros_while_moving
from ..diagnosis.model.stream_curve import Curve
from ..diagnosis.search.effect_selection import EffectSelection
from ..messages.decode import MessageDecoder
from ..recordings.recording import Recording
from ..recordings.recording import Recording as Opened
from ..recordings.topics import Topics

# Model-free properties of a DVL's messages: rate, jitter, latency, dropouts.

# log times further from the stamps belong to another clock (simulated time), so the latency is unknown, s
OTHER_CLOCK_S = 60.0
# longer intervals, in typical ones, are dropouts
DROPOUT_INTERVALS = 1.6


@dataclass(frozen=True)
class StreamFacts:
    """Properties of one recording's DVL messages, N in order of stamps.

    steps: (N - 1,) s between stamps.
    latency: (N,) s from stamp to log time; empty if these are of different clocks.
    values: (N, 3) m/s of valid messages, without zeros while moving.
    received: number of messages.
    missing, refused, zero: number of events (runs) of missing messages, of messages marked invalid, of exact zeros
      while moving.
    lost: number of samples in all of these.
    repeats: valid messages that repeat the previous velocity exactly.
    """

    steps: Array
    latency: Array
    values: Array
    received: int
    missing: int
    refused: int
    zero: int
    lost: int
    repeats: int

    @property
    def interval(self) -> float:
        """Return the typical time between stamps, s."""
        return float(np.median(self.steps)) if len(self.steps) else np.nan


def stream_facts(recording: Recording, parameters: Parameters, topics: Topics) -> StreamFacts:
    """Return the properties of one recording's DVL stream."""
    chosen = topics.found_in(recording.types)
    streams = recording.streams(chosen, MessageDecoder(recording.of_types(chosen, parameters)))
    (columns,) = recording.columns[chosen.dvl]
    return facts_of(streams.dvl, streams.reference, columns.arrivals[1])


def facts_of(dvl: SampleBlock, reference: SampleBlock, log_ns: Stamps) -> StreamFacts:
    """Compute from all messages of a DVL and of its reference, in order of arrival; log_ns: (N,) of the DVL's."""
    refused = dvl.refused > 0
    order = np.argsort(reference.stamps_ns, kind="stable")
    zero = zeros_while_moving(dvl, reference.part(order)) & ~refused
    finite = np.isfinite(dvl.values).all(axis=1)
    valid = np.flatnonzero(~refused & ~zero & finite)
    stamps = np.sort(dvl.stamps_ns[~refused])
    steps = 1e-9 * np.diff(stamps)
    steps = steps[steps > 0.0]
    interval = float(np.median(steps)) if len(steps) else np.nan
    gaps = steps[steps > DROPOUT_INTERVALS * interval] if len(steps) else steps
    latency = 1e-9 * (log_ns - dvl.stamps_ns)[valid] if len(log_ns) == len(dvl) else np.zeros(0)
    if len(latency) and abs(float(np.median(latency))) > OTHER_CLOCK_S:
        latency = np.zeros(0)
    values = dvl.values[valid]
    n_in_gaps = int(np.rint(gaps / interval - 1.0).sum()) if len(gaps) else 0
    return StreamFacts(
        steps=steps,
        latency=latency,
        values=values,
        received=len(dvl),
        missing=len(gaps) if not refused.any() else 0,
        refused=_runs(refused),
        zero=_runs(zero),
        lost=max(n_in_gaps, int(refused.sum())) + int(zero.sum()),
        repeats=int((np.diff(values, axis=0) == 0.0).all(axis=1).sum()),
    )


def _runs(mask: NDArray[np.bool_]) -> int:
    """Return the number of runs of true values."""
    return int(np.count_nonzero(np.diff(mask.astype(int), prepend=0) > 0))


# a DVL with less noise (m/s) is a simulator's truth: the resolution of a real one is 1 mm/s
NOISE_FREE_MPS = 2e-4
# noise added to such a DVL, so that interpolation errors are not mistaken for an effect: a DVL's resolution
DITHER_MPS = 1e-3
# a DVL that follows its reference with less than this share of its own noise is a copy with the same noise
COPIED = 0.3


@dataclass(frozen=True)
class RecordedSide:
    """Recordings of one side, and how to read them."""

    opened: Opened
    parameters: Parameters
    topics: Topics


@dataclass(frozen=True)
class Log:
    """Diagnosis of one side.

    residuals: (N, 3) m/s per recording, recorded DVL velocity minus the fitted model's, DVL frame, at the DVL's stamps.
    exact: the DVL has no noise of its own.
    copied: it has the noise of its reference.
    """

    diagnosis: Diagnosis
    recordings: tuple[RecordedStreams, ...]
    facts: tuple[StreamFacts, ...]
    residuals: tuple[Array, ...]
    exact: bool
    copied: bool

    @property
    def selection(self) -> EffectSelection | None:
        """Return the fits behind the diagnosis; None without any."""
        return self.diagnosis.selection


def read_log(
    source: RecordedSide, on_progress: Callable[[float], None] = lambda _: None, with_series: bool = False
) -> Log:
    """Read and diagnose one side. Raises InputError if it cannot be compared."""
    loaded = load_recordings(source.opened, source.parameters, source.topics)
    facts = tuple(stream_facts(part, source.parameters, source.topics) for part in source.opened.each)
    on_progress(0.5)
    exact = all(float(np.linalg.norm(recording.dvl.roughness)) < NOISE_FREE_MPS for recording in loaded.recordings)
    recordings = tuple(dithered(recording) for recording in loaded.recordings) if exact else loaded.recordings
    diagnosis = diagnose_recordings(recordings, source.parameters, loaded.notes, with_series=with_series)
    on_progress(1.0)
    residuals: tuple[Array, ...] = ()
    if diagnosis.selection is not None:
        residuals = dvl_residuals(diagnosis.selection)
        recordings = diagnosis.selection.fitter.problem.recordings  # without rejected samples
    return Log(diagnosis, recordings, facts, residuals, exact, not exact and is_copied(recordings, residuals))


def dithered(recording: RecordedStreams) -> RecordedStreams:
    """Return the recording with white noise added to its DVL, the same at every call."""
    dvl = recording.dvl
    noise = DITHER_MPS * np.random.default_rng(0).standard_normal(dvl.values.shape)
    return replace(recording, dvl=Curve(dvl.time, dvl.values + noise, dvl.reported, sample_std=dvl.sample_std))


def dvl_residuals(selection: EffectSelection) -> tuple[Array, ...]:
    """Return (N, 3) m/s per recording: recorded minus fitted, DVL frame, with a noise-free reference."""
    problem = with_denoised_reference(selection.fitter.problem)
    return tuple(
        recording.dvl.values - simulated(problem, selection.fit.hypothesis, index)
        for index, recording in enumerate(problem.recordings)
    )


def is_copied(recordings: Sequence[RecordedStreams], residuals: Sequence[Array]) -> bool:
    """Return whether the DVL's residual has much less noise than the DVL itself, which then shares its reference's."""
    if not residuals:
        return False
    deviations = [
        float(np.linalg.norm(Curve(one.dvl.time, r).roughness)) for one, r in zip(recordings, residuals, strict=True)
    ]
    roughness = [float(np.linalg.norm(one.dvl.roughness)) for one in recordings]
    return all(one < COPIED * other for one, other in zip(deviations, roughness, strict=True))
