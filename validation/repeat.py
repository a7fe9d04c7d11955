"""The suite as the README has it, or its live part, many times over: one line a run, a log of each that failed."""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dvl_calib_ros.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
SUITE = ("-q", "-n", "3", "--dist", "worksteal")
LIVE = (*SUITE, "test/live")  # what goes over DDS
MOST = 10_000


class Run(NamedTuple):
    """What one run of pytest came to; load: what the machine had to do in the minute before it."""

    code: int
    passed: int
    failed: int
    seconds: float
    load: float
    output: str


def main(argv: Sequence[str]) -> int:
    """Run and print; 0, or 1 if any run failed."""
    parser = argparse.ArgumentParser(
        prog="python -m validation repeat", description=__doc__, epilog="example: ... repeat --live --times 50"
    )
    parser.add_argument("--times", type=int, default=20, help=f"1 to {MOST}; default: %(default)s")
    parser.add_argument("--live", action="store_true", help="only the tests over DDS")
    parser.add_argument("--logs", type=Path, default=Path("repeat_logs"), help="folder for failures; %(default)s")
    arguments = parser.parse_args(argv)
    if not 1 <= arguments.times <= MOST:
        raise InputError(f"--times: {arguments.times} is outside 1 .. {MOST}")
    bad = 0
    for number in range(1, arguments.times + 1):
        run = _run_once(LIVE if arguments.live else SUITE)
        said = f"{number:4d}  passed {run.passed}  failed {run.failed}  {run.seconds:.0f} s  load {run.load:.2f}"
        if run.code:
            bad += 1
            said += f"  {_keep(run, arguments.logs, number)}"
        print(said, flush=True)
    print(f"{bad} of {arguments.times} runs failed")
    return 1 if bad else 0


def _run_once(arguments: Sequence[str]) -> Run:
    load = os.getloadavg()[0]
    began = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seconds = time.monotonic() - began
    counts = {what: int(n) for n, what in re.findall(r"(\d+) (passed|failed|errors?)\b", done.stdout[-300:])}
    failed = counts.get("failed", 0) + counts.get("error", 0) + counts.get("errors", 0)
    return Run(done.returncode, counts.get("passed", 0), failed, seconds, load, done.stdout)


def _keep(run: Run, folder: Path, number: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{time.strftime('%Y%m%dT%H%M%S')}_{number}.log"
    path.write_text(run.output)
    return path
