"""Peer (a): Bayesian evidence over sets of at most two effects, by nested sampling (dynesty).

The noise is white and first-order autoregressive, each of free size, sampled with its correlation time; what is linear
is marginalised exactly under a normal prior, clocks about where they fit best. Of all sets those are sampled that the
criterion of peer (b) has among its best, which leaves out none that could win.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.fft import dct
from scipy.linalg import cho_factor, cho_solve

from dvl_calib_ros.calibration.models.parameters import Parameters

from .answers import EXPECTED, Document, Found, answer, is_seeing, named, parameters_from, searched, times_of
from .forward import CLOCKS, COLUMNS, EFFECTS, N_PARTS
from .needed import needed
from .search import Fitted, Search, residual_of_all
from .streams import Floats

# Chance before anything was seen of none, one and two effects, and of something that is no effect
PRIOR = (0.5, 0.35, 0.15)
UNKNOWN = 0.02
N_SETS = 5
# Sets whose criterion is so much worse than the best one's are not sampled
WINDOW = 20.0
N_BANDS = 30
N_LIVE = 40
LEAST_GAIN = 0.5  # of the logarithm of the evidence, at which sampling ends
N_SAMPLES = 30
# A set with such a share of the best one's probability is another answer
NEAR = 0.1
LOG_RANGES = (np.log([0.3, 3.0]), np.log([0.01, 10.0]), np.log([0.7, 60.0]))  # white, coloured, s


class Spectrum:
    """The products of a set's columns by frequency: its likelihood at any noise, without what is linear."""

    def __init__(self, rows: Floats, prior_std: Floats, prior_mean: Floats, std: Floats, step_s: float) -> None:
        self.prior_std, self.prior_mean, self.step_s = prior_std, prior_mean, step_s
        shifted = rows.copy()
        shifted[..., -1] -= rows[..., :-1] @ prior_mean
        waves = dct(shifted / std[:, None, None], type=2, norm="ortho", axis=1)
        n = rows.shape[1]
        edges = np.unique(np.concatenate([[0, 1, 2, 3], np.geomspace(4, n, N_BANDS).astype(int)]))
        self.angle = np.pi * 0.5 * (edges[:-1] + edges[1:] - 1) / n
        self.count = np.diff(edges) * rows.shape[0]
        self.products = np.stack(
            [
                np.einsum("cni,cnj->ij", waves[:, a:b], waves[:, a:b], optimize=True)
                for a, b in itertools.pairwise(edges.tolist())
            ]
        )

    def power(self, noise: Floats) -> Floats:
        """(bands,) of noise by logarithms: white, coloured, correlation time."""
        white, coloured, seconds = np.exp(noise)
        keep = math.exp(-self.step_s / seconds)
        shape = (1.0 - keep**2) / (1.0 - 2.0 * keep * np.cos(self.angle) + keep**2)
        return np.asarray(white**2 + coloured**2 * shape)

    def given(self, noise: Floats) -> tuple[float, Floats, Floats]:
        """Log likelihood at a noise; mean and covariance of what is linear, in its units."""
        power = self.power(noise)
        total = np.tensordot(1.0 / power, self.products, axes=1)
        scaled = total[:-1, :-1] * np.outer(self.prior_std, self.prior_std) + np.eye(len(self.prior_std))
        factor = cho_factor(scaled, lower=True)
        right = self.prior_std * total[:-1, -1]
        mean = cho_solve(factor, right)
        chi2 = total[-1, -1] - right @ mean
        volume = 2.0 * np.log(np.diag(factor[0])).sum()
        log_likelihood = -0.5 * (chi2 + volume + (self.count * np.log(2.0 * np.pi * power)).sum())
        covariance = cho_solve(factor, np.eye(len(right))) * np.outer(self.prior_std, self.prior_std)
        return float(log_likelihood), self.prior_mean + self.prior_std * mean, covariance


@dataclass(frozen=True)
class Weighed:
    """A set with its evidence. values, std: of its columns. noise: at its mean."""

    fitted: Fitted
    log_posterior: float
    values: Floats
    std: Floats
    noise: Floats
    log_likelihood: float


def diagnose(paths: Sequence[Path], parameters: Parameters) -> Document:
    """The answer to bags of one vehicle. Raises InputError."""
    known = searched(tuple(paths), parameters)
    search, alone = known.search, known.alone
    lowest = known.sets[0].bic
    chosen = [each for each in known.sets if each.members and each.bic < lowest + WINDOW][:N_SETS]
    std = residual_of_all(search.model, known.sets[0].clock, known.sets[0].members).std(axis=1) + 1e-9
    weighed = sorted((_weighed(search, each, std) for each in [alone, *chosen]), key=lambda each: -each.log_posterior)
    best = weighed[0]
    left = _log_odds_of_left(search, best, std) > 0.0
    if not best.fitted.members:
        if left:
            return answer("unknown")
        return answer("no_gap" if is_seeing(search, alone) else "insufficient_excitation")
    sizes = {
        name: (v, s) for name, v, s in zip(best.fitted.names, best.values.tolist(), best.std.tolist(), strict=True)
    }

    def strength(name: str) -> float:
        return max(abs(value) / max(each or 0.0, 1e-12) for value, each in parameters_from(sizes, name).values())

    seconds = search.model.seconds
    found = [
        Found(name, parameters_from(sizes, name) | times_of(best.fitted, name, seconds), _rivals(weighed, name))
        for name in sorted(best.fitted.effects, key=strength, reverse=True)
    ]
    return named(found, left)


def _rivals(weighed: Sequence[Weighed], name: str) -> list[str]:
    best = weighed[0]
    rest = {*best.fitted.effects} - {name}
    found: list[str] = []
    for each in weighed[1:]:
        others = {*each.fitted.effects} - rest
        is_near = each.log_posterior > best.log_posterior + math.log(NEAR)
        if is_near and rest <= {*each.fitted.effects} and len(others) == 1 and others != {name}:
            found += others
    return found


def _log_prior(fitted: Fitted) -> float:
    n = len(EFFECTS)
    log = math.log(PRIOR[len(fitted.members)] / (1.0, n, n * (n - 1) / 2.0)[len(fitted.members)])
    for member in fitted.members:
        if member.name == "water_lock":
            log += math.log(0.5) if not member.n_times else math.log(0.5 / (N_PARTS * (N_PARTS - 1) / 2))
        elif member.n_times:
            log -= math.log(N_PARTS - 1)
    return log


def _spectrum(search: Search, fitted: Fitted, std: Floats, generic: int | None = None) -> Spectrum:
    rows = search.rows_of(fitted.members, fitted.clock, fitted.values)
    effects = [name.split(".")[0] for name in fitted.names]
    prior = np.array([EXPECTED[name] for name in effects])
    mean = np.array([-fitted.clock.size(name) if name in CLOCKS else 0.0 for name in effects])
    if generic is not None:
        first = len(COLUMNS) + 3 * generic
        beside = search.model.at(fitted.clock, generic=True)[..., first : first + 3]
        beside = beside / np.maximum(np.sqrt((beside**2).mean(axis=1).max(axis=0)), 1e-9)
        rows = np.concatenate([rows[..., :-1], beside, rows[..., -1:]], axis=2)
        prior, mean = np.concatenate([prior, np.full(3, 0.03)]), np.concatenate([mean, np.zeros(3)])
    step_s = float(np.median(np.diff(search.model.streams[0].reference_s)))
    return Spectrum(rows, prior, mean, std, step_s)


def _weighed(search: Search, fitted: Fitted, std: Floats) -> Weighed:
    dynesty = needed("dynesty")
    spectrum = _spectrum(search, fitted, std)
    low, high = np.array(LOG_RANGES).T
    sampler = dynesty.NestedSampler(
        lambda noise: spectrum.given(noise)[0], lambda unit: low + unit * (high - low), len(low),
        nlive=N_LIVE, bound="single", sample="unif", rstate=np.random.default_rng(1),
    )  # fmt: skip
    sampler.run_nested(dlogz=LEAST_GAIN, print_progress=False)
    results = sampler.results
    samples = results.samples_equal(rstate=np.random.default_rng(2))
    noise = samples.mean(axis=0)
    draws = [spectrum.given(each) for each in samples[:: max(1, len(samples) // N_SAMPLES)]]
    means = np.array([mean for _, mean, _ in draws])
    variance = np.array([np.diag(covariance) for *_, covariance in draws]).mean(axis=0) + means.var(axis=0)
    clocks = np.array([fitted.clock.size(name.split(".")[0]) for name in fitted.names])
    log_posterior = float(results.logz[-1]) + _log_prior(fitted)
    values = means.mean(axis=0) + clocks
    return Weighed(fitted, log_posterior, values, np.sqrt(variance), noise, spectrum.given(noise)[0])


def _log_odds_of_left(search: Search, best: Weighed, std: Floats) -> float:
    """Of something that is no effect beside the best set, at its noise: the best of the plain functions."""
    whole = search.model.at(best.fitted.clock, generic=True)
    n = (whole.shape[2] - 1 - len(COLUMNS)) // 3
    power = best.noise
    gains = [_spectrum(search, best.fitted, std, each).given(power)[0] for each in range(n)]
    return max(gains) - best.log_likelihood + math.log(UNKNOWN / n)
