"""Look at a recording before it is calibrated: what is in it, what is wrong with it, whether it can calibrate.

One page: topics and rates, where the DVL sits, every fault with its remedy, what the motion shows, what to type next.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from rich.console import Console

    from ..examination.examine import Examination

BAR = 20
ANSWERS = {
    "yes": ("green", "This recording can calibrate the DVL."),
    "partly": ("yellow", "This recording can calibrate a part of the DVL's errors."),
    "no": ("red", "This recording cannot calibrate the DVL as it is."),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap or .db3")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    common.add_parameter_options(parser)
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Examine, print, save."""
    from ..examination.examine import examine

    common.check_outputs(arguments, "json")
    parameters = common.load(arguments)
    examination = examine(common.opened(arguments.bags, parameters), parameters, common.given(arguments))
    common.deliver(
        lambda: _print(examination), (arguments.json, lambda path: common.write_json(path, examination.document()))
    )


def _print(examined: Examination) -> None:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from ..errors import printable

    out = common.console()
    common.print_warnings(examined.notes)
    if examined.findings and examined.findings[0].code.startswith("DOCTOR_NO_IMU"):
        out.print(f"[bold]{escape(_sentence(examined.findings[0].says))}[/]")
    colour, answer = ANSWERS[examined.verdict]
    out.print(f"[bold {colour}]{examined.verdict}[/]: {answer} {escape(_why(examined))}")
    names = ", ".join(path.name or str(path) for path in examined.paths)
    out.print(f"\n{escape(printable(names))}: {examined.seconds:.0f} s")
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for column in ("", "topic", "frame", "Hz", "claims"):
        table.add_column(column, justify="right" if column == "Hz" else "left", overflow="fold")
    for content in examined.contents:
        cells = [escape(printable(cell)) for cell in (content.topic, content.frame_id)]
        table.add_row(
            content.role,
            *cells,
            f"{content.rate_hz:.3g}" if content.rate_hz else "-",
            content.covariance.removesuffix(" always"),
        )
    out.print(table)
    for sentence in (*examined.discovery.found[1:], *examined.discovery.notes):
        out.print(f"[dim]{escape(printable(sentence))}[/]")
    _print_findings(out, examined)
    _print_motion(out, examined)
    for word, command in zip(("next", "", ""), next_commands(examined), strict=False):
        out.print(f"{word:5} {escape(command)}", soft_wrap=True)


def _sentence(says: str) -> str:
    return f"{says[:1].upper()}{says[1:]}."


def _why(examined: Examination) -> str:
    errors = [found for found in examined.findings if found.severity.value == "error"]
    if errors:
        return f"{errors[0].says}."
    if not examined.has_reference:
        return "There is no reference velocity: roll and scale stay unknown, and nothing can be verified."
    missing = [each.name for each in examined.shown if each.needs]
    return f"It does not show {' and '.join(missing)}." if missing else ""


def _print_findings(out: Console, examined: Examination) -> None:
    from rich.markup import escape
    from rich.padding import Padding

    from ..errors import printable

    if not examined.findings:
        out.print("\n[green]nothing wrong was found[/]")
        return
    out.print(f"\n{len(examined.findings)} found:")
    for found in examined.findings:
        colour = "red" if found.severity.value == "error" else "yellow"
        out.print(Padding(f"[{colour}]{escape(printable(found.says))}[/]", (0, 0, 0, 2)))
        out.print(Padding(f"{escape(printable(found.remedy))} [dim]{escape(f'[{found.code}]')}[/]", (0, 0, 0, 4)))


def _print_motion(out: Console, examined: Examination) -> None:
    out.print(f"\nmotion: {examined.speed_mps:.2f} m/s (median); what it shows of the DVL, ±1σ to expect:")
    for each in examined.shown:
        full = round(BAR * each.share)
        colour = "green" if each.share >= 1.0 else "yellow" if not each.needs else "red"
        needs = f"  needs {each.needs}" if each.needs else ""
        out.print(f"  {each.name:6}[{colour}]{'█' * full}{'░' * (BAR - full)}[/] ±{each.std:.2f} {each.unit}{needs}")
    if not examined.shown:
        out.print("  (without a reference only pitch, and yaw if there are opposite headings)")
    out.print()


def next_commands(examined: Examination) -> list[str]:
    """What to type next."""
    bags = " ".join(shlex.quote(str(path)) for path in examined.paths)
    options = "".join(
        f" {found.remedy[found.remedy.index('-p ') :].split(' leaves')[0]}"
        for found in examined.findings
        if found.code in ("DOCTOR_CLOCKS", "DOCTOR_COVARIANCE") and "-p " in found.remedy
    )
    if examined.verdict == "no" and not options:
        return ["dvl-calib doctor BAG   (once it is recorded again)"]
    return [f"dvl-calib replay {bags}{options} --save calibration.yaml"]
