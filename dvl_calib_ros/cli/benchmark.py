"""Speed and memory as ratios against a peer in the same run; about nine minutes for all. Linux.

batch     the batch path against filterpy
evaluate  the published procedure against a loop with filterpy (set DVL_CALIB_SNAPIR to a folder of trajectories)
replay    an hour's bag against reading and deserialising it with rosbags
node      the node's CPU against a subscriber that only republishes
latency   from a DVL message to the estimate, against the same subscriber
rate      the node at 1000 Hz for a minute
soak      --minutes of operation at ten times the rates: samples lost, growth of memory and CPU
"""

from __future__ import annotations

import argparse

from . import common

NAME = "benchmark"
HELP = "speed and memory, as ratios against a peer in the same run"
EXAMPLE = "dvl-calib benchmark batch replay"
WHAT = ("batch", "evaluate", "replay", "node", "latency", "rate", "soak")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"of {', '.join(WHAT)}; default: all")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the soak, min; default: %(default)g")
    parser.add_argument("--markdown", action="store_true", help="print the table in Markdown, as in the README")


def run(arguments: argparse.Namespace) -> None:
    """Measure and print."""
    from ..io.errors import InputError

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


def _measure(name: str, minutes: float):  # type: ignore[no-untyped-def]
    if name == "batch":
        from ..benchmark.batch import measure

        return measure()
    if name == "evaluate":
        from ..benchmark.evaluate import measure

        return measure()
    if name == "replay":
        from ..benchmark.replay import measure

        return measure()
    from ..benchmark import node

    if name == "soak":
        return node.measure_soak(minutes)
    return {"node": node.measure_cpu, "latency": node.measure_latency, "rate": node.measure_rate}[name]()
