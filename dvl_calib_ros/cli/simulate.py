"""Write a bag from a motion, an error model and any effects. The same options and seed give the same bag.

With --live, publish the same on ROS 2 instead, or follow a vehicle's odometry and publish its simulated sensors.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError, needing_ros
from ..standard_streams import show
from . import common

if TYPE_CHECKING:
    from ..simulation.scenario import Scenario

GNSS_FRAMES = ("from_frame_id", "body", "enu", "ned")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..simulation.injection import FORM
    from ..simulation.trajectories import TRAJECTORIES

    parser.add_argument("output", nargs="?", type=Path, metavar="BAG", help="folder to write; must not exist")
    motion = parser.add_mutually_exclusive_group()
    motion.add_argument("--trajectory", choices=TRAJECTORIES, default="box", help="default: %(default)s")
    motion.add_argument(
        "--motion-of", type=Path, metavar="RECORDED",
        help="take the motion from a bag: its reference velocity and attitude, the longest stretch without a gap",
    )  # fmt: skip
    parser.add_argument(
        "--motion-topics", nargs=2, default=("gnss/twist", "imu/data"), metavar=("GNSS", "IMU"),
        help="topics of RECORDED; default: gnss/twist imu/data",
    )  # fmt: skip
    parser.add_argument(
        "--motion-frame", choices=GNSS_FRAMES, default=GNSS_FRAMES[0],
        help="frame of RECORDED's reference velocity, as the parameter gnss_frame; default: %(default)s",
    )  # fmt: skip
    parser.add_argument(
        "--motion-smoothing", type=float, default=1.0, metavar="S",
        help="window (standard deviation) that smooths RECORDED's velocity; default: %(default)g",
    )  # fmt: skip
    parser.add_argument("--duration", type=float, metavar="S", help="default: 600 s, or all of RECORDED")
    parser.add_argument(
        "--waves", nargs=2, type=float, metavar=("HEIGHT", "PERIOD"),
        help="surface waves: significant height (m), period of the peak (s)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="seed of all random numbers; default: %(default)s")
    parser.add_argument(
        "--effect", action="append", default=[], metavar=FORM,
        help="add an effect, such as lever_arm:x_m=0.3; repeatable (dvl-calib parameters --effects lists them)",
    )  # fmt: skip
    parser.add_argument(
        "--diagnosis", type=Path, metavar="FILE",
        help="simulate a diagnosed DVL: a file of diagnose --json, or a result or parameter file",
    )  # fmt: skip
    parser.add_argument(
        "--truth", action="store_true", help="attach all that was simulated to the bag, as truth.json (MCAP only)"
    )
    angles = ("ROLL", "PITCH", "YAW")
    none = (0.0, 0.0, 0.0)
    parser.add_argument(
        "--misalignment", nargs=3, type=float, default=none, metavar=angles,
        help="rotation of the DVL from its nominal mounting, degrees",
    )  # fmt: skip
    scale_help = "scale error: one number, or one per axis"
    parser.add_argument("--scale", nargs="+", type=float, default=[0.0], metavar="PERCENT", help=scale_help)
    parser.add_argument(
        "--mounting-rpy", nargs=3, type=float, default=none, metavar=angles,
        help="nominal mounting, rad, as parameter mounting_rpy",
    )  # fmt: skip
    parser.add_argument("--dvl-rate", type=float, default=5.0, metavar="HZ", help="default: %(default)g")
    parser.add_argument("--gnss-rate", type=float, default=5.0, metavar="HZ", help="default: %(default)g; 0: no GNSS")
    parser.add_argument("--imu-rate", type=float, default=20.0, metavar="HZ", help="default: %(default)g; 0: no IMU")
    parser.add_argument("--beam-std", type=float, default=0.005, metavar="M/S", help="noise per beam (%(default)g)")
    parser.add_argument(
        "--beam-bias", nargs=4, type=float, default=(0.0,) * 4, metavar=("B1", "B2", "B3", "B4"),
        help="constant error of each beam, m/s",
    )  # fmt: skip
    parser.add_argument("--gnss-std", type=float, default=0.1, metavar="M/S", help="noise per axis (%(default)g)")
    parser.add_argument("--gnss-frame", choices=("enu", "body"), default="enu", help="default: %(default)s")
    parser.add_argument(
        "--gnss-outage", nargs=2, type=float, action="append", default=[], metavar=("FROM", "TO"),
        help="seconds without GNSS; repeatable",
    )  # fmt: skip
    parser.add_argument("--attitude-std", type=float, default=0.0, metavar="DEG", help="IMU; default: %(default)g")
    parser.add_argument("--gyro-std", type=float, default=0.0, metavar="DEG/S", help="IMU; default: %(default)g")
    parser.add_argument(
        "--gyro-bias", nargs=3, type=float, default=none, metavar=("X", "Y", "Z"), help="IMU, degrees per second"
    )
    common.add_storage_options(parser)
    add_live_arguments(parser)


def run(arguments: argparse.Namespace) -> None:
    """Simulate, and write or publish."""
    import math

    from ..bags.writer import Compression, Storage
    from ..calibration.numerics.samples import VelocityFrame
    from ..simulation.injection import injection
    from ..simulation.recorded_motion import MotionSource
    from ..simulation.scenario import Scenario, write_bag
    from ..simulation.sensors import DvlErrors, ImuErrors
    from ..simulation.trajectories import Waves

    _check_ranges(arguments)
    defaults = _defaults()
    check(arguments, defaults)
    common.check_outputs(arguments, folders=["output"])
    roll, pitch, yaw = map(math.radians, arguments.misalignment)
    scale = [0.01 * s for s in arguments.scale] * (3 if len(arguments.scale) == 1 else 1)
    bias_x, bias_y, bias_z = map(math.radians, arguments.gyro_bias)
    gnss_topic, imu_topic = arguments.motion_topics
    recording = arguments.motion_of and MotionSource(
        arguments.motion_of, gnss_topic, imu_topic, arguments.motion_frame, arguments.motion_smoothing
    )
    if recording:
        common.print_warnings(recording.opened.notes)
    scenario = Scenario(
        **{name: getattr(arguments, name) for name in OF_THE_SCENARIO},
        seconds=arguments.duration,
        errors=DvlErrors(
            (roll, pitch, yaw), (scale[0], scale[1], scale[2]), tuple(arguments.beam_bias), arguments.beam_std
        ),
        mounting_rpy=tuple(arguments.mounting_rpy),
        gnss_frame=VelocityFrame(arguments.gnss_frame),
        outages=tuple((start, end) for start, end in arguments.gnss_outage),
        imu_errors=ImuErrors(
            math.radians(arguments.attitude_std), math.radians(arguments.gyro_std), (bias_x, bias_y, bias_z)
        ),
        recording=recording,
        waves=Waves(*arguments.waves) if arguments.waves else None,
        effects=tuple(injection(text) for text in arguments.effect),
    )
    if arguments.diagnosis is not None:
        scenario = _with_diagnosis(arguments, defaults, scenario)
    if arguments.live:
        run_live(arguments, scenario)
        return
    storage, compression = Storage(arguments.storage), Compression(arguments.compression)
    write_bag(scenario, arguments.output, storage, compression, with_truth=arguments.truth)
    show(f"wrote {arguments.output}")


# options that are fields of a scenario
OF_THE_SCENARIO = ("trajectory", "seed", "dvl_rate", "gnss_rate", "imu_rate", "gnss_std")
# options that describe the DVL, as a diagnosis does
OF_THE_DVL = ("misalignment", "scale", "mounting_rpy", "beam_std", "beam_bias", "dvl_rate")


def _defaults() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.parse_args([])


def _with_diagnosis(arguments: argparse.Namespace, defaults: argparse.Namespace, scenario: Scenario) -> Scenario:
    """Give the scenario the DVL found by a diagnosis. Raises InputError if options contradict it."""
    from ..simulation.found_effects import with_dvl
    from ..simulator_export.dvl_description import load_description

    for name in OF_THE_DVL:
        if getattr(arguments, name) != getattr(defaults, name):
            raise InputError(f"--{name.replace('_', '-')}: {arguments.diagnosis} sets it as well; omit one of the two")
    description = load_description(arguments.diagnosis)
    scenario, left_out = with_dvl(scenario, description)
    notes = [*description.ambiguities]
    if left_out:
        notes.append(f"not simulated (of unknown size, or of another day): {', '.join(left_out)}")
    common.print_warnings([f"{arguments.diagnosis}: {note}" for note in notes])
    return scenario


# Option -> smallest and largest value
LIMITS = {
    "duration": (1.0, 100_000.0),
    "seed": (0, 2**63),
    "misalignment": (-89.0, 89.0),
    "scale": (-99.0, 99.0),
    "mounting_rpy": (-6.3, 6.3),
    "dvl_rate": (0.01, 1000.0),
    "gnss_rate": (0.01, 1000.0),
    "imu_rate": (0.01, 100.0),
    "beam_std": (0.0, 10.0),
    "gnss_std": (0.0, 10.0),
    "beam_bias": (-10.0, 10.0),
    "attitude_std": (0.0, 30.0),
    "gyro_std": (0.0, 100.0),
    "gyro_bias": (-100.0, 100.0),
    "motion_smoothing": (0.0, 60.0),
}


def _check_ranges(arguments: argparse.Namespace) -> None:
    """Raise InputError for an option outside its range."""
    if len(arguments.scale) not in (1, 3):
        raise InputError("--scale: give one number for all axes, or three")
    for name, (low, high) in LIMITS.items():
        given = getattr(arguments, name)
        for value in given if isinstance(given, list | tuple) else [] if given is None else [given]:
            if not low <= value <= high and not (value == 0.0 and name in ("gnss_rate", "imu_rate")):  # no sensor
                raise InputError(f"--{name.replace('_', '-')}: {value:g} is outside {low:g} .. {high:g}")
    if arguments.waves and not (0.0 <= arguments.waves[0] <= 10.0 and 1.0 <= arguments.waves[1] <= 30.0):
        raise InputError("--waves: give a height of 0 .. 10 m, then a period of 1 .. 30 s")
    for start, end in arguments.gnss_outage:
        if not start < end:
            raise InputError(f"--gnss-outage: {start:g} is not before {end:g}; give the beginning, then the end")


# options for a motion, which --follow takes from an odometry topic instead
MOTION_OPTIONS = ("trajectory", "motion_of", "duration", "waves")
SPEEDS = (0.01, 1000.0)


def add_live_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --live and its further options in their own group."""
    from ..messages.drivers import TWIST_TYPE

    live = parser.add_argument_group("live", "publish DVL, GNSS and IMU on ROS 2 instead of writing a bag")
    live.add_argument("--live", action="store_true", help="publish; stamps begin now, or are taken from the odometry")
    live.add_argument(
        "--follow", metavar="TOPIC",
        help="nav_msgs/Odometry of a vehicle driven elsewhere, such as in another simulator; until Ctrl-C",
    )  # fmt: skip
    live.add_argument(
        "--speed", type=float, default=1.0, help="multiple of real time, without --follow; default: %(default)g"
    )
    live.add_argument("--wait", action="store_true", help="begin when DVL, GNSS and IMU have a subscriber each")
    live.add_argument(
        "--dvl-type", default=TWIST_TYPE, metavar="TYPE", help="type of the DVL's messages; default: %(default)s"
    )
    common.add_topic_options(live)
    live.add_argument("--ros-args", nargs=argparse.REMAINDER, default=[], dest="ros_args", help=argparse.SUPPRESS)


def check(arguments: argparse.Namespace, defaults: argparse.Namespace) -> None:
    """Raise InputError for options that exclude each other. defaults: of all options."""
    if not arguments.live:
        if arguments.output is None:
            raise InputError("name a bag to write, or publish with --live")
        for name in ("follow", "speed", "wait", "dvl_type", "dvl_topic", "gnss_topic", "imu_topic"):
            if getattr(arguments, name) != getattr(defaults, name):
                raise InputError(f"--{name.replace('_', '-')} needs --live")
        return
    if arguments.output is not None:
        raise InputError(f"{arguments.output}: --live publishes and writes no bag; leave the name out")
    if arguments.truth:
        raise InputError("--truth needs a bag, and --live writes none; leave one of them out")
    if not SPEEDS[0] <= arguments.speed <= SPEEDS[1]:
        raise InputError(f"--speed: {arguments.speed:g} is outside {SPEEDS[0]:g} .. {SPEEDS[1]:g}")
    if arguments.follow is not None:
        for name in (*MOTION_OPTIONS, "speed"):
            if getattr(arguments, name) != getattr(defaults, name):
                raise InputError(f"--{name.replace('_', '-')}: the motion comes from {arguments.follow}; leave it out")


def run_live(arguments: argparse.Namespace, scenario: Scenario) -> None:
    """Publish until the end, or until Ctrl-C. Raises InputError."""
    from ..node.shutdown import Ending

    with Ending() as ending:
        with needing_ros("--live"):
            from ..node.simulator_node import Outputs, run_until
        outputs = Outputs(arguments.dvl_topic, arguments.gnss_topic, arguments.imu_topic, arguments.dvl_type)
        ros_args = ["--ros-args", *arguments.ros_args] if arguments.ros_args else []
        sent = run_until(ending, scenario, outputs, ros_args, arguments.follow, arguments.speed, arguments.wait)
        show(f"published {sent} messages")
