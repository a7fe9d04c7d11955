"""What bags say that are checked against each other."""

from __future__ import annotations

from pathlib import Path

from ..calibration.navigation import Navigation
from ..evaluation.bags import CrossCheck
from .document import Document, Item, Section, Sentence, Table, Where, figures, number, parameter_texts


def cross_check(check: CrossCheck) -> Document:
    """What the calibration of each bag is worth on every other one."""
    return Document(
        title="Bags checked against each other",
        subtitle=", ".join(map(_name, check.bags)),
        answer=None,
        warnings=check.notes,
        sections=[
            Section(
                "",
                [Sentence("Each bag calibrates, and every other one that has a reference is corrected with that.")],
                Where.PAGE,
            ),
            Section("Dead reckoning on bags that were not calibrated on", [_drift(check)] if check.navigation else []),
            Section("", [each for bag in check.bags for each in _pictures(check, bag)], Where.PAGE),
            Section("Difference of DVL and GNSS on bags that were not calibrated on", [_errors(check)]),
        ],
        parameters=parameter_texts(check.parameters),
    )


def _name(bag: str) -> str:
    return Path(bag).name or bag


def _errors(check: CrossCheck) -> Table:
    rows = [("nothing", "uncalibrated", *(number(value, 4) for value in check.uncorrected.tolist()))]
    for bag, of_models in zip(check.bags, check.corrected, strict=True):
        for model, row in zip(check.models, of_models, strict=True):
            rows.append((_name(bag), model, *(number(value, 4) for value in row.tolist())))
    return Table(
        ("calibrated on", "model", *map(_name, check.bags)),
        rows,
        dense=True,
        notes=(
            "rms of the vector, m/s, with the noise of GNSS, which no calibration removes; – nothing to calibrate "
            "with, or to check against.",
        ),
        words=2,
    )


def _drift(check: CrossCheck) -> Table:
    first = [next(iter(_of(check, bag).values()), None) for bag in check.bags]
    drifts = [("nothing", "as mounted", [None if each is None else each.before for each in first])]
    for calibrated, model in zip(check.bags, check.selected, strict=True):
        found = [check.navigation.get((calibrated, bag)) for bag in check.bags]
        drifts.append((_name(calibrated), model, [None if each is None else each.after for each in found]))
    rows = [
        (name, model, *("–" if each is None else f"{each.per_km:.1f} ({each.percent:.2g} %)" for each in of_bags))
        for name, model, of_bags in drifts
    ]
    return Table(
        ("calibrated on", "model", *map(_name, check.bags)),
        rows,
        notes=(
            "Drift in m per km, and per cent of the distance, rms over stretches of up to 1 km. With the lever arm of "
            "the bag calibrated on; the delay, which is the day's, is that of the bag itself.",
        ),
        words=2,
    )


def _of(check: CrossCheck, bag: str) -> dict[str, Navigation]:
    """Dead reckoning of a bag by what corrected it."""
    return {calibrated: each for (calibrated, verified), each in check.navigation.items() if verified == bag}


def _pictures(check: CrossCheck, bag: str) -> list[Item]:
    found = _of(check, bag)
    if not found:
        return []
    named = {f"by {_name(calibrated)}": each for calibrated, each in found.items()}
    return [figures("navigation_figures.navigation_pictures", next(iter(found.values())), named, f", {_name(bag)}")]
