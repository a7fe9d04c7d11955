"""Recover damaged recordings, all topics, into a new bag that every tool reads, and say how much was recovered."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from . import common

PROGRESS_EVERY = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap or .db3")
    parser.add_argument("-o", "--output", type=Path, required=True, help="bag to write")
    common.add_storage_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Read everything, write it, say what was lost."""
    from ..bags.reader import BagReader
    from ..bags.writer import BagWriter, Compression, Storage
    from ..errors import InputError, printable

    common.check_outputs(arguments, folders=["output"])
    counts: Counter[str] = Counter()
    with BagReader(arguments.bags) as reader:
        topics, total = reader.topics, max(sum(reader.message_counts.values()), 1)
        if not topics:
            raise InputError(f"{', '.join(map(str, arguments.bags))}: there is no message in it; record it again")
        writer = BagWriter(arguments.output, Storage(arguments.storage), Compression(arguments.compression))
        with common.progress("salvaging") as on_progress, writer:
            for number, (log_ns, channel, data) in enumerate(reader.raw_messages(topics)):
                writer.raw(channel, log_ns, data)
                counts[channel.topic] += 1
                if number % PROGRESS_EVERY == 0:
                    on_progress(number / total)
        common.print_warnings(reader.notes)
    for topic, count in sorted(counts.items()):
        print(printable(f"{topic}: {count} messages"))
    print(f"{arguments.output}: {counts.total()} messages")
