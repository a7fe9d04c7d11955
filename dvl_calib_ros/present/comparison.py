"""Documents of a comparison of calibrations, and of a fleet's catalogue."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..calibration.comparison.mounting_change import ANSWERS, POWER, Comparison, Difference, fused, reasons, remarks
from ..calibration.results.extrinsics import MOUNTING, SCALE, Extrinsics
from ..calibration.results.mounting_quantities import LATE, date
from ..verdict.kinds import Severity
from ..verdict.reasons import full
from .document import (
    Answer,
    Cell,
    Columns,
    Document,
    Sentence,
    Table,
    Where,
    columns_for,
    figure,
    figures,
    section,
    table_by,
)
from .numbers import counted, number, with_std

if TYPE_CHECKING:
    from ..fleet_catalogue.update import CompassDeviation, Fleet, NeedsPerson, VehicleHistory

# with more pairs than these a terminal shows only neighbours in time
MOST_PAIRS = 10
_LATER = "Differences, the later less the earlier"
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
    *(ComparedQuantity(k, name, "°", _DEGREE, "moved") for k, name in enumerate(("roll", "pitch", "yaw"))),
    *(ComparedQuantity(3 + k, f"lever arm {axis}", "m", 1.0, "moved") for k, axis in enumerate("xyz")),
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
    own_values = table_by(columns, ordered, (OWN_NOTE,), words=3, dense=True)
    return Document(
        title="DVL calibrations compared",
        subtitle=", ".join(each.name for each in ordered),
        answer=Answer(result.word, result.answer.severity, [each.full_sentence for each in reasons(result)]),
        warnings=[str(each) for each in remarks(result)],
        sections=[
            section(
                "Over time",
                Sentence("With ±1σ; a dashed line marks a change.", soft=True),
                figures("comparison_figures.trend", result),
                where=Where.PAGE,
            ),
            section("Calibrations", own_values),
            section(_LATER, _differences(pairs, by_name), where=Where.BOTH if few else Where.PAGE),
            section(
                f"{_LATER} (neighbours; all pairs: --json)",
                None if few else _differences([pairs[k] for k in adjacent], [by_name[k] for k in adjacent]),
                where=Where.TERMINAL,
            ),
        ],
    )


def shown_quantities(result: Comparison) -> list[ComparedQuantity]:
    """Return the quantities that were observable in at least two calibrations."""
    return [each for each in QUANTITIES if sum(one.shown[each.component] for one in result.calibrations) > 1]


DIFFERENCES_NOTE = (
    "Angles as in a URDF. p: probability of so significant a difference of angles or lever arm without a change, "
    "corrected for the number of tests."
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
    return table_by(columns, rows, (DIFFERENCES_NOTE,), dense=True)


# default speed of sound of instruments, m/s
SET_SPEED = 1500.0
# number of recordings named per reason to ask a person
NAMED = 4
WORST_FIRST = [*reversed(ANSWERS)]
MOVEMENTS = ("MOUNTING_MOVED", "MOUNTING_SUSPICIOUS", "MOUNTING_SUSPECTED")
_ANGLES_AND_SCALE = tuple(each for each in QUANTITIES if each.component in (0, 1, 2, SCALE))


def fleet(result: Fleet) -> Document:
    """Lay out the mounting of each vehicle over time, speed of sound, heading, and recordings that need a person."""
    vehicles = result.vehicles
    recordings = result.recordings
    persons = sum(len(each.recordings) for each in result.persons)
    severity = ANSWERS[result.word].severity if result.word in ANSWERS else Severity.MARGINAL
    sentences = [
        f"{each.name}: {reason.full_sentence}"
        for each in vehicles
        if each.compared is not None
        for reason in reasons(each.compared)
        if each.compared.verdict != "same" and reason.code in MOVEMENTS
    ]
    if not sentences and result.word == "same":
        sentences = ["No movement found; the table has the smallest detectable movement."]
    if not sentences:
        sentences = ["No vehicle has an angle that is observable on two days, so nothing can be compared."]
    sentences.append(f"{counted(persons, 'recording')} of {recordings} {'needs' if persons == 1 else 'need'} a person.")
    done = f"{counted(result.calibrated, 'recording')} calibrated now, {result.unchanged} unchanged"
    current = [
        VehicleNow(each, now(each), [person for person in result.persons if person.vehicle == each.name])
        for each in vehicles
    ]
    current.sort(key=lambda each: each.urgency)
    speeds = [
        VehicleSpeeds(each, sorted((day for day in each.days if day.shown[SCALE]), key=lambda day: day.value[SCALE]))
        for each in vehicles
    ]
    waters = [
        Sentence(f"{each.name}, {date(each.water.first_ns)[:10]}: {each.water.cause_of_scale}")
        for each in vehicles
        if each.water is not None
    ]
    several = any(len(each.recordings) > 1 for each in result.persons)
    components = tuple(each.component for each in _ANGLES_AND_SCALE)
    compasses = [(each.name, each.heading) for each in vehicles if each.heading is not None]
    deviations = "; ".join(f"{name} up to {largest(heading):.2f}°" for name, heading in compasses)
    drawn = figure(
        "comparison_figures.compass", "Deviation, °", f"Deviation of the heading by heading: {deviations}", compasses
    )
    return Document(
        title="DVL calibrations of a fleet",
        subtitle=f"{counted(len(vehicles), 'vehicle')}, {counted(recordings, 'recording')}; {done}",
        answer=Answer(result.word, severity, sentences),
        warnings=result.notes,
        sections=[
            section(
                "Vehicles",
                *(Sentence(f"{each.history.name}: {each.word}. {each.why}") for each in current),
                table_by(VEHICLES, current, (MOUNTING_NOTE,), dense=True),
            ),
            section(
                "Recordings that need a person",
                table_by(PERSONS, result.persons, (SEVERAL_NOTE,) if several else (), words=3),
            ),
            *(
                section(
                    each.history.name,
                    *(Sentence(reason.full_sentence) for reason in reasons(each.history.compared)),
                    figures("comparison_figures.trend", each.history.compared, components),
                    where=Where.PAGE,
                )
                for each in current
                if each.history.compared is not None
            ),
            section(
                "Speed of sound",
                table_by(SPEEDS, [each for each in speeds if each.days], (SPEED_NOTE,)),
                *waters,
            ),
            section(
                "Deviation of the compass",
                table_by(COMPASS, compasses, (COMPASS_NOTE,), dense=True),
                drawn if compasses else None,
            ),
        ],
    )


def now(vehicle: VehicleHistory) -> Extrinsics | None:
    """Return the mounting since it last moved; None if no recording is usable."""
    days = vehicle.days
    if not days:
        return None
    if vehicle.compared is not None and vehicle.compared.moved:
        since = vehicle.compared.moved[-1].first_after.first_ns
        days = tuple(each for each in days if each.first_ns >= since)
    return fused(days)


class VehicleNow(NamedTuple):
    """A vehicle with its current mounting, None if no recording is usable, and its recordings that need a person."""

    history: VehicleHistory
    mounting: Extrinsics | None
    persons: Sequence[NeedsPerson]

    @property
    def word(self) -> str:
        """Result of comparing the vehicle's days."""
        return "not compared" if self.history.compared is None else self.history.compared.word

    @property
    def why(self) -> str:
        """Reason for the word, and how many recordings need a person."""
        compared, days = self.history.compared, len(self.history.days)
        if compared is not None:
            sentence = reasons(compared)[0].full_sentence
        elif days:
            sentence = "One day alone." if days == 1 else "No angle is observable on two days."
        else:
            sentence = full(self.persons[0].why).partition(". ")[0].removesuffix(".") + "." if self.persons else ""
        waiting = sum(len(each.recordings) for each in self.persons)
        needs = f"{counted(waiting, 'recording')} {'needs' if waiting == 1 else 'need'} a person."
        return f"{sentence} {needs}" if waiting else sentence

    @property
    def urgency(self) -> tuple[int, bool]:
        """Sort key: moved mountings, suspicious ones, vehicles without a calibration, recordings that need a person."""
        if self.history.compared is None and not self.history.days:
            return WORST_FIRST.index("suspicious") + 1, False
        is_same = self.history.compared is None or self.word == "same"
        return len(WORST_FIRST) if is_same else WORST_FIRST.index(self.word), not self.persons

    @property
    def detectable_movement(self) -> str:
        """Detectable movement, degrees, of the least known angle."""
        compared = self.history.compared
        return "–" if compared is None else f"{math.degrees(float(np.nanmax(compared.smallest, initial=0.0))):.1f}"

    @property
    def moved(self) -> int:
        """Number of times the mounting moved."""
        return 0 if self.history.compared is None else len(self.history.compared.moved)


MOUNTING_NOTE = (
    "Angles and scale since the mounting last moved, ±1σ, without rejected recordings. Of movements of roll, pitch or "
    f"yaw as large as 'seen from', {100.0 * POWER:.0f} of 100 are found."
)
KINDS = {"moved": "text bad", "suspicious": "text off", "same": "text good"}
VEHICLES: Columns[VehicleNow] = {
    "": lambda each: each.history.name,
    "recordings": lambda each: str(each.history.recordings),
    "days": lambda each: str(len(each.history.days)),
    "mounting": lambda each: Cell(
        each.word + (f" ({each.moved}×)" if each.moved > 1 else ""), KINDS.get(each.word, "text")
    ),
    "seen from, °": lambda each: each.detectable_movement,
    **columns_for(
        {f"{each.name}, {each.unit}": each for each in _ANGLES_AND_SCALE},
        lambda each, quantity: "–" if each.mounting is None else with_std(*quantity.of(each.mounting)),
    ),
}
SEVERAL_NOTE = "With several recordings the sentence is about the first."
PERSONS: Columns[NeedsPerson] = {
    "": lambda each: each.vehicle,
    "recordings": lambda each: str(len(each.recordings)),
    "why": lambda each: Cell(
        full(each.why) + (f" [{each.code}]" if each.code else ""),
        "text",
        ", ".join(each.recordings[:NAMED])
        + (f" and {len(each.recordings) - NAMED} more" if len(each.recordings) > NAMED else ""),
    ),
}
COMPASS_NOTE = (
    "Error of the heading reference by yaw (0 is east, counter-clockwise), ±1σ; a constant is in the mounting."
)
COMPASS: Columns[tuple[str, CompassDeviation]] = {
    "": lambda each: each[0],
    "recordings": lambda each: str(each[1].recordings),
    "largest": lambda each: f"{number(largest(each[1]))}°",
    **columns_for(
        {"sin, °": 0, "cos, °": 1, "sin 2, °": 2, "cos 2, °": 3},
        lambda each, k: with_std(each[1].value[k], each[1].std[k]),
    ),
}


SPEED_NOTE = (
    "A wrong speed of sound causes a scale error: if it causes all of it, the water had these speeds. If "
    f"no recording has the DVL's setting, {SET_SPEED:.0f} m/s are assumed."
)


class VehicleSpeeds(NamedTuple):
    """A vehicle and its days with an observable scale, the smallest scale first."""

    history: VehicleHistory
    days: Sequence[Extrinsics]

    @property
    def recommended_setting(self) -> float:
        """Speed of sound setting of the DVL in the newest recording that has it, m/s; else the default."""
        used = math.nan if self.history.water is None else self.history.water.used
        return SET_SPEED if math.isnan(used) else used


SPEEDS: Columns[VehicleSpeeds] = {
    "": lambda each: each.history.name,
    "days": lambda each: str(len(each.days)),
    "set to": lambda each: f"{number(each.recommended_setting, 1)} m/s",
    **columns_for(
        {"lowest": -1, "highest": 0},
        lambda each, at: Cell(
            f"{number(each.recommended_setting / (1.0 + each.days[at].value[SCALE]), 0)} m/s",
            "",
            f"{with_std(100.0 * each.days[at].value[SCALE], 100.0 * each.days[at].std[SCALE])} %, "
            f"{date(each.days[at].first_ns)[:10]}",
        ),
    ),
}


def deviation(heading: CompassDeviation, yaw: np.ndarray) -> np.ndarray:
    """Return the heading deviation in degrees at yaws (N,) rad."""
    terms = np.stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw)], axis=1)
    found: np.ndarray = terms @ heading.value
    return found


def largest(heading: CompassDeviation) -> float:
    """Return the largest absolute deviation over all headings, degrees."""
    return float(np.abs(deviation(heading, np.linspace(0.0, 2.0 * math.pi, 361))).max())
