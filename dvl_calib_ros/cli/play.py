"""Play recorded bags over ROS 2 like `ros2 bag play`, also where that is not installed, and also damaged bags.

All topics whose message packages are installed are published, with the recorded bytes and unchanged stamps. pip has no
tf2_msgs; without it, /tf_static is published as joints of /robot_description, which the calibration node also reads.
Needs ROS 2 Jazzy (or pip install 'dvl_calib_ros[ros]').
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from ..standard_streams import say, show
from . import common

if TYPE_CHECKING:
    from ..bags.reader import BagReader
    from ..demo.player import BagPlayer

# time without subscribers before a message names their topics, s; discovery takes less
SAID_AFTER_S = 2.0
RATES = (0.01, 1000.0)
DESCRIPTION = "/robot_description"
TF_MISSING = "tf2_msgs is not installed, and pip does not have it; for TF itself: apt install ros-jazzy-tf2-msgs"
CLOCKS_HZ = (0.1, 1000.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap, .db3 or .bag file")
    parser.add_argument("-r", "--rate", type=float, default=1.0, help="multiple of real time; default: %(default)g")
    parser.add_argument("-l", "--loop", action="store_true", help="repeat until Ctrl-C")
    parser.add_argument(
        "-d", "--delay", type=float, default=0.0, metavar="S", help="wait S seconds before the first message"
    )
    parser.add_argument("--start-offset", type=float, default=0.0, metavar="S", help="begin S seconds into the bag")
    parser.add_argument(
        "--playback-duration", type=float, default=float("inf"), metavar="S", help="play S seconds of the bag"
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play only these topics")
    parser.add_argument(
        "-m", "--remap", nargs="+", default=[], metavar="OLD:=NEW", help="publish a topic by another name"
    )
    parser.add_argument(
        "--clock", nargs="?", type=float, const=40.0, default=0.0, metavar="HZ",
        help="publish /clock at this rate in time of the bag; without a number: 40",
    )  # fmt: skip
    parser.add_argument("--wait", action="store_true", help="begin when every topic has a subscriber")


def run(arguments: argparse.Namespace) -> None:
    """Play until the end, or until Ctrl-C. Raises InputError."""
    from ..bags.reader import BagReader

    _check_arguments(arguments)
    start, duration = arguments.start_offset, arguments.playback_duration
    with common.ros_node("play", "dvl_calib_player") as (node, ending):
        from ..demo.player import BagPlayer, wait_until

        with BagReader(arguments.bags) as bag:
            targets, static = _targets(bag, arguments.topics, arguments.remap)
            description = _description(bag, static, targets) if static else ""
            seconds = 1e-9 * (bag.span_ns[1] - bag.span_ns[0])
        if start >= seconds:
            raise InputError(f"--start-offset {start:g}: the recording has {seconds:.1f} s")

        def has_ended() -> bool:
            return ending.requested

        # the recorded description would replace the extended one
        recorded = [name for name in targets if description and name.strip("/") == DESCRIPTION.strip("/")]
        topic = next(map(targets.pop, recorded), DESCRIPTION)
        player = BagPlayer(node, arguments.bags, targets, clock_hz=arguments.clock)
        if description:
            player.describe(description, topic)
        if arguments.wait:
            _wait_for_subscribers(player, has_ended)
        wait_until(time.monotonic() + arguments.delay, has_ended)
        total = 0
        with common.progress("playing") as on_progress:

            def on_time(at: float, _: object) -> None:
                on_progress((at - start) / min(duration, seconds - start))

            while not ending.requested:
                total += sum(player.play(arguments.rate, on_time, start, duration, has_ended).values())
                if not arguments.loop:
                    break
        show(f"published {total} messages of {len(targets)} topics")


def _wait_for_subscribers(player: BagPlayer, has_ended: Callable[[], bool]) -> None:
    """Wait until every published topic has a subscriber, and print which ones have none."""
    from ..demo.player import BREATH_S

    began, is_said = time.monotonic(), False
    while (unheard := player.unheard) and not has_ended():
        if not is_said and time.monotonic() - began > SAID_AFTER_S:
            say(f"waiting for subscribers of {', '.join(unheard)}")
            is_said = True
        time.sleep(BREATH_S)


def _check_arguments(arguments: argparse.Namespace) -> None:
    """Raise InputError for an option outside its range."""
    for name, (low, high) in (("rate", RATES), ("clock", CLOCKS_HZ)):
        value = getattr(arguments, name)
        if not low <= value <= high and (value or name == "rate"):
            raise InputError(f"--{name}: {value:g} is outside {low:g} .. {high:g}")
    if not arguments.playback_duration > 0.0:
        raise InputError("--playback-duration: give a number of seconds, above 0")
    for name in ("delay", "start_offset"):
        if not getattr(arguments, name) >= 0.0:
            raise InputError(f"--{name.replace('_', '-')}: give a number of seconds, 0 or more")


def _description(bag: BagReader, static: Sequence[str], played: Mapping[str, str]) -> str:
    """Return the URDF to publish: the recorded one, if played, with the transforms of `static` topics as joints."""
    from ..discovery.transforms import FrameTree
    from ..recordings.recording import MOST_STATIC

    topics = [*static, *(name for name in played if name.strip("/") == DESCRIPTION.strip("/"))]
    transforms, text = [], ""
    for topic, _, message, _ in islice(bag.messages(topics), MOST_STATIC):
        if message is not None and topic in static:
            transforms += message.transforms
        elif message is not None:
            text = message.data
    return FrameTree.of(transforms, []).as_urdf(text)


def _targets(bag: BagReader, topics: Sequence[str] | None, remap: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Map topics to published names; list static transforms that cannot be published. Raises InputError."""
    from ..node.message_types import message_class
    from ..recordings.recording import is_static
    from ..recordings.topics import spelled

    def found(name: str, option: str) -> str:
        """Return a topic as spelled in the recording. Raises InputError if it is missing."""
        spelled_topic = spelled(name, bag.topics)
        if spelled_topic is None:
            raise InputError(f"{option}: {name} is not in the recording, which has {', '.join(sorted(bag.topics))}")
        return spelled_topic

    renamed = {}
    for each in remap:
        old, separator, new = each.partition(":=")
        if not (separator and old and new):
            raise InputError(f"--remap: {each!r} is not OLD:=NEW")
        renamed[found(old, "--remap")] = new
    targets: dict[str, str] = {}
    static = []
    for name in bag.topics if topics is None else [found(topic, "--topics") for topic in topics]:
        try:
            message_class(f"{name} of the bag holds", bag.topics[name])
        except InputError as error:
            if is_static(name, bag.topics[name]):
                static.append(name)
                common.print_warnings([f"{name} is published as joints of {DESCRIPTION}: {TF_MISSING}"])
                continue
            if topics is not None:
                raise
            common.print_warnings([f"{error}; not played"])
            continue
        targets[name] = renamed.get(name, name)
    if not targets and not static:
        raise InputError("no topic whose message package is installed; nothing can be played")
    return targets, static
