"""Run the published validation procedure: calibrate on one run, correct all others, compare with the published table.

FOLDER holds trajectories T01_dvl.csv .. T15_dvl.csv (time s; surge, sway, heave m/s, forward-right-down) and,
optionally, T01_attitude.csv .. (time s, the same stamps; roll, pitch, yaw rad in north-east-down). They are public:
T01-T13 in github.com/ansfl/A-KIT, T14 and T15 in github.com/ansfl/BeamsNet. Without a folder the procedure runs on
simulated trajectories of the same lengths.

With several recorded bags instead, calibrate on each and correct every other bag that has GNSS.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import InputError
from . import common

MAX_SEEDS = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("paths", nargs="*", type=Path, metavar="FOLDER | BAG", help="trajectories, or two bags or more")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="noise seeds 0 .. N - 1; default: %(default)s"
    )
    parser.add_argument("--sets", default="all", help="sets, such as E1,E2; default: all")
    parser.add_argument("--models", default="all", help="models, such as M3,M7; default: all")
    parser.add_argument("--partial", action="store_true", help="go on although trajectories are missing in the folder")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was found as JSON")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every Avg.VRMSE as CSV, one per line")
    common.add_report_option(parser)
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes; default: one per core")
    parser.add_argument("--dask", default="", metavar="ADDRESS", help="scheduler to work on, such as tcp://host:8786")
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Run the evaluation or the cross-check, print its document, and write the requested files."""
    from ..calibration.models import BY_VELOCITY
    from ..disk.atomic import save_text
    from ..evaluation.cross_check import cross_check
    from ..evaluation.documents import evaluation_csv
    from ..evaluation.protocol import SETS
    from ..evaluation.validation_study import DEFAULTS, EVALUATED, evaluate
    from ..parallel import Workers
    from ..present import evaluation as present

    are_bags = _are_bags(arguments.paths)
    if arguments.models == "all" and not are_bags:
        models = list(EVALUATED)
    else:
        models = common.chosen("--models", arguments.models, BY_VELOCITY)
    sets = common.chosen("--sets", arguments.sets, [each.name for each in SETS])
    if not 1 <= arguments.seeds <= MAX_SEEDS:
        raise InputError(f"--seeds: {arguments.seeds} is outside 1 .. {MAX_SEEDS}")
    common.check_outputs(arguments, "json", "csv", "report")
    workers = Workers(arguments.jobs, arguments.dask)
    if are_bags:
        if arguments.csv is not None:
            raise InputError("--csv: only for a folder of trajectories; for bags there is --json")
        with common.progress("replaying") as on_progress:
            given = common.given(arguments)
            check = cross_check(arguments.paths, common.load(arguments), models, given, workers, on_progress)
        common.deliver(
            lambda: common.print_document(present.cross_check(check)), *common.result_files(arguments, check)
        )
        return
    parameters = common.load(arguments, DEFAULTS)
    with common.progress("evaluating") as on_progress:
        evaluation = evaluate(
            arguments.paths[0] if arguments.paths else None,
            parameters,
            models=models,
            sets=sets,
            n_seeds=arguments.seeds,
            partial_folder=arguments.partial,
            workers=workers,
            on_progress=on_progress,
        )
    common.deliver(
        lambda: common.print_document(present.evaluation(evaluation)),
        *common.result_files(arguments, evaluation),
        (arguments.csv, lambda path: save_text(path, evaluation_csv(evaluation))),
    )


def _are_bags(paths: list[Path]) -> bool:
    """Return whether the paths are bags rather than a folder of trajectories."""
    if not paths:
        return False
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; give a folder of trajectories, or bags")
    if len(paths) == 1 and paths[0].is_dir() and not (paths[0] / "metadata.yaml").exists():
        return False
    if len(paths) == 1:
        raise InputError(f"{paths[0]}: one bag cannot be checked against another; name two at least, or use replay")
    return True
