"""`python -m validation trial`: options and output of the blind trial of the diagnosis."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path

from dvl_calib_ros import __version__
from dvl_calib_ros.cli import common
from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.present.document import Table as Shown
from dvl_calib_ros.present.terminal import rich_table

from ..figures.stored import head
from .motion import BOAT, HELD_OUT_KINDS, RECORDED, TUNING_KINDS
from .pairs_run import by_row, figures, misses, run_pairs, score_pair
from .plan import KINDS, Case, Family, plan
from .recorded import NO_RECORDINGS, has_boat, has_ins, recordings_folder
from .run import Trial
from .scored import join
from .sequential import Sequential
from .tables import Table, markdown, score
from .truth import Category, unseal

DEFAULT_CASES = 100
KIND_CHOICES = {"all": KINDS, "tuning": TUNING_KINDS, "held-out": HELD_OUT_KINDS}
CATEGORIES = [each.value for each in Category]
FAMILIES = [each.value for each in Family]


def main(argv: Sequence[str]) -> int:
    """Run what is left of the trial, score it, print the tables and write them to the folder. Raises InputError."""
    parser = argparse.ArgumentParser(
        prog="python -m validation trial", description="Try the diagnosis itself, blindly, on bags made for it."
    )
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--cases", type=int, metavar="N", help=f"a fair part of the trial; default: {DEFAULT_CASES}")
    amount.add_argument(
        "--case", action="append", metavar="KEY", help="one case, by its key or id (as in sealed/); may be given again"
    )
    amount.add_argument(
        "--plan", action="store_true",
        help="questions with goals, each asked until it is decided: 900 cases at most, of one commit",
    )  # fmt: skip
    amount.add_argument("--full", action="store_true", help="all cases (hours)")
    amount.add_argument(
        "--pairs", type=int, metavar="N",
        help="instead: N pairs of logs of a vehicle and a simulator, for --simulator; 60 are a whole round",
    )  # fmt: skip
    parser.add_argument("--kinds", choices=KIND_CHOICES, default="all", help="of trajectory; default: %(default)s")
    parser.add_argument(
        "--family", choices=FAMILIES, action="append",
        help="simulated manoeuvres, real motion, the same with a horizontal reference, or several recordings of one "
        "vehicle; may be given again; default: all, in turns",
    )  # fmt: skip
    parser.add_argument(
        "--category", choices=CATEGORIES, action="append", help="of cases; may be given again; default: all"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("dvl_calib_trial"), metavar="FOLDER",
        help="folder of the trial, which goes on where it was stopped; default: %(default)s",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes; default: one per core")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the trial; default: %(default)s")
    parser.add_argument("--minutes", type=float, default=math.inf, metavar="M", help="begin no case after this time")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the page of the documentation (Markdown)")
    parser.add_argument("--keep-bags", action="store_true", help="leave the bags in the folder")
    arguments = parser.parse_args(argv)
    _check(arguments)
    if arguments.pairs is not None:
        _run_pairs(arguments)
    elif arguments.plan:
        _run_plan(arguments)
    else:
        _run(arguments)
    return 0


def _run(arguments: argparse.Namespace) -> None:
    errors = common.console(stderr=True)
    cases = _planned(arguments)
    if arguments.case:
        cases = _chosen(cases, arguments.case)
    elif not arguments.full:
        cases = cases[: arguments.cases or DEFAULT_CASES]
    trial = Trial(arguments.out, arguments.seed, arguments.jobs, arguments.keep_bags)
    try:
        with common.progress("trial") as on_progress:
            answers = trial.run(cases, on_progress, 60.0 * arguments.minutes)
    except OSError as error:
        raise InputError(f"{arguments.out}: {error.strerror or error}; name another folder by --out") from error
    result = score(join(unseal(trial.sealed), answers))
    common.write_json(arguments.out / "score.json", result.document())
    save_text(arguments.out / "score.md", result.markdown())
    if arguments.page is not None:
        save_text(arguments.page, result.page(_command(arguments), __version__))
    out = common.console()
    for table in result.tables:
        out.print(rich_table(Shown(table.columns, table.rows, table.title)))
    if result.n_failed:
        errors.print(f"[red]{result.n_failed} cases failed[/]; {trial.answers} says how")


def _planned(arguments: argparse.Namespace) -> list[Case]:
    """Cases of the kinds, families and categories that are asked for, as far as their recordings are there."""
    kinds = KIND_CHOICES[arguments.kinds]
    if RECORDED in kinds and not has_ins(recordings_folder()):
        kinds = tuple(kind for kind in kinds if kind != RECORDED)
        common.console(stderr=True).print(f"[yellow]note:[/] {NO_RECORDINGS}")
    cases = plan(kinds, [Family(name) for name in arguments.family or FAMILIES])
    cases = [case for case in cases if case.category.value in (arguments.category or CATEGORIES)]
    return cases if has_boat(recordings_folder()) else [case for case in cases if case.kind != BOAT]


def _run_plan(arguments: argparse.Namespace) -> None:
    """Ask what is open, print how each question stands, write it to the folder."""
    trial = Trial(arguments.out, arguments.seed, arguments.jobs, arguments.keep_bags)
    asked = Sequential(trial, _planned(arguments), head())
    with common.progress("trial") as on_progress:
        scored = asked.run(on_progress, 60.0 * arguments.minutes, time.monotonic)
    cpu_s = sum(case.cpu_s for case in scored)
    title = f"Trial of {asked.commit}: {len(scored)} cases, seed {arguments.seed}, diagnosis {cpu_s:.0f} s of CPU"
    shown = Table(title, ("question", "goal", "measured", "95 % bounds", "n", "stands"), tuple(asked.lines(scored)))
    save_text(arguments.out / "plan.md", markdown(shown) + "\n")
    common.console().print(rich_table(Shown(shown.columns, shown.rows, shown.title)))


def _run_pairs(arguments: argparse.Namespace) -> None:
    """Compare what is left of the pairs, print the figures and what was not right, write both to the folder."""
    with common.progress("pairs") as on_progress:
        numbers = range(arguments.pairs)
        found = run_pairs(arguments.out, arguments.seed, numbers, on_progress, 60.0 * arguments.minutes)
    lines = [str(figure) for figure in figures([score_pair(*each) for each in found])]
    lines += [f"{row}: {right} of {n} right" for row, (right, n) in by_row(found).items()]
    lines += misses(found)
    save_text(arguments.out / "pairs.txt", "\n".join(lines) + "\n")
    print(*lines, sep="\n")


def _chosen(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """Cases by key or id, in the order of the names. Raises InputError."""
    by_name = {name: case for case in cases for name in (case.key, case.id)}
    if unknown := [name for name in names if name not in by_name]:
        raise InputError(f"--case {unknown[0]}: no such case; give a key or an id as in the folder's sealed/*.json")
    return [by_name[name] for name in names]


def _command(arguments: argparse.Namespace) -> str:
    """The command line that runs the same cases again."""
    words = ["python -m validation trial", f"--seed {arguments.seed}"]
    if arguments.case:
        words += [f"--case {name}" for name in arguments.case]
    else:
        words.append("--full" if arguments.full else f"--cases {arguments.cases or DEFAULT_CASES}")
    words += [f"--family {name}" for name in arguments.family or ()]
    words += [f"--category {name}" for name in arguments.category or ()]
    if arguments.kinds != "all":
        words.append(f"--kinds {arguments.kinds}")
    return " ".join(words)


def _check(arguments: argparse.Namespace) -> None:
    if arguments.cases is not None and arguments.cases < 1:
        raise InputError(f"--cases: {arguments.cases} is no number of cases; give 1 or more, or --full")
    if arguments.pairs is not None and arguments.pairs < 1:
        raise InputError(f"--pairs: {arguments.pairs} is no number of pairs; give 1 or more")
    if arguments.jobs < 0:
        raise InputError(f"--jobs: {arguments.jobs} is negative; give a number of processes, or 0 for one per core")
    if not arguments.minutes >= 0.0:
        raise InputError(f"--minutes: {arguments.minutes} is no time; give 0 or more")
    if arguments.seed < 0:
        raise InputError(f"--seed: {arguments.seed} is negative; give 0 or more")
