"""Gauss-Newton fits of hypotheses in the composed model.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...effects.base import Effect
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis, Values, amplitudes, is_time_of_run, whose_parameters
from ..model.seen import Seen
from ..model.settings import SETTINGS
from ..noise.noise_model import Noise
from ..noise.whitened_least_squares import WhitenedLeastSquares

# Largest number of steps; converged if a step would reduce the deviance by less than this; differences of 1 matter
MAX_STEPS, CONVERGED_GAIN = 30, 1e-3
HALVINGS = 5
# The last step is rejected if it increases the misfit by this factor
MAX_MISFIT_INCREASE = 30.0
# Standard deviations of the chance gain from other noise that are subtracted
CHANCE_GAIN_Z = 1.5
# Prior σ of an effect's parameters, in typical sizes: wide, to act only on unobservable parameters
PRIOR_IN_TYPICAL = 50.0
# Deviance within which two fits are equal
EQUAL_DEVIANCE = 2.0
# A fit is skipped as worse if its bound is worse by that, plus this share of its first step's gain for nonlinearity
NONLINEAR_SHARE = 0.2
# A burst: outliers with neighbours beyond half of that, of at most this share of the recording
MAX_BURST_SHARE = 0.02
# Deviance bound of a change point's 95 per cent interval (Hansen, 2000, Econometrica 68, theorem 2)
CHANGE_POINT_DEVIANCE = -2.0 * float(np.log(1.0 - np.sqrt(0.95)))
# Half width, in standard deviations, of a 95 per cent interval
Z_INTERVAL = 1.96
Mask = NDArray[np.bool_]
# Evaluation of a hypothesis, and its residual (M, A)
Evaluated = tuple[tuple[Seen, ...], Array]


def around(value: float, std: float) -> tuple[float, float, float]:
    """Return a value with its 95 per cent interval."""
    return value, value - Z_INTERVAL * std, value + Z_INTERVAL * std


def prior_std(hypothesis: Hypothesis) -> Array:
    """Return the prior's standard deviations of calibration and effects, (6 + p,)."""
    own = [PRIOR_IN_TYPICAL * each.spec.typical for each in hypothesis.parameters()]
    return np.array([SETTINGS.prior_angle] * 3 + [SETTINGS.prior_scale] * 3 + own)


@dataclass(frozen=True)
class Fit:
    """Fitted hypothesis. residual: (M, A) m/s, winsorised. system: of the last step. own_noise: whitened residual from
    simulated noise of the velocities. deviance: whitened squares and prior, minus the squares of own_noise: a delay
    changes the interpolation phase and a low-pass smooths noise, neither of which is evidence."""

    problem: Problem
    hypothesis: Hypothesis
    residual: Array
    noise: Noise
    system: WhitenedLeastSquares
    deviance: float
    own_noise: Array
    # results of tests of this fit, by name, each computed once
    kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def n_recordings(self) -> int:
        """Return the number of recordings."""
        return len(self.problem.recordings)

    @cached_property
    def seen(self) -> list[Seen]:
        """Return the evaluation per recording, on demand: it is large, and most fits never need it."""
        return self.problem.all_seen(self.hypothesis)

    @cached_property
    def columns(self) -> Array:
        """Return derivatives of the residual, (M, A, 6 + p), on demand."""
        return self.problem.all_columns(self.hypothesis, self.seen)

    def gain_over(self, reduced: Fit) -> float:
        """Return the lower bound of the deviance gain over another fit.

        The deviances of two fits whose simulated whitened noise differs by d differ by σ = 2 |d| under the null
        hypothesis.
        """
        other = self.own_noise - reduced.own_noise
        return reduced.deviance - self.deviance - CHANCE_GAIN_Z * 2.0 * float(np.sqrt(other @ other))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the effects of the hypothesis."""
        return self.hypothesis.effects

    @property
    def values(self) -> Mapping[str, tuple[Values, ...]]:
        """Return the values of the hypothesis."""
        return self.hypothesis.values

    @property
    def dof(self) -> float:
        """Return the degrees of freedom of the effects."""
        return float(self.system.effective_dof()[6:].sum())

    def covariance(self, block: NDArray[np.intp]) -> Array:
        """Return the covariance (6 + p, 6 + p) from the noise model or from blocks (M,), whichever is larger.

        The sandwich H⁻¹ (Σ s sᵀ) H⁻¹ of the blocks' scores s holds whatever colour and level the noise has in a block.
        """
        inverse = self.system.covariance()
        scores = self.scores(block)
        scores = scores - scores.mean(axis=0)  # prior and own noise make the mean
        n = len(scores)
        sandwich = inverse @ (scores.T @ scores) @ inverse * n / max(n - 1, 1)
        grown = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
        return np.asarray(inverse * np.outer(grown, grown))

    def scores(self, block: NDArray[np.intp]) -> Array:
        """Return sums (B, 6 + p) of whitened columns times residual over blocks (M,)."""
        white = self.noise.whiten(self.columns).reshape(len(block), -1, self.columns.shape[2])
        residual = self.noise.whiten(self.residual).reshape(len(block), -1)
        products = np.einsum("map,ma->mp", white, residual)
        return np.stack([np.bincount(block, column) for column in products.T], axis=1)


@dataclass(frozen=True)
class _Linearisation:
    """Linearisation of a hypothesis under a noise: seen, residual and columns as in `Fit`; system of its step."""

    seen: tuple[Seen, ...]
    residual: Array
    columns: Array
    system: WhitenedLeastSquares


@dataclass(frozen=True)
class Fitter:
    """Fitter of hypotheses to a problem. outliers: (M, A) m/s, subtracted from residuals. held: (M,) bins held out."""

    problem: Problem
    outliers: Array | float = 0.0
    held: Mask | None = None
    _fits: dict[tuple[object, ...], Fit] = field(default_factory=dict, repr=False)

    def without(self, held: Mask) -> Fitter:
        """Return a fitter with some bins (M,) held out."""
        return replace(self, held=held, _fits={})

    def bursts(self, fit: Fit) -> Mask:
        """Return a mask (M,) of bins in short bursts of large errors, too rare for an effect.

        The residual is not whitened: bursts would determine the noise's colour.
        """
        raw = (fit.residual + self.outliers) / fit.noise.level
        size = np.abs(raw / np.maximum(robust_std(raw), 1e-12)).max(axis=1)
        run = np.cumsum(np.diff(size > 0.5 * SETTINGS.outlying, prepend=False))  # odd in the runs, even between them
        in_burst = np.isin(run, run[size > SETTINGS.outlying])
        return in_burst & (np.count_nonzero(in_burst) <= MAX_BURST_SHARE * len(in_burst))

    def evaluated(self, hypothesis: Hypothesis) -> tuple[tuple[Seen, ...], Array]:
        """Evaluate a hypothesis; return the evaluation and the residual (M, A)."""
        seen = tuple(self.problem.all_seen(hypothesis))
        return seen, self.problem.residual(seen) - self.outliers

    def _linearised(
        self, hypothesis: Hypothesis, noise: Noise, seen: tuple[Seen, ...] | None = None, residual: Array | None = None
    ) -> _Linearisation:
        """Linearise a hypothesis. seen, residual: its evaluation, if known."""
        if seen is None or residual is None:
            seen, residual = self.evaluated(hypothesis)
        columns = self.problem.all_columns(hypothesis, seen)
        return _Linearisation(seen, residual, columns, self._system(noise, columns, residual, hypothesis))

    def _whiten(self, noise: Noise, values: Array) -> Array:
        """Whiten values (M, A, ...) without held-out bins."""
        white = noise.whiten(values)
        if self.held is not None:
            white = white[np.repeat(~self.held, self.problem.axes)]
        return white

    def _misfit(self, noise: Noise, residual: Array, hypothesis: Hypothesis) -> float:
        white = self._whiten(noise, residual)
        return float(white @ white + np.sum((hypothesis.vector() / prior_std(hypothesis)) ** 2))

    def fit(
        self,
        start: Hypothesis,
        noise: Noise,
        max_steps: int = MAX_STEPS,
        only_own: bool = False,
        fixed: frozenset[str] = frozenset(),
        linearised: _Linearisation | None = None,
        evaluated: Evaluated | None = None,
    ) -> Fit:
        """Fit a hypothesis under a noise. only_own: fit only the parameters per recording.

        fixed: names of effects whose values are fixed. linearised, evaluated: linearisation or evaluation of the
        start, if known.
        """
        is_fixed = np.array([True] * 6 + [not each.effect.per_recording for each in start.parameters()]) & only_own
        is_fixed |= np.array([False] * 6 + [each.effect.name in fixed for each in start.parameters()])
        free, hypothesis = np.flatnonzero(~is_fixed), start
        if linearised is not None:
            evaluated = linearised.seen, linearised.residual
        seen, residual = evaluated or self.evaluated(hypothesis)
        misfit = self._misfit(noise, residual, hypothesis)
        for _ in range(max_steps):
            linearised = linearised or self._linearised(hypothesis, noise, seen, residual)
            step = np.zeros(len(is_fixed))
            step[free] = linearised.system.part(free).solution()
            if misfit - linearised.system.misfit(step) < CONVERGED_GAIN:
                break
            improved, trial_step = False, step
            for _ in range(HALVINGS):
                trial = hypothesis.moved(trial_step)
                trial_seen, trial_residual = self.evaluated(trial)
                trial_misfit = self._misfit(noise, trial_residual, trial)
                if trial_misfit <= misfit:
                    improved = True
                    break
                trial_step = 0.4 * trial_step
            if not improved:
                break
            linearised = None
            hypothesis, seen, residual, misfit = trial, trial_seen, trial_residual, trial_misfit
        linearised = linearised or self._linearised(hypothesis, noise, seen, residual)
        system = self._without_own_noise(linearised, hypothesis, noise)
        step = np.zeros(len(is_fixed))
        step[free] = system.part(free).solution()
        last = hypothesis.moved(step)
        last_residual = self.evaluated(last)[1]
        last_misfit = self._misfit(noise, last_residual, last)
        if last_misfit < MAX_MISFIT_INCREASE * misfit:
            hypothesis, residual, misfit = last, last_residual, last_misfit
        own_noise = self._own_noise(hypothesis, noise, residual + self.outliers)
        deviance = misfit - float(own_noise @ own_noise)
        return Fit(self.problem, hypothesis, residual, noise, system, deviance, own_noise)

    def _without_own_noise(self, at: _Linearisation, hypothesis: Hypothesis, noise: Noise) -> WhitenedLeastSquares:
        """Subtract from a linearisation's system the contribution of the velocities' own noise, which is simulated.

        The columns of scale and misalignment contain the same noise as the residual, so scale would fit noise (errors
        in variables).
        """
        gram = at.system.gram
        for perturbed in self.problem.perturbed:
            seen = perturbed.all_seen(hypothesis)
            white = self._whiten(noise, perturbed.all_columns(hypothesis, seen) - at.columns)
            noise_part = self._whiten(noise, perturbed.residual(seen) - at.residual - self.outliers)
            joined = np.column_stack([white, -noise_part])
            gram = gram - joined.T @ joined
        corrected = replace(at.system, gram=gram)
        return corrected if corrected.is_definite else at.system

    def _own_noise(self, hypothesis: Hypothesis, noise: Noise, residual: Array) -> Array:
        """Return the whitened contribution (S n,) of S simulations of velocity noise to a residual of n values."""
        white = [
            self._whiten(noise, perturbed.residual(perturbed.all_seen(hypothesis)) - residual)
            for perturbed in self.problem.perturbed
        ]
        return np.concatenate(white)

    def _system(self, noise: Noise, columns: Array, residual: Array, hypothesis: Hypothesis) -> WhitenedLeastSquares:
        """Return the system of the step (6 + p,) from a hypothesis."""
        return WhitenedLeastSquares.of(
            self._whiten(noise, columns), -self._whiten(noise, residual), prior_std(hypothesis), -hypothesis.vector()
        )

    def fit_kept(self, start: Hypothesis, noise: Noise) -> Fit:
        """Return `fit`, cached by effects, event times and noise; it starts at the best optimum under another noise."""
        windows = tuple(
            value[spec.name]
            for effect in start.effects
            for value in start.values[effect.name]
            for spec in effect.parameters
            if is_time_of_run(spec)
        )
        effects = sorted((effect.name, len(effect.parameters), effect.per_recording) for effect in start.effects)
        model = tuple(effects), windows
        key = (id(noise), *model)
        if key not in self._fits:
            nearest, evaluated = start, self.evaluated(start)
            for each in self.problem.fitted.get(model, []):  # optima under other noise are near
                other = self.evaluated(each)
                if self._misfit(noise, other[1], each) < self._misfit(noise, evaluated[1], nearest):
                    nearest, evaluated = each, other
            self._fits[key] = self.fit(nearest, noise, evaluated=evaluated)
            self.problem.fitted[model] = [self._fits[key].hypothesis]
        return self._fits[key]

    def refined(self, fit: Fit, steps: Sequence[float]) -> Fit:
        """Refine the times at which a fit's effects begin and end, beyond the grid."""
        for step in steps:
            for effect in fit.effects:
                for spec in (spec for spec in effect.parameters if is_time_of_run(spec)):
                    fit = self._refine_event_time(fit, effect, spec.name, step)
        return fit

    def _refine_event_time(self, fit: Fit, effect: Effect, name: str, step: float) -> Fit:
        """Return the fit with an effect's time moved by ± `step` (s), if that lowers the deviance.

        name: of the time parameter. The predicted gain of the current fit is computed once, and again after a move.
        """
        converged: tuple[Fit, float] | None = None
        for sign in (-1.0, 1.0):
            values = fit.values[effect.name]
            if not all(np.isfinite(each[name]) for each in values):
                continue
            shifted = tuple({**each, name: max(0.0, each[name] + sign * step)} for each in values)
            hypothesis = replace(fit.hypothesis, values={**fit.values, effect.name: shifted})
            linearised = self._linearised(hypothesis, fit.noise)
            if converged is None or converged[0] is not fit:
                converged = fit, self._predicted_gain(fit)
            if self._is_surely_worse(hypothesis, linearised, fit.noise, fit.deviance, converged[1]):
                continue
            trial = self.fit(hypothesis, fit.noise, 3, linearised=linearised)
            if trial.deviance < fit.deviance:
                fit = trial
        return fit

    def _predicted_gain(self, fit: Fit) -> float:
        """Return the predicted gain of a linear step from a converged fit, which is not attainable."""
        system = self._system(fit.noise, fit.columns, fit.residual, fit.hypothesis)
        return self._misfit(fit.noise, fit.residual, fit.hypothesis) - system.misfit(system.solution())

    def _is_surely_worse(
        self, hypothesis: Hypothesis, linearised: _Linearisation, noise: Noise, deviance: float, promised: float = 0.0
    ) -> bool:
        """Return whether the fit of a hypothesis will surely exceed a deviance, judged by one linear step.

        The deviance after the step is the minimum that a fit can reach, except for nonlinearity, for which a share of
        the step's gain is allowed.

        linearised: the hypothesis before the step.
        deviance: of the fit to compare with.
        promised: gain that a linear step predicts even from a converged fit nearby (`_predicted_gain`). No fit reaches
          this gain, so it is not expected of the hypothesis either.
        """
        own_noise = self._own_noise(hypothesis, noise, linearised.residual + self.outliers)
        minimum = linearised.system.misfit(linearised.system.solution())
        gain = self._misfit(noise, linearised.residual, hypothesis) - minimum
        minimum -= float(own_noise @ own_noise)
        if minimum > deviance + EQUAL_DEVIANCE + NONLINEAR_SHARE * gain:
            return True
        unattainable = min(promised, gain)
        return minimum + unattainable > deviance + 2.0 * EQUAL_DEVIANCE + NONLINEAR_SHARE * (gain - unattainable)

    def time_interval(self, fit: Fit, effect: Effect, name: str, recording: int) -> tuple[float, float, float]:
        """Return the time at which an effect begins or ends, with its 95 per cent interval."""
        value = fit.values[effect.name][recording][name]
        seconds = self.problem.recordings[recording].seconds
        if not np.isfinite(value):
            return value, seconds, value
        ends = []
        for sign in (-1.0, 1.0):
            step, end, was_as_good = 0.5 * self.problem.interval, value, True
            while 0.0 <= (at := value + sign * step) <= seconds:
                worse = self._worse_at(_with_time(fit, effect, name, recording, at), fit)
                if was_as_good or worse < CHANGE_POINT_DEVIANCE:  # the first rejected time bounds the interval
                    end = at
                if worse > SETTINGS.conclusive:
                    break
                step, was_as_good = 1.6 * step, worse < CHANGE_POINT_DEVIANCE
            ends.append(end)
        return value, ends[0], ends[1]

    def _worse_at(self, moved: Hypothesis, fit: Fit) -> float:
        """Return the deviance increase of a fit at another time, infinite if it is certainly too large."""
        linearised = self._linearised(moved, fit.noise)
        if self._is_surely_worse(moved, linearised, fit.noise, fit.deviance + SETTINGS.conclusive):
            return np.inf
        return self.fit(moved, fit.noise, 2, linearised=linearised).deviance - fit.deviance

    def moved_by_time(self, fit: Fit, effect: Effect, name: str, recording: int, ends: Sequence[float]) -> Array:
        """Return the covariance (6 + p, 6 + p) due to a time's uncertainty. ends: of its 95 per cent interval, s."""
        added = np.zeros((len(fit.hypothesis.vector()),) * 2)
        for at in ends:
            if np.isfinite(at) and at != fit.values[effect.name][recording][name]:
                moved = self.fit(_with_time(fit, effect, name, recording, at), fit.noise, 3).hypothesis.vector()
                moved = (moved - fit.hypothesis.vector()) / Z_INTERVAL
                added += np.outer(moved, moved) / len(ends)
        return added


def _with_time(fit: Fit, effect: Effect, name: str, recording: int, at: float) -> Hypothesis:
    """Return the hypothesis of a fit with another time, s, of an effect in one recording."""
    per = fit.values[effect.name]
    moved = tuple({**each, name: at} if index == recording else each for index, each in enumerate(per))
    return replace(fit.hypothesis, values={**fit.values, effect.name: moved})


def n_amplitudes(effect: Effect, n_recordings: int) -> int:
    """Return the number of parameters with a derivative, of all recordings."""
    return len(amplitudes(effect)) * len(whose_parameters(effect, n_recordings))
