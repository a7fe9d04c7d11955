"""`dvl-calib diagnose REAL --simulator SIM`: options and output."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from . import common
from .reporting import report_writer
from .tables import interval, intervals, titled

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.table import Table

    from ..discovery.discover import Discovery
    from ..unpaired.logs import Source
    from ..unpaired.results import UnpairedComparison

COLOURS = {"different": "yellow", "only_noise": "yellow", "no_difference": "green", "cannot_tell": "yellow"}
NOT_WITH = ("apply", "twin")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """--simulator and what belongs to it."""
    parser.add_argument(
        "--simulator", nargs="+", type=Path, metavar="SIM",
        help="bags of a simulator, from any motion, with its true velocity: what does its DVL lack?",
    )  # fmt: skip
    parser.add_argument(
        "--simulator-params", type=Path, metavar="FILE", help="parameter file of the simulator, where it needs another"
    )


def run(arguments: argparse.Namespace, defaults: Mapping[str, float]) -> None:
    """Compare, print, save."""
    from ..errors import InputError
    from ..unpaired.compare import compare
    from ..unpaired.results import unpaired_document

    for option in NOT_WITH:
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option} is of a diagnosis of one vehicle; run it without --simulator")
    common.check_outputs(arguments, "json", "report")
    write_report = report_writer(arguments, "write_unpaired_report")
    real = _source(arguments, arguments.bags, arguments.params, defaults)
    made = _source(arguments, arguments.simulator, arguments.simulator_params or arguments.params, defaults)
    with common.progress("comparing") as on_progress:
        comparison = compare(real[0], made[0], on_progress, with_series=arguments.report is not None)

    def answer() -> None:
        _print(comparison)
        common.print_found(real[1], arguments.bags)
        common.print_found(made[1], arguments.simulator)

    common.deliver(
        answer,
        (arguments.json, lambda path: common.write_json(path, unpaired_document(comparison))),
        (arguments.report, lambda path: write_report(path, comparison)),
    )


def _source(
    arguments: argparse.Namespace, bags: Sequence[Path], params: Path | None, defaults: Mapping[str, float]
) -> tuple[Source, Discovery]:
    """One side's bags and what they say of themselves."""
    from ..unpaired.logs import Source

    own = argparse.Namespace(**{**vars(arguments), "params": params})
    recording = common.opened(bags, common.load(own))
    discovery = common.discovered(own, recording, common.load(own))
    common.print_warnings(discovery.doubts)
    parameters = common.load(own, defaults).replace(**discovery.values)
    return Source(recording, parameters, discovery.topics), discovery


def _print(comparison: UnpairedComparison) -> None:
    from rich.markup import escape

    common.print_warnings(comparison.notes)
    out = common.console()
    word = comparison.verdict.value
    out.print(f"[bold {COLOURS[word]}]{word}[/]: {escape(comparison.sentence)}", soft_wrap=True)
    if comparison.effects:
        out.print(_effects(comparison))
    if comparison.rungs:
        out.print(_rungs(comparison))
    if comparison.noise:
        out.print(_noise(comparison))
    if comparison.levels:
        out.print(_levels(comparison))
    for side, names in comparison.not_shown.items():
        for name, why in names.items():
            out.print(f"not shown by the {side}'s motion: {name}, {why}")
    for effect in comparison.effects:
        if effect.needs:
            out.print(f"to tell {effect.name}: {escape(effect.needs)}", soft_wrap=True)


def _effects(comparison: UnpairedComparison) -> Table:
    table = titled("effects", ("effect", "", "vehicle (95 %)", "simulator (95 %)", "adds mm/s", "mostly", "p"))
    for each in comparison.effects:
        names = " or ".join((each.name, *each.equivalent_to))
        table.add_row(
            names, each.status.words, intervals(each.vehicle), intervals(each.simulator),
            f"{1e3 * each.adds_mps:.1f}", str(each.lies or "-"), "-" if math.isnan(each.p) else f"{each.p:.1g}",
        )  # fmt: skip
    return table


def _rungs(comparison: UnpairedComparison) -> Table:
    title = f"the simulator on the vehicle's own motion, held out; noise {1e3 * comparison.floor_mps:.1f} mm/s"
    table = titled(title, ("simulator", "error mm/s", "energy distance", "alike: below", "p"))
    for rung in comparison.rungs:
        table.add_row(
            rung.name, f"{1e3 * rung.error_mps:.1f}", f"{rung.distance:.2f}", f"{rung.null95:.2f}", f"{rung.p:.2g}"
        )
    return table


def _noise(comparison: UnpairedComparison) -> Table:
    table = titled("noise and stream", ("property", "", "vehicle (95 %)", "simulator (95 %)", "unit", "p", ""))
    for each in comparison.noise:
        table.add_row(
            each.name, each.status.words, interval(each.vehicle), interval(each.simulator), each.unit,
            f"{each.p:.1g}", each.note,
        )  # fmt: skip
    return table


def _levels(comparison: UnpairedComparison) -> Table:
    table = titled("noise of the DVL by regime, mm/s over the axes", ("when", "vehicle", "simulator"))
    for name, (vehicle, simulator) in comparison.levels.items():
        table.add_row(name, f"{1e3 * vehicle:.1f}", f"{1e3 * simulator:.1f}")
    return table
