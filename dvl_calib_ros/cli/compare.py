"""Compare calibrations of one DVL: did the mounting move, by how much, and between which calibrations?

Each RESULT is a result file of the node or of replay --save, or a bag, which is calibrated first. The whole corrected
mounting with lever arm, scale and delay is compared, weighted by the stated σ; models and configured mountings may
differ.

Exit code 0: the same mounting within 2 σ. 2: bad usage or input. 3: suspicious, 2 to 3.7 σ. 4: moved, beyond 3.7 σ.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..standard_streams import give_up
from . import common

if TYPE_CHECKING:
    from ..calibration.results.extrinsics import Extrinsics


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT", help="result file (YAML), or a bag")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    common.add_report_option(parser)
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Load or calibrate, compare, save, print. Return the exit code."""
    from ..calibration.comparison.mounting_change import check_distinct, compare
    from ..present import comparison as present

    paths: list[Path] = arguments.results
    common.check_outputs(arguments, "json", "report")
    names = _names(paths)
    notes: list[str] = []
    calibrations = [_load_or_calibrate(arguments, path, name, notes) for path, name in zip(paths, names, strict=True)]
    check_distinct(calibrations)
    comparison = compare(calibrations)
    try:
        common.deliver(
            lambda: common.print_document(present.comparison(comparison), notes),
            *common.result_files(arguments, comparison),
        )
    except BrokenPipeError:  # the exit code is still valid after | head
        give_up(sys.stdout)
    return comparison.answer.exit_code


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the file names if they are unique, else the full paths."""
    short = [path.name or str(path) for path in paths]
    return short if len(set(short)) == len(short) else list(map(str, paths))


def _load_or_calibrate(arguments: argparse.Namespace, path: Path, name: str, notes: list[str]) -> Extrinsics:
    """Load a result file, or calibrate with a bag and append its warnings to `notes`."""
    from ..bags.files import is_bag
    from ..files.mounting import load_extrinsics

    if not is_bag(path):
        return load_extrinsics(path, name)
    from ..bag_replay.checked_replay import calibrated

    recording, discovery = common.discovered(arguments, [path], common.load(arguments))
    with common.progress(f"replaying {name}") as on_progress:
        found = calibrated(recording, discovery.parameters, discovery.topics, name, on_progress)
    notes += [f"{name}: {note}" for note in found.notes]
    return found.extrinsics
