"""Ten faults put into the ten most important rules, one at a time, in a copy of the tree: the tests must see each.

The tests named with each are the smallest set that is to see it; they pass in the copy as it is.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dvl_calib_ros.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 120.0
UNIT = "test/unit/"
COPIED = ("dvl_calib_ros", "test", "bags", "config", "docs", "validation", "benchmarks", "pyproject.toml", "README.md")


class Mutant(NamedTuple):
    """A rule, and how it is broken: `old`, which stands once in the file `path`, becomes `new`. tests: see above."""

    rule: str
    path: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTANTS = (
    Mutant(
        "sign of H",
        "dvl_calib_ros/calibration/models/published.py",
        "h[:, axis, column] = -r[:, axis]",
        "h[:, axis, column] = r[:, axis]",
        (UNIT + "calibration/test_models.py::test_h_is_the_derivative_of_the_nonlinear_error_model",),
    ),
    Mutant(
        "frame",
        "dvl_calib_ros/calibration/numerics/frames.py",
        "[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])",
        "[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])",
        (UNIT + "calibration/test_calibrator.py::test_gnss_models_recover_the_errors_from_a_reference_in_any_frame",),
    ),
    Mutant(
        "gate",
        "dvl_calib_ros/calibration/numerics/kalman.py",
        "is_used = usable[i] and nis_i <= gate[i]",
        "is_used = usable[i]",
        (UNIT + "calibration/test_kalman.py",),
    ),
    Mutant(
        "pairing by stamps",
        "dvl_calib_ros/calibration/streams/pairing.py",
        "earlier + (later - earlier) * fraction[:, None]",
        "earlier + (later - earlier) * (1.0 - fraction[:, None])",
        (UNIT + "calibration/test_alignment.py",),
    ),
    Mutant(
        "covariance",
        "dvl_calib_ros/calibration/numerics/kalman.py",
        "p = ikh @ p @ ikh.T + gain @ r_i @ gain.T",
        "p = ikh @ p @ ikh.T",
        (UNIT + "calibration/test_kalman.py",),
    ),
    Mutant(
        "order of saves",
        "dvl_calib_ros/disk/atomic.py",
        "        os.fsync(handle)\n        yield temporary\n",
        "        yield temporary\n",
        (UNIT + "disk/test_atomic.py",),
    ),
    Mutant(
        "unit",
        "dvl_calib_ros/files/parameter_files.py",
        "return math.radians(float(found[1])) if found",
        "return float(found[1]) if found",
        ("test/integration/test_stacks.py::test_angles_on_the_command_line_may_be_in_degrees",),
    ),
    Mutant(
        "limit of the verdict",
        "dvl_calib_ros/calibration/results/held_out_verification.py",
        "if corrected > predicted * parameters.max_error_ratio * by_chance:",
        "if corrected > predicted * parameters.max_error_ratio * by_chance * 1.1:",
        (UNIT + "calibration/test_verification.py",),
    ),
    Mutant(
        "tie of discovery",
        "dvl_calib_ros/discovery/topic_choice.py",
        "sorted((order, preview.topic) for order, preview in ranked)",
        "sorted(((order, preview.topic) for order, preview in ranked), key=lambda entry: entry[0])",
        (UNIT + "discovery/test_choose.py",),
    ),
    Mutant(
        "checksum of salvage",
        "dvl_calib_ros/bags/salvage/mcap_records.py",
        "elif head.checksum and crc32(records) != head.checksum:",
        "elif head.checksum and False:",
        (UNIT + "bags/test_damaged_bags.py::test_corrupt_bytes_anywhere_never_give_a_message_that_was_not_recorded",),
    ),
)


def main(argv: Sequence[str]) -> int:
    """Try them and print; 0, or 1 if one survives, or if its tests fail without it."""
    parser = argparse.ArgumentParser(
        prog="python -m validation mutants", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rule", nargs="*", help=f"of: {', '.join(each.rule for each in MUTANTS)}; default: all")
    chosen = _named(parser.parse_args(argv).rule)
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, copy / name)
        failed, output = tests_in(copy, sorted({test for each in chosen for test in each.tests}))
        if failed is not None or output:
            print(f"{output}\nthe tests do not pass without a fault: {failed}")
            return 1
        for number, each in enumerate(chosen, start=1):
            print(f"{each.rule:<22}", end="", flush=True)
            by, output = _with(copy, each, number)
            bad += by is None
            print(f"killed by {by}" if by else f"SURVIVED {', '.join(each.tests)} {output}", flush=True)
    print(f"{len(chosen) - bad} of {len(chosen)} killed")
    return 1 if bad else 0


def _named(rules: Sequence[str]) -> list[Mutant]:
    of = {each.rule: each for each in MUTANTS}
    for rule in rules:
        if rule not in of:
            raise InputError(f"mutants: {rule!r} is no rule; there are {', '.join(of)}")
    return [of[rule] for rule in rules or of]


def _with(copy: Path, mutant: Mutant, number: int) -> tuple[str | None, str]:
    """`tests_in` with one fault, which is then taken out again."""
    path = copy / mutant.path
    before, times = path.read_text(encoding="utf-8"), path.stat()
    if (n := before.count(mutant.old)) != 1:
        raise InputError(f"mutants: {mutant.rule}: {mutant.old!r} stands {n} times in {mutant.path}, not once")
    path.write_text(before.replace(mutant.old, mutant.new), encoding="utf-8")
    # Python knows by time and size what it has compiled
    os.utime(path, (times.st_atime, times.st_mtime + 10 * number))
    try:
        return tests_in(copy, mutant.tests)
    finally:
        path.write_text(before, encoding="utf-8")
        os.utime(path, (times.st_atime, times.st_mtime))


def tests_in(folder: Path, tests: Sequence[str]) -> tuple[str | None, str]:
    """The first of these tests that fails in a tree, None if none does; and what was said if they could not be run."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=short", "-rfE", "-p", "no:cacheprovider", *tests]
    # one that is installed must not be taken for that of the folder
    environment = os.environ | {"PYTHONPATH": str(folder)}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, text=True, timeout=PATIENCE_S,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None, f"they do not end within {PATIENCE_S:.0f} s"
    if done.returncode == 0:
        return None, ""
    failed = re.search(r"^FAILED (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return (failed[1], "") if done.returncode == 1 and failed else (None, done.stdout)
