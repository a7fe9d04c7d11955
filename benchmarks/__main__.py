"""Speed and memory as ratios against a peer in the same run; about nine minutes for all. Linux.

batch     the batch path against filterpy
commands  CPU of help, doctor, replay and diagnosis as they are typed, against reading the same bags with rosbags
evaluate  the published procedure against a loop with filterpy (set DVL_CALIB_SNAPIR to a folder of trajectories)
replay    an hour's bag against reading and deserialising it with rosbags
node      the node's CPU against a subscriber that only republishes
latency   from a DVL message to the estimate, against the same subscriber
rate      the node at 1000 Hz for a minute
soak      --minutes of operation at ten times the rates: samples lost, growth of memory and CPU

Each part is measured by itself: one that fails is said and counted, and the others go on. Exit code: 0, 1 where a part
failed or a ratio is worse than the baseline, 2 for what cannot be asked.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path

# as `dvl-calib` does: more threads of BLAS only wait for each other. Before numpy is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")

from dvl_calib_ros.cli import common
from dvl_calib_ros.disk.atomic import check_writable
from dvl_calib_ros.errors import InputError

from . import Measurement
from .results import WORSE, Baseline, Part, Run

Measure = Callable[[argparse.Namespace], list[Measurement]]


def _part(module: str, function: str, *options: str) -> Measure:
    """A function of one of these modules, which imports its peer, and only that, once it is measured."""

    def measure(arguments: argparse.Namespace) -> list[Measurement]:
        found = getattr(import_module(f"{__package__}.{module}"), function)
        measured: list[Measurement] = found(**{name: getattr(arguments, name) for name in options})
        return measured

    return measure


PARTS: Mapping[str, Measure] = {
    "batch": _part("batch", "measure"),
    "commands": _part("commands", "measure", "quick"),
    "evaluate": _part("evaluate", "measure"),
    "replay": _part("replay", "measure", "quick"),
    "node": _part("node", "measure_cpu"),
    "latency": _part("node", "measure_latency"),
    "rate": _part("node", "measure_rate"),
    "soak": _part("node", "measure_soak", "minutes"),
}


def main(argv: Sequence[str] | None = None, parts: Mapping[str, Measure] = PARTS) -> int:
    """Measure and print; see the module's exit codes."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=(__doc__ or "").strip(),
        epilog="example: python -m benchmarks batch replay commands --quick --against benchmarks/baseline.json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"of {', '.join(parts)}; default: all")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the soak, min; default: %(default)g")
    parser.add_argument("--quick", action="store_true", help="fewer rounds, and of the commands only the short ones")
    parser.add_argument("--markdown", action="store_true", help="print the table in Markdown, as in the documentation")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured, after every part")
    parser.add_argument(
        "--against", type=Path, metavar="FILE",
        help=f"a file of --json: fail where a ratio is worse than there by more than {WORSE:g} times",
    )  # fmt: skip
    try:
        return _run(parser.parse_args(argv), parts)
    except InputError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2


def _run(arguments: argparse.Namespace, parts: Mapping[str, Measure]) -> int:
    chosen = list(dict.fromkeys(arguments.what)) or list(parts)
    for name in chosen:
        if name not in parts:
            raise InputError(f"{name!r} is no benchmark; there are {', '.join(parts)}")
    if not 2.0 <= arguments.minutes <= 100_000.0:
        raise InputError(f"--minutes: {arguments.minutes:g} is outside 2 .. 100000")
    if arguments.json:
        check_writable(arguments.json)
    baseline = Baseline(arguments.against) if arguments.against else None
    run, unsaved = Run({}, os.getloadavg()[0]), ""
    for name in chosen:
        print(f"measuring: {name}", file=sys.stderr)
        run.parts[name] = _measured(parts[name], arguments)
        if arguments.json:
            try:
                run.save(arguments.json)
                unsaved = ""
            except InputError as error:  # a disk that fills up on the way does not cost what is printed
                unsaved = str(error)
    _print([each for part in run.parts.values() for each in part.measurements], arguments.markdown)
    print(f"load of the machine: {run.load_at_start:.2f} at the beginning, {os.getloadavg()[0]:.2f} at the end")
    failed = [f"{name}: failed: {part.failed}" for name, part in run.parts.items() if part.failed]
    worse = [] if baseline is None else list(baseline.worse(run))
    for line in [] if baseline is None else baseline.unknown(run):
        print(line, file=sys.stderr)
    for line in [*failed, *worse, *([unsaved] if unsaved else [])]:
        print(line, file=sys.stderr)
    if failed:
        print(f"{len(failed)} of {len(chosen)} parts failed", file=sys.stderr)
    if worse and baseline is not None:
        print(
            f"{len(worse)} ratios are worse than those of {baseline.commit} by more than {WORSE:g} times",
            file=sys.stderr,
        )
    return 1 if failed or worse or unsaved else 0


def _measured(measure: Measure, arguments: argparse.Namespace) -> Part:
    try:
        return Part(measure(arguments))
    except Exception as error:  # whatever it is: the other parts are measured, and what was measured is kept
        said = " ".join(str(error).split())
        return Part([], f"{type(error).__name__}: {said}" if said else type(error).__name__)


def _print(measurements: Sequence[Measurement], markdown: bool) -> None:
    if markdown:
        print("| what | ours | peer | ratio | target |\n|---|---|---|---|---|")
        for each in measurements:
            print(f"| {each.what} | {each.ours} | {each.peer} | {each.ratio} | {each.target} |")
        return
    from rich.table import Table

    table = Table("what", "ours", "peer", "ratio", "target", "met")
    for each in measurements:
        table.add_row(*each[:5], "yes" if each.met else "[red]no[/]")
    common.console().print(table)


if __name__ == "__main__":
    sys.exit(main())
