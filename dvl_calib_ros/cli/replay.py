"""Calibrate with recorded bags: the estimator of the node on rosbag2 folders or files, several as one.

Topics, mounting, lever arm and frames are found in the bag unless an option names them. The answer comes first: a
verdict, the corrected mounting and the next command. -p takes angles in degrees: -p mounting_rpy:="[0, 0, 45deg]".

Exit code 0: the calibration is usable. 1: it is rejected. 2: bad usage or input.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from . import common

if TYPE_CHECKING:
    from ..bag_replay.replay import Replayed
    from ..discovery.discovery import Discovery
    from ..verdict.reasons import Reason


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap, .db3 or .bag")
    parser.add_argument("--models", metavar="NAMES", help="also show these models, such as M3,M7 or all")
    parser.add_argument("--merge", action="store_true", help="calibrate bags together even if the mounting moved")
    parser.add_argument("-v", "--verbose", action="store_true", help="show counts, selection and all models as well")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write estimates, counts and selection as JSON")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the result file (YAML) of the selected model")
    common.add_report_option(parser)
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Examine the bags, replay them, save, print. Return 1 for a rejected calibration."""
    from ..bag_replay.replay import replay_document
    from ..calibration.models import MODELS
    from ..examination.examine import judged_replay
    from ..files.result_file import result_document, save_result
    from ..present.replay import replayed as document_of
    from ..verdict.kinds import Severity

    extra = [] if arguments.models is None else common.chosen("--models", arguments.models, tuple(MODELS))
    models = list(MODELS) if arguments.verbose or not extra else extra
    parameters = common.load(arguments)
    common.check_outputs(arguments, "json", "save", "report")
    recording, discovery = common.discovered(arguments, arguments.bags, parameters)
    with common.progress("replaying") as on_progress:
        replayed = judged_replay(
            recording, discovery, on_progress, merge=arguments.merge, with_history=arguments.report is not None
        )
    result = replayed.result
    if extra and not any(name in result.estimates for name in extra):
        raise InputError(
            f"--models: {', '.join(extra)} needs positions, and the reference has velocities; name another model, "
            "or a topic of positions with --gnss-topic"
        )
    discovery = discovery.with_mounting(result.parameters["mounting_rpy"])

    def write(path: Path) -> None:
        common.write_json(path, replay_document(replayed, models) | {"discovery": discovery.document()})

    def save(path: Path) -> None:
        document = result_document(result, replayed.dvl_frame, replayed.turned, replayed.water)
        save_result(path, document, round(parameters.result_backups))

    common.deliver(
        lambda: _print(arguments, replayed, discovery, models if arguments.verbose else extra),
        (arguments.json, write),
        (arguments.save, save),
        (arguments.report, lambda path: common.write_page(path, document_of(replayed, arguments.bags, models))),
    )
    verification = result.verifications.get(result.selected)
    return int(verification is not None and verification.verdict is Severity.REJECT)


def _print(arguments: argparse.Namespace, replayed: Replayed, discovery: Discovery, models: Sequence[str]) -> None:
    """Print the result of a replay with warnings and next commands."""
    from ..present import replay as present

    findings = shown_findings(replayed, discovery, [replayed.result.selected, *models])
    known = {str(found) for found in replayed.findings}
    verification = replayed.result.verifications.get(replayed.result.selected)
    answered = {each.sentence for each in verification.reasons} if verification is not None else set()
    doubts = [each for each in discovery.doubts if each not in answered]
    warnings = [*doubts, *(note for note in replayed.notes if note not in known), *map(str, findings)]
    named = common.options_given(arguments)
    commands = present.next_commands(replayed, arguments.bags, arguments.save, named, bool(findings))
    document = present.replayed(
        replayed,
        arguments.bags,
        models,
        details=bool(models),
        warnings=warnings,
        found=common.found_lines(discovery, arguments.bags),
        commands=commands,
    )
    common.print_document(document)


def shown_findings(replayed: Replayed, discovery: Discovery, models: Sequence[str]) -> list[Reason]:
    """Return the findings to print: only of requested models, and none that discovery has settled."""
    other = [f"{name}: " for name in replayed.result.estimates if name not in models]
    settled = {"BAG_NO_GNSS"} | ({"IMU_FRAME"} if discovery.knows_imu else set())
    return [
        found
        for found in replayed.findings
        if found.code not in settled and not any(found.says.startswith(prefix) for prefix in other)
    ]
