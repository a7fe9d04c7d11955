"""Speed and memory as ratios against a peer in the same run; about nine minutes for all. Linux.

batch     the batch path against filterpy
commands  CPU of help, doctor, replay and diagnosis as they are typed, against an interpreter that does nothing
evaluate  the published procedure against a loop with filterpy (set DVL_CALIB_SNAPIR to a folder of trajectories)
replay    an hour's bag against reading and deserialising it with rosbags
node      the node's CPU against a subscriber that only republishes
latency   from a DVL message to the estimate, against the same subscriber
rate      the node at 1000 Hz for a minute
soak      --minutes of operation at ten times the rates: samples lost, growth of memory and CPU
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence

# as `dvl-calib` does: more threads of BLAS only wait for each other. Before numpy is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")

from dvl_calib_ros.cli import common
from dvl_calib_ros.errors import InputError

from . import Measurement

WHAT = ("batch", "commands", "evaluate", "replay", "node", "latency", "rate", "soak")


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; 0, or 2 with one line on standard error for what cannot be measured."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=(__doc__ or "").strip(),
        epilog="example: python -m benchmarks batch replay",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"of {', '.join(WHAT)}; default: all")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the soak, min; default: %(default)g")
    parser.add_argument("--markdown", action="store_true", help="print the table in Markdown, as in the documentation")
    try:
        _run(parser.parse_args(argv))
    except InputError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    return 0


def _run(arguments: argparse.Namespace) -> None:
    chosen = arguments.what or WHAT
    for name in chosen:
        if name not in WHAT:
            raise InputError(f"{name!r} is no benchmark; there are {', '.join(WHAT)}")
    if not 2.0 <= arguments.minutes <= 100_000.0:
        raise InputError(f"--minutes: {arguments.minutes:g} is outside 2 .. 100000")
    errors = common.console(stderr=True)
    measurements = []
    for name in chosen:
        errors.print(f"measuring: {name}")
        measurements += _measure(name, arguments.minutes)
    if arguments.markdown:
        print("| what | ours | peer | ratio | target |\n|---|---|---|---|---|")
        for each in measurements:
            print(f"| {each.what} | {each.ours} | {each.peer} | {each.ratio} | {each.target} |")
        return
    from rich.table import Table

    table = Table("what", "ours", "peer", "ratio", "target", "met")
    for each in measurements:
        table.add_row(*each[:5], "yes" if each.met else "[red]no[/]")
    common.console().print(table)


def _measure(name: str, minutes: float) -> list[Measurement]:
    # each imports its peer, and only that
    if name in ("node", "latency", "rate", "soak"):
        from . import node

        if name == "soak":
            return node.measure_soak(minutes)
        return {"node": node.measure_cpu, "latency": node.measure_latency, "rate": node.measure_rate}[name]()
    from . import batch, commands, evaluate, replay

    modules = {"batch": batch, "commands": commands, "evaluate": evaluate, "replay": replay}
    measure: Callable[[], list[Measurement]] = modules[name].measure
    return measure()


if __name__ == "__main__":
    sys.exit(main())
