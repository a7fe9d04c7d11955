"""Run the calibration node, live. Needs ROS 2 Jazzy (or pip install 'dvl_calib_ros[ros]').

Everything after --ros-args goes to ROS 2 unchanged (remappings, namespace, log level).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from . import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_parameter_options(parser)
    common.add_topic_options(parser)
    parser.add_argument("--watch", action="store_true", help="show estimates, convergence and missing manoeuvres, live")
    parser.add_argument("--ros-args", nargs=argparse.REMAINDER, default=[], dest="ros_args", help=argparse.SUPPRESS)


def run(arguments: argparse.Namespace) -> int:
    """Convert the options for ROS 2 and run the node. Return its exit code."""
    from ..node.shutdown import Ending

    with Ending() as ending:  # before anything slow
        common.load(arguments)  # report a bad file or value in one line before ROS starts
        if arguments.watch:
            from .watch import run_and_watch

            return run_and_watch(ros_arguments(arguments), ending)
        from ..node.main import run_until

        return run_until(ending, ros_arguments(arguments))


def ros_arguments(arguments: argparse.Namespace) -> list[str]:
    """Return the options as ROS 2 arguments."""
    from ..files.parameter_files import ros_override
    from ..recordings.topics import Topics

    ros = ["--ros-args"]
    if arguments.params is not None:
        ros += ["--params-file", str(Path(arguments.params).resolve())]
    for override in arguments.overrides:
        ros += ["-p", ros_override(override)]
    for role, default in vars(Topics()).items():
        topic = getattr(arguments, f"{role}_topic")
        if topic != default:
            ros += ["-r", f"{default}:={topic}"]
    return ros + list(arguments.ros_args)
