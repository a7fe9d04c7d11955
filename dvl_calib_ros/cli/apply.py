"""Write a saved calibration into URDF, parameters, static transform, robot_localization or the instrument itself.

Without options, show it. Each file is replaced atomically and its previous version kept as .bak; the same command with
--rollback restores it. Nothing is sent to an instrument without --send.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError, printable
from ..standard_streams import show
from . import common

if TYPE_CHECKING:
    from ..files.mounting import CalibratedMounting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("result", nargs="?", type=Path, metavar="RESULT", help="result file of the node or of replay")
    parser.add_argument("--urdf", type=Path, metavar="FILE", help="rotate and move the DVL's joint in this URDF")
    parser.add_argument("--joint", metavar="NAME", help="the DVL's joint; default: the one above the DVL's frame")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the URDF here, do not change --urdf")
    parser.add_argument("--keep-position", action="store_true", help="do not change the DVL's xyz in the URDF")
    parser.add_argument(
        "--params",
        type=Path,
        metavar="FILE",
        help="write mounting, lever arm and delay as found into this parameter file of the node",
    )
    parser.add_argument("--launch", type=Path, metavar="FILE", help="write a launch file (XML) with a static transform")
    parser.add_argument("--fusion", type=Path, metavar="FILE", help="write parameters for robot_localization (YAML)")
    parser.add_argument(
        "--instrument",
        metavar="NAME",
        help="show the settings of the instrument itself instead: waterlinked, cerulean or ardupilot",
    )
    parser.add_argument(
        "--now",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the instrument when the data were recorded; repeatable",
    )
    parser.add_argument("--settings", type=Path, metavar="FILE", help="write the instrument's settings to this file")
    parser.add_argument("--send", metavar="HOST", help="send them to the instrument (waterlinked), and read them back")
    parser.add_argument("--dry-run", action="store_true", help="show old and new, write and send nothing")
    parser.add_argument(
        "--force", action="store_true",
        help="apply a result that is rejected, not converged, or found with another mounting",
    )  # fmt: skip
    parser.add_argument(
        "--rollback",
        action="store_true",
        help="restore the files from before the last apply; a second --rollback undoes this",
    )


def run(arguments: argparse.Namespace) -> None:
    """Check all files and then write them, or roll back."""
    from ..files.mounting import Targets, roll_back, write_calibration

    names = ("urdf", "output", "joint", "keep_position", "params", "launch", "fusion")
    targets = Targets(**{name: getattr(arguments, name) for name in names})
    written = "urdf" if arguments.output is None else "output"
    common.check_outputs(arguments, written, "params", "launch", "fusion", "settings")
    if arguments.instrument is None and (arguments.now or arguments.settings or arguments.send):
        raise InputError("--now, --settings and --send need --instrument")
    if arguments.instrument is not None and (targets.paths or arguments.rollback):
        raise InputError(
            "--instrument corrects the error at its source; with --urdf, --params, --launch or --fusion the DVL "
            "would be corrected twice: give one of them"
        )
    if arguments.rollback:
        for path, kept in roll_back(targets).items():
            show(f"{path}: restored; the replaced version is now {kept.name}")
        return
    if arguments.result is None:
        raise InputError("name a result file, as ~/save and dvl-calib replay --save write them")
    from ..files.mounting import load_calibrated_mounting

    calibrated = load_calibrated_mounting(arguments.result)
    if arguments.instrument is not None:
        _apply_to_instrument(calibrated, arguments)
        return
    applied = write_calibration(calibrated, targets, arguments.force, arguments.dry_run)
    show(*(f"note: {note}" for note in applied.notes))
    is_refused = calibrated.objections and not arguments.force
    refused = ["this calibration should not be applied, see the warnings; --force shows and writes it anyway"]
    _print_lines(calibrated, refused if is_refused else _mounting_lines(calibrated))
    if arguments.dry_run:
        show(*(applied.changes.splitlines() or ["nothing would change"]))
        return
    for path in targets.paths:
        before = f"; the one before is {applied.kept[path].name}" if path in applied.kept else ""
        show(f"{path}: written{before}" if path in applied.written else f"{path}: already up to date")


def _apply_to_instrument(calibrated: CalibratedMounting, arguments: argparse.Namespace) -> None:
    """Print an instrument's settings; with the options, also write and send them."""
    from ..disk.atomic import save_bytes
    from ..instruments.settings import AS_RECORDED, configure, instrument_settings

    known = _parse_now(arguments.now)
    chosen = instrument_settings(calibrated, arguments.instrument, known, arguments.force)
    missing = [each.name for each in chosen.settings if each.name not in known and each.now_by != AS_RECORDED]
    if arguments.send and (arguments.instrument != "waterlinked" or missing):
        raise InputError(
            "--send is for waterlinked, and needs its settings when the data were recorded: "
            + " ".join(f"--now {name}=..." for name in missing or ("mounting_rotation_offset",))
        )
    lines = [f"{chosen.instrument}, by: {chosen.document}", *(f"  {setting}" for setting in chosen.settings)]
    _print_lines(calibrated, [*lines, *chosen.text.splitlines(), *(f"note: {note}" for note in chosen.notes)])
    if arguments.settings and not arguments.dry_run:
        save_bytes(arguments.settings, chosen.text.encode())
        show(f"{arguments.settings}: written")
    if arguments.send:
        is_so = configure(arguments.send, chosen.settings, arguments.dry_run)
        done = "would be set" if arguments.dry_run else "set, and read back"
        show(f"{arguments.send}: {'already up to date' if is_so else done}")


def _parse_now(words: Sequence[str]) -> dict[str, float]:
    """Parse --now NAME=VALUE. Raises InputError."""
    settings = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            settings[name.strip()] = float(value)
        except ValueError as error:
            raise InputError(f"--now {word}: is not NAME=VALUE with a number") from error
    return settings


def _mounting_lines(calibrated: CalibratedMounting) -> list[str]:
    """Return the calibrated mounting as lines to print."""
    import numpy as np

    from ..calibration.numerics.frames import near_angles
    from ..files.mounting import POSITION_UNKNOWN, scale_advice
    from ..files.urdf import numbers

    angles = near_angles(calibrated.rpy, calibrated.parameters.mounting_rpy)  # as in the report, 180.4° not -179.6°
    degrees = " ".join(f"{angle:+.2f}°" for angle in np.degrees(angles))
    is_known = calibrated.position is not None
    transform = (
        f"ros2 run tf2_ros static_transform_publisher {calibrated.static_transform}" if is_known else POSITION_UNKNOWN
    )
    lines = [
        f"{calibrated.model.name}: {calibrated.dvl_frame} in {calibrated.base_frame} at roll, pitch, yaw {degrees}",
        f'URDF:   rpy="{numbers(calibrated.rpy)}" (of {calibrated.dvl_frame} in {calibrated.base_frame})',
        f"TF:     {transform}",
        f"scale:  {scale_advice(calibrated)}",
    ]
    if calibrated.cause_of_scale is not None:
        lines.append(f"water:  {calibrated.cause_of_scale.sentence}")
    if any(calibrated.lever_arm):
        source = "found" if calibrated.lever_arm_found else "as lever_arm says"
        lines.append(f"lever arm: {_metres(calibrated.lever_arm)} from the reference point, {source}")
    if calibrated.dvl_time_offset:
        way = "late" if calibrated.dvl_time_offset > 0.0 else "early"
        lines.append(
            f"delay:  the DVL's stamps are {abs(calibrated.dvl_time_offset):.3f} s {way} against the IMU's in "
            "this recording: URDF and TF have no delay; --params writes dvl_time_offset, or set the DVL's clock"
        )
    if calibrated.position is not None:
        lines.append(f"position: {_metres(calibrated.position)} in {calibrated.base_frame}")
    return lines


def _metres(values: Sequence[float]) -> str:
    return " ".join(f"{value:+.2f}" for value in values) + " m"


def _print_lines(calibrated: CalibratedMounting, lines: Sequence[str]) -> None:
    """Print lines, then the warnings about the calibration."""
    for line in lines:
        show(*([line] if line.startswith(TO_COPY) else _wrapped(line)))
    sys.stdout.flush()
    common.print_warnings([f"{calibrated.path}: {each}" for each in (*calibrated.objections, *calibrated.doubts)])


# beginnings of lines that are copied, and stay in one piece
TO_COPY = ("TF:", "URDF:", "<", "  ")


def _wrapped(line: str) -> list[str]:
    """Return a line, broken between words on a terminal."""
    if not sys.stdout.isatty():
        return [line]
    import textwrap

    width = shutil.get_terminal_size().columns
    return textwrap.wrap(
        printable(line), width, subsequent_indent="        ", break_long_words=False, break_on_hyphens=False
    )
