"""Calibrate with recorded bags: the same estimator as the node's, over rosbag2 folders or files, several as one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from . import common
from .reporting import add_report_option, report_writer

if TYPE_CHECKING:
    from ..replay.replay import Replayed

NAME = "replay"
HELP = "calibrate with recorded bags"
VERDICT_COLOURS = {"accept": "green", "marginal": "yellow", "reject": "red"}
EXAMPLE = "dvl-calib replay my_bag --models all --params calibration.yaml --save calibration_result.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap or .db3")
    parser.add_argument("--models", default="all", help="models to show, such as M3,M7; default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write estimates, counts and selection as JSON")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the result file (YAML) of the selected model")
    add_report_option(parser)
    common.add_parameter_options(parser)
    common.add_topic_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Replay, print, save."""
    from ..calibration.models import MODELS
    from ..files.result_file import result_document, save_result
    from ..replay.replay import Topics, replay, replay_document

    models = common.chosen("--models", arguments.models, tuple(MODELS))
    parameters = common.load(arguments)
    common.check_outputs(arguments, "json", "save", "report")
    write_report = report_writer(arguments, "write_replay_report")
    topics = Topics(arguments.dvl_topic, arguments.gnss_topic, arguments.imu_topic)
    with common.progress("replaying") as on_progress:
        replayed = replay(arguments.bags, parameters, topics, on_progress, with_history=write_report is not None)
    result = replayed.result
    if arguments.json is not None:
        common.write_json(
            arguments.json,
            replay_document(result, models)
            | {
                "dvl": {"type": replayed.dvl_type, "turned_from_frd": replayed.turned},
                "findings": [found.as_dict() for found in replayed.findings],
            },
        )
    if arguments.save is not None:
        document = result_document(result, replayed.dvl_frame, replayed.turned)
        save_result(arguments.save, document, round(parameters.result_backups))
    if write_report is not None:
        write_report(arguments.report, replayed, arguments.bags, models)
    _print(replayed, models)


def _print(replayed: Replayed, models: Sequence[str]) -> None:
    result = replayed.result
    common.print_warnings(replayed.notes)
    out = common.console()
    dvl, pairing = result.counts["dvl"], result.counts["pairing"]
    seconds = 1e-9 * ((result.last_ns or 0) - (result.first_ns or 0))
    title = f"{dvl['accepted']} DVL samples over {seconds:.1f} s, {pairing['paired']} paired with GNSS"
    out.print(common.result_table(result, models, title))
    for name in ("dvl", "reference", "imu"):
        counts = result.counts[name]
        lost = ", ".join(f"{value} {key}" for key, value in counts.items() if value and key != "received")
        out.print(f"{name}: {counts['received']} received" + (f": {lost}" if lost else ""))
    out.print(f"dvl data: {replayed.dvl_data}")
    out.print(f"selected: {result.selected} ({result.selected_because})")
    for entry in result.estimate.observability:
        if entry.missing:
            out.print(f"{result.selected} has not seen {entry.name} ({entry.axis}) yet; it needs {entry.missing}")
    verification = result.verifications[result.selected]
    word = verification.verdict.value
    out.print(
        f"verdict on {result.selected}: [bold {VERDICT_COLOURS[word]}]{word}[/]: {'; '.join(verification.reasons)}"
    )
