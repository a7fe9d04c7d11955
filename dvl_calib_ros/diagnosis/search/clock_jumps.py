"""Detection of jumps of the DVL's clock: the delay per part of the run, by a search over all delays.

The linearised model of a clock jump is valid about the delays of a fit. For jumps of seconds, these lie between the
delays of the parts, beyond the linear range of each.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...calibration.numerics.frames import Array
from ...effects.base import ActsOn, Effect, late
from ..fit.gauss_newton import CHANGE_POINT_DEVIANCE, Fit, Fitter
from ..fit.selection_criteria import step_of_times
from ..model.hypothesis import Hypothesis, Values
from ..model.settings import SETTINGS
from .arm_clock_ambiguity import ARM, CLOCKS, DVL_CLOCK, LAG, LAG_OR_DELAY, lags_and_delays

LEAP = "time_offset_jump"
# Effects that a clock jump biases, and among them those that a jump may replace
MOVING_CLOCK = ("clock_drift", LEAP)
OF_TIME = (*CLOCKS, LAG, *MOVING_CLOCK)
STANDS_IN = (DVL_CLOCK, *MOVING_CLOCK)
# DVL delays to try, s; parts of a run with constant delay, and fewest parts between jumps: shorter ones are not
# identifiable from the ends of a run
DELAYS = np.arange(-4.0, 4.01, 0.25)
N_PARTS, FEWEST_PARTS = 60, 3
# Largest gaps that may be jumps ahead: their number, least length (s), which is a least delay too, and tolerance of the
# size of a jump (s)
N_GAPS, MIN_GAP_S, SIZE_TOL_S = 6, 0.15, 0.3
# Lost samples leave a gap of whole steps; a clock jump differs from that by this share of a step
STEP_TOLERANCE = 0.15


@dataclass(frozen=True)
class Delays:
    """DVL delay, s, per part of the run, and the first part of each delay but the first."""

    seconds: tuple[float, ...]
    begins: tuple[int, ...]


def hypotheses_with_jumps(
    fitter: Fitter, fit: Fit, single: Mapping[str, Effect], every: Mapping[str, Effect]
) -> list[Hypothesis]:
    """Return hypotheses with clock jumps at the delay changes of one recording, replacing effects that resemble jumps.

    single, every: effects with one and with two jumps. Empty if the fit has no effect of time.
    """
    present = {effect.name for effect in fit.effects}
    if fit.n_recordings > 1 or LEAP not in single or not present & {*OF_TIME}:
        return []
    kept = [effect for effect in fit.effects if effect.name not in STANDS_IN]
    squares, ends = _squares(fitter, fit, kept, every[DVL_CLOCK])
    delays = _best_delays(squares)
    if not delays.begins:
        return []
    times = [_time(fitter, ends, part, delay) for part, delay in zip(delays.begins, delays.seconds[1:], strict=True)]
    steps = np.diff(delays.seconds).tolist()
    values = {"seconds": steps[0], "at_s": times[0]}
    if len(steps) > 1:
        values |= {"again_seconds": steps[1], "again_at_s": times[1]}
    jump = every[LEAP] if len(steps) > 1 else single[LEAP]
    return _hypotheses(fit, kept, single, jump, values, delays.seconds[0])


def gaps(fitter: Fitter, fit: Fit) -> list[tuple[float, float]]:
    """Return true times (s) and excess (s) of the largest gaps in the DVL's stamps of one recording.

    Backward clock steps have a negative excess, an upper bound of their size. A forward clock jump leaves a gap of its
    own size; lost samples leave gaps as well.
    """
    if fit.n_recordings > 1:
        return []
    (recording,) = fitter.problem.recordings
    stamps = recording.dvl.time
    steps = np.diff(stamps)
    interval = float(np.median(steps))
    back = [(event.before, -event.by) for event in recording.backward_steps]
    for event in recording.backward_steps:
        steps[(stamps[:-1] <= event.before) & (stamps[1:] >= event.after)] = interval
    largest = np.argsort(-steps)[:N_GAPS]
    ahead = zip(stamps[largest].tolist(), (steps[largest] - interval).tolist(), strict=True)
    injections = [each for each in fit.hypothesis.injections(0) if each.effect.name != LEAP]
    jumps: list[tuple[float, float]] = []  # stamps (s) of the jumps, and sizes (s)
    for each in fit.values.get(LEAP, ()):
        for at_s, seconds in (("at_s", "seconds"), ("again_at_s", "again_seconds")):
            if np.isfinite(each.get(at_s, np.inf)):
                delay = late(injections, ActsOn.DVL_CLOCK, np.array([each[at_s]]))[0]
                jumps.append((each[at_s] + float(delay) + sum(by for _, by in jumps), each[seconds]))
    result = []
    for stamp, gap in (*back, *ahead):
        matching = [each for each in jumps if _is_as_large(each[1], gap)]
        its = min(matching, key=lambda each: abs(each[0] - stamp), default=None)  # the jump that may have left the gap
        other_jumps = [each for each in jumps if each != its]
        before = sum(by for at, by in other_jumps if at < stamp)
        at = stamp - before - float(late(injections, ActsOn.DVL_CLOCK, np.array([stamp]))[0]) + 0.5 * interval
        if abs(gap) > MIN_GAP_S and at > 0.0:
            result.append((at, gap))
    return result


def _is_shifted(gap: float, interval: float) -> bool:
    """Return whether a gap is a clock jump: negative or not a whole number of steps, unlike lost samples."""
    return gap < 0.0 or STEP_TOLERANCE < (gap / interval) % 1.0 < 1.0 - STEP_TOLERANCE


def _is_as_large(by: float, gap: float) -> bool:
    """Return whether a jump (s) matches a gap (s); a backward step may be smaller than the gap."""
    return gap - SIZE_TOL_S < by < (0.0 if gap < 0.0 else gap + SIZE_TOL_S)


def with_jumps_in_gaps(fitter: Fitter, fit: Fit) -> Fit:
    """Return a fit with its clock jumps moved to gaps of matching size, if the time is equally likely.

    Outliers near the gap are not corrected: a wrong jump time would have caused them.
    """
    for at_s, seconds in (("at_s", "seconds"), ("again_at_s", "again_seconds")):
        if not all(at_s in each for each in fit.values.get(LEAP, ({},))):
            continue
        for time, gap in gaps(fitter, fit):
            (values,) = fit.values[LEAP]
            other_time = values.get("at_s" if at_s == "again_at_s" else "again_at_s", np.inf)
            is_of_other = abs(other_time - time) < step_of_times(fitter.problem)
            if is_of_other or not _is_as_large(values[seconds], gap):
                continue
            trial = replace(fit.hypothesis, values={**fit.values, LEAP: ({**values, at_s: time},)})
            times = fitter.problem.time
            excluded = (times > min(time, values[at_s]) - abs(gap)) & (times < max(time, values[at_s]) + abs(gap))
            fair = replace(fitter, outliers=np.where(excluded[:, None], 0.0, fitter.outliers), _fits={})
            refitted = [fair.fit(each, fit.noise) for each in (fit.hypothesis, trial)]
            before, after = (float((each.noise.whiten(each.residual) ** 2).sum()) for each in refitted)
            if after < before + CHANGE_POINT_DEVIANCE:
                fit = fitter.fit(refitted[1].hypothesis, fit.noise)
    return fit


def time_by_stamps(fitter: Fitter, fit: Fit, at_s: str) -> tuple[float, float, float] | None:
    """Return time and interval (s) of a clock jump that the stamps confirm to a sample, or None.

    at_s: name of the time parameter. Evidence is a backward step, or a gap of matching size that is no whole number of
    steps.
    """
    interval = float(np.median(np.diff(fitter.problem.recordings[0].dvl.time)))
    value, size = fit.values[LEAP][0][at_s], fit.values[LEAP][0][at_s.replace("at_s", "seconds")]
    for time, gap in gaps(fitter, fit):
        if _is_shifted(gap, interval) and _is_as_large(size, gap) and abs(value - time) < max(interval, SIZE_TOL_S):
            return value, min(value, time) - interval, max(value, time) + interval
    return None


def _hypotheses(
    fit: Fit, kept: Sequence[Effect], single: Mapping[str, Effect], jump: Effect, values: Values, before: float
) -> list[Hypothesis]:
    """Return hypotheses with a jump, with and without a delay before it, next to all or only the usual effects."""
    essential = [effect for effect in kept if effect.name in (*OF_TIME, ARM)]
    if ARM in single and ARM not in {effect.name for effect in essential}:
        essential.append(single[ARM])
    hypotheses: dict[frozenset[str], Hypothesis] = {}
    clocks = [{}, {DVL_CLOCK: before}] if abs(before) > MIN_GAP_S and DVL_CLOCK in single else [{}]
    lags = [{}, *lags_and_delays(fit, single)]
    for included, lag, clock in itertools.product((list(kept), essential), lags, clocks):
        if lag:
            included = [effect for effect in included if effect.name not in LAG_OR_DELAY]
        effects = [*included, *(single[name] for name in (*lag, *clock)), jump]
        start: dict[str, tuple[Values, ...]] = {**lag, jump.name: (values,)}
        start |= {name: ({"seconds": seconds},) for name, seconds in clock.items()}
        if len(effects) <= SETTINGS.max_effects:
            names = frozenset(effect.name for effect in effects)
            hypotheses.setdefault(names, fit.hypothesis.with_effects(effects, 1, start))
    return list(hypotheses.values())


def _squares(fitter: Fitter, fit: Fit, kept: Sequence[Effect], clock: Effect) -> tuple[Array, Array]:
    """Return whitened squares (D, P) per delay and part of the run, and the last bins (P,) of the parts."""
    white = fit.noise.white
    ends = np.linspace(0, len(fit.residual), N_PARTS + 1).astype(int)
    squares = np.zeros((len(DELAYS), N_PARTS))
    for number, seconds in enumerate(DELAYS.tolist()):
        trial = fit.hypothesis.with_effects([*kept, clock], 1, {clock.name: ({"seconds": seconds},)})
        whitened = white.whiten(fitter.evaluated(trial)[1]).reshape(len(fit.residual), -1)
        squares[number] = np.add.reduceat((whitened**2).sum(axis=1), ends[:-1])
    return squares, ends[1:]


def _best_delays(squares: Array) -> Delays:
    """Return the delay of each part of the run, with no, one or two jumps between the parts.

    squares: (D, P) sums of whitened squares for each of `DELAYS` and each of P short parts of the run.
    A jump is kept if it reduces the sum of squares by more than `SETTINGS.conclusive`.
    """
    cumulative = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    n = squares.shape[1]

    def best_delay(a: int, b: int) -> tuple[float, int]:
        gains = cumulative[:, b] - cumulative[:, a]
        return float(gains.min()), int(gains.argmin())

    no_jump = best_delay(0, n)
    starts = range(FEWEST_PARTS, n - FEWEST_PARTS + 1)
    one_jump = min((best_delay(0, m)[0] + best_delay(m, n)[0], m) for m in starts)
    two_jumps = min(
        (best_delay(0, m)[0] + best_delay(m, k)[0] + best_delay(k, n)[0], m, k)
        for m, k in itertools.combinations(starts, 2)
        if k - m >= FEWEST_PARTS
    )
    edges = [0, n]
    if one_jump[0] - two_jumps[0] > SETTINGS.conclusive and no_jump[0] - two_jumps[0] > 2.0 * SETTINGS.conclusive:
        edges = [0, two_jumps[1], two_jumps[2], n]
    elif no_jump[0] - one_jump[0] > SETTINGS.conclusive:
        edges = [0, one_jump[1], n]
    delays = tuple(float(DELAYS[best_delay(a, b)[1]]) for a, b in itertools.pairwise(edges))
    return Delays(delays, tuple(edges[1:-1]))


def _time(fitter: Fitter, ends: Array, part: int, delay: float) -> float:
    """Return the true time, s of the run, at which a part with a DVL delay `delay` (s) begins."""
    problem = fitter.problem
    (grid,) = problem.grids
    time = float(problem.time[min(int(ends[part - 1]), len(problem.time) - 1)])
    return max(0.0, time + grid.delay_s - delay) if grid.clock is ActsOn.DVL_CLOCK else max(0.0, time)
