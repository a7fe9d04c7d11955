"""Score tests of the residual of the best combination of effects against vehicle motion and time.

The dictionary holds functions of motion or time, each with a free vector in the body frame. GNSS noise is independent
of the vehicle's motion, so a residual that follows the motion is systematic.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_isf, chi2_logsf
from ...calibration.numerics.frames import Array
from ...calibration.streams.interpolation import shortened
from ...effects.base import Effect
from ...verdict.reasons import Reason, finding
from ..fit.cross_validation import held_out_deviance, predictive_gain
from ..fit.gauss_newton import Fit, Fitter
from ..fit.parametric_bootstrap import SIMULATED, simulated_recordings
from ..fit.selection_criteria import NuisanceFit, SlowNoiseOfFit
from ..model.forward_model import Problem
from ..model.seen import Seen
from ..model.settings import SETTINGS
from ..noise.whitened_least_squares import ScoreTest, orthonormal
from .alternative_regressors import ALTERNATIVES, dictionary
from .effect_selection import EffectSelection
from .event_scan import events

# Spectral lines: longer than wave periods; more periods than the time dictionary resolves
SHORTEST_PERIOD_S, FEWEST_PERIODS = 16.0, 3.0
# Steps per bin of the series for the spectrum, at most: memory must not grow with pauses
STEPS_OF_A_BIN = 16
# Degrees of freedom of the prior on the null distribution's scale of 1
PRIOR_DOF = 4.0
# Share of the effects' explained deviance that inexact interpolation may leave
INTERPOLATION_SHARE = 0.005
# Among candidates within this log p of the best (a factor of 400), the simplest is named: one speed rather than
# fifteen functions of the turn rate.
EQUAL_LOG_P = 6.0
# A column belongs to a group whose functions leave less than this share of its squares
GROUP_RESIDUAL_SHARE = 0.02


@dataclass(frozen=True)
class Unexplained:
    """Result of the score tests. log_p: of the best entry or of all jointly, adjusted for multiple tests.

    about: name of the regressor, or a period (s). columns: (M, A, f), the dictionary; empty if insignificant. clearest:
    (M, A, c), the most significant columns. penalty: quantile of the best test under the null at
    `SETTINGS.robust_level`.
    """

    log_p: float
    about: str | float
    columns: Array
    clearest: Array
    penalty: float = 0.0

    @property
    def found(self) -> bool:
        """Return whether the residual is systematic."""
        return self.log_p < np.log(SETTINGS.robust_level)

    @property
    def follows(self) -> Reason:
        """Return the sentence that names the regressor."""
        if isinstance(self.about, float):
            return finding("REST_FOLLOWS_PERIOD", seconds=self.about)
        return finding("REST_FOLLOWS", about=self.about)


def find_unexplained(fitter: Fitter, fit: Fit) -> Unexplained:
    """Test the residual of a fit against the dictionary.

    The null distribution is from recordings simulated from the fit (parametric bootstrap).
    """
    problem, noise = fitter.problem, fit.noise
    score_tests, white, raw, basis = _score_tests(fitter, fit, problem, fit.seen, fit.residual)
    no_columns = raw["time"][:, :, :0]
    # Noise in the columns keeps the residual of a fit from being orthogonal to them. Projected, the residual would
    # follow the vehicle's speed and have its periods.
    whitened = noise.whiten(fit.residual)
    whitened = whitened / np.sqrt(float(whitened @ whitened) / (whitened.size - basis.shape[1]))
    spectral = lines(problem, whitened.reshape(-1, problem.axes))
    tested = len(score_tests) + len(spectral)
    found_events = [each for each in events(problem, fit, basis, white) if each.log_p < np.log(SETTINGS.robust_level)]
    if found_events:  # slow noise explains a step as well, unless the step predicts better
        base = fitter.fit_kept(fit.hypothesis.with_effects([], len(fit.seen), {}), fit.noise)
        least = INTERPOLATION_SHARE * (base.deviance - fit.deviance)
        found_events = [
            each
            for each in found_events
            if _is_predictive(problem, fit, each.columns, least + _limit(tested + each.tried, each.columns.shape[2]))
        ]
    log_trials = float(np.log(tested))
    nominal = [
        *(each.log_p for each in found_events),
        *(test.log_p() for test in score_tests),
        *(line.log_p for line in spectral),
    ]
    if min(nominal) + log_trials > np.log(SETTINGS.robust_level):
        return Unexplained(min(min(nominal) + log_trials, 0.0), "", no_columns, no_columns)
    grown = _inflation_under_null(fitter, fit, score_tests)
    tests: list[tuple[float, str | float, Array]]
    tests = [
        (test.log_p(by), test.name, raw[test.name][:, :, test.at]) for test, by in zip(score_tests, grown, strict=True)
    ]
    tests += [(line.log_p, line.period_s, _along_axes(line.waves, problem.axes)) for line in spectral]
    tests += [(each.log_p, each.about, each.columns) for each in found_events]
    best = min(tests, key=_first)
    about = _simplest(tests, best[0])
    log_p = best[0] + log_trials
    # the best of many lines would always explain some of the noise
    clear = [_along_axes(line.waves, problem.axes) for line in spectral if line.log_p < np.log(SETTINGS.robust_level)]
    columns = np.concatenate([*raw.values(), *clear], axis=2)
    tested = next((tested + each.tried for each in found_events if each.about == best[1]), tested)
    found = Unexplained(min(log_p, 0.0), about[1], columns, best[2], _limit(tested, best[2].shape[2]))
    return found if found.found else replace(found, columns=no_columns, clearest=no_columns)


def _limit(tested: int, columns: int) -> float:
    """Return the energy that the best of `tested` tests exceeds under the null with probability
    `SETTINGS.robust_level`."""
    return float(chi2_isf(SETTINGS.robust_level / tested, columns))


def _simplest(tests: Sequence[tuple[float, str | float, Array]], log_p: float) -> tuple[float, str | float, Array]:
    """Return the candidate with the fewest columns among those within `EQUAL_LOG_P` of log_p."""
    likely = (each for each in tests if each[0] <= log_p + EQUAL_LOG_P)
    return min(likely, key=lambda each: (each[2].shape[2], each[0]))


def _first(each: tuple[float, str | float, Array]) -> float:
    return each[0]


@dataclass(frozen=True)
class FollowTest:
    """Score test. name: of the group; at: columns under test; energy: chi-square of dof."""

    name: str
    at: NDArray[np.intp]
    energy: float
    dof: int

    def log_p(self, grown: float = 1.0) -> float:
        """Return log p of the energy, divided by its inflation under the null."""
        return float(chi2_logsf(self.energy / grown, max(self.dof, 1))) if self.dof else 0.0


def _score_tests(
    fitter: Fitter, fit: Fit, problem: Problem, seen: Sequence[Seen], residual: Array
) -> tuple[list[FollowTest], Array, dict[str, Array], Array]:
    """Return tests of a residual (M, A), the whitened residual, each group's columns and the basis.

    The whitened residual is of unit variance, orthogonal to the fit's columns, and ends with the rows of the prior.
    """
    noise = fit.noise
    columns = replace(fitter, problem=problem).columns(fit.hypothesis, seen)
    nuisance = NuisanceFit.of(problem, fit.hypothesis, seen, columns)
    q, white = _orthogonal_to_nuisances(nuisance, noise.whiten(nuisance.columns), noise.whiten(residual))
    white = white - q @ (q.T @ white)
    unobservable = nuisance.columns.shape[2] - columns.shape[2]
    white = white / np.sqrt(float(white @ white) / (residual.size - q.shape[1] + unobservable))
    score_tests: list[FollowTest] = []
    raw: dict[str, Array] = {}
    for name, functions in dictionary(problem, seen).items():
        raw[name] = _along_axes(functions, problem.axes)
        all_columns = ScoreTest.of(q, noise.whiten(raw[name]), white)
        for at in _columns_of_tests(name, functions.shape[1], problem.axes):
            score_tests.append(FollowTest(name, at, *all_columns.energy(at)))
    return score_tests, white, raw, q


def _orthogonal_to_nuisances(known: NuisanceFit, columns: Array, white: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis of whitened nuisance columns (M A, k) and a series, each with k prior rows.

    Without the prior, the scale of an insignificant sway, which is noise, would explain that noise.
    """
    basis = orthonormal(np.concatenate([columns, np.diag(1.0 / known.std)]))
    return basis, np.concatenate([white, known.centre / known.std])


def _inflation_under_null(fitter: Fitter, fit: Fit, score_tests: Sequence[FollowTest]) -> list[float]:
    """Return the inflation of each test's energy over chi-square in simulated recordings, at least 1."""
    energy, dof = np.full(len(score_tests), PRIOR_DOF), np.full(len(score_tests), PRIOR_DOF)
    for simulated, seen, residual in simulated_recordings(fitter.problem, fit, SIMULATED):
        tests, *_ = _score_tests(fitter, fit, simulated, seen, residual)
        energy += [test.energy for test in tests]
        dof += [test.dof for test in tests]
    return np.maximum(energy / dof, 1.0).tolist()


@dataclass(frozen=True)
class SpectralLine:
    """Most significant line of one recording. log_p: adjusted for all frequencies; waves: (M, 2) cosine and sine."""

    period_s: float
    log_p: float
    waves: Array


def lines(problem: Problem, innovations: Array) -> list[SpectralLine]:
    """Find a line in the spectrum of the innovations (M, A) of each recording that is long enough.

    Coloured GNSS noise has no period. Only periods longer than waves count: pairing two sensors leaves a residual of
    waves, which is no finding.
    """
    found = []
    for index, recording in enumerate(problem.recordings):
        rows = problem.recording_of == index
        step = SHORTEST_PERIOD_S / 5.0
        time = problem.time
        steps = np.diff(time[rows])
        shorter = shortened(steps, STEPS_OF_A_BIN * step * np.count_nonzero(rows))
        if shorter is not steps:
            time = time.copy()
            time[rows] = time[rows][0] + np.append(0.0, np.cumsum(shorter))
        position = ((time[rows] - time[rows][0]) / step).astype(int)
        sums = np.stack([np.bincount(position, series) for series in innovations[rows].T])
        n = 2 * sums.shape[1]  # twice the resolution of independent frequencies
        frequency = np.fft.rfftfreq(n, step)
        power = 2.0 * np.abs(np.fft.rfft(sums, n)) ** 2 / np.count_nonzero(rows)  # chi-square of 2 degrees of freedom
        band = (frequency >= FEWEST_PERIODS / recording.seconds) & (frequency <= 1.0 / SHORTEST_PERIOD_S)
        if not band.any():
            continue
        log_p = np.vstack([chi2_logsf(power, 2), chi2_logsf(power.sum(axis=0), 2 * innovations.shape[1])])[:, band]
        best = int(np.argmin(log_p.min(axis=0)))
        period = 1.0 / float(frequency[band][best])
        phase = 2.0 * np.pi * time / period
        waves = np.where(rows[:, None], np.column_stack([np.cos(phase), np.sin(phase)]), 0.0)
        found.append(SpectralLine(period, float(log_p.min() + np.log(log_p.size)), waves))
    return found


def is_predictive(problem: Problem, fit: Fit, unexplained: Unexplained) -> bool:
    """Return whether the regressor of the residual predicts held-out data better than slow noise and chance do."""
    return unexplained.found and _is_predictive(problem, fit, unexplained.clearest, unexplained.penalty)


def _is_predictive(problem: Problem, fit: Fit, columns: Array, min_gain: float) -> bool:
    """Return whether columns (M, A, c), added to a fit, gain more than the least in held-out deviance."""
    slow = SlowNoiseOfFit.of_fit(problem, fit)
    gain = predictive_gain(problem, slow, slow.with_nuisance(problem, fit.noise, columns))
    return gain > min_gain - columns.shape[2]


def without_replaceable(selection: EffectSelection) -> tuple[EffectSelection, Unexplained]:
    """Reject effects that an unknown cause explains better or may contribute to; return also the new residual's tests.

    Better means better prediction of held-out stretches. A group of functions that contains the effects includes their
    cause and is no rival. Only effects below `SETTINGS.instead_of` are tested.
    """
    fitter, fit = selection.fitter, selection.fit
    problem, unexplained = fitter.problem, find_unexplained(fitter, fit)
    best: tuple[float, EffectSelection, Unexplained] | None = None
    for out in _subsets(selection):
        reduced = selection.without({effect.name for effect in out})
        drop = reduced.fit.deviance - fit.deviance
        if drop > SETTINGS.instead_of:
            continue
        new = find_unexplained(fitter, reduced.fit)
        if not new.found or is_of_group(problem, fit, out, new.about) or not is_predictive(problem, reduced.fit, new):
            continue
        gain = _held_out_gain(problem, fit, reduced.fit, new) - SETTINGS.indistinguishable - INTERPOLATION_SHARE * drop
        if gain > 0.0 and (best is None or gain > best[0]):
            best = gain, reduced, new
    return (selection, unexplained) if best is None else best[1:]


def _held_out_gain(problem: Problem, fit: Fit, reduced: Fit, other: Unexplained) -> float:
    """Return the held-out deviance gain of an unmodelled regressor over the removed effects."""
    full, reduced_fit = (NuisanceFit.of_fit(problem, each) for each in (fit, reduced))
    reduced_fit = reduced_fit.and_nuisance(other.clearest, reduced.residual)
    effects = held_out_deviance(problem, fit.noise, full, fit.residual)
    return effects - held_out_deviance(problem, fit.noise, reduced_fit, reduced.residual)


def _subsets(selection: EffectSelection) -> list[tuple[Effect, ...]]:
    effects = selection.fit.effects
    return [out for n in range(1, min(2, len(effects)) + 1) for out in itertools.combinations(effects, n)]


def nuisance_shift(problem: Problem, fit: Fit, unexplained: Unexplained) -> Array:
    """Return the shift (6 + p,) of a fit's parameters with the most significant columns as nuisance."""
    slow = SlowNoiseOfFit.of_fit(problem, fit).with_nuisance(problem, fit.noise, unexplained.clearest)
    system = slow.known._replace(centre=np.zeros_like(slow.known.centre))  # linearised at the fit, whatever its prior
    return system.step(slow.noise, fit.residual).solution()[: fit.columns.shape[2]]


def is_of_group(problem: Problem, fit: Fit, effects: Sequence[Effect], about: str | float) -> bool:
    """Return whether the columns of some effects of a fit, without its calibration, lie in one group.

    about: what a residual follows; a period (s) and an event are no group.
    """
    groups = dictionary(problem, fit.seen)
    if isinstance(about, float) or about not in groups:
        return False
    noise, parameters = fit.noise, fit.hypothesis.parameters()
    own = [6 + at for at, each in enumerate(parameters) if each.effect in effects]
    functions = _along_axes(groups[about], problem.axes)
    calibration = orthonormal(noise.whiten(fit.columns[:, :, :6]))
    own_columns = noise.whiten(fit.columns[:, :, own])
    own_columns = own_columns - calibration @ (calibration.T @ own_columns)
    group = orthonormal(np.concatenate([calibration, noise.whiten(functions)], axis=1))
    residual = own_columns - group @ (group.T @ own_columns)
    return bool(((residual**2).sum(axis=0) < GROUP_RESIDUAL_SHARE * (own_columns**2).sum(axis=0)).all())


def _along_axes(functions: Array, axes: int) -> Array:
    """Return (M, A, A c): each function of (M, c) on each axis."""
    m, c = functions.shape
    return np.einsum("mc,ij->mijc", functions, np.eye(axes)).reshape(m, axes, axes * c)


def _columns_of_tests(name: str, c: int, axes: int) -> list[NDArray[np.intp]]:
    """Return columns of `_along_axes` per test: the group, each axis and each alternative."""
    index = np.arange(axes * c).reshape(axes, c)
    parts = [index.ravel(), *index]
    if name not in ALTERNATIVES:
        return parts
    together = ALTERNATIVES[name]
    return [*parts, *(index[:, at : at + together].ravel() for at in range(0, c, together))]
