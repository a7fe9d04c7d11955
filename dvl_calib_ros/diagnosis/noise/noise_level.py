"""Noise level as a function of reported covariances per sample, speed and turn rate.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_sf
from ...calibration.numerics.frames import Array
from ...effects.base import EffectNeeds
from ..model.claimed_noise import Exponents, exponents, is_informative, relative_std
from ..model.forward_model import Problem
from ..model.seen import Seen
from ..model.settings import SETTINGS
from .noise_model import Noise, white_noise

# Extreme rows that alone do not establish a level
N_EXTREMES = 6


@dataclass(frozen=True)
class Level:
    """Log-linear noise level: log σ = const + Σ slope · (covariate - mean). p: of all slopes jointly, p_of: of each."""

    names: tuple[str, ...]
    slopes: Array
    p: float
    p_of: Array
    values: Array


def covariates(problem: Problem, seen: Sequence[Seen]) -> dict[str, Array]:
    """Return (M,) each: speed m/s, and turn rate rad/s if there is an IMU."""
    found = {"speed": problem.sampled(seen, lambda motion: motion.speed)}
    if EffectNeeds.ANGULAR_VELOCITY in problem.available:
        found["turn_rate"] = problem.sampled(seen, lambda motion: np.linalg.norm(motion.turn_rate, axis=1))
    return {name: values for name, values in found.items() if np.std(values) > 1e-3 * max(1.0, abs(np.mean(values)))}


def fit_level(problem: Problem, seen: Sequence[Seen], innovations: Array) -> Level | None:
    """Fit log squared innovations (M, A) to the covariates, robustly. Return None without covariates."""
    found = covariates(problem, seen)
    if not found:
        return None
    log_square = np.log(np.maximum((innovations**2).mean(axis=1), 1e-12))
    slopes, covariance, wald = _fit_slopes(list(found.values()), log_square)
    p, p_of = float(chi2_sf(wald, len(slopes))), chi2_sf(slopes**2 / np.diag(covariance), 1)
    if p < SETTINGS.robust_level:
        common = [each for values in found.values() if np.ptp(each := _clip_extremes(values)) > 0.0]
        p_common = float(chi2_sf(_fit_slopes(common, log_square)[2], len(common))) if common else 1.0
        p = p if p_common < SETTINGS.robust_level else p_common
    x = np.column_stack([values - values.mean() for values in found.values()])
    level = np.exp(np.clip(0.5 * x @ slopes, -2.0, 2.0))
    return Level(tuple(found), 0.5 * slopes, p, p_of, level)


def _fit_slopes(found: Sequence[Array], log_square: Array) -> tuple[Array, Array, float]:
    """Return slopes (c,) of log squares (M,) along c covariates (M,), their covariance, and the Wald statistic."""
    x = np.column_stack([np.ones(len(log_square)), *(values - values.mean() for values in found)])
    inverse = np.linalg.pinv(x.T @ x)
    parameters = inverse @ x.T @ log_square
    scores = (log_square - x @ parameters)[:, None] * x
    covariance = (inverse @ (scores.T @ scores) @ inverse * len(x) / max(len(x) - x.shape[1], 1))[1:, 1:]  # HC1
    slopes = parameters[1:]
    return slopes, covariance, float(slopes @ np.linalg.solve(covariance, slopes))


def _clip_extremes(values: Array) -> Array:
    """Clip values (M,) to the range without `N_EXTREMES` extreme rows: an accidentally small one biases a slope."""
    ordered = np.sort(values)
    few = min(N_EXTREMES, (len(values) - 1) // 2)
    return np.clip(values, ordered[few], ordered[-1 - few])


def estimate_noise(
    problem: Problem, seen: Sequence[Seen], residual: Array, rotation: Array | None, columns: Array, std: Array
) -> tuple[Noise, Array]:
    """Estimate the noise of a residual (M, A) in a frame, with a significant level, and the winsorised residual.

    columns, std: (M, A, p) and (p,) of the fit that the residual is from, which has absorbed some of the noise.
    """
    noise = white_noise(residual, problem.segments, rotation, problem.interval).refitted(residual)
    for _ in range(2):  # colour and absorbed noise depend weakly on each other
        absorbed = noise.absorbed_by(columns, std)
        noise = noise.refitted(noise.robust(residual), absorbed=absorbed)
    names, log_claims = log_reported(problem, seen, rotation)
    if names:
        innovations = noise.whiten(residual).reshape(residual.shape)
        noise = replace(noise, level=noise.level * relative_std(log_claims, innovations, names, stretches_of(problem)))
        noise = noise.refitted(noise.robust(residual), absorbed=absorbed)
    level = fit_level(problem, seen, noise.whiten(residual).reshape(residual.shape))
    if level is not None and level.p < SETTINGS.robust_level:
        noise = replace(noise, level=noise.level * level.values[:, None])
    robust = noise.robust(residual)
    return noise.refitted(robust, absorbed=absorbed), robust


def fit_claims(problem: Problem, seen: Sequence[Seen], innovations: Array, rotation: Array | None) -> Exponents | None:
    """Fit innovations (M, A) of constant level to informative reported values. Return None without."""
    names, log_claims = log_reported(problem, seen, rotation)
    return exponents(names, log_claims, innovations, stretches_of(problem)) if names else None


# ------------------------------------------------------------------ of what is compared


def log_reported(problem: Problem, seen: Sequence[Seen], rotation: Array | None) -> tuple[tuple[str, ...], Array]:
    """Return streams with informative reported values, and their logarithms (M, A, c) in the noise's frame."""
    names, columns = [], []
    for name in ("dvl", "reference"):
        each = _log_reported_std(problem, seen, rotation, name)
        if each is not None and is_informative(each):
            names.append(name)
            columns.append(each)
    return tuple(names), np.stack(columns, axis=2) if columns else np.zeros((len(problem.time), problem.axes, 0))


def _log_reported_std(problem: Problem, seen: Sequence[Seen], rotation: Array | None, name: str) -> Array | None:
    """Return the log standard deviation (M, A). Return None if a recording has none, or all are equal."""
    given = [(each.dvl if name == "dvl" else each.reference).sample_std for each in problem.recordings]
    sample_std = [each for each in given if each is not None and len(each)]
    if len(sample_std) < len(given) or all(bool((each == sample_std[0][0]).all()) for each in sample_std):
        return None
    parts = []
    start = 0
    for recording, grid, each, own in zip(problem.recordings, problem.grids, seen, sample_std, strict=True):
        curve, stamps = (
            (recording.dvl, each.dvl_stamps) if name == "dvl" else (recording.reference, each.reference_stamps)
        )
        variance = np.stack([np.interp(stamps, curve.time, column) for column in (own**2).T], axis=1)
        variance = grid.averaged(variance)
        at = slice(start, start + len(variance))
        start = at.stop
        if name == "reference":
            variance = np.where(recording.measured, variance, 0.0)
        used = variance[:, variance.any(axis=0)]
        if np.ptp(used, axis=1).max(initial=0.0) <= 1e-9 * used.max(initial=0.0):  # equal on all axes, so in any frame
            parts.append(np.repeat(used[:, :1], problem.axes, axis=1))
            continue
        to_compared = problem.to_compared(recording, grid.bin_time, of_dvl=name == "dvl")
        turned = to_compared if rotation is None else rotation[at] @ to_compared
        parts.append((turned**2 @ variance[:, :, None])[:, :, 0])
    return np.asarray(0.5 * np.log(np.maximum(np.concatenate(parts), 1e-12)))


def stretches_of(problem: Problem) -> NDArray[np.intp]:
    """Return (M,) index of the stretch of time of each bin."""
    index = np.floor(problem.time / SETTINGS.block).astype(int)
    keys = problem.recording_of * (int(np.ptp(index)) + 1) + index - index.min()
    return np.asarray(np.unique(keys, return_inverse=True)[1], dtype=np.intp)
