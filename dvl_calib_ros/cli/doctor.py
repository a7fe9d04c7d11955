"""Look at a recording before it is calibrated: what is in it, what is wrong with it, whether it can calibrate.

One page: topics and rates, where the DVL sits, every fault with its remedy, what the motion shows, what to type next.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from . import common
from .reporting import add_report_option, report_writer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folder, .mcap or .db3")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    add_report_option(parser)
    common.add_parameter_options(parser)
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Examine, print, save."""
    from ..examination.examine import examine
    from ..present import examination as present

    common.check_outputs(arguments, "json", "report")
    write_report = report_writer(arguments)
    parameters = common.load(arguments)
    examination = examine(common.opened(arguments.bags, parameters), parameters, common.given(arguments))
    common.deliver(
        lambda: common.print_document(present.examination(examination)),
        (arguments.json, lambda path: common.write_json(path, examination.document())),
        (arguments.report, lambda path: write_report(path, examination)),
    )
