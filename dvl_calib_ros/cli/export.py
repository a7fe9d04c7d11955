"""Write a diagnosed DVL as the settings of another simulator, and list what that simulator cannot represent.

Mounting with misalignment, lever arm, noise and rate are from the diagnosis; all other settings are the simulator's
defaults, and marked as such. Each effect that cannot be represented is printed with the remaining error in m/s, and
written to FILE.missing.json.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from . import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..simulator_export.simulators import SIMULATORS

    parser.add_argument("simulator", choices=tuple(SIMULATORS), metavar="SIMULATOR", help=", ".join(SIMULATORS))
    parser.add_argument(
        "source", type=Path, metavar="DIAGNOSIS", help="file of diagnose --json, or a result or parameter file"
    )
    parser.add_argument("--sample", type=int, metavar="N", help="use this sample of diagnose --samples, from 0")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="settings to write")


def run(arguments: argparse.Namespace) -> None:
    """Write the settings for the simulator and the list of what is missing, and print a summary."""
    from ..present.document import Table
    from ..present.terminal import rich_table
    from ..simulator_export.simulators import missing_beside, write_settings

    missing = missing_beside(arguments.output)
    also_written = {} if missing is None else {"--output, for missing effects,": missing}
    common.check_outputs(arguments, "output", also_written=also_written)
    exported = write_settings(arguments.simulator, arguments.source, arguments.output, arguments.sample)
    if missing is None:
        return
    out = common.console()
    out.print(f"wrote {arguments.output}: {', '.join(exported.settings.found)}", soft_wrap=True, markup=False)
    if exported.settings.defaults:
        names = ", ".join(exported.settings.defaults)
        out.print(f"at the simulator's defaults: {names}", soft_wrap=True, markup=False)
    for remark in exported.remarks:
        out.print(f"note: {remark}", soft_wrap=True, markup=False)
    if not exported.missing:
        out.print(f"{arguments.simulator} can represent everything that was found")
        return
    rows = [(e.name, "-" if e.error is None else f"{1e3 * e.error:.1f}", e.says) for e in exported.missing]
    head = ("what", "remaining error, mm/s", "why")
    out.print(rich_table(Table(head, rows, f"{arguments.simulator} cannot represent", words=3)))
