"""Standard streams that may be closed, full, or without a reader."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TextIO


def open_streams() -> None:
    """Open closed standard streams on /dev/null.

    Otherwise the next opened file would get the number of a standard stream, and messages would be written into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            handle = os.open(os.devnull, os.O_RDWR)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))


def say(line: str) -> None:
    """Print a line on standard error, if it has a reader."""
    from .errors import printable

    with suppress(OSError, ValueError):
        print(printable(line), file=sys.stderr, flush=True)


def show(*lines: str) -> None:
    """Print lines on standard output, each escaped to one line."""
    from .errors import printable

    for line in lines:
        print(printable(line))


def give_up(stream: TextIO) -> None:
    """Redirect a standard stream that cannot be written to /dev/null, with its buffered text."""
    handle = os.open(os.devnull, os.O_WRONLY)
    with suppress(OSError, ValueError):
        os.dup2(handle, stream.fileno())
    os.close(handle)
