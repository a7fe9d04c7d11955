"""Recover all topics of damaged recordings into a new bag that every tool reads, and report the losses."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..standard_streams import show
from . import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap, .db3 or .bag")
    parser.add_argument("-o", "--output", type=Path, required=True, help="bag to write")
    common.add_storage_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Read everything, write it, report the losses."""
    from ..bags.writer import Compression, Storage, recover
    from ..present.numbers import counted

    common.check_outputs(arguments, folders=["output"])
    storage, compression = Storage(arguments.storage), Compression(arguments.compression)
    with common.progress("salvaging") as on_progress:
        recovered = recover(arguments.bags, arguments.output, storage, compression, on_progress)
    common.print_warnings(recovered.notes)
    for topic, count in recovered.counts.items():
        show(f"{topic}: {counted(count, 'message')}")
    show(f"{arguments.output}: {counted(sum(recovered.counts.values()), 'message')}")
