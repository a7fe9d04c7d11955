"""What bags say that are checked against each other."""

from __future__ import annotations

from ..evaluation.cross_check import CrossCheck
from .document import Document, Item, Sentence, Table, Where, figures, section
from .numbers import number

ERRORS_NOTE = (
    "rms of the vector, m/s, with the noise of GNSS, which no calibration removes; – nothing to calibrate with, or to "
    "check against."
)
DRIFT_NOTE = (
    "Drift in m per km, and per cent of the distance, rms over stretches of up to 1 km. With the lever arm of the bag "
    "calibrated on; the delay, which is the day's, is that of the bag itself."
)


def cross_check(check: CrossCheck) -> Document:
    """What the calibration of each bag is worth on every other one."""
    pictures: list[Item] = []
    for bag, name in zip(check.bags, check.names, strict=True):
        by = {f"by {one}": check.navigation.get((each, bag)) for each, one in zip(check.bags, check.names, strict=True)}
        found = {name: each for name, each in by.items() if each is not None}
        if found:
            one = next(iter(found.values()))
            pictures.append(figures("replay_figures.navigation_pictures", one, found, f", {name}"))
    head, nothing = ("calibrated on", "model", *check.names), ("nothing", "uncalibrated")
    errors = [(*nothing, *(number(value, 4) for value in check.uncorrected.tolist()))]
    for name, of_models in zip(check.names, check.corrected, strict=True):
        for model, row in zip(check.models, of_models, strict=True):
            errors.append((name, model, *(number(value, 4) for value in row.tolist())))
    of_pairs = [[check.navigation.get((calibrated, bag)) for bag in check.bags] for calibrated in check.bags]
    first = [next((each for each in of_bag if each is not None), None) for of_bag in zip(*of_pairs, strict=True)]
    drifts = [("nothing", "as mounted", [each and each.before for each in first])]
    drifts += [
        (name, model, [each and each.after for each in of_bags])
        for name, model, of_bags in zip(check.names, check.selected, of_pairs, strict=True)
    ]
    by_drift = [
        (name, model, *("–" if each is None else f"{each.per_km:.1f} ({each.percent:.2g} %)" for each in of_bags))
        for name, model, of_bags in drifts
    ]
    return Document(
        title="Bags checked against each other",
        subtitle=", ".join(check.names),
        answer=None,
        warnings=check.notes,
        sections=[
            section(
                "",
                Sentence("Each bag calibrates, and every other one that has a reference is corrected with that."),
                where=Where.PAGE,
            ),
            section(
                "Dead reckoning on bags that were not calibrated on",
                Table(head, by_drift if check.navigation else (), notes=(DRIFT_NOTE,), words=2),
                *pictures,
            ),
            section(
                "Difference of DVL and GNSS on bags that were not calibrated on",
                Table(head, errors, dense=True, notes=(ERRORS_NOTE,), words=2),
            ),
        ],
        parameters=check.parameters,
    )
