"""Calibrate every recording below folders or object stores, and keep the results as one catalogue.

The catalogue has one row per recording and parameter (FOLDER/rows/*.parquet, for DuckDB, pandas, Polars) and a page
(FOLDER/index.html). Unchanged recordings are skipped, so an interrupted run continues. A recording that cannot be
calibrated is a row with its error.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from . import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("places", nargs="+", metavar="PLACE", help="folder, file, or URL such as s3://bucket/dives")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="catalogue to create or to continue")
    parser.add_argument(
        "--vehicle-from",
        metavar="PATTERN",
        help="regular expression whose first group in the path names the vehicle; default: first folder below PLACE",
    )
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes; default: one per core")
    parser.add_argument("--dask", default="", metavar="ADDRESS", help="scheduler to work on, such as tcp://host:8786")
    common.add_discovery_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Calibrate new and changed recordings, write the page, print."""
    from ..fleet_catalogue.update import run_fleet
    from ..parallel import Workers
    from ..present.comparison import fleet as present
    from ..present.page import write_report

    parameters, given = common.load(arguments), common.given(arguments)
    workers = Workers(arguments.jobs, arguments.dask)
    with common.progress("calibrating") as on_progress:
        found = run_fleet(
            arguments.places, arguments.out, parameters, given, workers, arguments.vehicle_from, on_progress
        )
    common.deliver(lambda: common.print_document(present(found)), (found.page, lambda path: write_report(path, found)))
