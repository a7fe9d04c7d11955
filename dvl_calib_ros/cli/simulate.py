"""Write a bag from a trajectory and an error model. The same options and seed give the same bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import common

NAME = "simulate"
HELP = "write a bag from a trajectory and an error model"
EXAMPLE = "dvl-calib simulate my_bag --trajectory box --misalignment 1.5 -2 3 --scale 0.5 --gnss-outage 300 390"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    from ..simulation.trajectories import ROUNDS

    parser.add_argument("output", type=Path, metavar="BAG", help="folder to write; must not exist")
    parser.add_argument("--trajectory", choices=tuple(ROUNDS), default="box", help="default: %(default)s")
    parser.add_argument("--duration", type=float, default=600.0, metavar="S", help="default: %(default)g s")
    parser.add_argument("--seed", type=int, default=0, help="of the noise; default: %(default)s")
    angles = ("ROLL", "PITCH", "YAW")
    none = (0.0, 0.0, 0.0)
    parser.add_argument(
        "--misalignment", nargs=3, type=float, default=none, metavar=angles,
        help="degrees by which the DVL is turned against its nominal mounting",
    )  # fmt: skip
    parser.add_argument("--scale", nargs="+", type=float, default=[0.0], metavar="PERCENT", help="one, or one per axis")
    parser.add_argument(
        "--mounting-rpy", nargs=3, type=float, default=none, metavar=angles,
        help="nominal mounting, rad, as the parameter",
    )  # fmt: skip
    parser.add_argument("--dvl-rate", type=float, default=5.0, metavar="HZ", help="default: %(default)g")
    parser.add_argument("--gnss-rate", type=float, default=5.0, metavar="HZ", help="default: %(default)g; 0: no GNSS")
    parser.add_argument("--imu-rate", type=float, default=20.0, metavar="HZ", help="default: %(default)g; 0: no IMU")
    parser.add_argument("--beam-std", type=float, default=0.005, metavar="M/S", help="default: %(default)g per beam")
    parser.add_argument("--gnss-std", type=float, default=0.1, metavar="M/S", help="default: %(default)g per axis")
    parser.add_argument("--gnss-frame", choices=("enu", "body"), default="enu", help="default: %(default)s")
    parser.add_argument(
        "--gnss-outage", nargs=2, type=float, action="append", default=[], metavar=("FROM", "TO"),
        help="seconds without GNSS; repeatable",
    )  # fmt: skip
    common.add_storage_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Simulate and write."""
    import math

    from ..calibration.samples import VelocityFrame
    from ..io.bags import Compression, Storage
    from ..simulation.scenario import Scenario, write_bag
    from ..simulation.sensors import DvlErrors

    _check(arguments)
    roll, pitch, yaw = map(math.radians, arguments.misalignment)
    scale = [0.01 * s for s in arguments.scale] * (3 if len(arguments.scale) == 1 else 1)
    scenario = Scenario(
        trajectory=arguments.trajectory,
        seconds=arguments.duration,
        seed=arguments.seed,
        errors=DvlErrors((roll, pitch, yaw), (scale[0], scale[1], scale[2]), beam_std=arguments.beam_std),
        mounting_rpy=tuple(arguments.mounting_rpy),
        dvl_rate=arguments.dvl_rate,
        gnss_rate=arguments.gnss_rate,
        imu_rate=arguments.imu_rate,
        gnss_std=arguments.gnss_std,
        gnss_frame=VelocityFrame(arguments.gnss_frame),
        outages=tuple((start, end) for start, end in arguments.gnss_outage),
    )
    write_bag(scenario, arguments.output, Storage(arguments.storage), Compression(arguments.compression))
    print(f"wrote {arguments.output}")


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
}
MAY_BE_ZERO = ("gnss_rate", "imu_rate")  # no such sensor


def _check(arguments: argparse.Namespace) -> None:
    from ..io.errors import InputError

    if len(arguments.scale) not in (1, 3):
        raise InputError("--scale: give one number for all axes, or three")
    for name, (low, high) in LIMITS.items():
        given = getattr(arguments, name)
        for value in given if isinstance(given, list | tuple) else [given]:
            if not low <= value <= high and not (value == 0.0 and name in MAY_BE_ZERO):
                raise InputError(f"--{name.replace('_', '-')}: {value:g} is outside {low:g} .. {high:g}")
    for start, end in arguments.gnss_outage:
        if not start < end:
            raise InputError(f"--gnss-outage: {start:g} is not before {end:g}; give the beginning, then the end")
