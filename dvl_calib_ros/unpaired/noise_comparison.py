"""Comparison of both sides' noise: level per axis, growth with motion, tails, colour.

The level of a fast DVL is estimated from differences between neighbouring samples, which exclude motion and reference;
for a slow one from its residual, which includes the reference's noise. Levels are compared over blocks of equal size on
both sides, so the scatter between blocks accounts for any distribution of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import norm

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..diagnosis.answer.gap_location import regimes
from ..diagnosis.answer.noise_findings import NoiseFinding
from ..diagnosis.fit.gauss_newton import around
from ..diagnosis.model.stream_curve import FAST_ENOUGH_S
from ..effects.base import EffectInput
from .both_sides import Log
from .stream_comparison import OUTLIER
from .welch_tests import BLOCK, FEWEST_BLOCKS, Candidate, mean_of, shares_of, welch

# smaller ratios of levels are irrelevant
WORTH_TELLING = 1.15
# limit of the tails in standard deviations, below outliers
TAIL = 3.7
# smallest share of samples with motion astern to estimate its noise
ASTERN_SHARE, ASTERN_MPS = 0.05, 0.1
# significance level for growth of the log level, and for colour, on either side
GROWS = 1e-4
# smallest standard deviations of speed, m/s, turn rate, rad/s, and speed astern, m/s, to estimate growth
SPREAD = {"speed": 0.1, "turn_rate": 0.01, "astern": 0.05}

Slopes = dict[str, tuple[float, float]]
"""Growth of the log level and its standard deviation, by covariate."""


@dataclass(frozen=True)
class Scatter:
    """Noise samples of one recording. values: (N, 3) m/s, white if the DVL's noise is, of its standard deviation.

    motion: at the samples. thin: step between independent samples. of_reference: m/s, upper limit of the reference's
    part.
    """

    values: Array
    motion: EffectInput
    thin: int
    of_reference: float


def compare_noise(vehicle: Log, simulator: Log) -> list[Candidate]:
    """Compare all properties observable on both sides."""
    found: list[Candidate | None] = []
    both = [scatter(log) for log in (vehicle, simulator)]
    if all(both) and not (vehicle.exact or simulator.exact):
        slopes = [slopes_of(side) for side in both]
        even = at_one_motion(both, slopes)
        found += [_level(even[0], even[1], axis) for axis in range(3)]
        found += _growth(slopes)
        found += [_tails(even[0], even[1])]
    found.append(_colour(vehicle, simulator))
    return [each for each in found if each is not None]


def scatter(log: Log) -> list[Scatter]:
    """Return the noise samples of each recording; empty if there are too few."""
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
    """Return differences (K, 3) of neighbours without a gap, their middle samples, and their norm for white noise."""
    w, reach = np.array(weights), len(weights) // 2
    n = len(time) - 2 * reach
    if n < 1:
        return np.zeros((0, values.shape[1])), np.zeros(0, dtype=np.intp), 1.0
    inner = np.arange(reach, reach + n)
    sums = np.sum([each * values[k : k + n] for k, each in enumerate(w)], axis=0)
    near = np.abs(time[2 * reach :] - time[:n] - 2 * reach * interval) < 0.5 * interval
    return sums[near], inner[near], float(np.sqrt(w @ w))


def block_levels(scattered: Sequence[Scatter], axis: int) -> Array:
    """Return the log standard deviation (B,) of one axis in blocks of equal size."""
    levels = []
    for each in scattered:
        values = each.values[:, axis]
        blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
        levels.append(np.log(np.maximum(np.median(np.abs(blocks), axis=1) / norm.ppf(0.75), 1e-9)))
    return np.concatenate(levels)


def _level(vehicle: Sequence[Scatter], simulator: Sequence[Scatter], axis: int) -> Candidate | None:
    """Compare the level of one DVL axis. The possible part of the reference in a slow DVL's level is not claimed."""
    blocks = [block_levels(side, axis) for side in (vehicle, simulator)]
    if min(map(len, blocks)) < FEWEST_BLOCKS:
        return None
    of_reference = [max(each.of_reference for each in side) for side in (vehicle, simulator)]
    intervals = []
    for levels, reference in zip(blocks, of_reference, strict=True):
        value, low, high = np.exp(mean_of(levels))
        intervals.append((float(value), float(np.sqrt(max(low**2 - reference**2, 0.0))), float(high)))
    larger = 0 if intervals[0][0] >= intervals[1][0] else 1
    own_levels = [np.asarray(each) for each in blocks]
    if of_reference[larger] > 0.0:
        own = np.exp(2.0 * own_levels[larger]) - of_reference[larger] ** 2
        own_levels[larger] = 0.5 * np.log(np.maximum(own, 1e-12))
    ratio = float(np.exp(own_levels[larger].mean() - own_levels[1 - larger].mean()))
    note = "DVL and reference together" if max(of_reference) > 0.0 else ""
    return Candidate(
        f"level_{'xyz'[axis]}", "m/s", intervals[0], intervals[1], welch(own_levels[0], own_levels[1]),
        matters=ratio > WORTH_TELLING, note=note,
    )  # fmt: skip


def levels_by_regime(log: Log) -> dict[str, float]:
    """Return regime of motion -> m/s, root of the sum over axes of the squared noise level."""
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
        name: float(np.linalg.norm(robust_std(values[mask])))
        for name, mask in masks.items()
        if np.count_nonzero(mask) > BLOCK
    }


def _growth(slopes: Sequence[Slopes]) -> list[Candidate | None]:
    """Compare slopes of the log level with speed, turn rate, and speed astern.

    If a simulator's σ depends on the signed speed, its level astern is below that ahead.
    """
    units = {"speed": "1/(m/s)", "turn_rate": "1/(rad/s)", "astern": "1/(m/s)"}
    found: list[Candidate | None] = []
    for name, unit in units.items():
        if not all(name in each for each in slopes):
            continue
        (a, std_a), (b, std_b) = (each[name] for each in slopes)
        there = tuple(_is_significant(each, name) for each in slopes)
        p = float(2.0 * norm.sf(abs(a - b) / np.hypot(std_a, std_b)))
        found.append(
            Candidate(
                f"growth_with_{name}",
                unit,
                around(a, std_a),
                around(b, std_b),
                p,
                (there[0], there[1]),
                matters=any(there),
            )
        )
    return found


def _is_significant(slopes: Slopes, name: str) -> bool:
    """Return whether a slope is significant."""
    value, std = slopes[name]
    return bool(2.0 * norm.sf(abs(value) / std) < GROWS)


def at_one_motion(both: Sequence[Sequence[Scatter]], slopes: Sequence[Slopes]) -> list[list[Scatter]]:
    """Scale the noise to a common motion of both sides, by the significant growth."""
    columns = [[_covariates(each) for each in side] for side in both]
    names = [name for name in SPREAD if any(name in of and _is_significant(of, name) for of in slopes)]
    even = [list(side) for side in both]
    for name in names:
        if not all(name in each for side in columns for each in side):
            continue
        usual = float(np.mean([np.mean(np.concatenate([each[name] for each in side])) for side in columns]))
        for side, of, own in zip(even, slopes, columns, strict=True):
            if name in of and _is_significant(of, name):
                for index, each in enumerate(side):
                    quieter = np.exp(-of[name][0] * (own[index][name] - usual))
                    side[index] = replace(each, values=each.values * quieter[:, None])
    return even


def _covariates(scattered: Scatter) -> dict[str, Array]:
    """Return speed m/s, turn rate rad/s if known, and speed astern m/s; each (N,)."""
    motion = scattered.motion
    found = {"speed": motion.speed}
    if motion.angular_velocity is not None:
        found["turn_rate"] = np.abs(motion.turn_rate[:, 2])
    return found | {"astern": np.maximum(-motion.velocity_body[:, 0], 0.0)}


def slopes_of(scattered: Sequence[Scatter]) -> Slopes:
    """Fit slope and standard deviation by covariate to log squares, with the scatter of blocks (sandwich estimate)."""
    each = [_covariates(one) for one in scattered]
    names = [name for name in SPREAD if all(name in one for one in each)]
    columns = {name: np.concatenate([one[name] for one in each]) for name in names}
    if np.mean(columns["astern"] > ASTERN_MPS) <= ASTERN_SHARE:
        del columns["astern"]
    columns = {name: column for name, column in columns.items() if np.std(column) > SPREAD[name]}
    if not columns:
        return {}
    values = np.concatenate([each.values for each in scattered])
    scale = robust_std(values)
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


def _tails(vehicle: Sequence[Scatter], simulator: Sequence[Scatter]) -> Candidate | None:
    """Compare shares of independent samples beyond TAIL standard deviations; those beyond OUTLIER are outliers."""
    counts = []
    for side in (vehicle, simulator):
        far = n = 0
        for each in side:
            size = np.abs(each.values[:: each.thin]) / robust_std(each.values)
            far += int(((size > TAIL) & (size < OUTLIER)).sum())
            n += size.size
        counts.append((far, n))
    return shares_of("heavy_tails", counts[0], counts[1])


def _colour(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare slow noise: means over blocks, against white noise of the same level.

    Only if it is significant on one side: the reference's noise, and its motion between samples, also contribute to
    these means and differ between the sides.
    """
    findings = [_finding(log, "coloured_reference_noise") for log in (vehicle, simulator)]
    findings = [each if each is not None and each.p < GROWS else None for each in findings]
    if findings[0] is None and findings[1] is None:
        return None
    slow = [_block_means(log) for log in (vehicle, simulator)]
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


def _block_means(log: Log) -> Array:
    """Return block means (B,) of residuals, in standard deviations expected for white noise."""
    means = []
    for residual in log.residuals:
        size = max(BLOCK, 1)
        blocks = residual[: len(residual) // size * size].reshape(-1, size, 3)
        level = robust_std(np.diff(residual, axis=0)) / np.sqrt(2.0)
        means.append((np.median(blocks, axis=1) / np.maximum(level, 1e-9) * np.sqrt(size / 1.57)).ravel())
    return np.concatenate(means) if means else np.zeros(0)
