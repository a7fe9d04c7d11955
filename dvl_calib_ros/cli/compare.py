"""Compare calibrations of one DVL: did the mounting move, by how much, between which of them?

Each RESULT is a result file of the node or of replay --save, or a bag, which is calibrated first. What is compared is
the whole corrected mounting, with lever arm, scale and delay, by the σ that each states; also of different models and
configured mountings.

Exit code 0: the same mounting within 2 σ. 1: it has moved, by more than 4 σ. 2: bad usage or input. 3: suspicious,
between the two.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from ..streams import give_up
from . import common
from .answer import VERDICTS
from .reporting import add_report_option, report_writer

if TYPE_CHECKING:
    from rich.table import Table

    from ..calibration.comparison import Comparison, Difference
    from ..calibration.extrinsics import Extrinsics

# More pairs than these are in --json; printed are the neighbours in time.
MOST_PAIRS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT", help="result file (YAML), or a bag")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    add_report_option(parser)
    common.add_parameter_options(parser)
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Load or calibrate, compare, save, print."""
    from ..calibration.comparison import check_distinct, compare
    from ..calibration.comparison_words import comparison_document
    from ..errors import InputError

    paths: list[Path] = arguments.results
    if len(paths) < 2:
        raise InputError(f"{paths[0]}: one alone cannot be compared; name two at least")
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise InputError(f"{twice}: named twice; a calibration cannot be compared with itself")
    common.check_outputs(arguments, "json", "report")
    write_report = report_writer(arguments, "write_comparison_report")
    names = _names(paths)
    calibrations = [_loaded(arguments, path, name) for path, name in zip(paths, names, strict=True)]
    check_distinct(calibrations)
    comparison = compare(calibrations)
    try:
        common.deliver(
            lambda: _print(comparison),
            (arguments.json, lambda path: common.write_json(path, comparison_document(comparison))),
            (arguments.report, lambda path: write_report(path, comparison)),
        )
    except BrokenPipeError:  # | head: the answer is the exit code all the same
        give_up(sys.stdout)
    return comparison.answer.exit_code


def _names(paths: Sequence[Path]) -> list[str]:
    """Short names, as long as they tell the paths apart."""
    short = [path.name or str(path) for path in paths]
    return short if len(set(short)) == len(short) else list(map(str, paths))


def _loaded(arguments: argparse.Namespace, path: Path, name: str) -> Extrinsics:
    """Of a result file; a bag is calibrated for it."""
    from ..bags.files import is_bag
    from ..files.extrinsics import load_extrinsics

    if not is_bag(path):
        return load_extrinsics(path, name)
    from ..replay.compared import calibrated

    parameters = common.load(arguments)
    recording = common.opened([path], parameters)
    discovery = common.discovered(arguments, recording, parameters)
    with common.progress(f"replaying {name}") as on_progress:
        found = calibrated(recording, discovery.parameters, discovery.topics, name, on_progress)
    common.print_warnings(found.notes)
    return found.extrinsics


# ------------------------------------------------------------------ tables


def _print(comparison: Comparison) -> None:
    from rich.markup import escape

    from ..calibration.comparison_words import reasons, remarks
    from ..errors import printable

    common.print_warnings([str(each) for each in remarks(comparison)])
    out = common.console()
    _, colour = VERDICTS[comparison.answer.severity.value]
    first, *others = (each.full_sentence for each in reasons(comparison))
    out.print(f"[bold {colour}]{comparison.word}[/]: {escape(printable(first))}")
    for sentence in others:
        out.print(escape(printable(sentence)))
    out.print()
    out.print(_calibrations(comparison))
    n = len(comparison.calibrations)
    neighbours = len(comparison.pairs) > MOST_PAIRS
    pairs = [
        pair for pair in comparison.pairs
        if not neighbours or _follow(comparison.calibrations, pair)
    ]  # fmt: skip
    title = "Differences, the later less the earlier" + (" (neighbours; all pairs: --json)" if neighbours else "")
    out.print(_differences(pairs, title, [f"{pair.first.name} → {pair.second.name}" for pair in pairs]))
    if n > 2:
        out.print(
            _differences(
                comparison.against_rest,
                "Each less all others together",
                [each.second.name for each in comparison.against_rest],
            )
        )


def _follow(ordered: Sequence[Extrinsics], pair: Difference) -> bool:
    return any(a is pair.first and b is pair.second for a, b in pairwise(ordered))


def _calibrations(comparison: Comparison) -> Table:
    import numpy as np
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from ..calibration.comparison_words import date
    from ..calibration.frames import rpy_from_rotation
    from ..errors import printable

    table = Table(box=box.SIMPLE_HEAD, caption="± 1σ;  -: not shown by its data", caption_justify="left")
    for column in ("", "from (UTC)", "model"):
        table.add_column(column, overflow="fold")
    for column in ("roll °", "pitch °", "yaw °", "x m", "y m", "z m", "scale %", "late s"):
        table.add_column(column, justify="right", no_wrap=True)
    for each in comparison.calibrations:
        values = [
            *np.degrees(rpy_from_rotation(each.rotation_body_from_dvl)), *each.lever_arm, 100 * each.scale,
            each.time_offset,
        ]  # fmt: skip
        table.add_row(
            escape(printable(each.name)), date(each.first_ns), each.model, *_cells(values, _in_units(each.std))
        )
    return table


def _in_units(values: Iterable[float]) -> list[float]:
    """Components in degrees, m, per cent and s."""
    import math

    factors = (*[math.degrees(1.0)] * 3, 1.0, 1.0, 1.0, 100.0, 1.0)
    return [factor * value for factor, value in zip(factors, values, strict=True)]


def _of(values: Iterable[float], columns: Sequence[int]) -> list[float]:
    shown = _in_units(values)
    return [shown[index] for index in columns]


def _cells(values: Sequence[float], stds: Sequence[float], sign: str = "") -> list[str]:
    return [
        f"{round(value, 2) + 0.0:{sign}.2f} ± {std:.2f}" if std == std else "-"
        for value, std in zip(values, stds, strict=True)
    ]


def _differences(differences: Sequence[Difference], title: str, names: Sequence[str]) -> Table:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from ..calibration.comparison import MOUNTING
    from ..errors import printable

    caption = "angles: turn of the mounting about the body's axes; χ² and its chance probability: angles and lever arm"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, caption=caption, caption_justify="left")
    table.add_column("", overflow="fold")
    names_of = ("about x °", "y °", "z °", "x m", "y m", "z m", "scale %", "late s")
    columns = [index for index in range(len(names_of)) if any(each.compared[index] for each in differences)]
    for column in (*(names_of[index] for index in columns), "mounting's χ², p"):
        table.add_column(column, justify="right", no_wrap=True)
    for each, name in zip(differences, names, strict=True):
        test = each.test(MOUNTING)
        table.add_row(
            escape(printable(name)),
            *_cells(_of(each.value, columns), _of(each.std, columns), "+"),
            f"{test.value:.1f} of {test.freedom}, {_p(test.p)}" if test.freedom else "-",
        )  # fmt: skip
    return table


def _p(p: float) -> str:
    return "-" if p != p else f"{p:.2f}" if p >= 0.01 else f"{p:.0e}"
