"""The tables of a trial, to be shown and written, and the page that documents it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .figures import KNOWN, NO_TARGET, Figure, figures, mean, share
from .motion import TUNING_KINDS
from .plan import Family
from .scored import Scored
from .truth import Category
from .vehicle import FAULTS, ODDITIES

NOTHING = "-"
# Figures that are no shares
NO_SHARES = ("closure", "size", "error after over")
PAGE = """# How good the diagnosis is: the blind trial

Written by a command; do not edit. Measured by version {version} with

<!-- not run: a trial takes hours of computing -->
```bash
{command}
```

over {cases} cases. The generator shares no code with the effects, the simulator and
the diagnosis, and the truth stays sealed until the answers are there.

Families: *simulated* manoeuvres with effects of a strength q wanted; *half_real*: motion recorded at sea, a DVL
computed exactly from it, effects as large as at sea; *horizontal*: the same cases with a reference that does not
measure the vertical; *several*: two to four recordings of one vehicle, a delay of its own each day, and a mounting that
may have moved; *displaced*: motion of the sea and of a boat, a DVL up to 3.5 m from a horizontal reference that lags,
clocks that are late, stamps that leap once or twice. At sea every effect
is drawn so that it can be known (q of 12 or more beside the others, 6 standard
deviations from every rival). *Error after over the possible*: with what was said compensated, over with the truth
compensated, both with the noise in them. *Theory*: what the best test could do. Bounds are exact
(Clopper-Pearson), 95 %.
"""


@dataclass(frozen=True)
class Table:
    """A table to be shown or written; the first column is text."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Score:
    """What a trial has shown.

    figures: by family. confusion: truth -> first named or verdict -> how often, of single faults.
    """

    figures: Mapping[str, Sequence[Figure]]
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
            "figures": {name: [asdict(figure) for figure in each] for name, each in self.figures.items()},
            "confusion": self.confusion,
            "verdicts": self.verdicts,
            "tables": [asdict(table) for table in self.tables],
        }

    def markdown(self) -> str:
        """The tables, for documentation."""
        return "\n\n".join(markdown(table) for table in self.tables) + "\n"

    def page(self, command: str, version: str) -> str:
        """The page of the documentation. command: what has measured it. version: of the software that answered."""
        return PAGE.format(command=command, cases=self.n_cases, version=version) + "\n" + self.markdown()


def score(scored: Sequence[Scored]) -> Score:
    """Every figure and table of a trial."""
    of_families = figures(scored)
    single = [case for case in scored if case.truth.category is Category.SINGLE]
    simulated = [case for case in single if case.truth.family == Family.SIMULATED.value]
    at_sea = [case for case in scored if case.truth.family != Family.SIMULATED.value]
    confusion = _counts((next(iter(case.truth.faults)), case.first) for case in single)
    verdicts = _counts((f"{case.truth.family}: {case.truth.category.value}", case.verdict) for case in scored)
    tables = (
        *(_figure_table(name, each) for name, each in of_families.items()),
        _curve_table(simulated),
        _effect_table(simulated),
        _at_sea_table(at_sea),
        _confusion_table(confusion),
        _group_table("Verdicts", verdicts),
        _kind_table(scored),
        _noise_table(scored),
        _detail_table(scored),
    )
    failed = sum(case.verdict == "failed" for case in scored)
    return Score(of_families, confusion, verdicts, tuple(t for t in tables if t.rows), len(scored), failed)


def _counts(pairs: Iterable[tuple[str, str]]) -> dict[str, dict[str, int]]:
    counted: dict[str, Counter[str]] = {}
    for row, column in pairs:
        counted.setdefault(row, Counter())[column] += 1
    return {row: dict(sorted(counted[row].items())) for row in sorted(counted)}


def _figure_table(name: str, of_family: Sequence[Figure]) -> Table:
    rows = []
    for figure in of_family:
        if not figure.n:
            continue
        met = NOTHING if figure.met is None else ("yes" if figure.met else "no")
        percent = not figure.name.startswith(NO_SHARES)
        cells = [_number(value, percent) for value in (figure.value, figure.low, figure.high)]
        bound = NOTHING if figure.bound is None else _number(figure.bound, percent)
        rows.append((figure.name, figure.target, cells[0], f"{cells[1]} .. {cells[2]}", bound, str(figure.n), met))
    columns = ("figure", "target", "measured", "95 % bounds", "theory", "n", "met")
    return Table(f"Blind trial: {name}", columns, tuple(rows))


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
        found = share("", NO_TARGET, (case.claimed for case in cases))
        right = share("", NO_TARGET, (case.is_right_first for case in cases))
        rows.append(
            (
                f"{q:g}",
                str(len(cases)),
                f"{_number(found.value, True)} ({_number(found.low, True)} .. {_number(found.high, True)})",
                _number(mean(case.power for case in cases) or np.nan, True),
                f"{_number(right.value, True)} ({_number(right.low, True)} .. {_number(right.high, True)})",
                _number(mean(case.power * case.chance_right for case in cases) or np.nan, True),
            )
        )
    columns = ("q", "n", "detected", "power of the test", "right effect first", "power and likelihood")
    return Table("By strength", columns, tuple(rows))


def _effect_table(single: Sequence[Scored]) -> Table:
    rows = []
    for name in FAULTS:
        cases = [case for case in single if name in case.truth.faults]
        if not cases:
            continue
        strong = [case for case in cases if case.truth.q_wanted >= 8.0]
        inside = [interval.holds for case in cases for interval in case.intervals]
        closures = [case.closure for case in strong if case.closure is not None and case.claimed]
        rows.append(
            (
                name,
                _share_cell(case.claimed for case in cases if case.truth.q_wanted < 8.0),
                _share_cell(case.claimed for case in strong),
                _share_cell(case.is_right_first for case in strong),
                _number(mean(case.chance_right for case in strong) or np.nan, True),
                _share_cell(case.is_in_set for case in strong),
                _share_cell(inside),
                _number(float(np.median(closures)) if closures else np.nan, False),
            )
        )
    columns = (
        "effect", "detected q < 8", "detected q >= 8", "right first", "theory", "in the set", "intervals", "closure"
    )  # fmt: skip
    return Table("By effect (right first .. closure: q >= 8, intervals: all)", columns, tuple(rows))


def _at_sea_table(scored: Sequence[Scored]) -> Table:
    """By fault, alone or among others, of every family with real motion."""
    rows = []
    known = [case for case in scored if case.truth.category in KNOWN]
    for name in sorted({name for case in known for name in case.truth.faults}, key=list(FAULTS).index):
        cases = [case for case in known if name in case.truth.faults]
        alone = [case for case in cases if case.truth.category is Category.SINGLE]
        inside = [each.holds for case in cases for each in case.intervals if each.fault == name]
        rows.append(
            (
                name,
                _share_cell(case.is_exact for case in alone),
                _share_cell(case.is_exact for case in cases if case not in alone),
                _share_cell(any(name in names for _, names in case.named) for case in cases),
                _share_cell(inside),
                _number(float(np.median([case.error_over_possible for case in cases])), False),
            )
        )
    columns = ("effect", "alone: exact", "among others: exact", "in the set", "intervals", "error after over possible")
    return Table("Real motion, by effect", columns, tuple(rows))


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
    scored = [case for case in scored if case.truth.family == Family.SIMULATED.value]
    for kind in sorted({case.truth.kind for case in scored}, key=lambda kind: (kind not in TUNING_KINDS, kind)):
        cases = [case for case in scored if case.truth.kind == kind]
        nulls = [case for case in cases if case.is_null]
        strong = [case for case in cases if case.truth.category is Category.SINGLE and case.truth.q_wanted >= 8.0]
        rows.append(
            (
                kind,
                "tuning" if kind in TUNING_KINDS else "held out",
                _share_cell(case.claimed for case in nulls),
                _share_cell(case.claimed for case in strong),
                _share_cell(case.is_right_first for case in strong),
                _share_cell(case.is_in_set for case in strong),
            )
        )
    columns = ("trajectory", "", "false alarms", "detected q >= 8", "right first q >= 8", "in the set q >= 8")
    return Table("By trajectory", columns, tuple(rows))


def _noise_table(scored: Sequence[Scored]) -> Table:
    """What is said of the noise where it is ordinary, and of each kind of hard null."""
    nulls = [case for case in scored if case.is_null]
    counts = _counts((case.truth.hardness or "ordinary", name) for case in nulls for name in ("runs", *case.noise))
    columns = ("runs", *sorted({name for row in counts.values() for name in row} - {"runs"}))
    rows = [(hardness, *(str(row.get(column, "")) for column in columns)) for hardness, row in counts.items()]
    return Table("Findings about the noise of nulls", ("noise", *columns), tuple(rows))


def _detail_table(scored: Sequence[Scored]) -> Table:
    """Hard nulls by what makes them hard, unknown faults by name, what is recorded at sea, time."""
    rows = []
    for hardness in sorted({case.truth.hardness for case in scored if case.truth.hardness}):
        hits = _share_cell(case.claimed for case in scored if case.truth.hardness == hardness)
        rows.append((f"false alarms: {hardness}", hits))
    unknown = [case for case in scored if case.truth.category is Category.UNKNOWN]
    for name in sorted({name for case in unknown for name in case.truth.faults if name in ODDITIES}):
        hits = _share_cell(case.verdict == "unknown" for case in unknown if name in case.truth.faults)
        rows.append((f"unknown: {name}", hits))
    at_sea = [c for c in scored if c.truth.category in KNOWN and c.truth.family != Family.SIMULATED.value]
    for smoothing_s in sorted({source[1] for case in at_sea for source in case.truth.scene["sources"]}):
        hits = _share_cell(c.is_exact for c in at_sea if smoothing_s in [each[1] for each in c.truth.scene["sources"]])
        rows.append((f"real motion, exact, smoothed by s: {smoothing_s:g}", hits))
    for what, key in (("rate Hz", "dvl_rate"), ("rates differenced", "rates_differenced"), ("vertical", "vertical")):
        for value in sorted({str(case.truth.scene.get(key)) for case in at_sea}):
            hits = _share_cell(case.is_exact for case in at_sea if str(case.truth.scene.get(key)) == value)
            rows.append((f"real motion, exact, {what}: {value or 'measured'}", hits))
    if scored:
        rows.append(("diagnosis of a case, median CPU s", f"{np.median([case.cpu_s for case in scored]):.1f}"))
    return Table("Details", ("what", "how often"), tuple(rows))


def markdown(table: Table) -> str:
    """A table for a page."""
    lines = [f"**{table.title}**", "", "| " + " | ".join(table.columns) + " |", "|---" * len(table.columns) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in table.rows)])
