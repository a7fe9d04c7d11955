"""List every parameter and model, as the code defines them: the tables of the README, and config/calibration.yaml."""

from __future__ import annotations

import argparse

NAME = "parameters"
HELP = "list every parameter, or every model, or write a parameter file"
EXAMPLE = "dvl-calib parameters --yaml > calibration.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--yaml", action="store_true", help="a ROS 2 parameter file with every default")
    what.add_argument("--models", action="store_true", help="what each model assumes and when it is wrong")


def run(arguments: argparse.Namespace) -> None:
    """Print."""
    from ..io.parameter_files import model_table, parameter_file_text, parameter_table

    make = parameter_file_text if arguments.yaml else model_table if arguments.models else parameter_table
    print(make(), end="")
