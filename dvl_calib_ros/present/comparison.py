"""Document of a comparison of calibrations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

from ..calibration.comparison.mounting_change import Comparison, Difference, reasons, remarks
from ..calibration.results.extrinsics import MOUNTING, Extrinsics
from ..calibration.results.mounting_quantities import LATE, date
from .document import Answer, Columns, Document, Section, Sentence, Table, Where, columns_for, figures, table_by
from .numbers import with_std

# with more pairs than these a terminal shows only neighbours in time
MOST_PAIRS = 10
OWN_NOTE = "± is 1σ as each calibration states it; – was not observable in its data."
_DEGREE = math.degrees(1.0)


class ComparedQuantity(NamedTuple):
    """Compared quantity. component: index in `COMPONENTS`. factor: from SI. changes: attribute of `Comparison`."""

    component: int
    name: str
    unit: str
    factor: float
    changes: str

    def of(self, compared: Extrinsics | Difference) -> tuple[float, float]:
        """Return its value and σ in a calibration or a difference, in its unit."""
        return self.factor * compared.value[self.component], self.factor * compared.std[self.component]


QUANTITIES = (
    ComparedQuantity(0, "roll", "°", _DEGREE, "moved"),
    ComparedQuantity(1, "pitch", "°", _DEGREE, "moved"),
    ComparedQuantity(2, "yaw", "°", _DEGREE, "moved"),
    ComparedQuantity(3, "lever arm x", "m", 1.0, "moved"),
    ComparedQuantity(4, "lever arm y", "m", 1.0, "moved"),
    ComparedQuantity(5, "lever arm z", "m", 1.0, "moved"),
    ComparedQuantity(6, "scale", "%", 100.0, "scale_changed"),
    ComparedQuantity(7, LATE, "s", 1.0, "clock_changed"),
)


def comparison(result: Comparison) -> Document:
    """Lay out whether the mounting moved and by how much, with each calibration and difference and their σ."""
    pairs, ordered = result.pairs, result.calibrations
    by_name = [f"{each.first.name} → {each.second.name}" for each in pairs]
    neighbours = {(id(one), id(other)) for one, other in pairwise(ordered)}
    adjacent = [k for k, each in enumerate(pairs) if (id(each.first), id(each.second)) in neighbours]
    few = len(pairs) <= MOST_PAIRS
    columns: Columns[Extrinsics] = {
        "": lambda each: each.name,
        "from (UTC)": lambda each: date(each.first_ns),
        "model": lambda each: each.model,
        "samples": lambda each: str(each.used),
        **columns_for(
            {f"{each.name}, {each.unit}": each for each in shown_quantities(result)},
            lambda each, quantity: with_std(*quantity.of(each)),
        ),
    }
    own_values = replace(table_by(columns, ordered, (OWN_NOTE,), words=3), dense=True)
    return Document(
        title="DVL calibrations compared",
        subtitle=", ".join(each.name for each in ordered),
        answer=Answer(result.word, result.answer.severity, [each.full_sentence for each in reasons(result)]),
        warnings=[str(each) for each in remarks(result)],
        sections=[
            Section(
                "Over time",
                [
                    Sentence("With ±1σ; a dashed line marks a change.", soft=True),
                    figures("comparison_figures.trend", result),
                ],
                Where.PAGE,
            ),
            Section("Calibrations", [own_values]),
            Section(
                "Differences, the later less the earlier",
                [_differences(pairs, by_name)],
                Where.BOTH if few else Where.PAGE,
            ),
            Section(
                "Differences, the later less the earlier (neighbours; all pairs: --json)",
                [] if few else [_differences([pairs[k] for k in adjacent], [by_name[k] for k in adjacent])],
                Where.TERMINAL,
            ),
        ],
    )


def shown_quantities(result: Comparison) -> list[ComparedQuantity]:
    """Return the quantities that were observable in at least two calibrations."""
    return [each for each in QUANTITIES if sum(one.shown[each.component] for one in result.calibrations) > 1]


DIFFERENCES_NOTE = (
    "Angles as in a URDF. p: probability under no change that the most significant of angles and lever arm is as "
    "large, corrected for the number of tests."
)


def _differences(differences: Sequence[Difference], names: Sequence[str]) -> Table:
    """Return the table of differences between calibrations, with σ and p of the mounting."""
    quantities = [each for each in QUANTITIES if any(pair.compared[each.component] for pair in differences)]
    columns: Columns[tuple[str, Difference, float]] = {
        "": lambda each: each[0],
        **columns_for(
            {f"{each.name}, {each.unit}": each for each in quantities},
            lambda each, quantity: with_std(*quantity.of(each[1]), signed=True),
        ),
        "mounting: p": lambda each: f"{each[2]:.{'2f' if each[2] >= 0.01 else '0e'}}",
    }
    rows = [(name, each, each.chance(MOUNTING)) for name, each in zip(names, differences, strict=True)]
    return replace(table_by(columns, rows, (DIFFERENCES_NOTE,)), dense=True)
