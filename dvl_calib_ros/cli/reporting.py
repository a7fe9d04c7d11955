"""--report, for the commands that have one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def add_report_option(parser: argparse.ArgumentParser) -> None:
    """--report FILE."""
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a report to look at (HTML, one file)")


def report_writer(arguments: argparse.Namespace, name: str = "write_report") -> Callable[..., None]:
    """A function of present/page.py, which nobody is to call if no report is asked for.

    Raises InputError, before any work is done, if a library is missing that reports are made with.
    """
    if arguments.report is None:
        return _no_report
    from ..errors import InputError

    try:
        from ..present import page
    except ModuleNotFoundError as error:
        raise InputError(f"--report needs matplotlib and jinja2 ({error}); pip install matplotlib jinja2") from error
    write: Callable[..., None] = getattr(page, name)
    return write


def _no_report(*_: object) -> None:
    raise AssertionError("no report was asked for")
