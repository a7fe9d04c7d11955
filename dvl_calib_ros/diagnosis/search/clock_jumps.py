"""Where the DVL's clock leaps: how late its stamps are in each part of a run, looked for over all delays at once.

Columns of a leap are straight lines about the delays of a fit. With leaps of seconds these lie between those of the
parts, where a straight line tells of none of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...calibration.numerics.frames import Array
from ...effects.base import ActsOn, Effect
from ...effects.composition import late
from ..fit.gauss_newton import OF_A_TIME, Fit, Fitter
from ..fit.selection_criteria import step_of_times
from ..model.hypothesis import Hypothesis, Values
from ..model.settings import SETTINGS
from .arm_clock_ambiguity import ARM, CLOCKS, DVL_CLOCK, LAG, LAG_OR_DELAY, lags_and_delays

LEAP = "time_offset_jump"
# Effects of time, of which one is wrong where a clock leaps, and of these such as stand in for a leap
MOVING_CLOCK = ("clock_drift", LEAP)
OF_TIME = (*CLOCKS, LAG, *MOVING_CLOCK)
STANDS_IN = (DVL_CLOCK, *MOVING_CLOCK)
# Delays that are tried, s, about those of the fit; parts of the run between which one leap may lie, and of how many of
# them a delay is, or it is not to be told from how a run begins or ends
DELAYS = np.arange(-4.0, 4.01, 0.25)
PARTS, FEWEST_PARTS = 60, 3
# Squares of white noise that a leap takes off, from which on it is fitted, and a delay that is none, s
WORTH_FITTING, NO_DELAY = 40.0, 0.13
# The largest gaps in the stamps, from so many seconds on, are times at which a clock may have leapt ahead, if by as
# much (but for that many seconds)
GAPS, GAP_FROM_S, AS_LARGE_S = 6, 0.15, 0.3
# Of those that a lost sample does not leave, so many are tried as leaps
LEAPS = 3
# Lost samples leave a gap of whole steps, a clock's leap such as differs by this share of a step
OF_A_STEP = 0.15


@dataclass(frozen=True)
class Delays:
    """How late the DVL is, s, in one part of the run after another, and where (part) each but the first begins."""

    seconds: tuple[float, ...]
    begins: tuple[int, ...]


def leaping(fitter: Fitter, fit: Fit, once: Mapping[str, Effect], every: Mapping[str, Effect]) -> list[Hypothesis]:
    """Hypotheses with the leaps that the delays of parts of one recording show, in place of what stands in for them.

    once, every: effects, with a leap that happens once, and twice. None without an effect of time in the fit.
    """
    present = {effect.name for effect in fit.effects}
    if len(fit.seen) > 1 or LEAP not in once or not present & {*OF_TIME}:
        return []
    rest = [effect for effect in fit.effects if effect.name not in STANDS_IN]
    squares, ends = _squares(fitter, fit, rest, every[DVL_CLOCK])
    found = _found(squares)
    if not found.begins:
        return []
    times = [_time(fitter, ends, part, by) for part, by in zip(found.begins, found.seconds[1:], strict=True)]
    steps = np.diff(found.seconds).tolist()
    values = {"seconds": steps[0], "at_s": times[0]}
    if len(steps) > 1:
        values |= {"again_seconds": steps[1], "again_at_s": max(times[1], times[0])}
    leap = every[LEAP] if len(steps) > 1 else once[LEAP]
    return _hypotheses(fit, rest, once, leap, values, found.seconds[0])


def gaps(fitter: Fitter, fit: Fit) -> list[tuple[float, float]]:
    """True times (s of the run) of the largest gaps in the stamps of the DVL of one recording, and what each is longer
    than usual, s; and of where its clock was set back, by how much at most, below zero.

    A clock that leaps ahead leaves a gap as large as the leap; lost samples leave gaps as well.
    """
    if len(fit.seen) > 1:
        return []
    (recording,) = fitter.problem.recordings
    stamps = recording.dvl.time
    steps = np.diff(stamps)
    usual = float(np.median(steps))
    back = [(event.before, -event.by) for event in recording.set_back]
    for event in recording.set_back:
        steps[(stamps[:-1] <= event.before) & (stamps[1:] >= event.after)] = usual
    largest = np.argsort(-steps)[:GAPS]
    ahead = zip(stamps[largest].tolist(), (steps[largest] - usual).tolist(), strict=True)
    injections = [each for each in fit.hypothesis.injections(0) if each.effect.name != LEAP]
    leaps: list[tuple[float, float]] = []  # stamps at which they come, s, and by how much
    for each in fit.values.get(LEAP, ()):
        for at_s, seconds in (("at_s", "seconds"), ("again_at_s", "again_seconds")):
            if np.isfinite(each.get(at_s, np.inf)):
                own = late(injections, ActsOn.DVL_CLOCK, np.array([each[at_s]]))[0]
                leaps.append((each[at_s] + float(own) + sum(by for _, by in leaps), each[seconds]))
    found = []
    for stamp, gap in (*back, *ahead):
        alike = [each for each in leaps if _is_as_large(each[1], gap)]
        its = min(alike, key=lambda each: abs(each[0] - stamp), default=None)  # that may have left it
        others = [each for each in leaps if each != its]
        before = sum(by for at, by in others if at < stamp)
        at = stamp - before - float(late(injections, ActsOn.DVL_CLOCK, np.array([stamp]))[0]) + 0.5 * usual
        if abs(gap) > GAP_FROM_S and at > 0.0:
            found.append((at, gap))
    return found


def jumps_in_stamps(
    fitter: Fitter, fit: Fit, once: Mapping[str, Effect], every: Mapping[str, Effect]
) -> list[Hypothesis]:
    """Hypotheses of a fit of one recording that leaps where the stamps say so to a sample, once or twice, by what the
    motion in each part says; but for those times of which a leap of the fit is one already.

    once, every: effects, with a leap that happens once, and twice. In a part that says little of a leap it is small
    beside the noise, and what then is left without it is taken for slow noise: it is found only where it is looked for.
    """
    if len(fit.seen) > 1 or LEAP not in once:
        return []
    rest = [effect for effect in fit.effects if effect.name not in STANDS_IN]
    stamped = replace(fit, hypothesis=fit.hypothesis.with_effects(rest, 1, {}))
    usual = float(np.median(np.diff(fitter.problem.recordings[0].dvl.time)))
    shown = [each for each in gaps(fitter, stamped) if _is_shifted(each[1], usual)][:LEAPS]
    own = fit.values.get(LEAP, ())
    n_own = sum(np.isfinite(each.get(at_s, np.inf)) for each in own for at_s in ("at_s", "again_at_s"))
    if n_own >= min(len(shown), 2):
        return []
    squares, ends = _squares(fitter, fit, rest, every[DVL_CLOCK])
    found = []
    for leapt in (each for n in (1, 2) for each in itertools.combinations(sorted(shown), n)):
        stamps, by = zip(*leapt, strict=True)
        edges = [0, *np.searchsorted(fitter.problem.time[np.maximum(ends - 1, 0)], stamps), len(ends)]
        if min(np.diff(edges)) < FEWEST_PARTS:
            continue
        late = [float(DELAYS[squares[:, a:b].sum(axis=1).argmin()]) for a, b in itertools.pairwise(edges)]
        steps = np.diff(late).tolist()
        if not all(map(_is_as_large, steps, by)):
            continue
        values = {"seconds": steps[0], "at_s": stamps[0] - late[0]}
        if len(leapt) > 1:
            values |= {"again_seconds": steps[1], "again_at_s": stamps[1] - late[1]}
        found += _hypotheses(fit, rest, once, every[LEAP] if len(leapt) > 1 else once[LEAP], values, late[0])
    return found


def _is_shifted(gap: float, usual: float) -> bool:
    """Whether stamps that go back, or a gap of no whole number of steps, are a clock's that leaps: not lost samples."""
    return gap < 0.0 or OF_A_STEP < (gap / usual) % 1.0 < 1.0 - OF_A_STEP


def _is_as_large(by: float, gap: float) -> bool:
    """Whether a leap, s, is one that leaves a gap, s; below zero: of a clock that is set back by no more."""
    return gap - AS_LARGE_S < by < (0.0 if gap < 0.0 else gap + AS_LARGE_S)


def in_gaps(fitter: Fitter, fit: Fit) -> Fit:
    """A fit whose leaps lie where the stamps have a gap as large or go back, if that is as good a time.

    Without the outliers there that a wrong time has made: they would be for it.
    """
    for at_s, seconds in (("at_s", "seconds"), ("again_at_s", "again_seconds")):
        if not all(at_s in each for each in fit.values.get(LEAP, ({},))):
            continue
        for at, gap in gaps(fitter, fit):
            (values,) = fit.values[LEAP]
            other = values.get("at_s" if at_s == "again_at_s" else "again_at_s", np.inf)
            is_of_other = abs(other - at) < step_of_times(fitter.problem)
            if is_of_other or not _is_as_large(values[seconds], gap):
                continue
            tried = replace(fit.hypothesis, values={**fit.values, LEAP: ({**values, at_s: at},)})
            times = fitter.problem.time
            near = (times > min(at, values[at_s]) - abs(gap)) & (times < max(at, values[at_s]) + abs(gap))
            fair = replace(fitter, outliers=np.where(near[:, None], 0.0, fitter.outliers), _fits={})
            left = [fair.fit(each, fit.noise) for each in (fit.hypothesis, tried)]
            before, after = (float((each.noise.whiten(each.residual) ** 2).sum()) for each in left)
            if after < before + OF_A_TIME:
                fit = fitter.fit(left[1].hypothesis, fit.noise)
    return fit


def time_by_stamps(fitter: Fitter, fit: Fit, at_s: str) -> tuple[float, float, float] | None:
    """The time of a leap with its interval (s of the run), where the stamps show it to a sample; else None.

    at_s: its name. They show it by a gap that is as large and no whole number of steps, as that of lost samples is, or
    where they go back.
    """
    usual = float(np.median(np.diff(fitter.problem.recordings[0].dvl.time)))
    value, by = fit.values[LEAP][0][at_s], fit.values[LEAP][0][at_s.replace("at_s", "seconds")]
    for at, gap in gaps(fitter, fit):
        if _is_shifted(gap, usual) and _is_as_large(by, gap) and abs(value - at) < max(usual, AS_LARGE_S):
            return value, min(value, at) - usual, max(value, at) + usual
    return None


def is_in_stamps(fitter: Fitter, fit: Fit) -> bool:
    """Whether the stamps of the DVL of one recording show one of the leaps of a fit, where they are next to it."""
    if len(fit.seen) > 1 or LEAP not in fit.values:
        return False
    beside = in_gaps(fitter, fit)
    times = [name for name in ("at_s", "again_at_s") if np.isfinite(beside.values[LEAP][0].get(name, np.inf))]
    return any(time_by_stamps(fitter, beside, name) is not None for name in times)


def _hypotheses(
    fit: Fit, rest: Sequence[Effect], once: Mapping[str, Effect], leap: Effect, values: Values, before: float
) -> list[Hypothesis]:
    """With a leap and, before it, a clock that is late and one that is not; beside all else, and what is usual."""
    usual = [effect for effect in rest if effect.name in (*OF_TIME, ARM)]
    if ARM in once and ARM not in {effect.name for effect in usual}:
        usual.append(once[ARM])
    made: dict[frozenset[str], Hypothesis] = {}
    clocks = [{}, {DVL_CLOCK: before}] if abs(before) > NO_DELAY and DVL_CLOCK in once else [{}]
    lags = [{}, *lags_and_delays(fit, once)]
    for others, lag, clock in itertools.product((list(rest), usual), lags, clocks):
        if lag:
            others = [effect for effect in others if effect.name not in LAG_OR_DELAY]
        effects = [*others, *(once[name] for name in (*lag, *clock)), leap]
        start: dict[str, tuple[Values, ...]] = {**lag, leap.name: (values,)}
        start |= {name: ({"seconds": seconds},) for name, seconds in clock.items()}
        if len(effects) <= SETTINGS.max_effects:
            names = frozenset(effect.name for effect in effects)
            made.setdefault(names, fit.hypothesis.with_effects(effects, 1, start))
    return list(made.values())


def _squares(fitter: Fitter, fit: Fit, rest: Sequence[Effect], clock: Effect) -> tuple[Array, Array]:
    """(D, P) whitened squares that each delay leaves in each part of the run, and the (P,) last bins of these."""
    white = fit.noise.white
    ends = np.linspace(0, len(fit.residual), PARTS + 1).astype(int)
    squares = np.zeros((len(DELAYS), PARTS))
    for number, seconds in enumerate(DELAYS.tolist()):
        tried = fit.hypothesis.with_effects([*rest, clock], 1, {clock.name: ({"seconds": seconds},)})
        each = white.whiten(fitter.evaluated(tried)[1]).reshape(len(fit.residual), -1)
        squares[number] = np.add.reduceat((each**2).sum(axis=1), ends[:-1])
    return squares, ends[1:]


def _found(squares: Array) -> Delays:
    """The delays with no leap, one or two: with as many as each takes off enough."""
    until = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    n = squares.shape[1]

    def best(a: int, b: int) -> tuple[float, int]:
        left = until[:, b] - until[:, a]
        return float(left.min()), int(left.argmin())

    none = best(0, n)
    places = range(FEWEST_PARTS, n - FEWEST_PARTS + 1)
    one = min((best(0, m)[0] + best(m, n)[0], m) for m in places)
    two = min(
        (best(0, m)[0] + best(m, k)[0] + best(k, n)[0], m, k)
        for m, k in itertools.combinations(places, 2)
        if k - m >= FEWEST_PARTS
    )
    edges = [0, n]
    if one[0] - two[0] > WORTH_FITTING and none[0] - two[0] > 2.0 * WORTH_FITTING:
        edges = [0, two[1], two[2], n]
    elif none[0] - one[0] > WORTH_FITTING:
        edges = [0, one[1], n]
    delays = tuple(float(DELAYS[best(a, b)[1]]) for a, b in itertools.pairwise(edges))
    return Delays(delays, tuple(edges[1:-1]))


def _time(fitter: Fitter, ends: Array, part: int, by: float) -> float:
    """When a part begins, s of the run by a true clock, in which the DVL is late by so many seconds."""
    problem = fitter.problem
    (grid,) = problem.grids
    at = float(problem.time[min(int(ends[part - 1]), len(problem.time) - 1)])
    return max(0.0, at + grid.late - by) if grid.clock is ActsOn.DVL_CLOCK else max(0.0, at)
