"""Fits of hypotheses with exact traces: the calibration, and effects on top of it, with the noise that each leaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve
from scipy.stats import chi2

from ..calibration.frames import Array
from ..effects.base import Effect, ParameterSpec
from .dictionary import Variant, amplitudes, is_bent, variant_at
from .noise import Noise
from .problem import PRIOR_STD, Problem, Values

# Gauss-Newton: steps, halvings of one, and the share of a typical size at which it has converged
MAX_STEPS, MAX_HALVINGS, CONVERGED = 8, 4, 1e-3
MAX_KEPT_VARIANTS = 100


@dataclass(frozen=True)
class Fit:
    """A hypothesis fitted: which effects, with which values.

    values: by effect and parameter. change, change_std: (6,) of φ and δk. residual: (M, 3) m/s that is left. noise: as
    estimated from it. deviance: -2 log likelihood with that noise. dof: that the effects use up.
    """

    effects: tuple[Effect, ...]
    values: Mapping[str, Values]
    change: Array
    change_std: Array
    residual: Array
    noise: Noise
    deviance: float
    dof: float


@dataclass(frozen=True)
class _Step:
    """The least squares problem about some values, solved. steps: (6 + p,) to go from there. at: (6 + p,) with those
    of the bent traces left where they are; residual (M, 3) and misfit are of that. std: (6,) of the calibration.
    """

    steps: Array
    at: Array
    std: Array
    residual: Array
    misfit: float
    dof: float


@dataclass(frozen=True)
class Fitter:
    """Fits hypotheses about one problem. residual: (M, 3), robustified, in place of the problem's own."""

    problem: Problem
    residual: Array
    _variants: dict[tuple[str, tuple[float, ...]], Variant] = field(default_factory=dict)

    def with_residual(self, residual: Array) -> Fitter:
        """The same with another residual (M, 3)."""
        return replace(self, residual=residual)

    def variant(self, effect: Effect, values: Values) -> Variant:
        """The effect about values; kept, since most are asked for again."""
        fixed = [] if is_bent(effect) else amplitudes(effect)
        key = effect.name, tuple(values[spec.name] for spec in effect.parameters if spec not in fixed)
        if key not in self._variants:
            if len(self._variants) > MAX_KEPT_VARIANTS:
                self._variants.clear()
            self._variants[key] = variant_at(self.problem, effect, values)
        return self._variants[key]

    def jacobian(self, effect: Effect, values: Values) -> tuple[list[ParameterSpec], Array]:
        """All parameters with a derivative and d trace / d parameter (M, 3, p)."""
        return amplitudes(effect), self.variant(effect, values).columns

    def fit(self, effects: Sequence[Effect], noise: Noise, start: Mapping[str, Values]) -> Fit:
        """Fit effects together with the calibration under a noise; parameters without a derivative stay at start.

        Gauss-Newton with halved steps; one step where all traces are linear.
        """
        values = {effect.name: start.get(effect.name, effect.defaults) for effect in effects}
        bent = any(is_bent(effect) for effect in effects)
        step = self._step(effects, noise, values)
        for _ in range(MAX_STEPS if bent else 0):
            moved, far = self._moved(effects, values, step.steps, 1.0)
            for halving in range(1, MAX_HALVINGS + 1):
                trial = self._step(effects, noise, moved)
                if trial.misfit <= step.misfit or far < CONVERGED:
                    break
                moved, far = self._moved(effects, values, step.steps, 0.5**halving)
            if trial.misfit > step.misfit:
                break
            values, step = moved, trial
            if far < CONVERGED:
                break
        at = 6
        for effect in effects:
            variant = self.variant(effect, values[effect.name])
            part = step.at[at : at + len(variant.std)]
            at += len(variant.std)
            if not is_bent(effect):
                values = {**values, effect.name: variant.moved(part)}
        return Fit(
            tuple(effects), values, self.problem.prior_change + step.at[:6], step.std, step.residual, noise,
            noise.deviance(step.residual), step.dof,
        )  # fmt: skip

    def fit_with_noise(
        self, effects: Sequence[Effect], noise: Noise, start: Mapping[str, Values], rounds: int = 2
    ) -> Fit:
        """`fit`, with the noise estimated anew from what it leaves, and again."""
        fit = self.fit(effects, noise, start)
        for _ in range(rounds):
            noise = noise.updated(fit.residual)
            fit = self.fit(effects, noise, fit.values)
        return fit

    def _step(self, effects: Sequence[Effect], noise: Noise, values: Mapping[str, Values]) -> _Step:
        """Solve about values. The residual and misfit hold those of the bent traces at the values themselves."""
        found = [self.variant(effect, values[effect.name]) for effect in effects]
        target = self.residual - self.problem.base @ self.problem.prior_change
        for one in found:
            if one.offset is not None:
                target = target - one.offset
        raw = np.concatenate([self.problem.base, *(one.columns for one in found)], axis=2)
        white = noise.whiten(np.concatenate([raw, target[:, :, None]], axis=2))
        gram = white.T @ white
        prior = np.concatenate([PRIOR_STD, *(one.std for one in found)]) ** -2.0
        normal, seen = gram[:-1, :-1] + np.diag(prior), gram[:-1, -1]
        straight = np.concatenate([np.ones(6, bool), *(np.full(len(one.std), one.offset is None) for one in found)])
        at = np.zeros(len(seen))
        at[straight] = solve(normal[np.ix_(straight, straight)], seen[straight], assume_a="pos")
        centre = np.concatenate([np.zeros(6), *(one.centre for one in found)])
        misfit = float(gram[-1, -1] - 2.0 * at @ seen + at @ normal @ at + centre**2 @ prior)
        variances = np.diag(np.linalg.inv(normal))
        held = variances * prior  # share that the prior has in each: no degree of freedom
        return _Step(
            steps=at if straight.all() else solve(normal, seen, assume_a="pos"),
            at=at,
            std=np.sqrt(variances[:6]),
            residual=target - raw @ at,
            misfit=misfit,
            dof=float(np.sum(1.0 - held[6:])),
        )

    def _moved(
        self, effects: Sequence[Effect], values: Mapping[str, Values], steps: Array, share: float
    ) -> tuple[dict[str, Values], float]:
        """Values a share of the steps on, and how far the farthest of the bent has gone, in typical sizes."""
        moved: dict[str, Values] = {}
        far, at = 0.0, 6
        for effect in effects:
            variant = self.variant(effect, values[effect.name])
            part = steps[at : at + len(variant.std)]
            at += len(variant.std)
            moved[effect.name] = variant.moved(share * part if is_bent(effect) else part)
            if is_bent(effect):
                far = max(
                    far,
                    *(
                        abs(moved[effect.name][spec.name] - values[effect.name][spec.name]) / spec.typical
                        for spec in amplitudes(effect)
                    ),
                )
        return moved, far

    def time_interval(self, fit: Fit, effect: Effect, spec: ParameterSpec) -> tuple[float, float, float]:
        """A time at which an effect begins or ends, with those that the data takes for as good (95 per cent)."""
        value = fit.values[effect.name][spec.name]
        seconds = max(recording.seconds for recording in self.problem.recordings)
        if not np.isfinite(value):
            return value, seconds, value
        as_good = [value]
        for sign in (-1.0, 1.0):
            step = seconds / 500.0
            while 0.0 <= (at := value + sign * step) <= seconds:
                trial = self.fit(
                    fit.effects, fit.noise, {**fit.values, effect.name: {**fit.values[effect.name], spec.name: at}}
                )
                if trial.deviance > fit.deviance + chi2.isf(0.05, 1):
                    break
                as_good.append(at)
                step *= 1.5
        return value, min(as_good), max(as_good)
