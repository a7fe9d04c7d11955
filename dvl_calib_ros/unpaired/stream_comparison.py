"""Comparison of both sides' streams: leaked truth, outliers, dropouts, repeats, rate, jitter, latency."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..calibration.streams.outliers import deviation_from_neighbours, neighbours
from ..diagnosis.model.stream_curve import FAST_ENOUGH_S
from .both_sides import DITHER_MPS, Log
from .results import Triple
from .stream_properties import DROPOUT_INTERVALS
from .welch_tests import BLOCK, FEWEST_BLOCKS, Candidate, mean_of, shares_of, welch

# outliers are beyond this number of standard deviations
OUTLIER = 7.0
# smaller differences are irrelevant: rate (relative), jitter and latency (s)
RATE_SHARE, JITTER_S, LATENCY_S = 0.03, 0.002, 0.01


def compare_streams(vehicle: Log, simulator: Log) -> list[Candidate]:
    """Compare all properties observable on both sides."""
    functions = (_exact, _outliers, _dropouts, _zeros, _repeats, _rate, _jitter, _latency)
    found = [function(vehicle, simulator) for function in functions]
    return [each for each in found if each is not None]


def _outliers(vehicle: Log, simulator: Log) -> Candidate | None:
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
    off = deviation_from_neighbours(values)
    scale = np.maximum(robust_std(off), DITHER_MPS)
    size = (np.abs(off) / scale).max(axis=1)
    return int(np.count_nonzero((size > OUTLIER) & (size > neighbours(size))))


def _exact(vehicle: Log, simulator: Log) -> Candidate | None:
    """Detect leaked ground truth: a DVL without noise, or with the noise of its reference."""
    leaks = [log.exact or log.copied for log in (vehicle, simulator)]
    if not any(leaks):
        return None
    how = "without any noise" if simulator.exact or vehicle.exact else "with the noise of its own reference"
    who = "the simulator's" if leaks[1] else "the vehicle's"
    shown: list[Triple] = [(float(leak),) * 3 for leak in leaks]
    p = 0.0 if leaks[0] != leaks[1] else 1.0
    return Candidate("truth_leaks", "yes", shown[0], shown[1], p, (leaks[0], leaks[1]), note=f"{who} DVL is {how}")


def _dropouts(vehicle: Log, simulator: Log) -> Candidate | None:
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
    if vehicle.exact or simulator.exact:
        return None  # at a constant velocity the truth repeats itself
    counts = [(sum(f.repeats for f in log.facts), sum(f.received for f in log.facts)) for log in (vehicle, simulator)]
    return shares_of("repeats", counts[0], counts[1])


def _rate(vehicle: Log, simulator: Log) -> Candidate | None:
    rates = [1.0 / float(np.median([f.interval for f in log.facts])) for log in (vehicle, simulator)]
    if not np.isfinite(rates).all():
        return None
    apart = abs(rates[0] / rates[1] - 1.0)
    shown: list[Triple] = [(rate, rate * (1.0 - 0.5 * RATE_SHARE), rate * (1.0 + 0.5 * RATE_SHARE)) for rate in rates]
    return Candidate("rate", "Hz", shown[0], shown[1], 0.0 if apart > RATE_SHARE else 1.0, matters=apart > RATE_SHARE)


def _jitter(vehicle: Log, simulator: Log) -> Candidate | None:
    def of(log: Log) -> Array:
        return np.concatenate([_blocks(_usual(f.steps), lambda b: np.std(b, axis=1)) for f in log.facts])

    return _times("jitter", of(vehicle), of(simulator), JITTER_S)


def _usual(steps: Array) -> Array:
    """Return the steps between stamps that are no gap."""
    usual = float(np.median(steps)) if len(steps) else 0.0
    return steps[steps < DROPOUT_INTERVALS * usual]


def _latency(vehicle: Log, simulator: Log) -> Candidate | None:
    def of(log: Log) -> Array:
        return np.concatenate([_blocks(f.latency, lambda b: np.median(b, axis=1)) for f in log.facts])

    return _times("latency", of(vehicle), of(simulator), LATENCY_S)


def _blocks(values: Array, of: Callable[[Array], Array]) -> Array:
    blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
    return of(blocks) if len(blocks) else np.zeros(0)


def _times(name: str, vehicle: Array, simulator: Array, worth: float) -> Candidate | None:
    if min(len(vehicle), len(simulator)) < FEWEST_BLOCKS:
        return None
    shown: list[Triple] = [tuple(mean_of(each).tolist()) for each in (vehicle, simulator)]  # type: ignore[misc]
    there = tuple(abs(float(each.mean())) > worth for each in (vehicle, simulator))
    apart = abs(float(vehicle.mean() - simulator.mean()))
    return Candidate(
        name, "s", shown[0], shown[1], welch(vehicle, simulator), (there[0], there[1]), matters=apart > worth
    )
