"""Tables of the comparison of several bags, of which each is calibrated on and every other one corrected with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import common
from .tables import cell, titled

if TYPE_CHECKING:
    from rich.table import Table

    from ..evaluation.bags import CrossCheck


def print_cross_check(check: CrossCheck) -> None:
    """Print what was found, its notes first."""
    from rich.markup import escape

    common.print_warnings(check.notes)
    caption = "with the noise of GNSS, which no calibration removes; -: nothing to calibrate with, or to check against"
    title = "Difference of DVL and GNSS, rms m/s, on bags that were not calibrated on"
    table = titled(title, ["calibrated on", "model"], [escape(bag) for bag in check.bags], caption=caption)
    table.add_row("nothing", "uncalibrated", *map(cell, check.uncorrected))
    for bag, rows in zip(check.bags, check.corrected, strict=True):
        table.add_section()
        for model, row in zip(check.models, rows, strict=True):
            table.add_row(escape(bag), model, *map(cell, row))
    out = common.console()
    out.print(table)
    if check.navigation:
        out.print(_drift_table(check))


def _drift_table(check: CrossCheck) -> Table:
    """Dead reckoning of each bag by each other one."""
    from rich.markup import escape

    title = "Dead reckoning: drift in m per km, on bags that were not calibrated on"
    caption = "with the lever arm of the bag calibrated on; the delay, which is the day's, is that of the bag itself"
    table = titled(title, ["calibrated on", "model"], [escape(bag) for bag in check.bags], caption=caption)
    nothing = [
        next((each.before.per_km for (_, bag), each in check.navigation.items() if bag == verified), float("nan"))
        for verified in check.bags
    ]
    table.add_row("nothing", "as mounted", *(cell(value, 1) for value in nothing))
    for calibrated, model in zip(check.bags, check.selected, strict=True):
        found = [check.navigation.get((calibrated, verified)) for verified in check.bags]
        table.add_row(
            escape(calibrated), model, *("-" if each is None else cell(each.after.per_km, 1) for each in found)
        )
    return table
