"""Join the answers of a trial with the truth: every figure of the target table, with exact confidence bounds.

Bounds are Clopper-Pearson's for shares and, for medians, those of the order statistics; both 95 %. What theory allows
stands beside what was measured: the power of a chi-square test at the level at which the family of effects has 1 %, and
the chance with which the likelihood tells two effects a known distance apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from .plan import Family
from .scored import Scored
from .truth import Category

AT_SEA = (Family.HALF_REAL, Family.HORIZONTAL, Family.SEVERAL, Family.DISPLACED)
# The error with what was said compensated may be so much larger than the possible one
CLOSE_TO_POSSIBLE = 1.1
# So far may the error that is said be from the true one: it is measured with one draw of the noise
HONEST = 0.2
KNOWN = (Category.SINGLE, Category.PAIR, Category.TRIPLE)


@dataclass(frozen=True)
class Figure:
    """One figure. value, low, high: NaN without cases. n: how many it is made of. bound: what theory allows."""

    name: str
    target: str
    value: float
    low: float
    high: float
    n: int
    met: bool | None
    bound: float | None = None


Test = Callable[[float], bool]


def _at_least(limit: float) -> tuple[str, Test]:
    return f">= {limit:.0%}", lambda value: value >= limit


def _at_most(limit: float) -> tuple[str, Test]:
    return f"<= {limit:.0%}", lambda value: value <= limit


NO_TARGET: tuple[str, Test | None] = ("", None)


def share(name: str, target: tuple[str, Test | None], hits: Iterable[bool], bound: float | None = None) -> Figure:
    """A share of cases with its exact interval."""
    outcomes = list(hits)
    n, k = len(outcomes), sum(outcomes)
    text, test = target
    if not n:
        return Figure(name, text, np.nan, np.nan, np.nan, 0, None, bound)
    interval = stats.binomtest(k, n).proportion_ci(0.95, "exact")
    value = k / n
    return Figure(name, text, value, float(interval.low), float(interval.high), n, test and test(value), bound)


def median(name: str, target: tuple[str, Test | None], values: Iterable[float]) -> Figure:
    """A median with the exact interval of its order statistics."""
    numbers = np.array(list(values), dtype=float)
    text, test = target
    if not len(numbers):
        return Figure(name, text, np.nan, np.nan, np.nan, 0, None)
    value = float(np.median(numbers))
    # how many of n numbers lie below the median is binomial; scipy's own quantile_test is younger than Jazzy's scipy
    below = stats.binom(len(numbers), 0.5)
    first, last = int(below.ppf(0.025)) - 1, int(below.isf(0.025))
    ordered = np.concatenate([[np.nan], np.sort(numbers), [np.nan]])  # too few numbers bound nothing
    low, high = float(ordered[max(first, -1) + 1]), float(ordered[min(last, len(numbers)) + 1])
    return Figure(name, text, value, low, high, len(numbers), test and test(value))


def figures(scored: Sequence[Scored]) -> dict[str, list[Figure]]:
    """The target tables by what they are of: every family that has cases, and all of them together."""
    of = {family: [case for case in scored if case.truth.family == family.value] for family in Family}
    tables = {"all families": _of_all(scored)}
    if of[Family.SIMULATED] or not scored:
        tables[Family.SIMULATED.value] = _simulated(of[Family.SIMULATED])
    return tables | {family.value: _at_sea(of[family], of[Family.HALF_REAL]) for family in AT_SEA if of[family]}


def _of_all(scored: Sequence[Scored]) -> list[Figure]:
    alarms = share("", NO_TARGET, (case.claimed for case in scored if case.is_null))
    met = None if not alarms.n else alarms.high <= 0.02
    return [
        replace(alarms, name="false alarms, all nulls", target="bound <= 2%", met=met),
        *_unknown(scored),
        share("answers without a failure", NO_TARGET, (case.verdict != "failed" for case in scored)),
    ]


def _simulated(scored: Sequence[Scored]) -> list[Figure]:
    of = {category: [case for case in scored if case.truth.category is category] for category in Category}
    single = of[Category.SINGLE]
    strong = [case for case in single if case.truth.q_wanted >= 8.0]
    return [
        share("false alarms, nulls", _at_most(0.01), (case.claimed for case in of[Category.NULL])),
        share("false alarms, hard nulls", _at_most(0.02), (case.claimed for case in of[Category.HARD_NULL])),
        _detection("detected, q = 5", _at_least(0.85), [case for case in single if case.truth.q_wanted == 5.0]),
        _detection("detected, q >= 8", _at_least(0.99), strong),
        *_right_first(single),
        share("truth in the named set, q >= 8", _at_least(0.98), (case.is_in_set for case in strong)),
        median(
            "size of the named set, q >= 8",
            ("1", lambda value: value == 1.0),
            (float(len(case.named_set)) for case in strong if case.named),
        ),
        *_unknown(of[Category.UNKNOWN]),
        _closure("closure, q >= 8", 0.90, strong),
        _closure("closure, q >= 20", 0.97, [case for case in single if case.truth.q_wanted >= 20.0]),
        _coverage(single + of[Category.PAIR]),
        share("both of a pair, q >= 12", _at_least(0.85), (case.are_all_named for case in of[Category.PAIR])),
        share("no guess where data cannot tell", NO_TARGET, (case.no_guess for case in of[Category.UNIDENTIFIABLE])),
    ]


def _at_sea(scored: Sequence[Scored], twins: Sequence[Scored]) -> list[Figure]:
    """Real motion: large effects, alone and together. twins: cases with all axes."""

    def of_category(category: Category) -> list[Scored]:
        return [case for case in scored if case.truth.category is category]

    known = [case for case in scored if case.truth.category in KNOWN]
    with_all_axes = {case.truth.id: case for case in twins}
    pairs = [(case, with_all_axes[case.truth.twin]) for case in scored if case.truth.twin in with_all_axes]
    return [
        share("false alarms, nulls", _at_most(0.02), (case.claimed for case in of_category(Category.NULL))),
        share("false alarms, hard nulls", _at_most(0.02), (case.claimed for case in of_category(Category.HARD_NULL))),
        share("exactly the true effects", _at_least(0.95), (case.is_exact for case in known)),
        *(
            share(f"exactly the true effects, {category.value}s", NO_TARGET, hits)
            for category in KNOWN
            if (hits := [case.is_exact for case in known if case.truth.category is category])
        ),
        share("all true effects in the named sets", NO_TARGET, (case.are_all_named for case in known)),
        _coverage(known),
        median("error after over the possible", NO_TARGET, (case.error_over_possible for case in known)),
        share(
            f"error after within {CLOSE_TO_POSSIBLE:g} of the possible",
            _at_least(0.95),
            (case.error_over_possible <= CLOSE_TO_POSSIBLE for case in known),
        ),
        share(
            f"error after said within {HONEST:.0%} of the true",
            NO_TARGET,
            (abs(case.error_said_over_true - 1.0) <= HONEST for case in known if case.after_mps is not None),
        ),
        *_unknown(scored),
        *([share("same as with all axes", _at_least(0.95), (a.agrees_with(b) for a, b in pairs))] if pairs else []),
    ]


def _coverage(cases: Sequence[Scored]) -> Figure:
    target = ("92 .. 98%", lambda value: 0.92 <= value <= 0.98)
    return share("true value in the 95 % interval", target, (each.holds for case in cases for each in case.intervals))


def _detection(name: str, target: tuple[str, Test | None], cases: Sequence[Scored]) -> Figure:
    return share(name, target, (case.claimed for case in cases), mean(case.power for case in cases))


def _right_first(single: Sequence[Scored]) -> Iterable[Figure]:
    weak = [case for case in single if case.truth.q_wanted == 8.0]
    strong = [case for case in single if case.truth.q_wanted >= 12.0]
    for text, limit, cases in (("q = 8", 0.90, weak), ("q >= 12", 0.95, strong)):
        target = _at_least(limit)
        bound = mean(case.power * case.chance_right for case in cases)
        yield share(f"right effect first, {text}", target, (case.is_right_first for case in cases), bound)
        apart = [case for case in cases if case.separable]
        name = f"right effect first, {text}, where theory can tell"
        bound = mean(case.power * case.chance_right for case in apart)
        yield share(name, target, (case.is_right_first for case in apart), bound)


def _unknown(scored: Sequence[Scored]) -> Iterable[Figure]:
    cases = [case for case in scored if case.truth.category is Category.UNKNOWN]
    for text, limit, q in (("q = 12", 0.80, 12.0), ("q = 20", 0.90, 20.0), ("q = 40", 0.90, 40.0)):
        chosen = [case.verdict == "unknown" for case in cases if case.truth.q_wanted == q]
        yield share(f"unknown called unknown, {text}", _at_least(limit), chosen)


def _closure(name: str, limit: float, cases: Sequence[Scored]) -> Figure:
    values = (case.closure for case in cases if case.closure is not None and case.claimed)
    return median(name, (f">= {limit:.2f}", lambda value: value >= limit), values)


def mean(values: Iterable[float]) -> float | None:
    """None of nothing."""
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else None
