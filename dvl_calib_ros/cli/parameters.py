"""List all parameters, models, effects, drivers, warnings and commands: the tables of docs/, and parameter files."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import InputError
from ..standard_streams import show

# tables of messages by their names in `verdict.reasons`
_TABLES = {
    "findings": "every warning with its meaning and remedy",
    "doctor": "everything that the doctor can find wrong with a bag",
    "verdicts": "every reason for which a calibration is or is not to be used",
    "comparisons": "everything that compare can say",
    "configurations": "alternatives to the configuration that fit the data",
    "selections": "why a model is selected",
    "diagnoses": "everything that diagnose can conclude",
    "unpaired": "everything that diagnose --simulator can conclude",
    "manoeuvres": "everything that the live view can say is to be driven next",
    "discoveries": "what discovery skips or guesses in a recording",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--yaml", action="store_true", help="a ROS 2 parameter file with every default")
    what.add_argument("--models", action="store_true", help="what each model assumes and when it is wrong")
    what.add_argument("--drivers", action="store_true", help="the message types that DVLs are read from, and how")
    what.add_argument("--effects", action="store_true", help="what can be simulated and diagnosed, with its parameters")
    for name, help_text in _TABLES.items():
        what.add_argument(f"--{name}", action="store_true", help=help_text)
    what.add_argument("--commands", action="store_true", help="every command")
    what.add_argument("--urdf", type=Path, metavar="FILE", help="a parameter file that begins with a URDF's mounting")
    parser.add_argument("--joint", metavar="NAME", help="the DVL's joint in the URDF; default: the one above dvl_link")
    parser.add_argument(
        "--base-frame", default="base_link", metavar="LINK", help="body in the URDF; default: %(default)s"
    )


def run(arguments: argparse.Namespace) -> None:
    """Print the requested table."""
    if arguments.joint is not None and arguments.urdf is None:
        raise InputError("--joint needs --urdf")
    show(*_table(arguments).splitlines())


def _table(arguments: argparse.Namespace) -> str:
    """Return the requested table; import only what it needs."""
    if arguments.effects:
        from ..effects.registry import effect_table

        return effect_table()
    if arguments.drivers:
        from ..messages.drivers import driver_table

        return driver_table()
    if arguments.commands:
        return command_table()
    if table := next((name for name in _TABLES if getattr(arguments, name)), None):
        from ..verdict.reasons import TABLES, lookup

        return lookup(TABLES[table])
    if arguments.urdf is not None:
        from ..files.mounting import urdf_parameters
        from ..files.urdf import read_urdf

        return urdf_parameters(read_urdf(arguments.urdf), arguments.base_frame, "dvl_link", arguments.joint)
    from ..files.parameter_files import model_table, parameter_file_text, parameter_table

    return (parameter_file_text if arguments.yaml else model_table if arguments.models else parameter_table)()


def command_table() -> str:
    """Return a table of all commands, in Markdown."""
    from .commands import COMMANDS

    lines = ["| command | does |", "|---|---|"]
    lines += [f"| `{command.name}` | {command.help} |" for command in COMMANDS]
    return "\n".join(lines) + "\n"
