"""What the residual of the best combination of effects follows: vehicle motion, time, a period or an event.

Score tests against a dictionary of regressors, each with a free vector in the body frame, propose. Prediction of
held-out stretches decides, with the noise re-estimated beside the regressor: slow noise is the rival explanation.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_logsf
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
from .alternative_regressors import ALTERNATIVES, Regressor, dictionary
from .effect_selection import EffectSelection
from .event_scan import events

# Spectral lines: longer than wave periods; more periods than the time dictionary resolves
SHORTEST_PERIOD_S, FEWEST_PERIODS = 16.0, 3.0
# Steps per bin of the series for the spectrum, at most: memory must not grow with pauses
STEPS_OF_A_BIN = 16
# Degrees of freedom of the prior on the null distribution's scale of 1
PRIOR_DOF = 4.0
# Regressors with the most significant score tests, of which the prediction is computed
N_PREDICTED = 8
# Share of the effects' explained deviance that inexact interpolation may leave
INTERPOLATION_SHARE = 0.005
# A column belongs to a group whose functions leave less than this share of its squares
GROUP_RESIDUAL_SHARE = 0.02


@dataclass(frozen=True)
class Unexplained:
    """What a residual follows.

    log_p: of the regressor's gain on held-out data, adjusted for its alternatives.
    about: name of the regressor, or a period (s).
    columns: (M, A, f), the dictionary; empty if insignificant.
    clearest: (M, A, c), of the regressor.
    log_tried: logarithm of its alternatives.
    """

    log_p: float
    about: str | float
    columns: Array
    clearest: Array
    log_tried: float = 0.0

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
    """Return the regressor with the most significant score test that predicts held-out stretches of a residual."""
    problem, noise = fitter.problem, fit.noise
    basis, white = _orthogonal_residual(problem, fit, fit.seen, fit.residual)
    of_motion = _score_tests(problem, fit, fit.seen, basis, white)
    # Noise in the columns keeps the residual of a fit from being orthogonal to them. Projected, the residual would
    # follow the vehicle's speed and have its periods.
    whitened = noise.whiten(fit.residual)
    whitened = whitened / np.sqrt(float(whitened @ whitened) / (whitened.size - basis.shape[1]))
    spectral = lines(problem, whitened.reshape(-1, problem.axes))
    of_time = spectral + events(problem, fit, basis, white)
    log_p = min(each.log_p for each in of_motion + of_time)
    none = fit.columns[:, :, :0]
    if log_p > np.log(SETTINGS.robust_level):
        return Unexplained(min(log_p, 0.0), "", none, none)
    base = fitter.fit_kept(fit.hypothesis.with_effects([], fit.n_recordings, {}), noise)
    left = INTERPOLATION_SHARE * (base.deviance - fit.deviance)
    of_time = [each._replace(left=left) for each in of_time]
    proposed = sorted(_inflated(problem, fit, of_motion) + of_time, key=lambda each: each.log_p)[:N_PREDICTED]
    log_p = 0.0
    for each in proposed:
        log_p = min(log_p, _predicted(problem, fit, each).log_p)
        if log_p < np.log(SETTINGS.robust_level):
            # the best of many lines would always explain some of the noise
            clear = [line.columns for line in spectral if line.log_p < np.log(SETTINGS.robust_level)]
            groups = {part.about: part.columns for part in reversed(of_motion)}  # of each the first, the whole group
            columns = np.concatenate([*groups.values(), *clear], axis=2)
            return Unexplained(log_p, each.about, columns, each.columns, each.log_tried)
    return Unexplained(log_p, "", none, none)


def _predicted(problem: Problem, fit: Fit, regressor: Regressor) -> Regressor:
    """Return a regressor with its gain in held-out deviance over slow noise as the energy of its test.

    Chance gains c less of c columns on held-out data than on the data that they were fitted to.
    """
    slow, c = SlowNoiseOfFit.of_fit(problem, fit), regressor.columns.shape[2]
    gain = predictive_gain(problem, slow, slow.with_nuisance(problem, fit.noise, regressor.columns))
    return regressor._replace(energy=max(gain - regressor.left + c, 0.0), dof=c)


def _orthogonal_residual(problem: Problem, fit: Fit, seen: Sequence[Seen], residual: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis (M A + k, r) of a fit's whitened columns, and a whitened residual of unit variance.

    problem, seen, residual: of the recordings or of simulated ones. Basis and residual end with the rows of the prior,
    and the residual is orthogonal to the basis.
    """
    columns = problem.all_columns(fit.hypothesis, seen)
    nuisance, noise = NuisanceFit.of(problem, fit.hypothesis, seen, columns), fit.noise
    q, white = _orthogonal_to_nuisances(nuisance, noise.whiten(nuisance.columns), noise.whiten(residual))
    white = white - q @ (q.T @ white)
    unobservable = nuisance.columns.shape[2] - columns.shape[2]
    return q, white / np.sqrt(float(white @ white) / (residual.size - q.shape[1] + unobservable))


def _score_tests(problem: Problem, fit: Fit, seen: Sequence[Seen], basis: Array, white: Array) -> list[Regressor]:
    """Return the dictionary's regressors by groups and their parts, with score tests of an `_orthogonal_residual`."""
    found = []
    for name, functions in dictionary(problem, seen).items():
        columns = _along_axes(functions, problem.axes)
        test = ScoreTest.of(basis, fit.noise.whiten(columns), white)
        for at in _columns_of_tests(name, functions.shape[1], problem.axes):
            found.append(Regressor(name, columns[:, :, at], *test.energy(at)))
    return [each._replace(log_tried=float(np.log(len(found)))) for each in found]


def _inflated(problem: Problem, fit: Fit, of_motion: Sequence[Regressor]) -> list[Regressor]:
    """Return regressors with the inflation of their energies over chi-square in simulated recordings, at least 1."""
    energy, dof = np.full(len(of_motion), PRIOR_DOF), np.full(len(of_motion), PRIOR_DOF)
    for simulated, seen, residual in simulated_recordings(problem, fit, SIMULATED):
        tests = _score_tests(simulated, fit, seen, *_orthogonal_residual(simulated, fit, seen, residual))
        energy += [test.energy for test in tests]
        dof += [test.dof for test in tests]
    inflation = np.maximum(energy / dof, 1.0).tolist()
    return [each._replace(inflation=by) for each, by in zip(of_motion, inflation, strict=True)]


def _orthogonal_to_nuisances(known: NuisanceFit, columns: Array, white: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis of whitened nuisance columns (M A, k) and a series, each with k prior rows.

    Without the prior, the scale of an insignificant sway, which is noise, would explain that noise.
    """
    basis = orthonormal(np.concatenate([columns, np.diag(1.0 / known.std)]))
    return basis, np.concatenate([white, known.centre / known.std])


def lines(problem: Problem, innovations: Array) -> list[Regressor]:
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
        energy = np.vstack([power, power.sum(axis=0)])[:, band]
        dof = np.array([2] * innovations.shape[1] + [2 * innovations.shape[1]])
        log_p = chi2_logsf(energy, dof[:, None])
        which, best = np.unravel_index(int(np.argmin(log_p)), log_p.shape)
        period = 1.0 / float(frequency[band][best])
        phase = 2.0 * np.pi * time / period
        waves = np.where(rows[:, None], np.column_stack([np.cos(phase), np.sin(phase)]), 0.0)
        columns, tried = _along_axes(waves, problem.axes), float(np.log(log_p.size))
        found.append(Regressor(period, columns, float(energy[which, best]), int(dof[which]), tried))
    return found


def without_replaceable(selection: EffectSelection) -> tuple[EffectSelection, Unexplained]:
    """Reject effects that an unknown cause explains better or may contribute to; return also the new residual's tests.

    Better means better prediction of held-out stretches, by more than chance. A group of functions that contains the
    effects includes their cause and is no rival. Only effects below `SETTINGS.instead_of` are tested.
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
        if not new.found or is_of_group(problem, fit, out, new.about):
            continue
        chance = SETTINGS.indistinguishable + new.log_tried  # more, as the best of several regressors is chosen
        gain = _held_out_gain(problem, fit, reduced.fit, new) - chance - INTERPOLATION_SHARE * drop
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
