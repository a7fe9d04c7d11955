"""Fits of nested hypotheses: the calibration, and effects on top of it, with the noise that each leaves."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from ..calibration.frames import Array
from ..effects.base import Effect, ParameterSpec
from .noise import Noise
from .problem import PRIOR_STD, Problem

# Prior of an effect's parameters, in their typical sizes: wide enough to do nothing but where the data says nothing
PRIOR_IN_TYPICAL = 20.0
# Times of the run at which an effect that comes and goes is tried to begin or end
WINDOW_STEPS = 8


@dataclass(frozen=True)
class Fit:
    """A hypothesis fitted: which effects, with which values.

    values: by effect and parameter. change: (6,) of φ and δk. residual: (M, 3) m/s that is left. noise: as estimated
    from it. deviance: -2 log likelihood with that noise. dof: that the effects use up.
    """

    effects: tuple[Effect, ...]
    values: Mapping[str, Mapping[str, float]]
    change: Array
    residual: Array
    noise: Noise
    deviance: float
    dof: float


@dataclass(frozen=True)
class Fitter:
    """Fits hypotheses about one problem. residual: (M, 3), robustified, in place of the problem's own."""

    problem: Problem
    residual: Array
    _columns: dict[tuple[str, tuple[float, ...]], Array] = field(default_factory=dict)

    # ------------------------------------------------------------------ regressors

    def columns(self, effect: Effect, values: Mapping[str, float]) -> tuple[list[ParameterSpec], Array]:
        """The linear parameters of an effect and what a unit of each adds (M, 3, p), with the others as in values."""
        linear = linear_parameters(effect)
        if not linear:
            return [], np.zeros((*self.residual.shape, 0))
        key = effect.name, tuple(values[spec.name] for spec in effect.parameters if spec not in linear)
        if key not in self._columns:
            zero = {**values, **{spec.name: 0.0 for spec in linear}}
            units = [self.problem.trace(effect, zero | {spec.name: spec.typical}) / spec.typical for spec in linear]
            if len(self._columns) > 400:
                self._columns.clear()
            self._columns[key] = np.stack(units, axis=2)
        return linear, self._columns[key]

    def jacobian(self, effect: Effect, values: Mapping[str, float]) -> tuple[list[ParameterSpec], Array]:
        """All parameters with a derivative and d trace / d parameter (M, 3, p): exact or by central differences."""
        specs, parts = self.columns(effect, values)
        derivatives = [parts]
        for spec in smooth_parameters(effect):
            step = 0.05 * spec.typical
            low, high = max(values[spec.name] - step, spec.low), min(values[spec.name] + step, spec.high)
            traces = [self.problem.trace(effect, {**values, spec.name: at}) for at in (low, high)]
            derivatives.append(((traces[1] - traces[0]) / (high - low))[:, :, None])
            specs = [*specs, spec]
        return specs, np.concatenate(derivatives, axis=2)

    # ------------------------------------------------------------------ fits

    def fit(self, effects: Sequence[Effect], noise: Noise, start: Mapping[str, Mapping[str, float]]) -> Fit:
        """Fit effects together with the calibration under a noise; parameters without a derivative stay at start."""
        values = {effect.name: dict(start.get(effect.name, effect.defaults)) for effect in effects}
        smooth = [(effect, spec) for effect in effects for spec in smooth_parameters(effect)]
        fixed = self._fixed(effects, values, noise)
        if smooth:
            x0 = np.array([values[effect.name][spec.name] / spec.typical for effect, spec in smooth])
            low = np.array([spec.low / spec.typical for _, spec in smooth])
            high = np.array([spec.high / spec.typical for _, spec in smooth])

            def left(x: Array) -> Array:
                prior = x / PRIOR_IN_TYPICAL
                return np.concatenate([fixed.left(noise.whiten(self._less(smooth, values, x))), prior])

            span = 1e-3 * (high - low)
            found = least_squares(
                left, np.clip(x0, low + span, high - span), bounds=(low, high), x_scale=1.0,
                diff_step=[1e-3] * len(smooth), xtol=1e-4, ftol=1e-7, max_nfev=20,
            )  # fmt: skip
            for (effect, spec), value in zip(smooth, found.x, strict=True):
                values[effect.name][spec.name] = float(value * spec.typical)
        less = self._less(smooth, values, None)
        solution = fixed.solve(noise.whiten(less))
        residual = less - fixed.raw @ solution
        at = 6
        for effect in effects:
            for spec in linear_parameters(effect):
                values[effect.name][spec.name] = float(solution[at])
                at += 1
        dof = fixed.dof + len(smooth)
        return Fit(tuple(effects), values, solution[:6], residual, noise, noise.deviance(residual), dof)

    def fit_with_noise(
        self, effects: Sequence[Effect], noise: Noise, start: Mapping[str, Mapping[str, float]], rounds: int = 2
    ) -> Fit:
        """`fit`, with the noise estimated anew from what it leaves, and again."""
        fit = self.fit(effects, noise, start)
        for _ in range(rounds):
            noise = noise.updated(fit.residual)
            fit = self.fit(effects, noise, fit.values)
        return fit

    def _fixed(self, effects: Sequence[Effect], values: Mapping[str, Mapping[str, float]], noise: Noise) -> _Linear:
        raw, prior = [self.problem.base], [1.0 / PRIOR_STD]
        for effect in effects:
            specs, columns = self.columns(effect, values[effect.name])
            raw.append(columns)
            prior.append(np.array([1.0 / (PRIOR_IN_TYPICAL * spec.typical) for spec in specs]))
        joined = np.concatenate(raw, axis=2)
        centre = np.zeros(joined.shape[2])
        centre[:6] = self.problem.prior_change
        return _Linear(joined, noise.whiten(joined), np.concatenate(prior), centre)

    def _less(
        self, smooth: Sequence[tuple[Effect, ParameterSpec]], values: dict[str, dict[str, float]], x: Array | None
    ) -> Array:
        """The residual less the traces of the effects that are not linear, with x in place of their values."""
        if x is not None:
            for (effect, spec), value in zip(smooth, x, strict=True):
                values[effect.name][spec.name] = float(value * spec.typical)
        residual = self.residual
        for effect in {effect.name: effect for effect, _ in smooth}.values():
            residual = residual - self.problem.trace(effect, values[effect.name])
        return residual

    def misfit(self, effects: Sequence[Effect], noise: Noise, start: Mapping[str, Mapping[str, float]]) -> float:
        """Square of what is left with the values at start, linear parameters solved for: where to fit from."""
        values = {effect.name: dict(start.get(effect.name, effect.defaults)) for effect in effects}
        smooth = [(effect, spec) for effect in effects for spec in smooth_parameters(effect)]
        left = self._fixed(effects, values, noise).left(noise.whiten(self._less(smooth, values, None)))
        return float(left @ left)

    # ------------------------------------------------------------------ starts

    def starts(self, effect: Effect) -> list[tuple[dict[str, float], float]]:
        """Values to start a fit from, each with how many of its kind there are: the price of having tried them."""
        times = [spec for spec in effect.parameters if is_time_of_run(spec)]
        if times:
            return self._windows(effect, times)
        smooth = list(smooth_parameters(effect))
        if not smooth:
            return [(effect.defaults, 1.0)]
        sizes = [
            [s for s in (-10.0, -3.0, 0.5, 3.0, 10.0) if spec.low < s * spec.typical < spec.high] for spec in smooth
        ]
        if len(smooth) > 1:  # near enough to linear in all of them
            sizes = [[0.5] for _ in smooth]
        return [
            (effect.defaults | {s.name: f * s.typical for s, f in zip(smooth, combination, strict=True)}, 1.0)
            for combination in itertools.product(*sizes)
        ]

    def tried(self, effect: Effect, values: Mapping[str, float]) -> float:
        """How many starts like the one that led to these values there are."""
        times = [spec.name for spec in effect.parameters if is_time_of_run(spec)]
        if not times or all(values[name] == effect.defaults[name] for name in times):
            return 2.0 if times else 1.0
        return self.starts(effect)[-1][1]

    def _windows(self, effect: Effect, times: Sequence[ParameterSpec]) -> list[tuple[dict[str, float], float]]:
        seconds = max(recording.seconds for recording in self.problem.recordings)
        grid = np.arange(WINDOW_STEPS + 1) / WINDOW_STEPS * seconds
        windows = [
            dict(zip((spec.name for spec in times), combination, strict=True))
            for combination in itertools.combinations(grid.tolist(), len(times))
        ]
        part = [effect.defaults | window for window in windows]
        return [(effect.defaults, 2.0), *((values, 2.0 * len(part)) for values in part)]

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


@dataclass(frozen=True)
class _Linear:
    """Columns raw (M, 3, p) and whitened (3 M, p); prior: (p,) one over its standard deviation, about centre (p,)."""

    raw: Array
    white: Array
    prior: Array
    centre: Array

    @cached_property
    def _factor(self) -> tuple[Array, Array]:
        scale = 1.0 / np.maximum(np.hypot(np.linalg.norm(self.white, axis=0), self.prior), 1e-300)
        stacked = np.concatenate([self.white, np.diag(self.prior)]) * scale
        q, r = np.linalg.qr(stacked)
        return q, r / scale

    def _extended(self, white: Array) -> Array:
        return np.concatenate([white, self.prior * self.centre])

    def left(self, white: Array) -> Array:
        """What the columns do not explain of a whitened series (3 M,), with the prior's part at the end."""
        q, _ = self._factor
        extended = self._extended(white)
        return extended - q @ (q.T @ extended)

    def solve(self, white: Array) -> Array:
        """Coefficients (p,) of the columns."""
        q, r = self._factor
        return np.asarray(np.linalg.solve(r, q.T @ self._extended(white)))

    @cached_property
    def dof(self) -> float:
        """How many degrees of freedom the columns beyond the calibration use up; less than one each where the prior
        has to hold them.
        """
        q, _ = self._factor
        held = (q[len(self.white) :] ** 2).sum(axis=1)
        return float(np.sum(1.0 - held[6:]))


def log_p_value(drop: float, dof: float, tried: float = 1.0) -> float:
    """log p of a drop in deviance, times how many alternatives were tried."""
    return min(0.0, float(chi2.logsf(max(drop, 0.0), max(dof, 1e-3))) + float(np.log(tried)))


def is_time_of_run(spec: ParameterSpec) -> bool:
    """Whether a parameter is a time at which an effect begins or ends."""
    return spec.unit == "s" and not np.isfinite(spec.high)


def smooth_parameters(effect: Effect) -> list[ParameterSpec]:
    """Parameters to be found by iteration: all that have a derivative, if the trace is not linear in all of them."""
    specs = [spec for spec in effect.parameters if not is_time_of_run(spec)]
    return [] if all(spec.linear for spec in specs) else specs


def linear_parameters(effect: Effect) -> list[ParameterSpec]:
    """Parameters to be solved for at once."""
    smooth = smooth_parameters(effect)
    return [spec for spec in effect.parameters if spec not in smooth and not is_time_of_run(spec)]
