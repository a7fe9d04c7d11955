"""`python -m validation figures`: measure, write, check."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from dvl_calib_ros.errors import InputError

from . import pages, performance, stored
from .measured import MEASUREMENTS
from .registry import CHEAP, Measurement, MissingDataError

# What tells how a measurement was made
_NOT_COMPARED = ("made", "at", "load", "commit", "date", "command", "seeds")


def main(argv: Sequence[str]) -> int:
    """0, or 1 if a figure or picture is not as on the page. Raises InputError."""
    parser = argparse.ArgumentParser(
        prog="python -m validation figures",
        description="Measure NAMES, or all figures of README.md and docs/, store them and write them there.",
        epilog="measurements: " + ", ".join(f"{each.name} ({each.cost})" for each in MEASUREMENTS.values()),
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--render", action="store_true", help="write the pages from what is stored; nothing is measured")
    what.add_argument(
        "--check", action="store_true", help="measure what is cheap (or NAMES), and fail where a page says otherwise"
    )
    what.add_argument("--pictures", action="store_true", help="make the pictures NAMES, or all; needs chromium")
    parser.add_argument(
        "--benchmarks", type=Path, metavar="FILE", action="append",
        help="take what `python -m benchmarks --json FILE` wrote, else run it; may be given again, for other parts",
    )  # fmt: skip
    parser.add_argument("names", nargs="*", metavar="NAMES", help="measurements, or pictures")
    arguments = parser.parse_args(argv)
    if arguments.benchmarks:
        performance.take(arguments.benchmarks)
    if arguments.pictures:
        from . import pictures

        pictures.make(arguments.names)
        return 0
    if arguments.render:
        for changed in pages.render():
            print(f"written: {changed}")
        return 0
    if arguments.check:
        return _check(_chosen(arguments.names, [each for each in MEASUREMENTS.values() if each.cost == CHEAP]))
    for each in _chosen(arguments.names, list(MEASUREMENTS.values())):
        try:
            found = _measured(each, stored.head())
        except MissingDataError as why:
            print(f"skipped: {each.name}: {why}")
            continue
        stored.save(found)
    pages.forget()
    for changed in pages.render():
        print(f"written: {changed}")
    return 0


def _chosen(names: Sequence[str], otherwise: list[Measurement]) -> list[Measurement]:
    for name in names:
        if name not in MEASUREMENTS:
            raise InputError(f"{name!r} is no measurement; there are {', '.join(MEASUREMENTS)}")
    return [MEASUREMENTS[name] for name in names] or otherwise


def _measured(each: Measurement, commit: str = "") -> stored.Stored:
    """commit: that it is stored for. Raises MissingDataError, and InputError for a command that failed."""
    print(f"measuring: {each.name}: {each.command}", flush=True)
    before, started = stored.load_average(), time.monotonic()
    try:
        with tempfile.TemporaryDirectory() as folder:
            found = each.run(Path(folder))
    except subprocess.CalledProcessError as error:
        said = " ".join((error.stderr or "").split())[-300:]
        raise InputError(
            f"{each.name}: {' '.join(map(str, error.cmd))} ended with {error.returncode}: {said}"
        ) from error
    print(f"  {len(found)} values in {time.monotonic() - started:.0f} s", flush=True)
    return stored.stored_of(each, found, (before, stored.load_average()), commit)


def _check(chosen: list[Measurement]) -> int:
    """Pages against what is stored, what is stored against what is measured now, pictures against the history."""
    from . import pictures

    wrong = pages.differing()
    uses = [use for use in pages.uses() if use.value not in _NOT_COMPARED]
    checked = skipped = 0
    for each in chosen:
        used = [use for use in uses if use.measurement == each.name]
        if not used:
            continue
        try:
            now = _measured(each)
        except MissingDataError as why:
            skipped += len(used)
            print(f"skipped: {each.name}: {why}; {len(used)} figures not checked")
            continue
        except InputError as error:
            wrong.append(str(error))
            continue
        written = stored.load(each.name)
        checked += len(used)
        for use in used:
            one, other = written.values[use.value], now.values.get(use.value)
            if other is None:
                checked -= 1
                if not each.partial:
                    wrong.append(f"{use.page}, block {use.block}: {use.value} of {each.name} is not measured any more")
            elif one.differs(other):
                wrong.append(
                    f"{use.page}, block {use.block}: {use.value} of {each.name} is {one} on the page, "
                    f"{other} as measured now; it may differ by {one.tolerance:.3g}"
                )
    left = len(uses) - checked - skipped
    try:
        wrong += pictures.not_of_this_history()
    except InputError as why:  # a copy without a history
        print(f"skipped: pictures: {why}; their commits are not checked")
    for line in wrong:
        print(line, file=sys.stderr)
    print(f"{checked} figures checked, {skipped} skipped, {left} of other measurements; {len(wrong)} wrong")
    return 1 if wrong else 0
