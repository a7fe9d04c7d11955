"""Join the answers of a trial with the truth: every figure of the target table, with exact confidence bounds.

Bounds are Clopper-Pearson's for shares and, for medians, those of the order statistics; both 95 %. What theory allows
stands beside what was measured: the power of a chi-square test at the level at which the family of effects has 1 %, and
the chance with which the likelihood tells two effects a known distance apart.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from scipy import stats

from .motion import TUNING_KINDS
from .truth import Category, Truth
from .vehicle import FAULTS

CLAIMS = ("known", "ambiguous", "unknown")
FAMILY_LEVEL = 0.01
# Faults that even the likelihood would confuse more often than this are not told apart by anybody
CONFUSED = 0.02
NOT_SCORED_PARAMETERS = ("from_s", "to_s")  # change points have no regular interval
NOTHING = "-"


@dataclass(frozen=True)
class Scored:
    """A case and its answer: what the figures are made of.

    named: names of the effects, the strongest first, each with the ones that it cannot be told from. intervals: low,
    true value, high of each parameter of a fault that was named. noise: names of the findings about the noise.
    """

    truth: Truth
    verdict: str
    named: tuple[tuple[str, frozenset[str]], ...]
    closure: float | None
    intervals: tuple[tuple[float, float, float], ...]
    cpu_s: float
    noise: frozenset[str]

    @property
    def claimed(self) -> bool:
        """A systematic effect was claimed, be it by name or as unknown."""
        return self.verdict in CLAIMS or bool(self.named)

    @property
    def first(self) -> str:
        """The effect named first; the verdict where there is none."""
        return self.named[0][0] if self.named else self.verdict

    @property
    def named_set(self) -> frozenset[str]:
        """All names that the answer leaves possible."""
        return frozenset().union(*(names for _, names in self.named))

    @property
    def is_right_first(self) -> bool:
        """The fault of the truth was named first."""
        return self.first in self.truth.faults

    @property
    def chance_right(self) -> float:
        """Chance with which the likelihood prefers the truth over its nearest rival."""
        return NormalDist().cdf(min(self.truth.distances.values(), default=np.inf) / 2.0)

    @property
    def separable(self) -> bool:
        """Whether anybody could tell the fault from all others."""
        return self.chance_right >= 1.0 - CONFUSED

    @property
    def power(self) -> float:
        """Chance with which the test of the fault alone detects it, at the level of the family."""
        (name,) = self.truth.faults
        n = len(FAULTS[name].typical)
        threshold = stats.chi2.isf(FAMILY_LEVEL / len(FAULTS), n)
        return float(stats.ncx2.sf(threshold, n, self.truth.q[name] ** 2))


def join(truths: Mapping[str, Truth], answers: Mapping[str, Mapping[str, Any]]) -> list[Scored]:
    """Truth and answer of every case that has both, in order of their ids."""
    return [_scored(truths[id_], answers[id_]) for id_ in sorted(truths.keys() & answers.keys())]


def _scored(truth: Truth, answer: Mapping[str, Any]) -> Scored:
    document = answer["document"]
    effects = document.get("effects", [])
    named = tuple((each["name"], frozenset([each["name"], *each.get("equivalent_to", [])])) for each in effects)
    gap = document.get("gap") or {}
    return Scored(
        truth,
        document["verdict"],
        named,
        _finite(gap.get("closure")),
        tuple(_intervals(truth, effects)),
        answer["cpu_s"],
        frozenset(each["name"] for each in document.get("noise", [])),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _intervals(truth: Truth, effects: Iterable[Mapping[str, Any]]) -> Iterable[tuple[float, float, float]]:
    """Low, true value, high of every parameter of the faults that were named."""
    for effect in effects:
        for name, true in truth.faults.get(effect["name"], {}).items():
            given = effect.get("parameters", {}).get(name)
            if given is not None and given.get("ci95") is not None and name not in NOT_SCORED_PARAMETERS:
                low, high = given["ci95"]
                yield low, true, high


# ------------------------------------------------------------------ figures


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


_NO_TARGET: tuple[str, Test | None] = ("", None)


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
    interval: Any = stats.quantile_test(numbers, q=value, p=0.5).confidence_interval(0.95)
    return Figure(name, text, value, float(interval.low), float(interval.high), len(numbers), test and test(value))


def figures(scored: Sequence[Scored]) -> list[Figure]:
    """The target table."""
    of = {category: [case for case in scored if case.truth.category is category] for category in Category}
    single = of[Category.SINGLE]
    strong = [case for case in single if case.truth.q_wanted >= 8.0]
    intervals = [interval for case in single + of[Category.PAIR] for interval in case.intervals]
    return [
        share("false alarms, nulls", _at_most(0.01), (case.claimed for case in of[Category.NULL])),
        share("false alarms, hard nulls", _at_most(0.02), (case.claimed for case in of[Category.HARD_NULL])),
        _detection("detected, q = 5", _at_least(0.85), [case for case in single if case.truth.q_wanted == 5.0]),
        _detection("detected, q >= 8", _at_least(0.99), strong),
        *_right_first(single),
        share("truth in the named set, q >= 8", _at_least(0.97), (_is_in_set(case) for case in strong)),
        median(
            "size of the named set, q >= 8",
            ("1", lambda value: value == 1.0),
            (float(len(case.named_set)) for case in strong if case.named),
        ),
        *_unknown(of[Category.UNKNOWN]),
        _closure("closure, q >= 8", 0.90, strong),
        _closure("closure, q >= 20", 0.97, [case for case in single if case.truth.q_wanted >= 20.0]),
        share(
            "true value in the 95 % interval",
            ("92 .. 98%", lambda value: 0.92 <= value <= 0.98),
            (low <= true <= high for low, true, high in intervals),
        ),
        share("both of a pair, q >= 12", _at_least(0.85), (both_named(case) for case in of[Category.PAIR])),
        share("no guess where data cannot tell", _NO_TARGET, (no_guess(case) for case in of[Category.UNIDENTIFIABLE])),
    ]


def _detection(name: str, target: tuple[str, Test | None], cases: Sequence[Scored]) -> Figure:
    return share(name, target, (case.claimed for case in cases), _mean(case.power for case in cases))


def _right_first(single: Sequence[Scored]) -> Iterable[Figure]:
    weak = [case for case in single if case.truth.q_wanted == 8.0]
    strong = [case for case in single if case.truth.q_wanted >= 12.0]
    for text, limit, cases in (("q = 8", 0.90, weak), ("q >= 12", 0.95, strong)):
        target = _at_least(limit)
        bound = _mean(case.power * case.chance_right for case in cases)
        yield share(f"right effect first, {text}", target, (case.is_right_first for case in cases), bound)
        apart = [case for case in cases if case.separable]
        name = f"right effect first, {text}, where theory can tell"
        bound = _mean(case.power * case.chance_right for case in apart)
        yield share(name, target, (case.is_right_first for case in apart), bound)


def _unknown(cases: Sequence[Scored]) -> Iterable[Figure]:
    for text, limit, q in (("q = 12", 0.80, 12.0), ("q = 20", 0.90, 20.0), ("q = 40", 0.90, 40.0)):
        chosen = (case.verdict == "unknown" for case in cases if case.truth.q_wanted == q)
        yield share(f"unknown called unknown, {text}", _at_least(limit), chosen)


def _closure(name: str, limit: float, cases: Sequence[Scored]) -> Figure:
    values = (case.closure for case in cases if case.closure is not None and case.claimed)
    return median(name, (f">= {limit:.2f}", lambda value: value >= limit), values)


def _is_in_set(case: Scored) -> bool:
    return bool(case.named_set & case.truth.faults.keys())


def both_named(case: Scored) -> bool:
    """Each of two faults is named by an entry of its own, or is among the equals of that entry."""
    one, other = case.truth.faults
    sets = [names for _, names in case.named]
    return any(one in a and other in b for i, a in enumerate(sets) for j, b in enumerate(sets) if i != j)


def no_guess(case: Scored) -> bool:
    """It says that the data cannot tell, or names a set that has the truth and others in it."""
    if case.verdict == "ambiguous":
        return _is_in_set(case) and len(case.named_set) > 1
    return case.verdict == "insufficient_excitation"


def _mean(values: Iterable[float]) -> float | None:
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else None


# ------------------------------------------------------------------ tables


@dataclass(frozen=True)
class Table:
    """A table to be shown or written; the first column is text."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Score:
    """What a trial has shown. confusion: truth -> first named or verdict -> how often, of single faults."""

    figures: tuple[Figure, ...]
    confusion: Mapping[str, Mapping[str, int]]
    verdicts: Mapping[str, Mapping[str, int]]
    tables: tuple[Table, ...]
    n_cases: int
    n_failed: int

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "cases": self.n_cases,
            "failed": self.n_failed,
            "figures": [asdict(figure) for figure in self.figures],
            "confusion": self.confusion,
            "verdicts": self.verdicts,
            "tables": [asdict(table) for table in self.tables],
        }

    def markdown(self) -> str:
        """The tables, for documentation."""
        return "\n\n".join(_markdown(table) for table in self.tables) + "\n"


def score(scored: Sequence[Scored]) -> Score:
    """Every figure and table of a trial."""
    target_table = figures(scored)
    single = [case for case in scored if case.truth.category is Category.SINGLE]
    confusion = _counts((next(iter(case.truth.faults)), case.first) for case in single)
    verdicts = _counts((case.truth.category.value, case.verdict) for case in scored)
    tables = (
        _figure_table(target_table, len(scored)),
        _curve_table(single),
        _effect_table(single),
        _confusion_table(confusion),
        _group_table("Verdicts", verdicts),
        _kind_table(scored),
        _noise_table(scored),
        _detail_table(scored),
    )
    failed = sum(case.verdict == "failed" for case in scored)
    return Score(tuple(target_table), confusion, verdicts, tables, len(scored), failed)


def _counts(pairs: Iterable[tuple[str, str]]) -> dict[str, dict[str, int]]:
    counted: dict[str, Counter[str]] = {}
    for row, column in pairs:
        counted.setdefault(row, Counter())[column] += 1
    return {row: dict(sorted(counted[row].items())) for row in sorted(counted)}


def _figure_table(target_table: Sequence[Figure], n_cases: int) -> Table:
    rows = []
    for figure in target_table:
        met = NOTHING if figure.met is None else ("yes" if figure.met else "no")
        percent = "median" not in figure.name and not figure.name.startswith(("closure", "size"))
        cells = [_number(value, percent) for value in (figure.value, figure.low, figure.high)]
        bound = NOTHING if figure.bound is None else _number(figure.bound, percent)
        rows.append((figure.name, figure.target, cells[0], f"{cells[1]} .. {cells[2]}", bound, str(figure.n), met))
    columns = ("figure", "target", "measured", "95 % bounds", "theory", "n", "met")
    return Table(f"Blind trial, {n_cases} cases", columns, tuple(rows))


def _number(value: float, percent: bool) -> str:
    if value != value:
        return NOTHING
    return f"{100 * value:.1f}%" if percent else f"{value:.3g}"


def _share_cell(hits: Iterable[bool]) -> str:
    outcomes = list(hits)
    return f"{sum(outcomes)}/{len(outcomes)}" if outcomes else NOTHING


def _curve_table(single: Sequence[Scored]) -> Table:
    """Detection against strength, and what theory allows."""
    rows = []
    for q in sorted({case.truth.q_wanted for case in single}):
        cases = [case for case in single if case.truth.q_wanted == q]
        found = share("", _NO_TARGET, (case.claimed for case in cases))
        right = share("", _NO_TARGET, (case.is_right_first for case in cases))
        rows.append(
            (
                f"{q:g}",
                str(len(cases)),
                f"{_number(found.value, True)} ({_number(found.low, True)} .. {_number(found.high, True)})",
                _number(_mean(case.power for case in cases) or np.nan, True),
                f"{_number(right.value, True)} ({_number(right.low, True)} .. {_number(right.high, True)})",
                _number(_mean(case.power * case.chance_right for case in cases) or np.nan, True),
            )
        )
    columns = ("q", "n", "detected", "power of the test", "right effect first", "power and likelihood")
    return Table("By strength", columns, tuple(rows))


def _effect_table(single: Sequence[Scored]) -> Table:
    rows = []
    for name in FAULTS:
        cases = [case for case in single if name in case.truth.faults]
        strong = [case for case in cases if case.truth.q_wanted >= 8.0]
        inside = [low <= true <= high for case in cases for low, true, high in case.intervals]
        closures = [case.closure for case in strong if case.closure is not None and case.claimed]
        rows.append(
            (
                name,
                _share_cell(case.claimed for case in cases if case.truth.q_wanted < 8.0),
                _share_cell(case.claimed for case in strong),
                _share_cell(case.is_right_first for case in strong),
                _number(_mean(case.chance_right for case in strong) or np.nan, True),
                _share_cell(_is_in_set(case) for case in strong),
                _share_cell(inside),
                _number(float(np.median(closures)) if closures else np.nan, False),
            )
        )
    columns = (
        "effect", "detected q < 8", "detected q >= 8", "right first", "theory", "in the set", "intervals", "closure"
    )  # fmt: skip
    return Table("By effect (right first .. closure: q >= 8, intervals: all)", columns, tuple(rows))


def _confusion_table(confusion: Mapping[str, Mapping[str, int]]) -> Table:
    columns = sorted({column for row in confusion.values() for column in row}, key=_effects_first)
    rows = [
        (name, *(str(confusion[name].get(column, "")) for column in columns)) for name in FAULTS if name in confusion
    ]
    return Table("Truth (rows) and what was named first", ("", *columns), tuple(rows))


def _effects_first(name: str) -> tuple[bool, int, str]:
    known = list(FAULTS)
    return name not in FAULTS, known.index(name) if name in FAULTS else 0, name


def _group_table(title: str, counts: Mapping[str, Mapping[str, int]]) -> Table:
    columns = sorted({column for row in counts.values() for column in row})
    rows = [(name, *(str(row.get(column, "")) for column in columns)) for name, row in counts.items()]
    return Table(title, ("", *columns), tuple(rows))


def _kind_table(scored: Sequence[Scored]) -> Table:
    """Trajectories that the diagnosis may have been tuned on, and the others."""
    rows = []
    for kind in sorted({case.truth.kind for case in scored}, key=lambda kind: (kind not in TUNING_KINDS, kind)):
        cases = [case for case in scored if case.truth.kind == kind]
        nulls = [case for case in cases if case.truth.category in (Category.NULL, Category.HARD_NULL)]
        strong = [case for case in cases if case.truth.category is Category.SINGLE and case.truth.q_wanted >= 8.0]
        rows.append(
            (
                kind,
                "tuning" if kind in TUNING_KINDS else "held out",
                _share_cell(case.claimed for case in nulls),
                _share_cell(case.claimed for case in strong),
                _share_cell(case.is_right_first for case in strong),
                _share_cell(_is_in_set(case) for case in strong),
            )
        )
    columns = ("trajectory", "", "false alarms", "detected q >= 8", "right first q >= 8", "in the set q >= 8")
    return Table("By trajectory", columns, tuple(rows))


def _noise_table(scored: Sequence[Scored]) -> Table:
    """What is said of the noise where it is ordinary, and of each kind of hard null."""
    nulls = [case for case in scored if case.truth.category in (Category.NULL, Category.HARD_NULL)]
    counts = _counts((case.truth.hardness or "ordinary", name) for case in nulls for name in ("runs", *case.noise))
    columns = ("runs", *sorted({name for row in counts.values() for name in row} - {"runs"}))
    rows = [(hardness, *(str(row.get(column, "")) for column in columns)) for hardness, row in counts.items()]
    return Table("Findings about the noise of nulls", ("noise", *columns), tuple(rows))


def _detail_table(scored: Sequence[Scored]) -> Table:
    """Hard nulls by what makes them hard, unknown faults by name, time."""
    rows = []
    for hardness in sorted({case.truth.hardness for case in scored if case.truth.hardness}):
        hits = _share_cell(case.claimed for case in scored if case.truth.hardness == hardness)
        rows.append((f"false alarms: {hardness}", hits))
    unknown = [case for case in scored if case.truth.category is Category.UNKNOWN]
    for name in sorted({name for case in unknown for name in case.truth.faults}):
        rows.append(
            (f"unknown: {name}", _share_cell(c.verdict == "unknown" for c in unknown if name in c.truth.faults))
        )
    if scored:
        rows.append(("diagnosis of a case, median CPU s", f"{np.median([case.cpu_s for case in scored]):.1f}"))
    return Table("Details", ("what", "how often"), tuple(rows))


def _markdown(table: Table) -> str:
    lines = [f"**{table.title}**", "", "| " + " | ".join(table.columns) + " |", "|---" * len(table.columns) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in table.rows)])
