"""The live part of `simulate`: publish what would be written, or follow a vehicle of another simulator."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..simulation.scenario import Scenario

# Options of simulate that make a motion, which an odometry topic gives instead
MOTION_OPTIONS = ("trajectory", "motion_of", "duration", "waves")
SPEEDS = (0.01, 1000.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments, in a group of their own."""
    from ..messages.drivers import TWIST_TYPE

    live = parser.add_argument_group("live", "publish DVL, GNSS and IMU on ROS 2 instead of writing a bag")
    live.add_argument("--live", action="store_true", help="publish; stamps begin now, or are those of the odometry")
    live.add_argument(
        "--follow", metavar="TOPIC",
        help="nav_msgs/Odometry of a vehicle that is driven elsewhere, such as by another simulator; until Ctrl-C",
    )  # fmt: skip
    live.add_argument(
        "--speed", type=float, default=1.0, help="times real time, without --follow; default: %(default)g"
    )
    live.add_argument("--wait", action="store_true", help="begin when DVL, GNSS and IMU have a subscriber each")
    live.add_argument(
        "--dvl-type", default=TWIST_TYPE, metavar="TYPE", help="of the DVL's messages; default: %(default)s"
    )
    common.add_topic_options(live)
    live.add_argument("--ros-args", nargs=argparse.REMAINDER, default=[], dest="ros_args", help=argparse.SUPPRESS)


def check(arguments: argparse.Namespace, defaults: argparse.Namespace) -> None:
    """Raise InputError for options that do not go together. defaults: of all options."""
    from ..errors import InputError

    if not arguments.live:
        if arguments.output is None:
            raise InputError("name a bag to write, or publish with --live")
        if arguments.follow is not None:
            raise InputError("--follow goes with --live")
        return
    if arguments.output is not None:
        raise InputError(f"{arguments.output}: --live publishes and writes no bag; leave the name out")
    if arguments.truth:
        raise InputError("--truth goes with a bag; leave it out, or --live")
    if not SPEEDS[0] <= arguments.speed <= SPEEDS[1]:
        raise InputError(f"--speed: {arguments.speed:g} is outside {SPEEDS[0]:g} .. {SPEEDS[1]:g}")
    if arguments.follow is not None:
        for name in (*MOTION_OPTIONS, "speed"):
            if getattr(arguments, name) != getattr(defaults, name):
                raise InputError(f"--{name.replace('_', '-')}: the motion is that of {arguments.follow}; leave it out")


def run(arguments: argparse.Namespace, scenario: Scenario) -> None:
    """Publish until the end, or until Ctrl-C. Raises InputError."""
    from ..errors import needing_ros
    from ..node.shutdown import Ending

    with Ending() as ending:
        with needing_ros("--live"):
            from ..node.simulator_node import Outputs, run_until
        outputs = Outputs(arguments.dvl_topic, arguments.gnss_topic, arguments.imu_topic, arguments.dvl_type)
        ros_args = ["--ros-args", *arguments.ros_args] if arguments.ros_args else []
        sent = run_until(ending, scenario, outputs, ros_args, arguments.follow, arguments.speed, arguments.wait)
        print(f"published {sent} messages")
