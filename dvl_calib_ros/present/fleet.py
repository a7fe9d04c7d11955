"""What a catalogue of a fleet says."""

from __future__ import annotations

import math

import numpy as np

from ..calibration.comparison import ANSWERS, fused
from ..calibration.comparison_words import date, moved, reasons, suspicious
from ..calibration.extrinsics import SCALE, Extrinsics
from ..fleet.fleet import WORDS, Fleet
from ..fleet.history import CompassDeviation, NeedsPerson, VehicleHistory
from ..verdict.kinds import Severity
from ..verdict.reasons import full
from .comparison import QUANTITIES, values_of
from .document import (
    Answer,
    Cell,
    Document,
    Figures,
    Section,
    Sentence,
    Table,
    Where,
    figures,
    number,
    section,
    with_std,
)

# Speed of sound that instruments are delivered with, m/s
SET_SPEED = 1500.0
# Recordings that are named of those that need a person for one reason
NAMED = 4
_ANGLES_AND_SCALE = tuple(each for each in QUANTITIES if each.component in (0, 1, 2, SCALE))


def fleet(result: Fleet) -> Document:
    """The mounting of each vehicle over time, speed of sound, heading, and which recordings need a person."""
    vehicles = result.vehicles
    recordings = result.recordings
    persons = sum(len(each.recordings) for each in result.persons)
    severity = ANSWERS[result.word].severity if result.word in ANSWERS else Severity.MARGINAL
    said = [
        f"{each.name}: {reason.full_sentence}"
        for each in vehicles
        if each.compared is not None
        for reason in (*map(moved, each.compared.moved), *map(suspicious, each.compared.suspicious))
    ]
    if not said and result.word == "same":
        said = ["No mounting moved."]
    if not said:
        said = ["No vehicle has calibrations of two days, so nothing can be compared."]
    said.append(f"{_counted(persons, 'recording')} of {recordings} {'needs' if persons == 1 else 'need'} a person.")
    done = f"{_counted(result.calibrated, 'recording')} calibrated now, {result.unchanged} unchanged"
    return Document(
        title="DVL calibrations of a fleet",
        subtitle=f"{_counted(len(vehicles), 'vehicle')}, {_counted(recordings, 'recording')}; {done}",
        answer=Answer(result.word, severity, said),
        warnings=result.notes,
        sections=[
            Section("Vehicles", [_vehicles(vehicles)]),
            section("Recordings that need a person", _persons(result.persons) if result.persons else None),
            *(_trend(each) for each in sorted(vehicles, key=_by_word)),
            _speed_of_sound(vehicles),
            _heading(vehicles),
        ],
    )


def _by_word(vehicle: VehicleHistory) -> int:
    """Those whose mounting moved come first."""
    return len(WORDS) if vehicle.compared is None else WORDS.index(vehicle.compared.word)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def now(vehicle: VehicleHistory) -> Extrinsics | None:
    """The mounting as it is since it last moved; None where no recording is usable."""
    days = vehicle.days
    if not days:
        return None
    if vehicle.compared is not None and vehicle.compared.moved:
        since = vehicle.compared.moved[-1].first_after.first_ns
        days = tuple(each for each in days if each.first_ns >= since)
    return fused(days)


def _vehicles(vehicles: tuple[VehicleHistory, ...]) -> Table:
    rows: list[tuple[str | Cell, ...]] = []
    for each in vehicles:
        found, compared = now(each), each.compared
        word = "not compared" if compared is None else compared.word
        times = f" ({len(compared.moved)}×)" if compared is not None and len(compared.moved) > 1 else ""
        kind = {"moved": "bad", "suspicious": "off", "same": "good"}.get(word, "")
        angles = ["–"] * 4
        if found is not None:
            values = values_of(found)
            angles = [
                with_std(quantity.factor * values[quantity.component], quantity.factor * found.std[quantity.component])
                for quantity in _ANGLES_AND_SCALE
            ]
        rows.append(
            (each.name, str(each.recordings), str(len(each.days)), Cell(word + times, f"text {kind}".strip()), *angles)
        )
    head: tuple[str | Cell, ...] = (
        "",
        "recordings",
        "days",
        Cell("mounting", "text"),
        *(f"{each.name}, {each.unit}" for each in _ANGLES_AND_SCALE),
    )
    note = "Angles and scale since the mounting last moved, ±1σ. Rejected recordings are in none of them."
    return Table(head, rows, notes=(note,), dense=True)


def _persons(persons: tuple[NeedsPerson, ...]) -> Table:
    rows = []
    for each in persons:
        more = len(each.recordings) - NAMED
        below = ", ".join(each.recordings[:NAMED]) + (f" and {more} more" if more > 0 else "")
        why = full(each.why) + (f" [{each.code}]" if each.code else "")
        rows.append((str(len(each.recordings)), Cell(why, "", below)))
    several = any(len(each.recordings) > 1 for each in persons)
    notes = ("Of several recordings the sentence is that of the first.",) if several else ()
    return Table(("recordings", "why"), rows, notes=notes, words=2)


def _trend(vehicle: VehicleHistory) -> Section:
    if vehicle.compared is None:
        days = len(vehicle.days)
        why = {0: "no recording is usable", 1: "all are of one day"}.get(days, "no two days show the same angle")
        return Section(vehicle.name, [Sentence(f"There is nothing to compare: {why}.", soft=True)], Where.PAGE)
    shown: list[Sentence | Figures] = [Sentence(each.full_sentence) for each in reasons(vehicle.compared)]
    components = tuple(each.component for each in _ANGLES_AND_SCALE)
    shown.append(figures("comparison_figures.trend", vehicle.compared, components))
    return Section(vehicle.name, shown, Where.PAGE)


def _speed_of_sound(vehicles: tuple[VehicleHistory, ...]) -> Section:
    rows: list[tuple[str | Cell, ...]] = []
    for each in vehicles:
        own = [day for day in each.days if day.shown[SCALE]]
        if own:
            low, high = (pick(own, key=lambda day: day.scale) for pick in (min, max))
            cells = [
                Cell(
                    f"{number(SET_SPEED / (1.0 + day.scale), 0)} m/s",
                    "",
                    f"{with_std(100.0 * day.scale, 100.0 * day.std[SCALE])} %, {date(day.first_ns)[:10]}",
                )
                for day in (high, low)
            ]
            rows.append((each.name, str(len(own)), *cells))
    note = (
        "A scale is what a wrong speed of sound looks like: if the instrument was set to "
        f"{SET_SPEED:.0f} m/s, the water had this speed. Set temperature and salinity first."
    )
    return section("Speed of sound", Table(("", "days", "lowest", "highest"), rows, notes=(note,)))


def _heading(vehicles: tuple[VehicleHistory, ...]) -> Section:
    known = [(each.name, each.heading) for each in vehicles if each.heading is not None]
    rows = [
        (
            name,
            str(heading.recordings),
            f"{number(largest(heading))}°",
            *(with_std(value, std) for value, std in zip(heading.value, heading.std, strict=True)),
        )
        for name, heading in known
    ]
    head = ("", "recordings", "largest", "sin, °", "cos, °", "sin 2, °", "cos 2, °")
    note = (
        "Error of the heading reference with the yaw (from east, to the left), ±1σ; a constant is part of the mounting."
    )
    return section(
        "Deviation of the compass",
        Table(head, rows, notes=(note,), dense=True),
        figures("fleet_figures.compass", known) if known else None,
    )


def deviation(heading: CompassDeviation, yaw: np.ndarray) -> np.ndarray:
    """Degrees at yaws (N,) rad."""
    terms = np.stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw)], axis=1)
    found: np.ndarray = terms @ heading.value
    return found


def largest(heading: CompassDeviation) -> float:
    """Of all headings, degrees."""
    return float(np.abs(deviation(heading, np.linspace(0.0, 2.0 * math.pi, 361))).max())
