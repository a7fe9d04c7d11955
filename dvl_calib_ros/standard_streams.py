"""Standard streams as a process may be given them: closed, full, or with nobody at the other end."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TextIO


def open_streams() -> None:
    """Let those of standard input, output and error that are closed lead to nowhere.

    Else the next file that is opened would be taken for one of them, and what is said would be written into it.
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
    """Print a line on standard error, if there is somebody to read it."""
    from .errors import printable

    with suppress(OSError, ValueError):
        print(printable(line), file=sys.stderr, flush=True)


def show(*lines: str) -> None:
    """Print lines, each of which is one whatever is in it, on standard output."""
    from .errors import printable

    for line in lines:
        print(printable(line))


def give_up(stream: TextIO) -> None:
    """Let what is still to be written to a standard stream, and cannot be, lead to nowhere."""
    handle = os.open(os.devnull, os.O_WRONLY)
    with suppress(OSError, ValueError):
        os.dup2(handle, stream.fileno())
    os.close(handle)
