"""Measurements by name: what each costs, the command that makes it, and how far its values may be off."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# a number, a text, or (a number, its lower and upper 95 % bound, of how many)
Found = Mapping[str, float | str | tuple[float, float, float, int]]
# name, or pattern of names: absolute, or a share of the value in per cent
Tolerances = Mapping[str, float | str]
CHEAP, LONG = "cheap", "long"


class MissingDataError(Exception):
    """A data set that is not on this machine; says which, and how to name it."""


@dataclass(frozen=True)
class Measurement:
    """run: works in an empty folder. command: what a reader would type for it. seeds: as it has them, in words.

    partial: a check measures some of the values only. A value `rows` shows the others as text, which is
    not compared.
    """

    name: str
    cost: str
    command: str
    seeds: str
    tolerances: Tolerances
    run: Callable[[Path], Found]
    partial: bool = False

    def tolerance(self, name: str, value: float) -> float:
        """How far a measured value of this name may be from the stored one."""
        for pattern, tolerance in self.tolerances.items():
            if fnmatchcase(name, pattern):
                if isinstance(tolerance, str):
                    return abs(value) * float(tolerance.removesuffix("%")) / 100.0
                return tolerance
        raise KeyError(f"{self.name}: no tolerance for {name}")


MEASUREMENTS: dict[str, Measurement] = {}


def measurement(
    *, cost: str, command: str, tolerances: Tolerances, seeds: str = "none", partial: bool = False
) -> Callable[[Callable[[Path], Found]], Callable[[Path], Found]]:
    """Register a function under its own name."""

    def register(run: Callable[[Path], Found]) -> Callable[[Path], Found]:
        MEASUREMENTS[run.__name__] = Measurement(run.__name__, cost, command, seeds, tolerances, run, partial)
        return run

    return register


def dvl_calib(*arguments: object) -> str:
    """Output of a command of this tree. Raises CalledProcessError with what it said.

    In this process and from its folder: what a command imports takes as long as many of them take.
    """
    from dvl_calib_ros.cli.main import main

    command, before = [str(each) for each in arguments], Path.cwd()
    said, warned = io.BytesIO(), io.BytesIO()
    output, errors = (io.TextIOWrapper(each, encoding="utf-8", write_through=True) for each in (said, warned))
    os.chdir(ROOT)
    try:
        with redirect_stdout(output), redirect_stderr(errors):
            code: int | str | None = main(command)
    except SystemExit as end:  # of a command that there is not
        code = end.code
    finally:
        os.chdir(before)
    if code not in (None, 0, 1):  # 1: what was asked is rejected, which is an answer
        number = code if isinstance(code, int) else 2
        raise subprocess.CalledProcessError(number, command, said.getvalue().decode(), warned.getvalue().decode())
    return said.getvalue().decode()


def by_itself(*arguments: object) -> str:
    """`dvl_calib` in a process of its own."""
    return _run(["dvl_calib_ros.cli.main", *map(str, arguments)])


def validation(*arguments: object) -> str:
    """Output of another command of `python -m validation`. Raises CalledProcessError with what it said."""
    return _run(["validation", *map(str, arguments)])


def _run(module: Sequence[str]) -> str:
    command = [sys.executable, "-m", *module]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    if done.returncode not in (0, 1):
        raise subprocess.CalledProcessError(done.returncode, command, done.stdout, done.stderr)
    return done.stdout


def snapir() -> Path:
    """Folder of the Snapir sea trials. Raises MissingDataError."""
    named = os.environ.get("DVL_CALIB_SNAPIR")
    shared = Path(os.environ.get("DVL_CALIB_SHARED", ROOT.parent / "shared"))
    folder = Path(named) if named else shared / "data" / "snapir"
    if not (folder / "T12_dvl.csv").is_file():
        raise MissingDataError(f"no Snapir data in {folder}; name its folder in DVL_CALIB_SNAPIR")
    return folder.resolve()


def snapir_ins() -> Path:
    """Folder of the five recordings with the vehicle's INS, beside the other. Raises MissingDataError."""
    folder = snapir().parent / "snapir_ins"
    if not (folder / "T01_gnss.csv").is_file():
        raise MissingDataError(f"no Snapir INS data in {folder}; it lies beside the folder that DVL_CALIB_SNAPIR names")
    return folder
