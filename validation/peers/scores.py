"""The diagnosis and its peers on the same cases: what each got right, how good its intervals are, what it cost."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..trial.run import Document
from ..trial.scored import Scored, join
from ..trial.truth import Category, Truth
from ..trial.vehicle import FAULTS
from .needed import needed

OURS, ALL = "diagnose", "all"
# Error with what was said compensated may be so much larger than the possible one
CLOSE = 1.1
KNOWN = (Category.SINGLE, Category.PAIR, Category.TRIPLE)
Shown = tuple[str, tuple[str, ...], list[tuple[str, ...]]]
"""Title, columns and rows of a table."""
CLASSES = {Category.HARD_NULL: Category.NULL}


@dataclass(frozen=True)
class Side:
    """One who answers, and its cases."""

    name: str
    cases: Mapping[str, Scored]


def sides(truths: Mapping[str, Truth], answers: Mapping[str, Document]) -> list[Side]:
    """The diagnosis and each peer, over the cases that all have answered."""
    asked = {key: each for key, each in answers.items() if each.get("beside")}
    names = sorted(set.intersection(*({*each["beside"]} for each in asked.values()))) if asked else []
    of = {OURS: asked} | {name: {k: _whole_cpu(each["beside"][name]) for k, each in asked.items()} for name in names}
    return [Side(name, {case.truth.id: case for case in join(truths, each)}) for name, each in of.items()]


def _whole_cpu(said: Document) -> Document:
    """With the search that it shares with the one asked before it."""
    return {**said, "cpu_s": said["cpu_s"] + said["document"].get("shared_cpu_s", 0.0)}


def class_of(truth: Truth) -> str:
    """Family and kind of a case, by which the figures are told."""
    return f"{truth.family}: {kind_of(truth)}"


def kind_of(truth: Truth) -> str:
    """Null, single, pair or unknown."""
    return CLASSES.get(truth.category, truth.category).value


def is_right(case: Scored) -> bool:
    """The one answer that is exactly right: no gap, the true effects and no other, or unknown."""
    if case.is_null:
        return case.verdict in ("no_gap", "insufficient_excitation")
    return case.verdict == "unknown" if case.truth.category is Category.UNKNOWN else case.is_exact


def tables(all_sides: Sequence[Side]) -> list[Shown]:
    """Title, columns and rows: by class, by kind and of all; a row for each that answers, and differences in pairs."""
    found: list[Shown] = []
    ours = all_sides[0]
    columns = ("", "n", "right (95 %)", "truth in sets", "false alarms", "intervals hold", "interval score",
               "error <= 1.1 possible", "CPU s", "ours alone right / it alone (p)")  # fmt: skip
    truths = [case.truth for case in ours.cases.values()]
    for name in (*sorted({class_of(each) for each in truths}), *sorted({kind_of(each) for each in truths}), ALL):
        found.append((name, columns, [_row(side, ours, name) for side in all_sides]))
    return found


def _row(side: Side, ours: Side, name: str) -> tuple[str, ...]:
    cases = [case for case in side.cases.values() if name in (ALL, kind_of(case.truth), class_of(case.truth))]
    known = [case for case in cases if case.truth.category in KNOWN]
    errors = [case.error_over_possible <= CLOSE for case in known if math.isfinite(case.error_over_possible)]
    inside = [each.holds for case in known for each in case.intervals]
    return (
        side.name,
        str(len(cases)),
        _share([is_right(case) for case in cases], bounds=True),
        _share([case.are_all_named for case in known]),
        _share([case.claimed for case in cases if case.is_null]),
        _share(inside),
        _interval_score(known),
        _share(errors),
        f"{np.median([case.cpu_s for case in cases]):.1f}",
        "-" if side is ours else _paired(side, ours, [case.truth.id for case in cases]),
    )


def _share(hits: Sequence[bool], bounds: bool = False) -> str:
    if not hits:
        return "-"
    k, n = sum(hits), len(hits)
    text = f"{100 * k / n:.0f}%"
    if not bounds:
        return f"{text} of {n}"
    interval = stats.binomtest(k, n).proportion_ci(0.95, "exact")
    return f"{text} ({100 * interval.low:.0f} .. {100 * interval.high:.0f})"


def _interval_score(cases: Sequence[Scored]) -> str:
    """Median of the interval score over the size worth knowing of: of the intervals that were given."""
    score = needed("scoringrules").interval_score
    values = []
    for case in cases:
        for each in case.intervals:
            typical = FAULTS[each.fault].typical.get(each.parameter.split("@")[0])
            if typical:
                values.append(float(score(each.true, each.low, each.high, 0.05)) / typical)
    return f"{np.median(values):.2f} ({np.mean(values):.2f})" if values else "-"


def _paired(side: Side, ours: Side, ids: Sequence[str]) -> str:
    """How often one alone was right, and the chance of as uneven a split if both were as good."""
    both = [(is_right(ours.cases[k]), is_right(side.cases[k])) for k in ids]
    here, there = sum(a and not b for a, b in both), sum(b and not a for a, b in both)
    p = stats.binomtest(here, here + there).pvalue if here + there else 1.0
    return f"{here} / {there} ({p:.2g})"


def markdown(found: Sequence[Shown]) -> str:
    """The tables, for a page."""
    parts = []
    for title, columns, rows in found:
        lines = ["| " + " | ".join(each) + " |" for each in (columns, *rows)]
        parts.append("\n".join([f"**{title}**", "", lines[0], "|---" * len(columns) + "|", *lines[1:]]))
    return "\n\n".join(parts) + "\n"
