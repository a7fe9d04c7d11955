"""The noise of both sides: level per axis, growth, tails, outliers, dropouts, repeats, rate, jitter, latency, colour.

The level of a DVL that is fast enough is what its samples show against their own neighbours, to which motion and
reference are nothing; that of a slow one is of its residual, in which the reference's noise is too. Levels are compared
over blocks of as many samples on both sides, so whatever the noise's distribution is, it is in the scatter of blocks.
(Long, because each kind of noise has its own estimate.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import fisher_exact, median_abs_deviation, norm, t

from ..calibration.frames import Array
from ..diagnosis.noise_findings import NoiseFinding
from ..diagnosis.recordings import FAST_ENOUGH_S
from ..diagnosis.where import regimes
from ..effects.base import EffectInput
from .logs import DITHER_MPS, Log
from .results import Triple

# Samples of a block, and blocks that a level needs
BLOCK, FEWEST_BLOCKS = 40, 4
# Levels that are closer than this do not matter
WORTH_TELLING = 1.15
# Outliers: beyond so many standard deviations; tails: beyond so many, and no outlier
OUTLIER, TAIL = 7.0, 3.7
# Rates that differ by less, relative; jitter and latency that do, s
RATE_SHARE, JITTER_S, LATENCY_S = 0.03, 0.002, 0.01
# A vehicle that goes astern so often shows what its noise does then
ASTERN_SHARE, ASTERN_MPS = 0.05, 0.1
# Growth of the noise is of the logarithm: these are compared where one side shows them at this level
GROWS = 1e-4
# Standard deviations of speed, m/s, turn rate, rad/s, and speed astern, m/s, over which a growth can be seen
SPREAD = {"speed": 0.1, "turn_rate": 0.01, "astern": 0.05}


@dataclass(frozen=True)
class Candidate:
    """A property on both sides, with the p of both being alike, not adjusted yet. claims: whether it may be claimed.

    there: whether vehicle and simulator have any of it; of a level, both.
    """

    name: str
    unit: str
    vehicle: Triple
    simulator: Triple
    p: float
    there: tuple[bool, bool] = (True, True)
    matters: bool = True
    note: str = ""


@dataclass(frozen=True)
class Scatter:
    """Samples of one recording's noise. values: (N, 3) m/s, white if the DVL's noise is, of its standard deviation.

    speed, turn_rate, ahead: (N,) of the motion at the samples. thin: every so many are independent.
    """

    values: Array
    motion: EffectInput
    thin: int
    of_reference: float


def compare_noise(vehicle: Log, simulator: Log) -> list[Candidate]:
    """All properties that both sides show."""
    found: list[Candidate | None] = [_exact(vehicle, simulator)]
    both = [scatter(log) for log in (vehicle, simulator)]
    if all(both) and not (vehicle.exact or simulator.exact):
        found += [_level(both[0], both[1], axis) for axis in range(3)]
        found += _growth(both[0], both[1])
        found += [_tails(both[0], both[1])]
    found += [_outliers(vehicle, simulator), _colour(vehicle, simulator)]
    found += [_dropouts(vehicle, simulator), _zeros(vehicle, simulator), _repeats(vehicle, simulator)]
    found += [_rate(vehicle, simulator), _jitter(vehicle, simulator), _latency(vehicle, simulator)]
    return [each for each in found if each is not None]


# ------------------------------------------------------------------ level


def scatter(log: Log) -> list[Scatter]:
    """The noise of the samples of each recording; empty where there are too few."""
    if log.selection is None:
        return []
    problem, hypothesis = log.selection.fitter.problem, log.selection.fit.hypothesis
    found = []
    for index, (recording, residual) in enumerate(zip(log.recordings, log.residuals, strict=True)):
        dvl = recording.dvl
        if dvl.interval <= FAST_ENOUGH_S:
            values, inner, norm_of = _differences(dvl.time, dvl.values, dvl.interval, (1.0, -4.0, 6.0, -4.0, 1.0))
            of_reference, thin = 0.0, 5
        else:
            values, inner, norm_of = _differences(dvl.time, residual, dvl.interval, (1.0, -2.0, 1.0))
            of_reference, thin = float(np.mean(recording.reference.noise)), 3
        if len(values) < FEWEST_BLOCKS * BLOCK:
            continue
        motion = problem.seen(hypothesis, index, dvl.time[inner]).motion
        found.append(Scatter(values / norm_of, motion, thin, of_reference))
    return found


def _differences(
    time: Array, values: Array, interval: float, weights: Sequence[float]
) -> tuple[Array, NDArray[np.intp], float]:
    """Differences (K, 3) of neighbours without a gap, the middle sample of each, and their norm for white noise."""
    w, reach = np.array(weights), len(weights) // 2
    n = len(time) - 2 * reach
    if n < 1:
        return np.zeros((0, values.shape[1])), np.zeros(0, dtype=np.intp), 1.0
    inner = np.arange(reach, reach + n)
    sums = np.sum([each * values[k : k + n] for k, each in enumerate(w)], axis=0)
    near = np.abs(time[2 * reach :] - time[:n] - 2 * reach * interval) < 0.5 * interval
    return sums[near], inner[near], float(np.sqrt(w @ w))


def block_levels(scattered: Sequence[Scatter], axis: int) -> Array:
    """(B,) log standard deviation of one axis in blocks of as many samples."""
    levels = []
    for each in scattered:
        values = each.values[:, axis]
        blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
        levels.append(np.log(np.maximum(np.median(np.abs(blocks), axis=1) / norm.ppf(0.75), 1e-9)))
    return np.concatenate(levels)


def _level(vehicle: Sequence[Scatter], simulator: Sequence[Scatter], axis: int) -> Candidate | None:
    """Level of one axis of the DVL. What of a slow DVL may be the reference's is given the benefit of the doubt."""
    blocks = [block_levels(side, axis) for side in (vehicle, simulator)]
    if min(map(len, blocks)) < FEWEST_BLOCKS:
        return None
    of_reference = [max(each.of_reference for each in side) for side in (vehicle, simulator)]
    intervals = []
    for levels, reference in zip(blocks, of_reference, strict=True):
        value, low, high = np.exp(_mean(levels))
        intervals.append((float(value), float(np.sqrt(max(low**2 - reference**2, 0.0))), float(high)))
    larger = 0 if intervals[0][0] >= intervals[1][0] else 1
    own_levels = [np.asarray(each) for each in blocks]
    if of_reference[larger] > 0.0:
        own = np.exp(2.0 * own_levels[larger]) - of_reference[larger] ** 2
        own_levels[larger] = 0.5 * np.log(np.maximum(own, 1e-12))
    ratio = float(np.exp(own_levels[larger].mean() - own_levels[1 - larger].mean()))
    note = "DVL and reference together" if max(of_reference) > 0.0 else ""
    return Candidate(
        f"level_{'xyz'[axis]}", "m/s", intervals[0], intervals[1], _welch(own_levels[0], own_levels[1]),
        matters=ratio > WORTH_TELLING, note=note,
    )  # fmt: skip


def _mean(values: Array) -> Array:
    """(3,) mean and its 95 per cent interval."""
    reach = t.ppf(0.975, max(len(values) - 1, 1)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return np.array([values.mean(), values.mean() - reach, values.mean() + reach])


def _welch(one: Array, other: Array) -> float:
    """p of two samples having one mean, whatever their scatter."""
    a, b = (float(each.var(ddof=1)) / len(each) for each in (one, other))
    if a + b <= 0.0:
        return 1.0 if one.mean() == other.mean() else 0.0
    dof = (a + b) ** 2 / (a**2 / (len(one) - 1) + b**2 / (len(other) - 1))
    return float(2.0 * t.sf(abs(one.mean() - other.mean()) / np.sqrt(a + b), dof))


def levels_by_regime(log: Log) -> dict[str, float]:
    """Regime of motion -> m/s, root of the sum of squares over the axes of the noise's level there."""
    scattered = scatter(log)
    if not scattered or log.selection is None:
        return {}
    problem = log.selection.fitter.problem
    values = np.concatenate([each.values for each in scattered])

    class _AtSamples:
        def __init__(self, motion: EffectInput) -> None:
            self.motion = motion

    seen = [_AtSamples(each.motion) for each in scattered]
    masks = {"all": np.ones(len(values), dtype=bool)} | regimes(problem, seen, per_sample=True)  # type: ignore[arg-type]
    return {
        name: float(np.linalg.norm(median_abs_deviation(values[mask], axis=0, scale="normal")))
        for name, mask in masks.items()
        if np.count_nonzero(mask) > BLOCK
    }


# ------------------------------------------------------------------ growth


def _growth(vehicle: Sequence[Scatter], simulator: Sequence[Scatter]) -> list[Candidate | None]:
    """Slopes of the log level with speed, turn rate, and speed astern: the level that a simulator's σ, in which speed
    stands with its sign, has astern is below that ahead.
    """
    slopes = [_slopes(side) for side in (vehicle, simulator)]
    units = {"speed": "1/(m/s)", "turn_rate": "1/(rad/s)", "astern": "1/(m/s)"}
    found: list[Candidate | None] = []
    for name, unit in units.items():
        if not all(name in each for each in slopes):
            continue
        (a, std_a), (b, std_b) = (each[name] for each in slopes)
        p_of = [2.0 * norm.sf(abs(value) / std) for value, std in slopes_of(slopes, name)]
        there = tuple(bool(p < GROWS) for p in p_of)
        p = float(2.0 * norm.sf(abs(a - b) / np.hypot(std_a, std_b)))
        found.append(
            Candidate(
                f"growth_with_{name}",
                unit,
                _around(a, std_a),
                _around(b, std_b),
                p,
                (there[0], there[1]),
                matters=any(there),
            )
        )
    return found


def slopes_of(slopes: Sequence[Mapping[str, tuple[float, float]]], name: str) -> list[tuple[float, float]]:
    """Value and standard deviation on each side."""
    return [each[name] for each in slopes]


def _around(value: float, std: float) -> Triple:
    return value, value - 1.96 * std, value + 1.96 * std


def _slopes(scattered: Sequence[Scatter]) -> dict[str, tuple[float, float]]:
    """Slope and standard deviation by covariate, of log squares, with the scatter of blocks (a sandwich)."""
    columns: dict[str, Array] = {"speed": np.concatenate([each.motion.speed for each in scattered])}
    ahead = np.concatenate([each.motion.velocity_body[:, 0] for each in scattered])
    if all(each.motion.angular_velocity is not None for each in scattered):
        columns["turn_rate"] = np.concatenate([np.abs(each.motion.turn_rate[:, 2]) for each in scattered])
    if np.mean(ahead < -ASTERN_MPS) > ASTERN_SHARE:
        columns["astern"] = np.maximum(-ahead, 0.0)
    columns = {name: column for name, column in columns.items() if np.std(column) > SPREAD[name]}
    if not columns:
        return {}
    values = np.concatenate([each.values for each in scattered])
    scale = median_abs_deviation(values, axis=0, scale="normal")
    log_square = np.log(np.maximum(((values / scale) ** 2).mean(axis=1), 1e-12))
    x = np.column_stack([np.ones(len(values)), *(column - column.mean() for column in columns.values())])
    inverse = np.linalg.pinv(x.T @ x)
    parameters = inverse @ x.T @ log_square
    block = np.arange(len(x)) // BLOCK
    left = (log_square - x @ parameters)[:, None] * x
    scores = np.stack([np.bincount(block, column) for column in left.T], axis=1)
    n = len(scores)
    covariance = inverse @ (scores.T @ scores) @ inverse * n / max(n - x.shape[1], 1)
    std = np.sqrt(np.diag(covariance))
    return {name: (0.5 * float(parameters[i]), 0.5 * float(std[i])) for i, name in enumerate(columns, start=1)}


# ------------------------------------------------------------------ shape


def _tails(vehicle: Sequence[Scatter], simulator: Sequence[Scatter]) -> Candidate | None:
    """Share of independent samples beyond TAIL standard deviations; those beyond OUTLIER are outliers."""
    counts = []
    for side in (vehicle, simulator):
        far = n = 0
        for each in side:
            size = np.abs(each.values[:: each.thin]) / median_abs_deviation(each.values, axis=0, scale="normal")
            far += int(((size > TAIL) & (size < OUTLIER)).sum())
            n += size.size
        counts.append((far, n))
    return _shares("heavy_tails", counts[0], counts[1])


def _outliers(vehicle: Log, simulator: Log) -> Candidate | None:
    counts = []
    for log in (vehicle, simulator):
        far = n = 0
        for facts, recording, residual in zip(log.facts, log.recordings, log.residuals, strict=False):
            if recording.dvl.interval <= FAST_ENOUGH_S:
                far, n = far + _spikes(facts.values), n + len(facts.values)
            else:
                size = np.abs(residual) / np.maximum(median_abs_deviation(residual, axis=0, scale="normal"), 1e-9)
                far, n = far + int((size > 2.0 * OUTLIER).any(axis=1).sum()), n + len(residual)
        counts.append((far, n))
    return _shares("outliers", counts[0], counts[1])


def _spikes(values: Array) -> int:
    """Samples far from where four neighbours tell them to be, and farther than these."""
    if len(values) < 10:
        return 0
    off = np.zeros_like(values)
    x = values
    off[2:-2] = x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6.0
    scale = np.maximum(median_abs_deviation(off, axis=0, scale="normal"), DITHER_MPS)
    size = (np.abs(off) / scale).max(axis=1)
    beside = np.maximum(np.append(size[1:], 0.0), np.append(0.0, size[:-1]))
    return int(np.count_nonzero((size > OUTLIER) & (size > beside)))


def _shares(name: str, vehicle: tuple[int, int], simulator: tuple[int, int]) -> Candidate | None:
    """Counts of events among samples on both sides."""
    if not vehicle[1] or not simulator[1] or vehicle[0] + simulator[0] == 0:
        return None
    table = [[k, max(n - k, 0)] for k, n in (vehicle, simulator)]
    p = float(fisher_exact(table)[1])
    shares = [_share(*counts) for counts in (vehicle, simulator)]
    # one or two are no habit
    return Candidate(name, "share", shares[0], shares[1], p, (vehicle[0] > 2, simulator[0] > 2))


def _share(count: int, n: int) -> Triple:
    value = count / n
    half = 1.96 * np.sqrt(max(value * (1.0 - value), 0.25 / n) / n)
    return value, max(0.0, value - half), min(1.0, value + half)


def _colour(vehicle: Log, simulator: Log) -> Candidate | None:
    """Slow noise: means over blocks, against what white noise of the same level would have."""
    findings = [_finding(log, "coloured_reference_noise") for log in (vehicle, simulator)]
    if findings[0] is None and findings[1] is None:
        return None
    slow = [_slow(log) for log in (vehicle, simulator)]
    if min(len(each) for each in slow) < 3 * FEWEST_BLOCKS:
        return None
    ratio = float(np.mean(slow[0] ** 2) / np.mean(slow[1] ** 2))
    above = float(f_distribution.sf(ratio, len(slow[0]), len(slow[1])))
    p = 2.0 * min(above, 1.0 - above)
    values = [f.parameters["time_constant_s"] if f is not None else (0.0, 0.0, 0.0) for f in findings]
    return Candidate(
        "colour", "s", values[0], values[1], p,
        (findings[0] is not None, findings[1] is not None), note="of DVL or reference",
    )  # fmt: skip


def _finding(log: Log, name: str) -> NoiseFinding | None:
    return next((each for each in log.diagnosis.noise if each.name == name), None)


def _slow(log: Log) -> Array:
    """(B,) means of blocks of residuals, in standard deviations that they would have if these were white."""
    means = []
    for residual in log.residuals:
        size = max(BLOCK, 1)
        blocks = residual[: len(residual) // size * size].reshape(-1, size, 3)
        level = median_abs_deviation(np.diff(residual, axis=0), axis=0, scale="normal") / np.sqrt(2.0)
        means.append((np.median(blocks, axis=1) / np.maximum(level, 1e-9) * np.sqrt(size / 1.57)).ravel())
    return np.concatenate(means) if means else np.zeros(0)


# ------------------------------------------------------------------ the stream


def _exact(vehicle: Log, simulator: Log) -> Candidate | None:
    """Ground truth that leaks through: a DVL without noise, or one that has the noise of its reference."""
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
    return _shares("dropouts", counts[0], counts[1])


def _zeros(vehicle: Log, simulator: Log) -> Candidate | None:
    """Dropouts sent as a velocity of zero."""
    counts = [(sum(f.zero for f in log.facts), sum(f.received for f in log.facts)) for log in (vehicle, simulator)]
    return _shares("zeros_on_dropout", counts[0], counts[1])


def _repeats(vehicle: Log, simulator: Log) -> Candidate | None:
    if vehicle.exact or simulator.exact:
        return None  # at a constant velocity the truth repeats itself
    counts = [(sum(f.repeats for f in log.facts), sum(f.received for f in log.facts)) for log in (vehicle, simulator)]
    return _shares("repeats", counts[0], counts[1])


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
    """Steps between stamps that are no gap."""
    usual = float(np.median(steps)) if len(steps) else 0.0
    return steps[steps < 1.6 * usual]


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
    shown: list[Triple] = [tuple(_mean(each).tolist()) for each in (vehicle, simulator)]  # type: ignore[misc]
    there = tuple(abs(float(each.mean())) > worth for each in (vehicle, simulator))
    apart = abs(float(vehicle.mean() - simulator.mean()))
    return Candidate(
        name, "s", shown[0], shown[1], _welch(vehicle, simulator), (there[0], there[1]), matters=apart > worth
    )
