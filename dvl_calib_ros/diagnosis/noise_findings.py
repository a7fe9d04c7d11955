"""What the noise is like, beside the verdict: outliers, repeats, larger than reported, coloured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, chi2, norm

from ..calibration.frames import Array
from .fitting import Fit, Fitter
from .levels import SIGNIFICANT, fit_level
from .noise import Arma, Noise
from .problem import Problem

LEVEL = 0.01
OUTLIER_SIGMA = 6.0
# Repeats that chance and a coarse resolution may bring
CHANCE_OF_REPEAT = 1e-3
# A floor this much above the reported one is worth telling
INFLATION = 1.2


@dataclass(frozen=True)
class NoiseFinding:
    """One finding. parameters: value and 95 per cent interval by name."""

    name: str
    parameters: Mapping[str, tuple[float, float, float]]
    p: float


def noise_findings(fitter: Fitter, fit: Fit) -> list[NoiseFinding]:
    """Findings that are significant, the clearest first; p is Holm's over all."""
    from statsmodels.stats.multitest import multipletests

    problem = fitter.problem
    explained = fitter.residual - fit.residual
    raw = problem.residual - explained
    innovations = fit.noise.whiten(raw).reshape(-1, 3)
    candidates = [
        _outliers(innovations),
        _stale(problem),
        _coloured(fit.noise, fit.residual, problem),
        *_inflation(problem, raw, innovations, fit.noise),
    ]
    found = [each for each in candidates if each is not None]
    if not found:
        return []
    adjusted = multipletests([each.p for each in found], method="holm")[1]
    findings = [
        NoiseFinding(each.name, each.parameters, float(p)) for each, p in zip(found, adjusted, strict=True) if p < LEVEL
    ]
    return sorted(findings, key=lambda each: each.p)


def _outliers(innovations: Array) -> NoiseFinding | None:
    scale = 1.4826 * np.median(np.abs(innovations), axis=0)
    far = (np.abs(innovations) > OUTLIER_SIGMA * scale).any(axis=1)
    count, n = int(np.count_nonzero(far)), len(innovations)
    if count < 3:
        return None
    test = binomtest(count, n, 6.0 * norm.sf(OUTLIER_SIGMA), "greater")
    interval = binomtest(count, n).proportion_ci()
    return NoiseFinding("outliers", {"share": (count / n, interval.low, interval.high)}, float(test.pvalue))


def _stale(problem: Problem) -> NoiseFinding | None:
    count = sum(recording.repeats for recording in problem.recordings)
    n = sum(recording.received for recording in problem.recordings)
    if count < 3:
        return None
    test = binomtest(count, n, CHANCE_OF_REPEAT, "greater")
    interval = binomtest(count, n).proportion_ci()
    return NoiseFinding("stale_samples", {"share": (count / n, interval.low, interval.high)}, float(test.pvalue))


def _coloured(noise: Noise, residual: Array, problem: Problem) -> NoiseFinding | None:
    if all(not len(arma.ar) for arma in noise.axes):
        return None
    drop = noise.refitted(residual, [(0, 0)]).deviance(residual) - noise.deviance(residual)
    dof = sum(len(arma.ar) + (arma.ma != 0.0) for arma in noise.axes)
    clearest = max(noise.axes, key=lambda arma: arma.ratio)
    interval = problem.interval
    constant = _time_constant(clearest, interval)
    if constant < 2.0 * interval:
        return None  # neighbours share samples of the reference, which is the pairing's doing
    spread = constant * 2.0 / np.sqrt(max(1.0, sum(r.seconds for r in problem.recordings) / max(constant, interval)))
    parameters = {"time_constant_s": (constant, max(0.0, constant - spread), constant + spread)}
    return NoiseFinding("coloured_reference_noise", parameters, float(chi2.sf(max(drop, 0.0), dof)))


def _time_constant(arma: Arma, interval: float) -> float:
    roots = np.abs(np.roots(np.concatenate([[1.0], -arma.ar])))
    slowest = float(roots.max()) if len(roots) else 0.0
    return interval / -np.log(slowest) if 0.0 < slowest < 1.0 else interval


def _inflation(problem: Problem, raw: Array, innovations: Array, noise: Noise) -> list[NoiseFinding | None]:
    found: list[NoiseFinding | None] = []
    if all(recording.reported_variance is not None for recording in problem.recordings):
        reported = problem.joined([r.averaged(r.reported_variance) for r in problem.recordings])  # type: ignore[arg-type]
        ratio = np.median(np.abs(raw)) / (0.6745 * np.sqrt(np.median(reported)))
        error = 0.8 / np.sqrt(raw.size)
        if ratio > INFLATION:
            p = float(2.0 * norm.sf(np.log(ratio) / error))
            low, high = float(ratio * np.exp(-1.96 * error)), float(ratio * np.exp(1.96 * error))
            found.append(NoiseFinding("noise_inflation", {"factor": (float(ratio), low, high)}, p))
    level = fit_level(problem, innovations * noise.level)
    if level is not None and level.p < SIGNIFICANT:
        units = {"speed": "log_per_mps", "turn_rate": "log_per_radps", "reported": "log_per_log_reported"}
        z = norm.isf(np.maximum(level.p_of, 1e-300) / 2.0)
        parameters = {
            units[name]: (
                float(slope),
                float(slope - 1.96 * abs(slope) / z_of),
                float(slope + 1.96 * abs(slope) / z_of),
            )
            for name, slope, z_of, p in zip(level.names, level.slopes, z, level.p_of, strict=True)
            if p < LEVEL and name != "reported"
        }
        if parameters:
            found.append(NoiseFinding("noise_inflation", parameters, level.p))
    return found
