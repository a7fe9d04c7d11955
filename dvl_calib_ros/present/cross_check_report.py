"""The report of bags checked against each other: `dvl-calib evaluate BAG BAG --report out.html`."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ..evaluation.bags import CrossCheck
from ..replay.navigation import Navigation
from .document import Table
from .navigation_figures import navigation_pictures
from .page import parameter_texts, write_page
from .style import Picture


def write_cross_check_report(path: Path, check: CrossCheck) -> None:
    """Write the report. Raises InputError if the file cannot be written."""
    write_page(
        path,
        "cross_check.html",
        {
            "title": "Bags checked against each other",
            "subtitle": ", ".join(map(_name, check.bags)),
            "written": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC"),
            "warnings": check.notes,
            "errors": _errors(check),
            "drift": _drift(check) if check.navigation else None,
            "pictures": [each for bag in check.bags for each in _pictures(check, bag)],
            "parameters": parameter_texts(check.parameters),
        },
    )


def _name(bag: str) -> str:
    return Path(bag).name or bag


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def _errors(check: CrossCheck) -> Table:
    rows = [("nothing", "uncalibrated", *(_cell(value, 4) for value in check.uncorrected.tolist()))]
    for bag, of_models in zip(check.bags, check.corrected, strict=True):
        for model, row in zip(check.models, of_models, strict=True):
            rows.append((_name(bag), model, *(_cell(value, 4) for value in row.tolist())))
    return Table(
        ("calibrated on", "model", *map(_name, check.bags)),
        rows,
        dense=True,
        notes=("rms of the vector, m/s, with the noise of GNSS; – nothing to calibrate with, or to check against.",),
    )


def _drift(check: CrossCheck) -> Table:
    rows = [("nothing", "as mounted", *(_before(check, bag) for bag in check.bags))]
    for calibrated, model in zip(check.bags, check.selected, strict=True):
        found = [check.navigation.get((calibrated, bag)) for bag in check.bags]
        cells = ["–" if each is None else f"{each.after.per_km:.1f} ({each.after.percent:.2g} %)" for each in found]
        rows.append((_name(calibrated), model, *cells))
    return Table(
        ("calibrated on", "model", *map(_name, check.bags)),
        rows,
        notes=(
            "m per km, and per cent of the distance, rms over stretches of up to 1 km. With the lever arm of the bag "
            "calibrated on; the delay, which is the day's, is that of the bag itself.",
        ),
    )


def _of(check: CrossCheck, bag: str) -> dict[str, Navigation]:
    """Dead reckoning of a bag by what corrected it."""
    return {calibrated: each for (calibrated, verified), each in check.navigation.items() if verified == bag}


def _before(check: CrossCheck, bag: str) -> str:
    found = next(iter(_of(check, bag).values()), None)
    return "–" if found is None else f"{found.before.per_km:.1f} ({found.before.percent:.2g} %)"


def _pictures(check: CrossCheck, bag: str) -> list[Picture]:
    found = _of(check, bag)
    if not found:
        return []
    named = {f"by {_name(calibrated)}": each for calibrated, each in found.items()}
    return list(navigation_pictures(next(iter(found.values())), named, f", {_name(bag)}"))
