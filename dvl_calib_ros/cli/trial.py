"""The blind trial of the diagnosis: options and output of ``dvl-calib diagnose --trial``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..trial.scorer import Table

DEFAULT_CASES = 100
KIND_CHOICES = ("all", "tuning", "held-out")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that make sense with --trial only."""
    group = parser.add_argument_group("blind trial (--trial)")
    amount = group.add_mutually_exclusive_group()
    amount.add_argument("--cases", type=int, metavar="N", help=f"a fair part of the trial; default: {DEFAULT_CASES}")
    amount.add_argument("--full", action="store_true", help="all cases (hours)")
    group.add_argument("--kinds", choices=KIND_CHOICES, default="all", help="of trajectory; default: %(default)s")
    group.add_argument(
        "--out", type=Path, default=Path("dvl_calib_trial"), metavar="FOLDER",
        help="folder of the trial, which goes on where it was stopped; default: %(default)s",
    )  # fmt: skip
    group.add_argument("--jobs", type=int, default=0, metavar="N", help="processes; default: one per core")
    group.add_argument("--seed", type=int, default=0, metavar="S", help="of the trial; default: %(default)s")
    group.add_argument("--keep-bags", action="store_true", help="leave the bags in the folder")


def run(arguments: argparse.Namespace) -> None:
    """Run what is left of the trial, score it, print the tables and write them to the folder."""
    from ..errors import InputError
    from ..files.atomic import save_text
    from ..trial.cases import KINDS, plan
    from ..trial.motion import HELD_OUT_KINDS, RECORDED, TUNING_KINDS, recordings_folder
    from ..trial.run import Trial
    from ..trial.scorer import join, score
    from ..trial.truth import unseal

    _check(arguments)
    kinds = {"all": KINDS, "tuning": TUNING_KINDS, "held-out": HELD_OUT_KINDS}[arguments.kinds]
    errors = common.console(stderr=True)
    if RECORDED in kinds and recordings_folder() is None:
        kinds = tuple(kind for kind in kinds if kind != RECORDED)
        errors.print("[yellow]note:[/] no recorded trajectories; name the folder of Snapir's in DVL_CALIB_SNAPIR")
    cases = plan(kinds)
    if not arguments.full:
        cases = cases[: arguments.cases or DEFAULT_CASES]
    trial = Trial(arguments.out, arguments.seed, arguments.jobs, arguments.keep_bags)
    try:
        with common.progress("trial") as on_progress:
            answers = trial.run(cases, on_progress)
    except OSError as error:
        raise InputError(f"{arguments.out}: {error.strerror or error}; name another folder by --out") from error
    result = score(join(unseal(trial.sealed), answers))
    common.write_json(arguments.out / "score.json", result.document())
    save_text(arguments.out / "score.md", result.markdown())
    out = common.console()
    for table in result.tables:
        out.print(_rich(table))
    if result.n_failed:
        errors.print(f"[red]{result.n_failed} cases failed[/]; {trial.answers} says how")


def _check(arguments: argparse.Namespace) -> None:
    from ..errors import InputError

    if arguments.cases is not None and arguments.cases < 1:
        raise InputError(f"--cases: {arguments.cases} is no number of cases; give 1 or more, or --full")
    if arguments.jobs < 0:
        raise InputError(f"--jobs: {arguments.jobs} is negative; give a number of processes, or 0 for one per core")
    if arguments.seed < 0:
        raise InputError(f"--seed: {arguments.seed} is negative; give 0 or more")


def _rich(table: Table) -> object:
    from rich.markup import escape
    from rich.table import Table as RichTable

    shown = RichTable(title=table.title, title_justify="left")
    for number, column in enumerate(table.columns):
        shown.add_column(escape(column), justify="left" if number == 0 else "right")
    for row in table.rows:
        shown.add_row(*map(escape, row))
    return shown
