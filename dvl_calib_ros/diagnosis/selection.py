"""Which effects the data calls for.

Columns propose: about the best fit so far, every effect's derivatives make one Gram matrix, in which all combinations
of up to three effects are small least squares problems. The composed model decides: the best proposals are fitted in
it until they stand still, and compared by what they explain less what so many parameters explain by chance. About the
winner it is asked again, with the noise that is left by everything together: so that no effect is taken for noise.
(Long, because proposing, fitting and comparing hypotheses share their noise and their costs.)
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..calibration.distributions import chi2_isf, chi2_logsf, f_sf
from ..calibration.frames import Array
from ..calibration.register.registration import IN_TIME_STD_S
from ..effects.base import Effect
from .clock_or_arm import (
    ARM,
    ATTITUDE_CLOCK,
    CLOCKS,
    DVL_CLOCK,
    LAG,
    LAG_OR_DELAY,
    REFERENCE_CLOCK,
    TWO_CLOCKS,
    OpenArm,
    guessed_arm,
    is_open,
    lags_and_delays,
    moved_arm,
    opened_arm,
    with_arm,
    with_clocks,
)
from .compass import HEADING, heading_first, with_two_cycles
from .composed import Hypothesis, Offsets, Problem, Values, is_time_of_run, make_problem, no_effect
from .contradicted import without_contradicted
from .fitting import PRIOR_IN_TYPICAL, Fit, Fitter, n_amplitudes, prior_std
from .leaps import LEAP, gaps, in_gaps, leaping
from .least_squares import WhitenedLeastSquares
from .levels import estimated
from .noise import Noise, white_noise
from .recordings import RecordedStreams
from .registered import FirstGuess, first_guess
from .settings import SETTINGS
from .shown import shown_parts, without_faint
from .unexplained import unexplained

# What a vehicle with a gap has most often; the first fit starts with all of these
START = (ARM, "dvl_time_offset", "reference_time_offset")
# Parts of the run at whose ends effects that come and go are tried to begin or end, and how many of these are kept
WINDOW_STEPS, KEPT_VARIANTS = 10, 2
# Effects from which combinations of three are made; proposals fitted in one round, and how much worse than the best
SHORTLIST, FITTED, NOT_WORTH_IT = 12, 7, 40.0
ROUNDS = 4
# Deviance within which the usual is preferred
AS_WELL = 2.0
# Standard deviations from which on a second time that something happens stands without being tried without
CLEAR = 6.0
# What is taken back but for this share of it, or within a step of the grid, may be anything that is there for a while
TAKEN_BACK = 0.25
# where an unknown cause explains more in its place, or it explains less than that much. And taken back exactly
TAKEN_BACK_EXACTLY, MUCH = 0.05, 150.0
# A clock that explains less than this share of what two leaps do, and makes them cancel, is not late before them
LITTLE_OF_LEAPS = 0.02
# A clock is late for sure from so many σ of what registration leaves open
LATER = 2.0
# Fits with outliers drawn in about the one before, from the first guess on
ROBUST_ROUNDS = 3


@dataclass(frozen=True)
class Variant:
    """An effect with its times of the run. tried: how many there are of its kind."""

    effect: Effect
    values: tuple[Values, ...]
    columns: Array
    tried: float

    @property
    def p(self) -> int:
        """Number of columns."""
        return self.columns.shape[2]


@dataclass(frozen=True)
class Selected:
    """An effect that the data calls for. log_p: with all others in; equivalent: names that could stand in for it;
    rivals: with these in its place."""

    effect: Effect
    log_p: float
    equivalent: tuple[str, ...]
    rivals: tuple[Hypothesis, ...] = field(default=(), repr=False, compare=False)


@dataclass(frozen=True)
class EffectSelection:
    """Outcome of a selection: the effects, strongest first; fits without and with them, under the same noise; the
    fitter; guesses per recording; the effects there were, with what of each is shown. opened: at one speed.
    moved: by part of the lever arm, by how much (m) it is another where another clock explains the data as well.
    """

    selected: tuple[Selected, ...]
    base: Fit
    fit: Fit
    fitter: Fitter
    guesses: tuple[FirstGuess, ...]
    testable: Mapping[str, Effect]
    opened: OpenArm | None = None
    moved: Mapping[str, float] = field(default_factory=dict)

    def withdrawn(self) -> EffectSelection:
        """Without any effect."""
        return replace(self, selected=(), fit=self.base, opened=None, moved={})


def started(
    recordings: Sequence[RecordedStreams],
    rotation_dvl_from_body: Array,
    lever_arm: Array,
    effects: Mapping[str, Effect],
) -> tuple[Problem, Hypothesis, tuple[FirstGuess, ...], dict[str, Effect]]:
    """The problem about the first guess of each recording, a hypothesis with what it holds, the guesses, and effects
    with what of each is shown."""
    guesses = tuple(first_guess(recording, rotation_dvl_from_body, lever_arm) for recording in recordings)
    problem = make_problem(recordings, rotation_dvl_from_body, lever_arm, [guess.offsets for guess in guesses])
    effects = shown_parts({name: effect.once for name, effect in effects.items()}, problem)
    found: dict[str, tuple[Values, ...]] = {
        ARM: (guessed_arm(guesses, effects),) * len(guesses),
        "dvl_time_offset": tuple({"seconds": guess.offsets.dvl} for guess in guesses),
        "reference_time_offset": tuple({"seconds": guess.offsets.reference} for guess in guesses),
    }
    present = [effects[name] for name in START if name in effects]
    phi = problem.shown_turns @ np.median([guess.phi for guess in guesses], axis=0)
    start = no_effect(phi).with_effects(present, len(guesses), found)
    return problem, start, guesses, effects


def select(
    recordings: Sequence[RecordedStreams],
    rotation_dvl_from_body: Array,
    lever_arm: Array,
    effects: Mapping[str, Effect],
) -> EffectSelection:
    """Select among testable effects."""
    heading = effects.get(HEADING)
    effects = every = {name: effect.usual for name, effect in effects.items()}  # what is not shown is no noise either
    problem, start, guesses, effects = started(recordings, rotation_dvl_from_body, lever_arm, effects)
    fitter, fit = _first_fit(problem, start)
    kept = without_contradicted(problem, fit.hypothesis)
    if kept is not None:
        problem = make_problem(kept, rotation_dvl_from_body, lever_arm, [guess.offsets for guess in guesses])
        fitter, fit = _first_fit(problem, fit.hypothesis)
    fitter, fit = _about(fitter, fit, every)
    far = fitter.bursts(fit)
    if far.any():
        problem = problem.without(far)
        fitter, fit = _about(*_first_fit(problem, fit.hypothesis), every)
    best = fit
    seen_before: set[frozenset[str]] = set()
    for _ in range(ROUNDS):
        candidates = [*_proposed(fitter, fit, effects), *with_two_cycles(fitter, fit, heading)]
        fits = [fitter.fit_kept(hypothesis, fit.noise) for hypothesis in candidates]
        leapt = [fitter.fit(hypothesis, fit.noise) for hypothesis in leaping(fitter, fit, effects, every)]
        fits += [each for each in leapt if not _is_taken_back(fitter, each, LEAP, fit.deviance - each.deviance)]
        fits += _happening_again(fitter, fits, every, effects)
        finer = _finer_steps(problem)
        fits = [fitter.refined(each, finer[:3]) for each in fits]  # a time of the run is coarse until then
        best = fitter.refined_as_white(fitter.refined(_best(fits, effects), finer[3:]), [2.0 * finer[0], *finer])
        best = in_gaps(fitter, _by_fewer_clocks(fitter, best, effects))
        best = _called_for(fitter, best, len(effects))
        names = frozenset(effect.name for effect in best.effects)
        fitter, fit = _about(fitter, best, every)
        if names in seen_before:
            break
        seen_before.add(names)
    fit = _borne_out(fitter, _called_for(fitter, fit, len(effects)), len(effects))
    fit = _once_borne_out(fitter, fit, every, effects)
    fit = _by_fewer_clocks(fitter, fit, effects)
    fitter, fit = _about(fitter, fit, every)
    fit = _without_nothing(fitter, fit, len(effects))
    arm = without_faint(fitter.problem, fit)
    if arm is not None:
        effects, others = {**effects, ARM: arm}, [effect for effect in fit.effects if effect.name != ARM]
        values = tuple(dict(each) for each in fit.values[ARM])  # what is not said of it is held where it is
        hypothesis = fit.hypothesis.with_effects([arm, *others], len(values), {ARM: values})
        fitter, fit = _about(fitter, fitter.fit(hypothesis, fit.noise), every)
    whole = _with_all_of_the_arm(fitter, fit, every, effects)
    if whole is not fit:
        effects = {**effects, ARM: every[ARM]}
        fitter, fit = _about(fitter, whole, every)
    fit, alike = heading_first(fitter, fit, heading)
    called_for, fit = fit.effects, with_arm(fitter, fit, guesses, effects)
    selected = [_selected(fitter, fit, effect, effects) for effect in fit.effects]
    opened = opened_arm(guesses) if ARM in fit.values else None
    if is_open(guesses):
        selected = _clock_or_arm(fitter, fit, selected, len(effects), called_for, opened)
    selected = [_or_else(each, [alike[n]]) if (n := each.effect.name) in alike else each for each in selected]
    rivals = [one for each in selected if opened is not None and each.effect.name in CLOCKS for one in each.rivals]
    freed = with_clocks(fitter, fit, guesses, effects, blocks_of(fitter.problem), opened)
    clocks = tuple(effect.name for effect in (freed or fit).effects if effect not in fit.effects)
    if freed is None:
        clocks = tuple(name for name in TWO_CLOCKS if name not in fit.values)
    if clocks:
        selected = [_or_else(each, clocks) if each.effect.name == ARM else each for each in selected]
    if opened is not None and any(each.effect.name == ARM and REFERENCE_CLOCK in each.equivalent for each in selected):
        opened = replace(opened, late=IN_TIME_STD_S)  # only the two together are known
    if opened is not None:  # what tells a lag from a delay is less than what lies between samples
        selected = [
            _or_else(each, [*each.equivalent, REFERENCE_CLOCK]) if each.effect.name == LAG else each
            for each in selected
        ]
    fit, moved = (fit, moved_arm(fit, rivals)) if freed is None or freed is fit else (freed, {})
    base = fitter.fit_kept(fit.hypothesis.with_effects([], len(recordings), {}), fit.noise)
    if any(each.registration is not None and each.registration.not_told_apart for each in guesses):
        selected = [_or_else(each, TWO_CLOCKS) if each.effect.name in TWO_CLOCKS else each for each in selected]
    ordered = tuple(sorted(selected, key=lambda each: each.log_p))
    return EffectSelection(ordered, base, fit, fitter, guesses, effects, opened, moved)


# ------------------------------------------------------------------ noise


def _first_fit(problem: Problem, start: Hypothesis) -> tuple[Fitter, Fit]:
    """Robust fit of the first hypothesis, with white noise as large as the best fit so far leaves."""
    fitter = Fitter(problem)
    _, residual = fitter.evaluated(start)
    fit = fitter.fit(start, white_noise(residual, problem.segments, None, problem.interval))
    for _ in range(ROBUST_ROUNDS):
        raw = fit.residual + fitter.outliers
        noise = white_noise(raw, problem.segments, None, problem.interval)
        fitter = Fitter(problem, raw - noise.robust(raw))
        fit = fitter.fit(fit.hypothesis, noise)
    return fitter, fit


def _about(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> tuple[Fitter, Fit]:
    """A fit once more with the noise that everything together leaves, and outliers about that."""
    problem = fitter.problem
    columns = np.concatenate(
        [fit.columns, *(v.columns for v in _variants(fitter, fit, effects) if v.tried == 1.0)], axis=2
    )
    noise = fit.noise
    raw = fit.residual + fitter.outliers
    for _ in range(2):
        explained = _explained(noise, columns, raw - fitter.outliers)
        left = raw - explained
        noise, robust = min(
            (estimated(problem, fit.seen, left, rotation) for rotation in _frames(problem)),
            key=lambda each: each[0].deviance(each[1]),
        )
        fitter = Fitter(problem, left - robust)
    n, p = columns.shape[0] * columns.shape[1], np.linalg.matrix_rank(columns.reshape(-1, columns.shape[2]))
    grown = float(np.sqrt(n / max(n - int(p), 1)))
    noise = replace(noise, axes=tuple(replace(arma, std=arma.std * grown) for arma in noise.axes))
    return fitter, fitter.fit(fit.hypothesis, noise)


def _frames(problem: Problem) -> list[Array | None]:
    return [None] if problem.earth_from_compared is None else [problem.earth_from_compared, None]


def _explained(noise: Noise, columns: Array, residual: Array) -> Array:
    """(M, A) what all columns explain of a residual, with a ridge that keeps those apart that are alike."""
    size = np.maximum(np.sqrt((columns**2).mean(axis=(0, 1))), 1e-12)
    white = noise.whiten(columns / size)
    ridge = np.full(columns.shape[2], 10.0 * np.sqrt(float((noise.whiten(residual) ** 2).sum())) / np.sqrt(len(white)))
    solution = WhitenedLeastSquares.of(white, noise.whiten(residual), ridge, np.zeros_like(ridge)).solution()
    return np.asarray((columns / size) @ solution)


# ------------------------------------------------------------------ proposals


def windows(effect: Effect, seconds: float) -> list[dict[str, float]]:
    """Times of the run, by name, that are tried: none at all first, then every part of the grid."""
    times = [spec.name for spec in effect.parameters if is_time_of_run(spec)]
    if not times:
        return [{}]
    grid = np.linspace(0.0, seconds, WINDOW_STEPS + 1).tolist()
    if len(times) == 1:
        return [{times[0]: at} for at in grid[1:-1]]
    whole = {name: effect.defaults[name] for name in times}
    parts = [dict(zip(times, part, strict=True)) for part in itertools.combinations(grid, len(times))]
    return [whole, *(part for part in parts if part != {times[0]: 0.0, times[-1]: seconds})]


def _variants(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> list[Variant]:
    """Of every effect that is not in the fit, its columns about the fit, at every window that is tried."""
    problem, present = fitter.problem, {effect.name for effect in fit.effects}
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


@dataclass(frozen=True)
class _Table:
    """Everything that can be combined, in one Gram matrix. blocks: columns of each variant."""

    variants: list[Variant]
    blocks: list[NDArray[np.intp]]
    system: WhitenedLeastSquares

    def drop(self, chosen: Sequence[int]) -> float:
        """Misfit that a combination leaves."""
        part = self.system.part(np.concatenate([np.arange(6), *(self.blocks[index] for index in chosen)]))
        return part.misfit(part.solution())


def _table(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> _Table:
    problem, noise, hypothesis = fitter.problem, fit.noise, fit.hypothesis
    own: list[Variant] = []
    at = 6
    for effect in fit.effects:
        p = len(hypothesis.parameters_of(effect))
        own.append(Variant(effect, hypothesis.values[effect.name], fit.columns[:, :, at : at + p], 1.0))
        at += p
    variants = [*own, *_variants(fitter, fit, effects)]
    # the residual as it would be without the fit's effects, as far as straight lines tell
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
    system = WhitenedLeastSquares.of(noise.whiten(columns), noise.whiten(target), std, np.zeros_like(std))
    return _Table(variants, blocks, system)


def _std(effect: Effect, p: int, n_recordings: int) -> Array:
    sizes = [PRIOR_IN_TYPICAL * s.typical for s in effect.parameters if not is_time_of_run(s)]
    return np.array(sizes * (p // len(sizes)))


def price(effect: Effect, n_effects: int, n_recordings: int, tried: float = 1.0) -> float:
    """Deviance that an effect explains by chance, once in 1 / level data sets, having looked at all of them."""
    dof = n_amplitudes(effect, n_recordings)
    return float(chi2_isf(SETTINGS.level / n_effects / tried, dof))


def _proposed(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """Hypotheses worth fitting, by their straight lines about a fit; the fit's own among them."""
    table = _table(fitter, fit, effects)
    n = len(fitter.problem.recordings)
    cost = [price(v.effect, len(effects), n, v.tried) for v in table.variants]
    own = list(range(len(fit.effects)))
    usable = _shortlisted(table, own, cost)
    scored: list[tuple[float, tuple[int, ...]]] = []
    for size in range(SETTINGS.max_effects):
        for chosen in itertools.combinations(usable, size):
            names = {table.variants[index].effect.name for index in chosen}
            if len(names) == size:
                scored.append((table.drop(chosen) + sum(cost[index] for index in chosen), chosen))
    scored.sort()
    for _, chosen in scored[:3]:  # and one more on top of the best
        names = {table.variants[index].effect.name for index in chosen}
        scored += [
            (table.drop((*chosen, index)) + sum(cost[i] for i in (*chosen, index)), (*chosen, index))
            for index in usable
            if table.variants[index].effect.name not in names and len(chosen) < SETTINGS.max_effects
        ]
    scored.sort()
    scored = [each for each in scored if _is_told_by_two_clocks(table, each[1])]
    worth = list(dict.fromkeys(tuple(sorted(c)) for score, c in scored if score < scored[0][0] + NOT_WORTH_IT))[:FITTED]
    if tuple(own) not in worth:
        worth.append(tuple(own))
    return [
        *(_hypothesis(fitter, fit, table, chosen) for chosen in worth),
        *_told_by_other_clocks(fitter, fit, effects),
        *_told_by_a_lag(fit, effects),
    ]


def _is_told_by_two_clocks(table: _Table, chosen: Sequence[int]) -> bool:
    """Of three clocks only two differences matter: what any two say is told by those of DVL and reference."""
    names = {table.variants[index].effect.name for index in chosen}
    return ATTITUDE_CLOCK not in names or len(names & set(CLOCKS)) == 1


def _told_by_other_clocks(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """The fit's offsets said by fewer clocks, and by all that can say them: for large ones no straight line would.

    A leap at the beginning is a DVL's clock that is late throughout.
    """
    n, values = len(fit.seen), fit.values
    said = (*CLOCKS, LEAP) if _leaps_at_the_beginning(fitter, fit) else CLOCKS
    if not set(said) & set(values):
        return []
    dvl, reference, attitude = (
        np.array([each["seconds"] for each in values[name]]) if name in values else np.zeros(n) for name in CLOCKS
    )
    dvl, reference = dvl - attitude, reference - attitude
    if LEAP in said:
        dvl = dvl + [each["seconds"] for each in values[LEAP]]
    rest = [effect for effect in fit.effects if effect.name not in said]
    told = [
        {ATTITUDE_CLOCK: -0.5 * (dvl + reference)}, {DVL_CLOCK: dvl - reference}, {REFERENCE_CLOCK: reference - dvl},
        {DVL_CLOCK: dvl, REFERENCE_CLOCK: reference},
    ]  # fmt: skip
    found = []
    for one in told:
        if set(one) <= set(effects) and len(rest) + len(one) <= SETTINGS.max_effects:
            start = {name: tuple({"seconds": float(s)} for s in seconds) for name, seconds in one.items()}
            found.append(fit.hypothesis.with_effects([*rest, *(effects[name] for name in one)], n, start))
    return found


def _told_by_a_lag(fit: Fit, effects: Mapping[str, Effect]) -> list[Hypothesis]:
    """The fit with a lag of the reference for its delay, or the other way round."""
    rest = [effect for effect in fit.effects if effect.name not in LAG_OR_DELAY]
    return [
        fit.hypothesis.with_effects([*rest, *(effects[name] for name in start)], len(fit.seen), start)
        for start in lags_and_delays(fit, effects)
    ]


def _leaps_at_the_beginning(fitter: Fitter, fit: Fit) -> bool:
    """Whether there is one leap, and in each recording before the first of the times that are tried for it."""
    leaps = fit.values.get(LEAP, ())
    first = [recording.seconds / WINDOW_STEPS for recording in fitter.problem.recordings]
    twice = any(np.isfinite(leap.get("again_at_s", np.inf)) for leap in leaps)
    return bool(leaps) and not twice and all(leap["at_s"] < at for leap, at in zip(leaps, first, strict=True))


def _by_fewer_clocks(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> Fit:
    """A fit with two clocks, or the same told by one of the three: what else it holds was only tried with the two."""
    if not set(TWO_CLOCKS) <= set(fit.values) and not _leaps_at_the_beginning(fitter, fit):
        return fit
    others = [
        fitter.fit(hypothesis, fit.noise, careful=True) for hypothesis in _told_by_other_clocks(fitter, fit, effects)
    ]
    return _best([fit, *others], effects)


def _shortlisted(table: _Table, own: Sequence[int], cost: Sequence[float]) -> list[int]:
    """Variants that promise most, alone or on top of the fit's own; all of the fit's own."""
    alone, none = table.drop(own), table.drop([])
    gains: dict[int, float] = {}
    for index, variant in enumerate(table.variants):
        if index in own:
            continue
        by_itself = none - table.drop([index]) - cost[index]
        on_top = alone - table.drop([*own, index]) - cost[index]
        instead = max(
            (table.drop([i for i in own if i != out]) - table.drop([*(i for i in own if i != out), index]) - cost[index]
             for out in own),
            default=-np.inf,
        )  # fmt: skip
        # of what explains much by itself, strong effects make all look alike: what it adds counts more
        gains[index] = max(on_top, 0.1 * instead, 0.01 * by_itself)
        del variant
    kept: list[int] = []
    of_effect: dict[str, int] = {}
    for index in sorted(gains, key=lambda i: -gains[i]):
        name = table.variants[index].effect.name
        if of_effect.get(name, 0) < KEPT_VARIANTS and len(kept) < SHORTLIST:
            kept.append(index)
            of_effect[name] = of_effect.get(name, 0) + 1
    return [*own, *kept]


def _hypothesis(fitter: Fitter, fit: Fit, table: _Table, chosen: Sequence[int]) -> Hypothesis:
    """A combination with the values that the table gives it to start from; effects of the fit start at theirs."""
    part = table.system.part(np.concatenate([np.arange(6), *(table.blocks[index] for index in chosen)]))
    solution = part.solution()[6:]
    n = len(fitter.problem.recordings)
    start: dict[str, tuple[Values, ...]] = {}
    at = 0
    for index in chosen:
        variant = table.variants[index]
        step = solution[at : at + variant.p]
        at += variant.p
        if variant.effect in fit.effects:
            start[variant.effect.name] = variant.values
            continue
        empty = no_effect().with_effects([variant.effect], n, {variant.effect.name: variant.values})
        moved = empty.moved(np.concatenate([np.zeros(6), step]))
        start[variant.effect.name] = moved.values[variant.effect.name]
    effects = [table.variants[index].effect for index in chosen]
    return fit.hypothesis.with_effects(effects, n, start)


def _happening_again(
    fitter: Fitter, fits: Sequence[Fit], every: Mapping[str, Effect], effects: Mapping[str, Effect]
) -> list[Fit]:
    """Of what may happen twice, the best fit in which it happens once with a second time, where that promises to be
    worth it, and the best in which it happens twice with either alone, where the other is small.

    every: effects with what they are the second time. Several recordings share their times, which two of a day do not.
    """
    found: list[Fit] = []
    if len(fitter.problem.recordings) > 1:
        return found
    for name, whole in every.items():
        own = [fit for fit in fits if whole.again and name in fit.values]
        if not own:
            continue
        best = _best(own, effects)
        if whole.again.keys() <= best.values[name][0].keys():
            starts = _either_alone(best, effects[name], whole)
        else:
            n = len(best.seen)
            once, twice = (price(each, len(effects), n, _tried(each)) for each in (effects[name], whole))
            limit = best.deviance + once - twice
            starts = _a_second_time(fitter, best, whole, limit)
        tried = [fitter.fit(start, best.noise) for start in starts]
        found += [fit for fit in tried if not _is_taken_back(fitter, fit, name, best.deviance - fit.deviance)]
    return found


def _a_second_time(fitter: Fitter, fit: Fit, whole: Effect, limit: float) -> list[Hypothesis]:
    """The likeliest starts with a second time, one straight step about a fit, in the order of time, that are to leave
    less deviance than a limit."""
    others = [effect for effect in fit.effects if effect.name != whole.name]
    (again,) = (spec.name for spec in whole.parameters if spec.name in whole.again and is_time_of_run(spec))
    seconds = max(recording.seconds for recording in fitter.problem.recordings)
    left = fit.deviance - fitter.straight_on(fit, fit.hypothesis)[0]
    tried = []
    times = np.linspace(0.0, seconds, 2 * WINDOW_STEPS + 1)[1:-1].tolist()
    if whole.name == LEAP:
        times += [at for at, _ in gaps(fitter, fit)]
    for at in times:
        values = tuple({**whole.defaults, **each, again: at} for each in fit.values[whole.name])
        start = fit.hypothesis.with_effects([*others, whole], len(values), {whole.name: values})
        misfit, start = fitter.straight_on(fit, start)
        if misfit + left > limit:
            continue
        if at < values[0][whole.again[again]]:
            names = {**whole.again, **{first: second for second, first in whole.again.items()}}
            values = tuple({names[key]: value for key, value in each.items()} for each in start.values[whole.name])
            start = start.with_effects(start.effects, len(values), {whole.name: values})
        tried.append((misfit, start))
    return [start for _, start in sorted(tried, key=lambda each: each[0])[:KEPT_VARIANTS]]


def _is_taken_back(fitter: Fitter, fit: Fit, name: str, drop: float, rest: Fit | None = None) -> bool:
    """Whether what happens twice in a fit is undone the second time, or happens at once, in each recording.

    drop: deviance that it explains. What explains much may be undone where an unknown cause in its place (rest: without
    it) explains less. That is asked of what explains more than such causes do unseen only if it is undone exactly.
    """
    apart, share = _undone(fit, name)
    at_once = apart < max(recording.seconds for recording in fitter.problem.recordings) / WINDOW_STEPS
    if at_once or share >= TAKEN_BACK or drop < MUCH:
        return at_once or share < TAKEN_BACK
    if rest is None or (drop > SETTINGS.instead_of and share >= TAKEN_BACK_EXACTLY):
        return False
    other = unexplained(fitter, rest)
    return other.clear_energy - other.price > drop


def _undone(fit: Fit, name: str) -> tuple[float, float]:
    """How far (s) the second time that something happens in a fit is from the first, and what share is not undone by
    it, of the larger; the most of all recordings. Infinite where it cannot happen twice."""
    effect = next(each for each in fit.effects if each.name == name)
    own = {spec.name: spec for spec in effect.parameters}
    if not effect.again or not effect.again.keys() <= own.keys():
        return np.inf, np.inf
    apart, share = [], []
    for second, first in effect.again.items():
        for values in fit.values[name]:
            if is_time_of_run(own[second]):
                apart.append(values[second] - values[first])
            else:
                largest = max(abs(values[first]), abs(values[second]), 1e-12)
                share.append(abs(values[first] + values[second]) / largest)
    return max(apart), max(share)


def _either_alone(fit: Fit, once: Effect, whole: Effect, clear: Collection[str] | None = None) -> list[Hypothesis]:
    """What happens twice in a fit, as the first alone and as the second, each where the other is not clear.

    clear: names of the parameters that are; by default those many standard deviations large.
    """
    if clear is None:
        std = np.sqrt(np.diag(fit.system.covariance()))
        clear = {
            each.spec.name
            for each, own in zip(fit.hypothesis.parameters(), std[6:].tolist(), strict=True)
            if each.effect.name == whole.name and abs(fit.hypothesis.value(each)) > CLEAR * own
        }
    clear = {name for name in clear if not any(is_time_of_run(s) for s in whole.parameters if s.name == name)}
    others = [effect for effect in fit.effects if effect.name != whole.name]
    back = {first: second for second, first in whole.again.items()}
    starts = []
    for kept, out in (({first: first for first in back}, set(whole.again)), (back, set(back))):
        if not out & clear:
            values = tuple({first: each[name] for first, name in kept.items()} for each in fit.values[whole.name])
            starts.append(fit.hypothesis.with_effects([*others, once], len(values), {whole.name: values}))
    return starts


def _finer_steps(problem: Problem) -> list[float]:
    seconds = max(recording.seconds for recording in problem.recordings) / WINDOW_STEPS
    steps: list[float] = []
    while seconds > 0.7 * problem.interval and len(steps) < 8:
        seconds /= 2.0
        steps.append(seconds)
    return steps


# ------------------------------------------------------------------ decisions


def _best(fits: Sequence[Fit], effects: Mapping[str, Effect]) -> Fit:
    """The fit that explains most for its price; of those that do as well, that of the most usual effects.

    These come first in the library.
    """
    scores = [_criterion(fit, len(effects)) for fit in fits]
    rank = {name: index for index, name in enumerate(effects)}
    alike = [fit for fit, score in zip(fits, scores, strict=True) if score < min(scores) + AS_WELL]
    return min(alike, key=lambda fit: (sum(rank[effect.name] for effect in fit.effects), fit.deviance))


def _criterion(fit: Fit, n_effects: int) -> float:
    """Deviance and the price of every effect."""
    n = len(fit.seen)
    return fit.deviance + sum(price(effect, n_effects, n, _tried(effect)) for effect in fit.effects)


def _tried(effect: Effect) -> float:
    return 2.0 * len(windows(effect, 1.0)) if any(is_time_of_run(s) for s in effect.parameters) else 1.0


def _without(fitter: Fitter, fit: Fit, effect: Effect) -> Fit:
    rest = [other for other in fit.effects if other is not effect]
    return fitter.fit_kept(fit.hypothesis.with_effects(rest, len(fit.seen), {}), fit.noise)


def log_p_value(drop: float, dof: float, tried: float = 1.0) -> float:
    """log p of a drop in deviance, times how many alternatives were tried."""
    return min(0.0, float(chi2_logsf(max(drop, 0.0), max(dof, 1e-3))) + float(np.log(tried)))


def _log_p(fit: Fit, rest: Fit, effect: Effect) -> float:
    return log_p_value(fit.gain_over(rest), fit.dof - rest.dof, _tried(effect))


def _called_for(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """A fit without those effects that are not called for given all others, or add next to nothing to a strong one."""
    threshold = float(np.log(SETTINGS.level / n_effects))
    while fit.effects:
        base = fitter.fit_kept(fit.hypothesis.with_effects([], len(fit.seen), {}), fit.noise)
        explained = base.deviance - fit.deviance
        rests = [(effect, _without(fitter, fit, effect)) for effect in fit.effects]
        drops = {effect.name: rest.deviance - fit.deviance for effect, rest in rests}
        weak = [
            rest
            for effect, rest in rests
            if _log_p(fit, rest, effect) > threshold
            or _is_taken_back(fitter, fit, effect.name, drops[effect.name], rest)
            or _makes_leaps_cancel(fit, effect, drops)
            or (
                _is_ghost(effect, drops[effect.name], explained, fit.deviance)
                and not _is_late_before_a_leap(fit, effect)
            )
        ]
        if not weak:
            return fit
        fit = min(weak, key=lambda each: each.deviance)
    return fit


def _makes_leaps_cancel(fit: Fit, effect: Effect, drops: Mapping[str, float]) -> bool:
    """Whether an effect is a clock, late before two leaps that cancel with it alone, and little of what they explain.

    drops: deviance that each effect explains, by name.
    """
    if effect.name != DVL_CLOCK or LEAP not in fit.values or _undone(fit, LEAP)[1] > TAKEN_BACK_EXACTLY:
        return False
    return drops[DVL_CLOCK] < LITTLE_OF_LEAPS * drops[LEAP]


def _without_nothing(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """A fit without those effects that explain, under the noise as it is known now, no more than chance does.

    At one speed a quadratic scale and the scale go anywhere together, and what noise of the DVL that makes is all they
    explain.
    """
    while fit.effects:
        rests = [(rest := _without(fitter, fit, effect), _log_p(fit, rest, effect)) for effect in fit.effects]
        worst, log_p = max(rests, key=lambda each: each[1])
        if log_p < -float(np.log(n_effects)):
            return fit
        fit = worst
    return fit


def _with_all_of_the_arm(fitter: Fitter, fit: Fit, every: Mapping[str, Effect], effects: Mapping[str, Effect]) -> Fit:
    """A fit with the whole lever arm, where that part which is not shown is so large that it is what is left.

    every: effects with all that they have; effects: with what is shown.
    """
    if ARM not in fit.values or effects[ARM].parameters == every[ARM].parameters or not unexplained(fitter, fit).found:
        return fit
    values = tuple(every[ARM].defaults | dict(each) for each in fit.values[ARM])
    others = [effect for effect in fit.effects if effect.name != ARM]
    hypothesis = fit.hypothesis.with_effects([*others, every[ARM]], len(fit.seen), {ARM: values})
    whole = min(fit, fitter.fit(hypothesis, fit.noise), key=lambda each: _criterion(each, len(every)))
    if whole is fit or without_faint(fitter.problem, whole) is not None:
        return fit
    return fit if unexplained(fitter, whole).found else whole


def _is_ghost(effect: Effect, drop: float, explained: float, left: float) -> bool:
    """Whether an effect adds next to nothing to what all of them explain; of what bends an arm, nor to the noise."""
    if drop > SETTINGS.ghost_share * explained:
        return False
    return not effect.bends_arm or drop < SETTINGS.ghost_of_noise * left


def _is_late_before_a_leap(fit: Fit, effect: Effect) -> bool:
    """Whether an effect is that the DVL's clock is late before it leaps, by as much as nothing of the leap could be.

    It tells of the time before the leap alone, which may be short, and so of little of what all of them explain.
    """
    if effect.name != DVL_CLOCK or LEAP not in fit.values:
        return False
    late, leap = fit.values[effect.name], fit.values[LEAP]
    return any(
        abs(own["seconds"]) > TAKEN_BACK * max(abs(each["seconds"]), abs(each.get("again_seconds", 0.0)))
        for own, each in zip(late, leap, strict=True)
    )


def _borne_out(fitter: Fitter, fit: Fit, n_effects: int) -> Fit:
    """A fit without effects that the scatter of the blocks does not bear out, whatever the noise's colour."""
    block = blocks_of(fitter.problem)
    while fit.effects:
        p_values = {effect.name: _robust_p(fit, effect, block) for effect in fit.effects}
        worst = max(p_values, key=lambda name: p_values[name])
        if p_values[worst] < SETTINGS.robust_level:
            return fit
        fit = _without(fitter, fit, next(effect for effect in fit.effects if effect.name == worst))
    return fit


def _once_borne_out(fitter: Fitter, fit: Fit, every: Mapping[str, Effect], effects: Mapping[str, Effect]) -> Fit:
    """A fit in which what happens twice happens once, where the scatter of the blocks does not bear out the other."""
    block = blocks_of(fitter.problem)
    for effect in fit.effects:
        own = {spec.name for spec in effect.parameters}
        if not effect.again or not effect.again.keys() <= own:
            continue
        doubtful = {
            each.spec.name
            for each in fit.hypothesis.parameters_of(effect)
            if _robust_p(fit, effect, block, each.spec.name) >= SETTINGS.robust_level
        }
        starts = _either_alone(fit, effects[effect.name], every[effect.name], clear=own - doubtful)
        found = [fitter.refined(fitter.fit(start, fit.noise), _finer_steps(fitter.problem)) for start in starts]
        return min(found, key=lambda each: each.deviance, default=fit)
    return fit


def _robust_p(fit: Fit, effect: Effect, block: NDArray[np.intp], name: str = "") -> float:
    """p of a Wald test with the covariance that blocks show, of all parameters of an effect or of one by name."""
    at, start = np.zeros(0, dtype=int), 6
    for other in fit.effects:
        p = len(fit.hypothesis.parameters_of(other))
        if other is effect:
            at = np.arange(start, start + p)
        start += p
    own = fit.hypothesis.parameters_of(effect)
    is_asked = np.array([not name or each.spec.name == name for each in own])
    at, defaults = at[is_asked], np.array([each.spec.default for each in own])[is_asked]
    values = fit.hypothesis.vector()[at] - defaults
    covariance = fit.covariance(block)[np.ix_(at, at)]
    wald = float(values @ np.linalg.solve(covariance, values)) / len(at)
    blocks = int(block.max()) + 1
    return float(f_sf(wald, len(at), max(blocks - len(at), 2)))


def blocks_of(problem: Problem) -> NDArray[np.intp]:
    """(M,) block of each bin, from 0: stretches of time, half of those of hold-out."""
    index = np.floor(problem.time / (0.5 * SETTINGS.block)).astype(int)
    keys = problem.recording_of * (index.max() + 2) + index - index.min()
    return np.asarray(np.unique(keys, return_inverse=True)[1], dtype=np.intp)


def _selected(fitter: Fitter, fit: Fit, effect: Effect, effects: Mapping[str, Effect]) -> Selected:
    """Test an effect given all others, and every other effect in its place.

    One with more parameters that fits as well could be the cause, however much less likely its numbers make it; one
    that fits worse could be if it needs fewer.
    """
    rest = _without(fitter, fit, effect)
    log_p = _log_p(fit, rest, effect)
    drop = rest.deviance - fit.deviance
    table = _table(fitter, rest, effects)
    n = len(fit.seen)
    own = list(range(len(rest.effects)))
    found: list[tuple[float, str, Hypothesis]] = []
    best_of: dict[str, int] = {}
    drops = {i: table.drop(own) - table.drop([*own, i]) for i in range(len(own), len(table.variants))}
    for index in sorted(drops, key=lambda i: -drops[i]):
        best_of.setdefault(table.variants[index].effect.name, index)
    straight = drops.get(best_of.get(effect.name, -1), drop)
    for name, index in best_of.items():
        if name == effect.name or drops[index] < 0.7 * min(straight, drop) - 4.0 * SETTINGS.indistinguishable:
            continue
        rival = fitter.fit_kept(_hypothesis(fitter, rest, table, [*own, index]), fit.noise)
        behind = rival.deviance - fit.deviance
        fewer = n_amplitudes(effect, n) - n_amplitudes(effects[name], n)
        if behind < SETTINGS.indistinguishable + max(0.0, 2.0 * fewer):
            found.append((behind, name, rival.hypothesis))
    found.sort(key=lambda each: each[:2])
    return Selected(effect, log_p, tuple(name for _, name, _ in found), tuple(each for *_, each in found))


def _clock_or_arm(
    fitter: Fitter,
    fit: Fit,
    selected: list[Selected],
    n_effects: int,
    called_for: Sequence[Effect],
    opened: OpenArm | None,
) -> list[Selected]:
    """Lever arm and clock as one where each would do without the other.

    called_for: what the data calls for; a further clock that only stands beside the arm is named where it is shown.
    opened: as `opened_arm` has it; a clock of the reference that is no later than that is not shown.
    """
    threshold, block = float(np.log(SETTINGS.level / n_effects)), blocks_of(fitter.problem)

    late = [abs(each["seconds"]) for each in fit.values.get(REFERENCE_CLOCK, ())]
    is_late = opened is None or max(late, default=0.0) >= LATER * opened.late

    def is_shown(each: Selected) -> bool:
        if each.effect.name == REFERENCE_CLOCK and not is_late:
            return False
        return each.log_p <= threshold and _robust_p(fit, each.effect, block) < SETTINGS.robust_level

    own = {each.effect.name: each for each in selected}
    arm, clocks = own.get(ARM), [own[name] for name in TWO_CLOCKS if name in own]
    if arm is None or not clocks:
        return selected
    clock = min(clocks, key=lambda each: each.log_p)
    beside = [each for each in clocks if each is not clock and each.effect not in called_for and not is_shown(each)]
    selected = [each for each in selected if each not in beside]
    if is_shown(arm) and is_shown(clock):
        return selected
    one, other = (arm, clock) if is_shown(arm) else (clock, arm)
    rest = [effect for effect in fit.effects if effect not in (arm.effect, clock.effect)]
    without = fitter.fit_kept(fit.hypothesis.with_effects(rest, len(fit.seen), {}), fit.noise)
    log_p = log_p_value(fit.gain_over(without), fit.dof - without.dof)
    equivalent = dict.fromkeys((other.effect.name, *one.equivalent))
    return [Selected(one.effect, log_p, tuple(equivalent)), *(each for each in selected if each not in (one, other))]


def _or_else(selected: Selected, names: Sequence[str]) -> Selected:
    """An effect for which others could stand in as well."""
    others = (name for name in (*names, *selected.equivalent) if name != selected.effect.name)
    return replace(selected, equivalent=tuple(dict.fromkeys(others)))


__all__ = ["EffectSelection", "Offsets", "Selected", "blocks_of", "log_p_value", "select"]
