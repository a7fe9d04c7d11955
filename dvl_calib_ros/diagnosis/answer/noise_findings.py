"""Findings on the noise: outliers, repeats, inflation, colour, and dependence on reported covariances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...calibration.numerics.distributions import binomial_interval, binomial_sf, chi2_sf, normal_isf, normal_sf
from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...calibration.numerics.tests import holm
from ..fit.gauss_newton import Z_INTERVAL, Fit, Fitter, around
from ..model.claimed_noise import relative_std
from ..model.forward_model import Problem
from ..model.settings import SETTINGS
from ..noise.noise_level import fit_claims, fit_level, log_reported, stretches_of
from ..noise.noise_model import Arma, Noise
from .gap_closure import high_frequency_variance, reported_std

# Rate of repeats under the null hypothesis, with a coarse resolution
CHANCE_OF_REPEAT = 1e-3
# Least ratio of actual to reported noise that is reported
INFLATION = 1.2
# Exponent below which reported covariances are invalid; the other stream's noise lowers it even if they are valid
INVALID_EXPONENT = 0.5


@dataclass(frozen=True)
class NoiseFinding:
    """One finding. parameters: value and 95 per cent interval by name."""

    name: str
    parameters: Mapping[str, tuple[float, float, float]]
    p: float


def noise_findings(fitter: Fitter, fit: Fit) -> list[NoiseFinding]:
    """Return significant findings, the most significant first; p is Holm's over all."""
    problem = fitter.problem
    raw = fit.residual + fitter.outliers
    innovations = fit.noise.whiten(raw).reshape(raw.shape)
    candidates = [
        _outliers(innovations, problem),
        _stale(problem),
        _coloured(problem, fit),
        *_inflation(problem, fit, innovations),
        _reported_covariance(problem, fit, innovations * fit.noise.level),
    ]
    found = [each for each in candidates if each is not None]
    if not found:
        return []
    adjusted = holm([each.p for each in found])
    findings = [replace(each, p=float(p)) for each, p in zip(found, adjusted, strict=True) if p < SETTINGS.level]
    return sorted(findings, key=lambda each: each.p)


def _outliers(innovations: Array, problem: Problem) -> NoiseFinding | None:
    """Test whether outliers are more frequent than normal noise explains."""
    scale = robust_std(innovations)
    is_outlier = (np.abs(innovations) > SETTINGS.outlying * scale).any(axis=1)
    excluded = problem.bursts // problem.grids[0].per_bin
    count, n = int(np.count_nonzero(is_outlier)) + excluded, len(innovations) + excluded
    spikes, received = (sum(getattr(r, name) for r in problem.recordings) for name in ("spikes", "received"))
    if spikes > count:
        count, n = spikes, received
    return _share("outliers", count, n, 6.0 * float(normal_sf(SETTINGS.outlying)))


def _stale(problem: Problem) -> NoiseFinding | None:
    """Test whether repeated velocities are more frequent than chance explains."""
    count, n = (sum(getattr(each, name) for each in problem.recordings) for name in ("repeats", "received"))
    return _share("stale_samples", count, n, CHANCE_OF_REPEAT)


def _share(name: str, count: int, n: int, chance: float) -> NoiseFinding | None:
    """Test a share of samples against the share by chance; one or two samples are no finding."""
    if count < 3:
        return None
    return NoiseFinding(name, {"share": (count / n, *binomial_interval(count, n))}, binomial_sf(count, n, chance))


def _coloured(problem: Problem, fit: Fit) -> NoiseFinding | None:
    """Test whether the noise is coloured beyond the colour that interpolation gives to white noise."""
    noise, residual = fit.noise, fit.residual
    if all(not len(arma.ar) for arma in noise.axes):
        return None
    drop = noise.refitted(residual, [(0, 0)]).deviance(residual) - noise.deviance(residual)
    dof = sum(len(arma.ar) + (arma.ma != 0.0) for arma in noise.axes)
    clearest = max(noise.axes, key=lambda arma: arma.ratio)
    interval = problem.interval
    constant = _time_constant(clearest, interval)
    if constant < 2.0 * interval:
        return None  # interpolated neighbours share samples
    if float(chi2_sf(drop, dof)) < SETTINGS.level:
        drop = min(drop, _made_by_comparing(problem, fit).deviance(residual) - noise.deviance(residual))
    spread = constant * 2.0 / np.sqrt(max(1.0, sum(r.seconds for r in problem.recordings) / max(constant, interval)))
    parameters = {"time_constant_s": (constant, max(0.0, constant - spread), constant + spread)}
    return NoiseFinding("coloured_reference_noise", parameters, float(chi2_sf(max(drop, 0.0), dof)))


def _made_by_comparing(problem: Problem, fit: Fit) -> Noise:
    """Return the noise with the colour that interpolation gives to the white noise of both streams, by simulation.

    A stream that is `denoised` between its samples retains only low frequencies of its noise, as slow as the vehicle's
    motion. The residual's excess over the streams' noise is white.
    """
    noise, residual, rng = fit.noise, fit.residual, np.random.default_rng(0)
    noisy = problem.with_noise(rng, dvl=True, reference=True)
    simulated = noisy.residual(noisy.all_seen(fit.hypothesis)) - problem.residual(fit.seen)
    target, achieved = (float(np.mean(noise.white.whiten(each) ** 2)) for each in (residual, simulated))
    simulated += np.sqrt(max(target - achieved, 0.0)) * noise.white.unwhiten(rng.standard_normal(residual.size))
    unit = replace(noise, axes=tuple(replace(arma, std=1.0) for arma in noise.like(simulated).axes))
    stds = np.sqrt((unit.whiten(residual).reshape(residual.shape) ** 2).mean(axis=0)).tolist()
    return replace(unit, axes=tuple(replace(arma, std=std) for arma, std in zip(unit.axes, stds, strict=True)))


def _time_constant(arma: Arma, interval: float) -> float:
    roots = np.abs(np.roots(np.concatenate([[1.0], -arma.ar])))
    slowest = float(roots.max()) if len(roots) else 0.0
    return interval / -np.log(slowest) if 0.0 < slowest < 1.0 else interval


def _inflation(problem: Problem, fit: Fit, innovations: Array) -> list[NoiseFinding | None]:
    """Test whether the noise exceeds the reported one, or depends on speed or turn rate."""
    found: list[NoiseFinding | None] = []
    reported = reported_std(problem)
    if reported is not None:
        errors = problem.errors(fit.seen)
        variance, error = high_frequency_variance(problem.sample_time, errors)
        ratio = float(np.sqrt(variance.sum() / np.mean([np.sum(each**2) for each in reported])))
        error = 0.5 * error
        if ratio > INFLATION:
            p = float(2.0 * normal_sf(np.log(ratio) / error))
            low, high = float(ratio * np.exp(-Z_INTERVAL * error)), float(ratio * np.exp(Z_INTERVAL * error))
            found.append(NoiseFinding("noise_inflation", {"factor": (ratio, low, high)}, p))
    names, log_claims = log_reported(problem, fit.seen, fit.noise.rotation)
    even = innovations * fit.noise.level
    even = even / relative_std(log_claims, even, names, stretches_of(problem))
    level = fit_level(problem, fit.seen, even)
    if level is not None and level.p < SETTINGS.robust_level:
        units = {"speed": "log_per_mps", "turn_rate": "log_per_radps"}
        z = normal_isf(np.maximum(level.p_of, 1e-300) / 2.0)
        parameters = {
            units[name]: around(float(slope), float(abs(slope) / z_of))
            for name, slope, z_of, p in zip(level.names, level.slopes, z, level.p_of, strict=True)
            if p < SETTINGS.level
        }
        if parameters:
            found.append(NoiseFinding("noise_inflation", parameters, level.p))
    return found


def _reported_covariance(problem: Problem, fit: Fit, even: Array) -> NoiseFinding | None:
    """Test the dependence of noise (M, A), level included, on reported covariances: exponent 1 if valid, 0 if none.

    p: of no dependence, or, for an exponent below half, of a valid one. Return None if reported values are all equal.
    """
    found = fit_claims(problem, fit.seen, even, fit.noise.rotation)
    if found is None:
        return None
    parameters, p_values = {}, []
    for name, value, std in zip(found.names, found.exponents.tolist(), found.stds.tolist(), strict=True):
        parameters[f"{name}_exponent"] = around(value, std)
        p_values.append(2.0 * float(normal_sf(abs(value - (0.0 if value > INVALID_EXPONENT else 1.0)) / std)))
    return NoiseFinding("reported_covariance", parameters, float(min(1.0, len(p_values) * min(p_values))))
