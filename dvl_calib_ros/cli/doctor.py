"""Examine a recording before calibration: its topics, its faults, and whether it can calibrate.

One page: topics and rates, position of the DVL, every fault with its remedy, what the motion makes observable, and the
next command. With --live, record the topics of a running system for some seconds and examine them.

Exit code 0: the recording, or a part of it, can calibrate. 1: it cannot. 2: bad usage or input.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import InputError
from ..standard_streams import say
from . import common

LIVE_S = 20.0
# interval of the search for new topics, s
LOOK_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG", help="rosbag2 folder, .mcap, .db3 or .bag")
    parser.add_argument(
        "--live", nargs="?", type=float, const=LIVE_S, metavar="S",
        help="examine the current ROS 2 topics for S seconds, not a bag; without a number: %(const)g",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    common.add_report_option(parser)
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Examine, print, save. Return 1 for a recording that cannot calibrate."""
    from ..examination.examine import examine
    from ..present import examination as present

    _check_arguments(arguments)
    common.check_outputs(arguments, "json", "report")
    parameters = common.load(arguments)
    with _recordings(arguments) as bags:
        examination = examine(common.opened(bags, parameters), parameters, common.given(arguments))
    is_live, named = arguments.live is not None, common.options_given(arguments)
    common.deliver(
        lambda: common.print_document(present.examination(examination, is_live, named)),
        *common.result_files(arguments, examination),
    )
    return int(examination.verdict == "no")


def _check_arguments(arguments: argparse.Namespace) -> None:
    """Raise InputError unless either bags or a valid live duration are given."""
    if bool(arguments.bags) == (arguments.live is not None):
        raise InputError(
            "name a BAG, or give --live for a running system" if not arguments.bags else "a BAG or --live, not both"
        )
    if arguments.live is not None and not 1.0 <= arguments.live <= 3600.0:
        raise InputError(f"--live: {arguments.live:g} is outside 1 .. 3600 s")


@contextmanager
def _recordings(arguments: argparse.Namespace) -> Iterator[list[Path]]:
    """Yield the recordings to examine; a live one is deleted afterwards. Raises InputError."""
    if arguments.live is None:
        yield arguments.bags
        return
    with TemporaryDirectory(prefix="dvl_calib_") as folder:
        path = Path(folder) / "live"
        _record(path, arguments.live)
        yield [path]


def _record(path: Path, seconds: float) -> None:
    """Record the live topics for some seconds. Raises InputError if nothing comes."""
    from ..bags.writer import BagWriter

    with common.ros_node("--live", "dvl_calib_doctor") as (node, ending):
        from rclpy.executors import SingleThreadedExecutor

        from ..node.topic_recorder import TopicRecorder

        executor = SingleThreadedExecutor()
        executor.add_node(node)
        with BagWriter(path) as writer, common.progress("listening") as on_progress:
            recorder = TopicRecorder(node, writer)
            began = looked = time.monotonic()
            recorder.look()
            while (now := time.monotonic()) < began + seconds and not ending.requested:
                if now > looked + LOOK_S:
                    recorder.look()
                    looked = now
                    on_progress((now - began) / seconds)
                executor.spin_once(timeout_sec=LOOK_S)
        if recorder.failed is not None:
            raise recorder.failed
        for why in recorder.left_out.values():
            say(f"warning: {why}")
        if not recorder.counts:
            raise InputError(
                f"no message of a DVL, a reference or an IMU came within {time.monotonic() - began:.0f} s; check "
                "that the drivers run (ros2 topic list), ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE"
            )
