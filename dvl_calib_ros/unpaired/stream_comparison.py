"""Comparison of both sides' streams: leaked truth, outliers, dropouts, repeats, rate, jitter, latency."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import fisher_exact, t

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..calibration.streams.outliers import deviation_from_neighbours, neighbours
from ..diagnosis.model.stream_curve import FAST_ENOUGH_S
from .both_sides import DITHER_MPS, DROPOUT_INTERVALS, Log
from .results import Triple

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
    functions = (_exact, _outliers, _dropouts, _zeros, _repeats, _rate, _jitter, _latency)
    found = [function(vehicle, simulator) for function in functions]
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


def _dropouts(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the shares of missing and refused messages."""
    counts = [
        (sum(f.missing + f.refused for f in log.facts), sum(f.received for f in log.facts))
        for log in (vehicle, simulator)
    ]
    return shares_of("dropouts", counts[0], counts[1])


def _zeros(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare dropouts sent as a velocity of zero."""
    counts = [(sum(f.zero for f in log.facts), sum(f.received for f in log.facts)) for log in (vehicle, simulator)]
    return shares_of("zeros_on_dropout", counts[0], counts[1])


def _repeats(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the shares of repeated samples; None for a DVL without noise."""
    if vehicle.exact or simulator.exact:
        return None  # at a constant velocity the truth repeats itself
    counts = [(sum(f.repeats for f in log.facts), sum(f.received for f in log.facts)) for log in (vehicle, simulator)]
    return shares_of("repeats", counts[0], counts[1])


def _rate(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the sample rates, Hz; None if one is unknown."""
    rates = [1.0 / float(np.median([f.interval for f in log.facts])) for log in (vehicle, simulator)]
    if not np.isfinite(rates).all():
        return None
    change = abs(rates[0] / rates[1] - 1.0)
    spans: list[Triple] = [(rate, rate * (1.0 - 0.5 * RATE_SHARE), rate * (1.0 + 0.5 * RATE_SHARE)) for rate in rates]
    return Candidate("rate", "Hz", spans[0], spans[1], 0.0 if change > RATE_SHARE else 1.0, matters=change > RATE_SHARE)


def _jitter(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the standard deviation of the steps between stamps, s."""

    def std_of_steps(log: Log) -> Array:
        return np.concatenate([_blocks(_usual(f.steps), lambda b: np.std(b, axis=1)) for f in log.facts])

    return _compare_times("jitter", std_of_steps(vehicle), std_of_steps(simulator), JITTER_S)


def _usual(steps: Array) -> Array:
    """Return the steps between stamps that are no gap."""
    interval = float(np.median(steps)) if len(steps) else 0.0
    return steps[steps < DROPOUT_INTERVALS * interval]


def _latency(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare the median delay from stamp to log time, s."""

    def latency_of(log: Log) -> Array:
        return np.concatenate([_blocks(f.latency, lambda b: np.median(b, axis=1)) for f in log.facts])

    return _compare_times("latency", latency_of(vehicle), latency_of(simulator), LATENCY_S)


def _blocks(values: Array, statistic: Callable[[Array], Array]) -> Array:
    blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
    return statistic(blocks) if len(blocks) else np.zeros(0)


def _compare_times(name: str, vehicle: Array, simulator: Array, threshold_s: float) -> Candidate | None:
    """Compare the means of block values (B,) s of both sides; differences below a threshold do not matter."""
    if min(len(vehicle), len(simulator)) < FEWEST_BLOCKS:
        return None
    is_present = abs(float(vehicle.mean())) > threshold_s, abs(float(simulator.mean())) > threshold_s
    matters = abs(float(vehicle.mean() - simulator.mean())) > threshold_s
    p = welch(vehicle, simulator)
    return Candidate(name, "s", mean_of(vehicle), mean_of(simulator), p, is_present, matters)
