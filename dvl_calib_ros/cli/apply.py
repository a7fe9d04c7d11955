"""Write a saved calibration into URDF, parameters, static transform or robot_localization. Without options, show it.

Every file is replaced whole and the one before kept as .bak; the same line with --rollback brings that back.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..files.mounting import CalibratedMounting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("result", nargs="?", type=Path, metavar="RESULT", help="result file of the node or of replay")
    parser.add_argument("--urdf", type=Path, metavar="FILE", help="turn, and move, the DVL's joint in this URDF")
    parser.add_argument("--joint", metavar="NAME", help="the DVL's joint; default: the one above the DVL's frame")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the URDF here, leave --urdf as it is")
    parser.add_argument("--keep-position", action="store_true", help="leave the DVL's xyz in the URDF as it is")
    parser.add_argument(
        "--params",
        type=Path,
        metavar="FILE",
        help="write mounting, lever arm and delay as found into this parameter file of the node",
    )
    parser.add_argument("--launch", type=Path, metavar="FILE", help="write a launch file (XML) with a static transform")
    parser.add_argument("--fusion", type=Path, metavar="FILE", help="write parameters for robot_localization (YAML)")
    parser.add_argument(
        "--force", action="store_true", help="apply a result that is rejected, not converged, or of another mounting"
    )
    parser.add_argument(
        "--rollback", action="store_true", help="restore the files from before the last apply (again: undo that)"
    )


def run(arguments: argparse.Namespace) -> None:
    """Check everything, then write everything; or roll back."""
    from ..errors import InputError
    from ..files.applying import Targets, roll_back, write_calibration

    names = ("urdf", "output", "joint", "keep_position", "params", "launch", "fusion")
    targets = Targets(**{name: getattr(arguments, name) for name in names})
    common.check_outputs(arguments, "urdf" if arguments.output is None else "output", "params", "launch", "fusion")
    if arguments.rollback:
        for path, kept in roll_back(targets).items():
            print(f"{path}: as before; what it was is now {kept.name}")
        return
    if arguments.result is None:
        raise InputError("name a result file, as ~/save and dvl-calib replay --save write them")
    from ..files.mounting import load_calibrated_mounting

    calibrated = load_calibrated_mounting(arguments.result)
    applied = write_calibration(calibrated, targets, arguments.force)
    for note in applied.notes:
        print(f"note: {note}")
    _print(calibrated, arguments)
    for path in targets.paths:
        before = f"; the one before is {applied.kept[path].name}" if path in applied.kept else ""
        print(f"{path}: written{before}" if path in applied.written else f"{path}: is so already")


def _print(calibrated: CalibratedMounting, arguments: argparse.Namespace) -> None:
    import numpy as np
    from rich.markup import escape

    from ..files.mounting import POSITION_UNKNOWN, scale_advice
    from ..files.urdf import numbers

    errors, out = common.console(stderr=True), common.console()
    for sentence in (*calibrated.objections, *calibrated.doubts):
        errors.print(f"[yellow]warning:[/] {arguments.result}: {escape(sentence)}", soft_wrap=True)
    degrees = " ".join(f"{angle:+.2f}°" for angle in np.degrees(calibrated.rpy))
    known = calibrated.position is not None
    transform = (
        f"ros2 run tf2_ros static_transform_publisher {calibrated.static_transform}" if known else POSITION_UNKNOWN
    )
    lines = (
        f"{calibrated.model.name}: {calibrated.dvl_frame} in {calibrated.base_frame} at roll, pitch, yaw {degrees}",
        f'URDF:   rpy="{numbers(calibrated.rpy)}" (of {calibrated.dvl_frame} in {calibrated.base_frame})',
        f"TF:     {transform}",
        f"scale:  {scale_advice(calibrated)}",
    )
    if calibrated.objections and not arguments.force:
        out.print("nothing to apply; --force shows and writes it anyway", soft_wrap=True)
        return
    for line in lines:
        out.print(escape(line), soft_wrap=True)
    if any(calibrated.lever_arm):
        found = "found" if calibrated.lever_arm_found else "as lever_arm says"
        at = " ".join(f"{value:+.2f}" for value in calibrated.lever_arm)
        out.print(f"lever arm: {at} m from the reference point, {found}", soft_wrap=True)
    if calibrated.dvl_time_offset:
        late = "late" if calibrated.dvl_time_offset > 0.0 else "early"
        out.print(
            f"delay:  the DVL's stamps are {abs(calibrated.dvl_time_offset):.3f} s {late}, today: URDF and TF hold no "
            "delay; --params writes dvl_time_offset, or set the DVL's clock",
            soft_wrap=True,
        )
    if calibrated.position is not None:
        at = " ".join(f"{value:+.2f}" for value in calibrated.position)
        out.print(f"position: {at} m in {calibrated.base_frame}", soft_wrap=True)
