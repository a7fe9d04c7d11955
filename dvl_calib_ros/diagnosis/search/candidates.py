"""Proposal of hypotheses about a fit: combinations of effects in the linearised model, and equivalent formulations.

Linearised about a fit, all effects share one Gram matrix. Combinations of up to three effects are small least squares
problems in it.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...effects.base import Effect
from ..fit.gauss_newton import PRIOR_IN_TYPICAL, Fit, Fitter, prior_std
from ..fit.selection_criteria import penalty, windows
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis, Values, amplitudes, is_time_of_run, no_effect
from ..model.settings import SETTINGS
from ..noise.noise_model import Noise
from ..noise.whitened_least_squares import WhitenedLeastSquares
from .arm_clock_ambiguity import ATTITUDE_CLOCK, CLOCKS, DVL_CLOCK, LAG_OR_DELAY, REFERENCE_CLOCK, lags_and_delays

# Variants to combine; proposals fitted per round
SHORTLIST, N_PROPOSALS = 12, 7
# Places for the largest gains on top of the fit: next to seconds of clock offset a drift adds little
N_LARGEST_GAINS = 4
# Start times kept per intermittent effect
KEPT_VARIANTS = 2
# Share of the coloured noise's misfit that an intermittent effect may leave
MAX_LEFT_MISFIT_SHARE = 0.5


@dataclass(frozen=True)
class Variant:
    """An effect with its times of the run. tried: number of variants of its kind."""

    effect: Effect
    values: tuple[Values, ...]
    columns: Array
    tried: float

    @property
    def p(self) -> int:
        """Return the number of columns."""
        return self.columns.shape[2]

    @property
    def is_intermittent(self) -> bool:
        """Return whether the effect acts during a part of the run only."""
        times = [spec.name for spec in self.effect.parameters if is_time_of_run(spec)]
        return any(each[name] != self.effect.defaults[name] for each in self.values for name in times)


@dataclass(frozen=True)
class LinearisedModel:
    """Linearised model of all variants in one Gram matrix. blocks: columns of each variant."""

    variants: list[Variant]
    blocks: list[NDArray[np.intp]]
    system: WhitenedLeastSquares

    def misfit(self, chosen: Sequence[int]) -> float:
        """Return the misfit of a combination."""
        part = self.system.part(np.concatenate([np.arange(6), *(self.blocks[index] for index in chosen)]))
        return part.misfit(part.solution())


def proposed(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """Return hypotheses to fit, by the linearised model about a fit; the fit's own is among them."""
    table, to_fit = _combinations(fitter, fit, effects)
    own = tuple(range(len(fit.effects)))
    return [
        *(combined(fitter, fit, table, chosen) for chosen in (to_fit if own in to_fit else [*to_fit, own])),
        *by_other_clocks(fit, effects),
        *_with_lag_or_delay(fit, effects),
    ]


def intermittent_effects(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """Return the best hypotheses with intermittent effects under white noise.

    Coloured noise absorbs the residual of a wrong time, so no time on a grid improves the fit. Only effects that
    explain most of the noise are proposed: an intermittent effect explains a part of any coloured noise.
    """
    if not fit.noise.is_coloured:
        return []
    fit = replace(fit, noise=fit.noise.white)
    table, to_fit = _combinations(fitter, fit, effects)
    own = len(fit.effects)
    limit = MAX_LEFT_MISFIT_SHARE * table.misfit(range(own))
    come = [
        chosen
        for chosen in to_fit
        if any(i >= own and table.variants[i].is_intermittent for i in chosen) and table.misfit(chosen) < limit
    ]
    return [combined(fitter, fit, table, chosen) for chosen in come[:KEPT_VARIANTS]]


def _combinations(
    fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]
) -> tuple[LinearisedModel, list[tuple[int, ...]]]:
    """Return the linearised model about a fit, and its combinations of effects to fit, best first."""
    table = linearised(fitter, fit, effects)
    n = len(fitter.problem.recordings)
    cost = [penalty(v.effect, len(effects), n, v.tried) for v in table.variants]
    own = list(range(len(fit.effects)))
    usable = _shortlisted(table, own, cost)
    scored: list[tuple[float, tuple[int, ...]]] = []
    for size in range(SETTINGS.max_effects):
        for chosen in itertools.combinations(usable, size):
            names = {table.variants[index].effect.name for index in chosen}
            if len(names) == size:
                scored.append((table.misfit(chosen) + sum(cost[index] for index in chosen), chosen))
    scored.sort()
    for _, chosen in scored[:3]:  # add one more effect to the best combinations
        names = {table.variants[index].effect.name for index in chosen}
        scored += [
            (table.misfit((*chosen, index)) + sum(cost[i] for i in (*chosen, index)), (*chosen, index))
            for index in usable
            if table.variants[index].effect.name not in names
        ]
    scored.sort()
    scored = [each for each in scored if _has_no_redundant_clock(table, each[1])]
    to_fit = list(dict.fromkeys(tuple(sorted(c)) for score, c in scored if score < scored[0][0] + SETTINGS.conclusive))[
        :N_PROPOSALS
    ]
    if not any(_is_possible(table, chosen) for chosen in to_fit):  # outside the linear range
        to_fit += itertools.islice((chosen for _, chosen in scored if _is_possible(table, chosen)), 1)
    return table, to_fit


def variants_about(fit: Fit, effects: Mapping[str, Effect]) -> list[Variant]:
    """Return the columns about a fit of every effect that it lacks, at every window."""
    problem, present = fit.problem, {effect.name for effect in fit.effects}
    n = len(problem.recordings)
    seconds = max(recording.seconds for recording in problem.recordings)
    found = []
    for effect in effects.values():
        if effect.name in present:
            continue
        parts = windows(effect, seconds)
        for part in parts:
            values = (effect.defaults | part,) * n
            columns = problem.columns(fit.hypothesis, fit.seen, effect, values)
            tried = 1.0 if len(parts) == 1 else 2.0 if part is parts[0] and len(part) > 1 else 2.0 * len(parts)
            found.append(Variant(effect, values, columns, tried))
    return found


def linearised(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> LinearisedModel:
    """Linearise the effects of a fit, in its order, and then every other effect at every window."""
    problem, noise, hypothesis = fitter.problem, fit.noise, fit.hypothesis
    own = [
        Variant(each, fit.values[each.name], fit.columns[:, :, hypothesis.indices_of(each.name)], 1.0)
        for each in fit.effects
    ]
    variants = [*own, *variants_about(fit, effects)]
    # linear prediction of the residual without the fit's effects
    vector = hypothesis.vector()
    defaults = [0.0] * 6 + [each.spec.default for each in hypothesis.parameters()]
    target = -(fit.residual - fit.columns @ (vector - np.array(defaults)))
    blocks, start = [], 6
    for variant in variants:
        blocks.append(np.arange(start, start + variant.p))
        start += variant.p
    columns = np.concatenate([fit.columns[:, :, :6], *(variant.columns for variant in variants)], axis=2)
    n = len(problem.recordings)
    std = np.concatenate([prior_std(no_effect()), *(_std(variant.effect, variant.p, n) for variant in variants)])
    system = WhitenedLeastSquares(_gram(problem, noise, columns, target), std, np.zeros_like(std))
    return LinearisedModel(variants, blocks, system)


def _gram(problem: Problem, noise: Noise, columns: Array, target: Array) -> Array:
    """Return the Gram matrix (n + 1, n + 1) of whitened columns (M, A, n) and target (M, A), summed by recording.

    A parameter of one recording has a zero column in the others. Zero columns are left out, because whitening is slow.
    """
    total = np.zeros((columns.shape[2] + 1,) * 2)
    for rows in problem.rows_of:
        part, noise_of = columns[rows], noise.part(rows)
        nonzero = np.asarray(part.any(axis=(0, 1)))
        if not nonzero.any():
            nonzero[:] = True
        white = noise_of.whiten(part if nonzero.all() else part[:, :, nonzero])
        at, zeros = np.flatnonzero(np.append(nonzero, True)), np.zeros(white.shape[1])
        total[np.ix_(at, at)] += WhitenedLeastSquares.of(white, noise_of.whiten(target[rows]), zeros, zeros).gram
    return total


def _std(effect: Effect, p: int, n_recordings: int) -> Array:
    sizes = [PRIOR_IN_TYPICAL * s.typical for s in effect.parameters if not is_time_of_run(s)]
    return np.array(sizes * (p // len(sizes)))


def _shortlisted(table: LinearisedModel, present: Sequence[int], cost: Sequence[float]) -> list[int]:
    """Return the indices of all variants of the fit, and of the most promising others.

    A variant is promising by its gain in deviance, less its cost: in addition to the fit, or with less weight instead
    of an effect of the fit or alone. At most KEPT_VARIANTS of one effect are kept.

    present: indices of the variants of the fit. cost: price of each variant.
    """
    misfit, empty_misfit = table.misfit(present), table.misfit([])
    gains: dict[int, float] = {}
    adds: dict[int, float] = {}
    for index in range(len(table.variants)):
        if index in present:
            continue
        by_itself = empty_misfit - table.misfit([index]) - cost[index]
        adds[index] = misfit - table.misfit([*present, index]) - cost[index]
        instead = max(
            (table.misfit(rest) - table.misfit([*rest, index]) - cost[index]
             for rest in ([i for i in present if i != out] for out in present)),
            default=-np.inf,
        )  # fmt: skip
        # strong effects resemble whatever explains much by itself: the gain in addition counts more
        gains[index] = max(adds[index], 0.1 * instead, 0.01 * by_itself)
    kept: list[int] = []
    of_effect: dict[str, int] = {}
    by_addition = sorted((i for i in adds if adds[i] > 0.0), key=lambda i: -adds[i])
    for limit, ranked in ((N_LARGEST_GAINS, by_addition), (SHORTLIST, sorted(gains, key=lambda i: -gains[i]))):
        for index in ranked:
            name = table.variants[index].effect.name
            if index not in kept and of_effect.get(name, 0) < KEPT_VARIANTS and len(kept) < limit:
                kept.append(index)
                of_effect[name] = of_effect.get(name, 0) + 1
    return [*present, *kept]


def combined(fitter: Fitter, fit: Fit, table: LinearisedModel, chosen: Sequence[int]) -> Hypothesis:
    """Return the hypothesis of a combination. The fit's effects start at its values, others at the linear solution."""
    system = table.system.part(np.concatenate([np.arange(6), *(table.blocks[index] for index in chosen)]))
    solution = system.solution()[6:]
    n = len(fitter.problem.recordings)
    start: dict[str, tuple[Values, ...]] = {}
    offset = 0
    for index in chosen:
        variant = table.variants[index]
        step = solution[offset : offset + variant.p]
        offset += variant.p
        if variant.effect in fit.effects:
            start[variant.effect.name] = variant.values
            continue
        empty = no_effect().with_effects([variant.effect], n, {variant.effect.name: variant.values})
        solved = empty.moved(np.concatenate([np.zeros(6), step]))
        start[variant.effect.name] = solved.values[variant.effect.name]
    effects = [table.variants[index].effect for index in chosen]
    return fit.hypothesis.with_effects(effects, n, start)


def _is_possible(table: LinearisedModel, chosen: Sequence[int]) -> bool:
    """Return whether the linear solution of a combination is within the bounds of each parameter."""
    part = table.system.part(np.concatenate([np.arange(6), *(table.blocks[index] for index in chosen)]))
    variants = [table.variants[index] for index in chosen]
    specs = [
        spec
        for variant in variants
        for spec in amplitudes(variant.effect) * (variant.p // len(amplitudes(variant.effect)))
    ]
    return all(spec.low < x < spec.high for spec, x in zip(specs, part.solution()[6:].tolist(), strict=True))


def _has_no_redundant_clock(table: LinearisedModel, chosen: Sequence[int]) -> bool:
    """Return whether a combination has no redundant pair of clocks: DVL and reference represent any pair."""
    names = {table.variants[index].effect.name for index in chosen}
    return ATTITUDE_CLOCK not in names or len(names & set(CLOCKS)) == 1


def by_other_clocks(fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """Return hypotheses with a fit's clock offsets assigned to other clocks; large offsets exceed the linear range."""
    n, values = fit.n_recordings, fit.values
    if not set(CLOCKS) & set(values):
        return []
    dvl, reference, attitude = (
        np.array([each["seconds"] for each in values[name]]) if name in values else np.zeros(n) for name in CLOCKS
    )
    dvl, reference = dvl - attitude, reference - attitude
    kept = [effect for effect in fit.effects if effect.name not in CLOCKS]
    alternatives = [
        {ATTITUDE_CLOCK: -0.5 * (dvl + reference)}, {DVL_CLOCK: dvl - reference}, {REFERENCE_CLOCK: reference - dvl},
        {DVL_CLOCK: dvl, REFERENCE_CLOCK: reference},
    ]  # fmt: skip
    found = []
    for one in alternatives:
        if set(one) <= set(effects) and len(kept) + len(one) <= SETTINGS.max_effects:
            start: dict[str, tuple[Values, ...]] = _at_other_times(fit, kept, dvl + attitude - one.get(DVL_CLOCK, 0.0))
            start |= {name: tuple({"seconds": float(s)} for s in seconds) for name, seconds in one.items()}
            found.append(fit.hypothesis.with_effects([*kept, *(effects[name] for name in one)], n, start))
    return found


def _at_other_times(fit: Fit, effects: Sequence[Effect], shift: Array) -> dict[str, tuple[Values, ...]]:
    """Return the values of intermittent effects, delayed by some seconds per recording."""
    shifted: dict[str, tuple[Values, ...]] = {}
    for effect in effects:
        times = [spec.name for spec in effect.parameters if is_time_of_run(spec)]
        pairs = zip(fit.values[effect.name], shift.tolist(), strict=True)
        if times:  # an effect from the beginning keeps its start
            shifted[effect.name] = tuple(
                {**each, **{name: max(each[name] + seconds, 0.0) if each[name] else 0.0 for name in times}}
                for each, seconds in pairs
            )
    return shifted


def _with_lag_or_delay(fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """Return the fit with a lag of the reference for its delay, or a delay for its lag."""
    others = [effect for effect in fit.effects if effect.name not in LAG_OR_DELAY]
    return [
        fit.hypothesis.with_effects([*others, *(effects[name] for name in start)], fit.n_recordings, start)
        for start in lags_and_delays(fit, effects)
    ]
