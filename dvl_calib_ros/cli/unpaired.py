"""`dvl-calib diagnose REAL --simulator SIM`, with --rounds or without: options and output."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from . import common
from .reporting import report_writer

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ..discovery.discover import Discovery
    from ..unpaired.both_sides import RecordedSide

NOT_WITH = ("apply", "twin")
NEEDS_SIMULATOR = ("simulator_params", "rounds", "keep")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """--simulator and what belongs to it."""
    parser.add_argument(
        "--simulator", nargs="+", type=Path, metavar="SIM",
        help="bags of a simulator, from any motion, with its true velocity: what does its DVL lack?",
    )  # fmt: skip
    parser.add_argument(
        "--simulator-params", type=Path, metavar="FILE", help="parameter file of the simulator, where it needs another"
    )
    parser.add_argument(
        "--rounds", type=int, metavar="N",
        help="put the simulator's DVL right by what was found, simulate it on the simulator's motion and compare "
        "again, up to N times",
    )  # fmt: skip
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER",
        help="keep of every round its DVL (round_1.json, for export and simulate --diagnosis) and its bag (round_1)",
    )  # fmt: skip


def check_without(arguments: argparse.Namespace) -> None:
    """Raise InputError for options that mean nothing without --simulator."""
    from ..errors import InputError

    for option in NEEDS_SIMULATOR:
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option.replace('_', '-')} works only with --simulator")


def run(arguments: argparse.Namespace, defaults: Mapping[str, float]) -> None:
    """Compare, print, save."""
    from ..errors import InputError
    from ..present.result_documents import DOCUMENTS
    from ..unpaired.results import unpaired_document
    from ..unpaired.simulator_rounds import ClosedGap, against, check_rounds, closed_gap_document

    for option in NOT_WITH:
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option} works only without --simulator")
    check_rounds(arguments.rounds, arguments.keep)
    common.check_outputs(arguments, "json", "report", folders=["keep"])
    write_report = report_writer(arguments)
    real = _source(arguments, arguments.bags, arguments.params, defaults)
    made = _source(arguments, arguments.simulator, arguments.simulator_params or arguments.params, defaults)
    with common.progress("comparing") as on_progress:
        found = against(
            real[0], made[0], arguments.rounds, arguments.keep, on_progress, with_series=arguments.report is not None
        )
    document = closed_gap_document(found) if isinstance(found, ClosedGap) else unpaired_document(found)

    def answer() -> None:
        common.print_document(DOCUMENTS[type(found)](found))
        common.print_found(real[1], arguments.bags)
        common.print_found(made[1], arguments.simulator)

    common.deliver(
        answer,
        (arguments.json, lambda path: common.write_json(path, document)),
        (arguments.report, lambda path: write_report(path, found)),
    )


def _source(
    arguments: argparse.Namespace, bags: Sequence[Path], params: Path | None, defaults: Mapping[str, float]
) -> tuple[RecordedSide, Discovery]:
    """One side's bags and what they say of themselves."""
    from ..unpaired.both_sides import RecordedSide

    own = argparse.Namespace(**{**vars(arguments), "params": params})
    recording = common.opened(bags, common.load(own))
    discovery = common.discovered(own, recording, common.load(own))
    common.print_warnings(discovery.doubts)
    parameters = common.load(own, defaults).replace(**discovery.values)
    return RecordedSide(recording, parameters, discovery.topics), discovery
