"""The two sides of a comparison: recordings of a vehicle or of a simulator, each diagnosed by itself.

Their streams are compared here: leaked truth, outliers, dropouts, repeats, rate, jitter, latency.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import fisher_exact, t

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..calibration.numerics.samples import SampleBlock, Stamps
from ..calibration.streams.outliers import deviation_from_neighbours, neighbours
from ..diagnosis.answer.results import Diagnosis
from ..diagnosis.answer.simulated_twin import simulated, with_denoised_reference
from ..diagnosis.diagnose import diagnose_recordings
from ..diagnosis.model.recorded_streams import RecordedStreams, load_recordings, zeros_while_moving
from ..diagnosis.model.stream_curve import FAST_ENOUGH_S, Curve
from ..diagnosis.search.effect_selection import EffectSelection
from ..messages.decode import MessageDecoder
from ..recordings.recording import Recording
from ..recordings.recording import Recording as Opened
from ..recordings.topics import Topics
from .results import Triple

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
    return facts_of(streams.dvl, streams.reference, columns.log_ns)


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


# Comparison of both sides' streams: leaked truth, outliers, dropouts, repeats, rate, jitter, latency.

# Noise properties of both sides, and tests to compare them.

# samples per block, and smallest number of blocks for a level
BLOCK, FEWEST_BLOCKS = 40, 4


@dataclass(frozen=True)
class Candidate:
    """A noise property of both sides, and the p-value of equality before correction for multiple tests.

    vehicle, simulator: value and ends of its 95 per cent interval, in `unit`.

    there: whether vehicle and simulator have it; true for a level. matters: whether the difference is large enough to
    be claimed.
    """

    name: str
    unit: str
    vehicle: Triple
    simulator: Triple
    p: float
    there: tuple[bool, bool] = (True, True)
    matters: bool = True
    note: str = ""


def mean_of(values: Array) -> Triple:
    """Return the mean of values (N,) and the ends of its 95 per cent interval."""
    reach = t.ppf(0.975, max(len(values) - 1, 1)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return float(values.mean()), float(values.mean() - reach), float(values.mean() + reach)


def welch(one: Array, other: Array) -> float:
    """Return the p-value of equal means of two samples with any scatter."""
    a, b = (float(values.var(ddof=1)) / len(values) for values in (one, other))
    if a + b <= 0.0:
        return 1.0 if one.mean() == other.mean() else 0.0
    dof = (a + b) ** 2 / (a**2 / (len(one) - 1) + b**2 / (len(other) - 1))
    return float(2.0 * t.sf(abs(one.mean() - other.mean()) / np.sqrt(a + b), dof))


def shares_of(name: str, vehicle: tuple[int, int], simulator: tuple[int, int]) -> Candidate | None:
    """Compare the shares of events of two sides, each given as (number of events, number of samples)."""
    (vehicle_events, vehicle_samples), (simulator_events, simulator_samples) = vehicle, simulator
    if not vehicle_samples or not simulator_samples or vehicle_events + simulator_events == 0:
        return None
    p = float(fisher_exact([[events, max(samples - events, 0)] for events, samples in (vehicle, simulator)])[1])
    # one or two events are not systematic
    return Candidate(name, "share", _share(*vehicle), _share(*simulator), p, (vehicle_events > 2, simulator_events > 2))


def _share(count: int, n: int) -> Triple:
    """Return the share of `count` in `n` and the ends of its 95 per cent interval."""
    value = count / n
    half = 1.96 * np.sqrt(max(value * (1.0 - value), 0.25 / n) / n)
    return value, max(0.0, value - half), min(1.0, value + half)


# outliers are beyond this number of standard deviations
OUTLIER = 7.0
# smaller differences are irrelevant: rate (relative), jitter and latency (s)
RATE_SHARE, JITTER_S, LATENCY_S = 0.03, 0.002, 0.01


def compare_streams(vehicle: Log, simulator: Log) -> list[Candidate]:
    """Compare all properties observable on both sides."""
    has_noise = not (vehicle.exact or simulator.exact)  # at a constant velocity the truth repeats itself
    found = [
        _exact(vehicle, simulator),
        _outliers(vehicle, simulator),
        _events("dropouts", vehicle, simulator, lambda facts: facts.missing + facts.refused),
        _events("zeros_on_dropout", vehicle, simulator, lambda facts: facts.zero),  # sent as a velocity of zero
        _events("repeats", vehicle, simulator, lambda facts: facts.repeats) if has_noise else None,
        _rate(vehicle, simulator),
        _times("jitter", vehicle, simulator, lambda facts: _usual(facts.steps), np.std, JITTER_S),
        _times("latency", vehicle, simulator, lambda facts: facts.latency, np.median, LATENCY_S),
    ]
    return [candidate for candidate in found if candidate is not None]


def _outliers(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the shares of outliers: spikes of a fast stream, otherwise large residuals."""
    counts = []
    for log in (vehicle, simulator):
        far = n = 0
        for facts, recording, residual in zip(log.facts, log.recordings, log.residuals, strict=False):
            if recording.dvl.interval <= FAST_ENOUGH_S:
                far, n = far + _spikes(facts.values), n + len(facts.values)
            else:
                size = np.abs(residual) / np.maximum(robust_std(residual), 1e-9)
                far, n = far + int((size > 2.0 * OUTLIER).any(axis=1).sum()), n + len(residual)
                far, n = far + recording.spikes, n + recording.spikes  # already excluded
        counts.append((far, n))
    return shares_of("outliers", counts[0], counts[1])


def _spikes(values: Array) -> int:
    """Count samples far from the prediction by four neighbours, and farther than these."""
    if len(values) < 10:
        return 0
    deviation = deviation_from_neighbours(values)
    scale = np.maximum(robust_std(deviation), DITHER_MPS)
    size = (np.abs(deviation) / scale).max(axis=1)
    return int(np.count_nonzero((size > OUTLIER) & (size > neighbours(size))))


def _exact(vehicle: Log, simulator: Log) -> Candidate | None:
    """Detect leaked ground truth: a DVL without noise, or with the noise of its reference."""
    leaks = [log.exact or log.copied for log in (vehicle, simulator)]
    if not any(leaks):
        return None
    how = "without any noise" if simulator.exact or vehicle.exact else "with the noise of its own reference"
    who = "the simulator's" if leaks[1] else "the vehicle's"
    values: list[Triple] = [(float(leak),) * 3 for leak in leaks]
    p = 0.0 if leaks[0] != leaks[1] else 1.0
    return Candidate("truth_leaks", "yes", values[0], values[1], p, (leaks[0], leaks[1]), note=f"{who} DVL is {how}")


def _events(name: str, vehicle: Log, simulator: Log, events: Callable[[StreamFacts], int]) -> Candidate | None:
    """Compare the shares of messages with an event."""
    vehicle_counts, simulator_counts = (
        (sum(map(events, log.facts)), sum(facts.received for facts in log.facts)) for log in (vehicle, simulator)
    )
    return shares_of(name, vehicle_counts, simulator_counts)


def _rate(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the sample rates, Hz; None if one is unknown."""
    rates = [1.0 / float(np.median([f.interval for f in log.facts])) for log in (vehicle, simulator)]
    if not np.isfinite(rates).all():
        return None
    change = abs(rates[0] / rates[1] - 1.0)
    spans: list[Triple] = [(rate, rate * (1.0 - 0.5 * RATE_SHARE), rate * (1.0 + 0.5 * RATE_SHARE)) for rate in rates]
    return Candidate("rate", "Hz", spans[0], spans[1], 0.0 if change > RATE_SHARE else 1.0, matters=change > RATE_SHARE)


def _usual(steps: Array) -> Array:
    """Return the steps between stamps that are no gap."""
    interval = float(np.median(steps)) if len(steps) else 0.0
    return steps[steps < DROPOUT_INTERVALS * interval]


def _times(
    name: str,
    vehicle: Log,
    simulator: Log,
    times: Callable[[StreamFacts], Array],
    statistic: Callable[..., Array],
    threshold_s: float,
) -> Candidate | None:
    """Compare the means over blocks of a statistic of times, s; differences below a threshold do not matter."""

    def block_values(log: Log) -> Array:
        blocks = [values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK) for values in map(times, log.facts)]
        return np.concatenate([statistic(block, axis=1) for block in blocks])

    of_vehicle, of_simulator = block_values(vehicle), block_values(simulator)
    if min(len(of_vehicle), len(of_simulator)) < FEWEST_BLOCKS:
        return None
    is_present = abs(float(of_vehicle.mean())) > threshold_s, abs(float(of_simulator.mean())) > threshold_s
    matters = abs(float(of_vehicle.mean() - of_simulator.mean())) > threshold_s
    p = welch(of_vehicle, of_simulator)
    return Candidate(name, "s", mean_of(of_vehicle), mean_of(of_simulator), p, is_present, matters)
