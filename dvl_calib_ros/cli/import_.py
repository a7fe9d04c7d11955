"""Turn trajectories in CSV or NPY, and logs of DVLs and autopilots, into bags.

A file holds rows of time and three values. A folder holds recordings NAME_dvl.csv, each optionally with NAME_gnss.csv
and NAME_attitude.csv, and becomes one bag per recording. Units are SI and radians. Velocities are forward-right-down
(frd) by default and become ROS's forward-left-up. Attitude is roll, pitch, yaw of the forward-right-down body in
north-east-down.

If the header names speed and course (over ground, from true north), or a compass heading (optionally with pitch and
roll), the file is read by its column names, which include the units (_deg, knots). Latitude and longitude, with or
without the speed, become NavSatFix on gnss/fix.

For a table of another layout, --columns names the DVL's columns by header or number. Time is in seconds, in ISO 8601,
or a date and a time of day (time=Date+Time).

Logs are recognised by their content: JSON reports of Water Linked, text (Teledyne's PD6, Nortek's PNORBT, Cerulean's
DVPDL), PD0 ensembles of RDI, logs of Nortek DVLs, logs of ArduPilot (.BIN, .tlog: DVL, GNSS and attitude in one), and
RMC sentences of a receiver. PD0 includes the DVL's own heading, pitch and roll, and NMEA added by WinRiver II. Logs
have their own times: give --start 0 if the times of a GNSS or attitude file are also seconds since 1970.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..standard_streams import show
from . import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "dvl",
        type=Path,
        metavar="DVL",
        help="CSV or NPY of DVL velocities, a log of a DVL or an autopilot, or a folder of recordings",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="bag to write (for a folder: folder of bags)")
    parser.add_argument("--gnss", type=Path, metavar="FILE", help="reference velocities, or a receiver's NMEA (RMC)")
    parser.add_argument("--attitude", type=Path, metavar="FILE", help="roll, pitch, yaw in north-east-down")
    parser.add_argument("--frame", choices=("frd", "flu"), default="frd", help="axes of the DVL; default: %(default)s")
    frames = ("frd", "flu", "enu", "ned")
    parser.add_argument("--gnss-frame", choices=frames, default="frd", help="default: %(default)s")
    parser.add_argument(
        "--columns",
        default="",
        metavar="MAP",
        help="columns of a DVL's table: time=NAME,vx=NAME,vy=NAME,vz=NAME,valid=NAME",
    )
    parser.add_argument("--dvl-std", type=float, default=0.0, metavar="M/S", help="σ to write as covariance; 0: none")
    parser.add_argument("--gnss-std", type=float, default=0.0, metavar="M/S", help="σ to write as covariance; 0: none")
    parser.add_argument(
        "--start", type=float, default=1_600_000_000.0, metavar="S", help="stamp of time 0, s since 1970; default 1.6e9"
    )
    common.add_storage_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Import one recording, or a folder of recordings."""
    from ..bags.writer import Compression, Storage
    from ..logs.trajectories import ImportOptions, import_files

    names = ("frame", "gnss_frame", "dvl_std", "gnss_std", "start", "columns")
    given = {name: getattr(arguments, name) for name in names}
    storage, compression = Storage(arguments.storage), Compression(arguments.compression)
    options = ImportOptions(**given, storage=storage, compression=compression)
    common.check_outputs(arguments, folders=["output"])
    written = import_files(arguments.dvl, arguments.gnss, arguments.attitude, arguments.output, options)
    common.print_warnings([note for imported in written.values() for note in imported.notes])
    for path, (counts, _) in written.items():
        show(f"{path}: " + ", ".join(f"{count} {name}" for name, count in counts.items() if count))
