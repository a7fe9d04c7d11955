"""How the noise's level follows the vehicle: louder at speed, in turns, or where the messages say so."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from ..calibration.frames import Array
from ..effects.base import Needs
from .noise import Noise, white_noise
from .problem import Problem

SIGNIFICANT = 1e-4


@dataclass(frozen=True)
class Level:
    """log standard deviation = const + Σ slope · (covariate - mean). p: of all slopes together, p_of: of each."""

    names: tuple[str, ...]
    slopes: Array
    p: float
    p_of: Array
    values: Array


def covariates(problem: Problem) -> dict[str, Array]:
    """(M,) each: speed m/s, turn rate rad/s where there is an IMU, log of the reported std where it varies."""
    found = {"speed": problem.sampled(lambda motion: motion.speed)}
    if Needs.ANGULAR_VELOCITY in problem.available:
        found["turn_rate"] = problem.sampled(lambda motion: np.linalg.norm(motion.turn_rate, axis=1))
    if all(recording.reported_variance is not None for recording in problem.recordings):
        reported = problem.joined([r.averaged(r.reported_variance.mean(axis=1)) for r in problem.recordings])  # type: ignore[union-attr]
        found["reported"] = 0.5 * np.log(np.maximum(reported, 1e-12))
    return {name: values for name, values in found.items() if np.std(values) > 1e-3 * max(1.0, abs(np.mean(values)))}


def fit_level(problem: Problem, innovations: Array) -> Level | None:
    """Least squares of log squared innovations (M, 3) on the covariates, which no outlier upsets; None without any."""
    from statsmodels.regression.linear_model import OLS

    found = covariates(problem)
    if not found:
        return None
    x = np.column_stack([values - values.mean() for values in found.values()])
    log_square = np.log(np.maximum((innovations**2).mean(axis=1), 1e-12))
    result = OLS(log_square, np.column_stack([np.ones(len(x)), x])).fit(cov_type="HC1")
    slopes, covariance = result.params[1:], result.cov_params()[1:, 1:]
    wald = float(slopes @ np.linalg.solve(covariance, slopes))
    p_of = chi2.sf(slopes**2 / np.diag(covariance), 1)
    level = np.exp(np.clip(0.5 * x @ slopes, -2.0, 2.0))
    return Level(tuple(found), 0.5 * slopes, float(chi2.sf(wald, len(slopes))), p_of, level)


def estimated(problem: Problem, left: Array, rotation: Array | None) -> tuple[Noise, Array]:
    """The noise that is left (M, 3) of a problem's residual, in a frame, with the level that it calls for if it does
    so clearly; and what is left with its outliers drawn in.
    """
    noise = white_noise(left, problem.segments, rotation, problem.interval).refitted(left)
    noise = noise.refitted(noise.robust(left))
    level = fit_level(problem, noise.whiten(left).reshape(-1, 3))
    if level is not None and level.p < SIGNIFICANT:
        noise = replace(noise, level=noise.level * level.values[:, None])
    robust = noise.robust(left)
    return noise.refitted(robust), robust
