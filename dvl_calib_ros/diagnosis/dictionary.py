"""Every effect at once: its traces as columns, with which hypotheses are told apart in microseconds.

A trace that is not linear in a parameter is tabulated: each value of the table is one variant of the effect, linear
about it. An effect that comes and goes has a variant for every window of the run. So under a given noise every
hypothesis is a small least squares problem in one Gram matrix.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve
from scipy.stats import chi2

from ..calibration.frames import Array
from ..effects.base import Effect, ParameterSpec
from .noise import Noise
from .problem import PRIOR_STD, Problem, Values

# Prior of an effect's parameters, in their typical sizes: wide enough to do nothing but where the data says nothing
PRIOR_IN_TYPICAL = 20.0
# Values of a parameter that bends the trace, in its typical sizes: straight enough between neighbours to be told apart
TABLE = (0.0, 0.7, 1.5, 2.5, 4.0, 6.0, 9.0, 13.0, 18.0)
# Times of the run at which an effect that comes and goes is tried to begin or end
WINDOW_STEPS = 8


def is_time_of_run(spec: ParameterSpec) -> bool:
    """Whether a parameter is a time at which an effect begins or ends."""
    return spec.unit == "s" and not np.isfinite(spec.high)


def amplitudes(effect: Effect) -> list[ParameterSpec]:
    """Parameters with a derivative: all but times of the run."""
    return [spec for spec in effect.parameters if not is_time_of_run(spec)]


def is_bent(effect: Effect) -> bool:
    """Whether the trace is not linear in its amplitudes."""
    return not all(spec.linear for spec in amplitudes(effect))


def windows(effect: Effect, seconds: float) -> list[dict[str, float]]:
    """Times of the run, by name, that are tried: none at all first, then every part of the grid."""
    times = [spec.name for spec in effect.parameters if is_time_of_run(spec)]
    if not times:
        return [{}]
    whole = {name: effect.defaults[name] for name in times}
    grid = np.linspace(0.0, seconds, WINDOW_STEPS + 1).tolist()
    parts = [dict(zip(times, part, strict=True)) for part in itertools.combinations(grid, len(times))]
    return [whole, *(part for part in parts if part != {times[0]: 0.0, times[-1]: seconds})]


@dataclass(frozen=True)
class Variant:
    """An effect linear about some values of its parameters: trace = offset + columns · (amplitudes - centre).

    columns: (M, 3, p). offset: (M, 3), None for zero. centre, std: (p,), prior of the amplitudes. tried: how many of
    its kind there are, which is the price of having looked at them.
    """

    effect: Effect
    values: Values
    columns: Array
    offset: Array | None
    centre: Array
    std: Array
    tried: float = 1.0

    def moved(self, step: Array) -> dict[str, float]:
        """Values of all parameters with the amplitudes a step (p,) from the centre, within their bounds."""
        specs = amplitudes(self.effect)
        at = {
            spec.name: float(np.clip(value, spec.low, spec.high)) if is_bent(self.effect) else float(value)
            for spec, value in zip(specs, self.centre + step, strict=True)
        }
        return {**self.values, **at}


def variant_at(problem: Problem, effect: Effect, values: Values) -> Variant:
    """An effect about values: its derivatives exact where it is linear, else by central differences."""
    specs = amplitudes(effect)
    std = np.array([PRIOR_IN_TYPICAL * spec.typical for spec in specs])
    if not is_bent(effect):
        zero = {**values, **{spec.name: 0.0 for spec in specs}}
        units = [problem.trace(effect, {**zero, spec.name: spec.typical}) / spec.typical for spec in specs]
        return Variant(effect, values, np.stack(units, axis=2), None, np.zeros(len(specs)), std)
    columns = []
    for spec in specs:
        step = 0.05 * spec.typical
        low, high = max(values[spec.name] - step, spec.low), min(values[spec.name] + step, spec.high)
        ends = [problem.trace(effect, {**values, spec.name: at}) for at in (low, high)]
        columns.append((ends[1] - ends[0]) / (high - low))
        offset = ends[0] + (values[spec.name] - low) * columns[-1]
    centre = np.array([values[spec.name] for spec in specs])
    return Variant(effect, values, np.stack(columns, axis=2), offset, centre, std)


def variants(problem: Problem, effect: Effect) -> list[Variant]:
    """All of an effect that are tried."""
    specs = amplitudes(effect)
    parts = windows(effect, max(recording.seconds for recording in problem.recordings))
    found = []
    for part in parts:
        tried = 1.0 if len(parts) == 1 else 2.0 if part is parts[0] else 2.0 * (len(parts) - 1)
        values = effect.defaults | part
        if is_bent(effect) and len(specs) == 1:
            found += _tabulated(problem, effect, specs[0], values, tried)
        else:
            found.append(replace(variant_at(problem, effect, values), tried=tried))
    return found


def _tabulated(problem: Problem, effect: Effect, spec: ParameterSpec, values: Values, tried: float) -> list[Variant]:
    """Variants of an effect that bends with its one amplitude, each straight as far as its neighbours."""
    table = _table(spec)
    each_values = [{**values, spec.name: at} for at in table.tolist()]
    traces = np.stack([problem.trace(effect, each) for each in each_values])
    slopes = np.gradient(traces, table, axis=0)
    return [
        Variant(effect, each, slope[:, :, None], trace, np.array([at]), np.array([apart]), tried)
        for each, slope, trace, at, apart in zip(each_values, slopes, traces, table, np.gradient(table), strict=True)
    ]


def _table(spec: ParameterSpec) -> Array:
    """Values to tabulate: at least two, within the bounds."""
    sizes = spec.typical * np.array(TABLE)
    both = np.unique(np.concatenate([-sizes, sizes, [spec.low, spec.high]]))
    inside: Array = both[(both >= spec.low) & (both <= spec.high) & np.isfinite(both)]
    return inside


@dataclass(frozen=True)
class Candidate:
    """The best variant of an effect beside others. drop: in deviance. dof: that it uses up. index: of the variant."""

    effect: Effect
    index: int
    values: Values
    tried: float
    drop: float
    dof: float
    log_p: float


class Dictionary:
    """Variants of effects and the calibration, as raw columns (M, 3, n).

    present: variants of effects that are in already, about their fitted values; they come first.
    """

    def __init__(self, problem: Problem, effects: Mapping[str, Effect], present: Sequence[Variant] = ()) -> None:
        self.problem, self.effects = problem, effects
        self.n_present = len(present)
        self.variants = [*present, *(one for effect in effects.values() for one in variants(problem, effect))]
        raw, at = [problem.base], 6
        self.columns: list[NDArray[np.intp]] = []
        self.offset: list[int | None] = []
        for variant in self.variants:
            p = variant.columns.shape[2]
            raw.append(variant.columns)
            self.columns.append(np.arange(at, at + p))
            self.offset.append(None if variant.offset is None else at + p)
            if variant.offset is not None:
                raw.append(variant.offset[:, :, None])
            at += p + (variant.offset is not None)
        self.raw = np.concatenate(raw, axis=2)

    def seen(self, noise: Noise, residual: Array) -> Seen:
        """Through a noise, with a residual (M, 3) to explain."""
        raw = np.concatenate([self.raw, residual[:, :, None]], axis=2)
        white = noise.whiten(raw)
        return Seen(self, raw, white, white.T @ white)


@dataclass(frozen=True)
class Seen:
    """A dictionary through a noise. raw: (M, 3, n + 1) and white (3 M, n + 1): columns, and the residual at the end.
    gram: (n + 1, n + 1) of the white ones, or of those rows that a selection may see.
    """

    dictionary: Dictionary
    raw: Array
    white: Array
    gram: Array

    def beyond(self) -> Array:
        """What all effects together leave of the residual (M, 3), as large as noise would be without them."""
        dictionary = self.dictionary
        first: dict[str, int] = {}  # of each effect the variant with the smallest values
        for index, variant in enumerate(dictionary.variants):
            best = first.setdefault(variant.effect.name, index)
            if np.abs(variant.centre).max(initial=0.0) < np.abs(dictionary.variants[best].centre).max(initial=0.0):
                first[variant.effect.name] = index
        chosen = list(first.values())
        left = self.left(self.solved(chosen), chosen)
        n, p = 3 * len(left), 6 + sum(len(dictionary.columns[index]) for index in chosen)
        return np.asarray(left * np.sqrt(n / max(n - p, 1)))

    def without(self, held: NDArray[np.bool_]) -> Seen:
        """The same, with only those samples (M,) to see that are not held out."""
        rows = self.white[np.repeat(held, 3)]
        return replace(self, gram=self.gram - rows.T @ rows)

    def _target(self, chosen: Sequence[int]) -> Array:
        """(n + 1,) weights of the columns that make up what the chosen variants are to explain."""
        target = np.zeros(self.gram.shape[0])
        target[-1] = 1.0
        target[:6] = -self.dictionary.problem.prior_change
        for index in chosen:
            if (at := self.dictionary.offset[index]) is not None:
                target[at] = -1.0
        return target

    def _columns(self, chosen: Sequence[int]) -> tuple[NDArray[np.intp], Array]:
        """Columns to solve for and one over the variance of their prior."""
        dictionary = self.dictionary
        columns = [np.arange(6), *(dictionary.columns[index] for index in chosen)]
        prior = [PRIOR_STD, *(dictionary.variants[index].std for index in chosen)]
        return np.concatenate(columns), np.concatenate(prior) ** -2.0

    def solved(self, chosen: Sequence[int]) -> Array:
        """(6 + p,) steps of the calibration and of the chosen variants' amplitudes from the centres of their priors."""
        columns, prior = self._columns(chosen)
        normal = self.gram[np.ix_(columns, columns)] + np.diag(prior)
        return np.asarray(solve(normal, self.gram[columns] @ self._target(chosen), assume_a="pos"))

    def covariance(self, chosen: Sequence[int]) -> Array:
        """(6 + p, 6 + p) of the steps of `solved`."""
        columns, prior = self._columns(chosen)
        return np.asarray(np.linalg.inv(self.gram[np.ix_(columns, columns)] + np.diag(prior)))

    def left(self, steps: Array, chosen: Sequence[int]) -> Array:
        """(M, 3) m/s of the residual that is left with steps (6 + p,) of the chosen variants."""
        columns, _ = self._columns(chosen)
        weights = self._target(chosen)
        weights[columns] -= steps
        return np.asarray(self.raw @ weights)

    def candidates(self, chosen: Sequence[int], instead_of: int | None = None) -> dict[str, Candidate]:
        """The best variant of every other effect beside the chosen, by name; also in the place of one of them."""
        dictionary = self.dictionary
        taken = {dictionary.variants[index].effect.name for index in chosen}
        kept = [index for index in chosen if index != instead_of]
        columns, prior = self._columns(kept)
        normal = self.gram[np.ix_(columns, columns)] + np.diag(prior)
        rest = self.gram - self.gram[:, columns] @ solve(normal, self.gram[columns], assume_a="pos")
        target = self._target(kept)
        without = float(target @ rest @ target)
        best: dict[str, Candidate] = {}
        for index, variant in enumerate(dictionary.variants):
            name = variant.effect.name
            if name in taken and index != instead_of:
                continue
            candidate = self._candidate(index, variant, rest, target, without)
            if name not in best or candidate.log_p < best[name].log_p:
                best[name] = candidate
        return best

    def _candidate(self, index: int, variant: Variant, rest: Array, target: Array, without: float) -> Candidate:
        columns, offset = self.dictionary.columns[index], self.dictionary.offset[index]
        if offset is not None:
            target = target.copy()
            target[offset] = -1.0
        seen = rest @ target
        block = rest[np.ix_(columns, columns)]
        normal = block + np.diag(variant.std**-2.0)
        step = np.linalg.solve(normal, seen[columns])
        drop = without - float(target @ seen) + float(seen[columns] @ step)
        # where the prior has to hold an amplitude it uses up less than a degree of freedom
        dof = float(len(columns)) if offset is not None else float(np.trace(np.linalg.solve(normal, block)))
        return Candidate(
            variant.effect, index, variant.moved(step), variant.tried, drop, dof, log_p_value(drop, dof, variant.tried)
        )


def log_p_value(drop: float, dof: float, tried: float = 1.0) -> float:
    """log p of a drop in deviance, times how many alternatives were tried."""
    return min(0.0, float(chi2.logsf(max(drop, 0.0), max(dof, 1e-3))) + float(np.log(tried)))
