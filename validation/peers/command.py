"""`python -m validation peers`: the diagnosis and its peers on the same bags, blindly; goes on where it was stopped."""

from __future__ import annotations

import argparse
import itertools
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from dvl_calib_ros.cli import common
from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.present.document import Table
from dvl_calib_ros.present.terminal import rich_table

from ..trial.motion import BOAT, RECORDED
from ..trial.plan import Case, Family, plan
from ..trial.recorded import has_ins, recordings_folder
from ..trial.run import Document, Identified, Trial, read_answers
from ..trial.truth import Category, unseal
from .asked import PEERS, peers
from .foreign import FOREIGN, foreign_cases, has_physics, record_foreign
from .scores import markdown, sides, tables

DEFAULT_CASES = 40
# Strengths that a single effect has to have to be asked for: weaker ones nobody can name
NAMED_FROM = 12.0
# One recording each, and no more than two effects beside what is unknown: what peers can be asked
CATEGORIES = (Category.NULL, Category.HARD_NULL, Category.SINGLE, Category.PAIR, Category.UNKNOWN)
FAMILIES = (Family.SIMULATED, Family.HALF_REAL)


def main(argv: Sequence[str]) -> int:
    """Ask all about what is left of the cases, print the tables and write them to the folder. Raises InputError."""
    parser = argparse.ArgumentParser(prog="python -m validation peers", description=__doc__)
    parser.add_argument("--cases", type=int, default=DEFAULT_CASES, metavar="N", help="in turns over the classes")
    parser.add_argument("--peer", choices=PEERS, action="append", help="may be given again; default: all")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the trial; default: %(default)s")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes; default: %(default)s")
    parser.add_argument("--minutes", type=float, default=math.inf, metavar="M", help="begin no case after this time")
    parser.add_argument(
        "--out", type=Path, default=Path("dvl_calib_peers"), metavar="FOLDER",
        help="folder of the answers, which goes on where it was stopped; default: %(default)s",
    )  # fmt: skip
    parser.add_argument(
        "--anew", action="store_true",
        help="ask the diagnosis, which has changed, once more about the cases that the folder has; the peers have not",
    )  # fmt: skip
    arguments = parser.parse_args(argv)
    if arguments.cases < 1 or arguments.jobs < 0 or arguments.seed < 0 or not arguments.minutes >= 0.0:
        raise InputError("wrong number: give --cases 1 or more, and --jobs, --seed and --minutes 0 or more")
    names = list(dict.fromkeys(arguments.peer or PEERS))
    beside = peers(names)
    out = common.console()
    sources = 2 if has_physics() else 1
    if sources == 1:
        out.print("[yellow]note:[/] no cases outside of the generator; set DVL_CALIB_SHARED")
    n_foreign = arguments.cases // 4 if sources == 2 else 0
    seconds = 60.0 * arguments.minutes
    inside = Trial(arguments.out / "generator", arguments.seed, arguments.jobs, beside=beside)
    outside = Trial(
        arguments.out / FOREIGN, arguments.seed, arguments.jobs, beside=beside, recorder=record_foreign
    )  # fmt: skip
    if arguments.anew and not any(read_answers(each.answers) for each in (inside, outside)):
        raise InputError(f"{arguments.out}: has no answers to be asked for anew; run it without --anew first")
    with common.progress("peers") as on_progress:
        chosen, strange = generator_cases(arguments.cases - n_foreign), foreign_cases(n_foreign)
        run = asked_anew if arguments.anew else Trial.run
        answers = run(inside, chosen, on_progress, seconds * (1.0 - n_foreign / arguments.cases))
        answers = answers | run(outside, strange, on_progress, seconds * n_foreign / arguments.cases)
    truths = {**unseal(inside.sealed), **unseal(outside.sealed)}
    found = tables(sides(truths, answers))
    save_text(arguments.out / "score.md", markdown(found))
    for title, columns, rows in found:
        out.print(rich_table(Table(columns, tuple(rows), title)))
    return 0


def asked_anew(
    trial: Trial, cases: Sequence[Identified], on_progress: Callable[[float], None], seconds: float
) -> dict[str, Document]:
    """Answers to those cases that the trial's folder has: of the diagnosis anew, of the peers as they were.

    The folder has the new ones when all are there; until then a further call goes on. Raises InputError.
    """
    trial.prepare()
    before = read_answers(trial.answers)
    asked = [case for case in cases if case.id in before]
    again = replace(trial, folder=trial.folder / "anew", beside={})
    found = {key: before[key] | answer for key, answer in again.run(asked, on_progress, seconds).items()}
    if len(found) == len(asked):
        lines = [json.dumps(answer, sort_keys=True) + "\n" for answer in (before | found).values()]
        save_text(trial.answers, "".join(lines))
        shutil.rmtree(again.folder)
    return found


def generator_cases(n: int) -> list[Case]:
    """The first n of the trial's cases that peers can be asked, classes in turns; half of the nulls are hard."""
    families = FAMILIES if has_ins(recordings_folder()) else FAMILIES[:1]
    queues = []
    for family in families:
        cases = [
            case for case in plan(families=[family]) if case.kind not in (RECORDED, BOAT) or family in FAMILIES[1:]
        ]
        cases = [case for case in cases if case.category in CATEGORIES and _can_be_named(case)]
        nulls = [[c for c in cases if c.category is category] for category in CATEGORIES[:2]]
        queues.append([case for both in zip(*nulls, strict=False) for case in both])
        queues += [[case for case in cases if case.category is category] for category in CATEGORIES[2:]]
    turns = itertools.chain.from_iterable(itertools.zip_longest(*queues))
    return list(itertools.islice((case for case in turns if case is not None), n))


def _can_be_named(case: Case) -> bool:
    return case.category is not Category.SINGLE or case.family is not Family.SIMULATED or case.q >= NAMED_FROM
