"""Turn trajectories in CSV or NPY, and logs of DVLs and autopilots, into bags.

A file holds rows of time and three values; a folder holds recordings NAME_dvl.csv, each with NAME_gnss.csv and
NAME_attitude.csv where there are such, and becomes one bag per recording. Units are SI and radians; velocities are
forward-right-down (frd) unless said otherwise and become ROS's forward-left-up; attitude is roll, pitch, yaw of the
forward-right-down body in north-east-down. Files whose header names speed and course (over ground, from true north), or
heading (of a compass, with pitch and roll or without), are read by their columns; units are in the names (_deg, knots).
Latitude and longitude beside or instead of the speed become NavSatFix on gnss/fix.

Of a table of another layout --columns names the DVL's columns, by header or number; time is in seconds, in ISO 8601, or
a date and a time of day (time=Date+Time).

A log of Water Linked's JSON reports, of text (Teledyne's PD6, Nortek's PNORBT, Cerulean's DVPDL), of RDI's PD0
ensembles (with the DVL's own heading, pitch and roll, and the NMEA that WinRiver II put into them), of Nortek's DVLs or
of ArduPilot (.BIN, .tlog: DVL, GNSS and attitude in one) is known by its content; so are a receiver's RMC sentences.
They have their own times: give --start 0 with a GNSS or attitude file whose times are seconds since 1970 as well.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..standard_streams import show
from . import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "dvl",
        type=Path,
        metavar="DVL",
        help="CSV or NPY of DVL velocities, a log of a DVL or an autopilot, or a folder of recordings",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="bag to write (for a folder: folder of bags)")
    parser.add_argument("--gnss", type=Path, metavar="FILE", help="reference velocities, or a receiver's NMEA (RMC)")
    parser.add_argument("--attitude", type=Path, metavar="FILE", help="roll, pitch, yaw in north-east-down")
    parser.add_argument("--frame", choices=("frd", "flu"), default="frd", help="of the DVL; default: %(default)s")
    frames = ("frd", "flu", "enu", "ned")
    parser.add_argument("--gnss-frame", choices=frames, default="frd", help="default: %(default)s")
    parser.add_argument(
        "--columns",
        default="",
        metavar="MAP",
        help="columns of a DVL's table: time=NAME,vx=NAME,vy=NAME,vz=NAME,valid=NAME",
    )
    parser.add_argument("--dvl-std", type=float, default=0.0, metavar="M/S", help="covariance to write; 0: not given")
    parser.add_argument("--gnss-std", type=float, default=0.0, metavar="M/S", help="covariance to write; 0: not given")
    parser.add_argument(
        "--start", type=float, default=1_600_000_000.0, metavar="S", help="stamp of time 0, s since 1970; default 1.6e9"
    )
    common.add_storage_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Import one recording, or a folder of them."""
    from ..bags.writer import Compression, Storage
    from ..logs.trajectories import ImportOptions, import_files

    options = ImportOptions(
        frame=arguments.frame,
        gnss_frame=arguments.gnss_frame,
        dvl_std=arguments.dvl_std,
        gnss_std=arguments.gnss_std,
        start=arguments.start,
        columns=arguments.columns,
        storage=Storage(arguments.storage),
        compression=Compression(arguments.compression),
    )
    common.check_outputs(arguments, folders=["output"])
    written = import_files(arguments.dvl, arguments.gnss, arguments.attitude, arguments.output, options)
    common.print_warnings([note for imported in written.values() for note in imported.notes])
    for path, (counts, _) in written.items():
        show(f"{path}: " + ", ".join(f"{count} {name}" for name, count in counts.items() if count))
