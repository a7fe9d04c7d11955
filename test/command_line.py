"""Commands run in this process or a fresh one, and what they must say."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from dvl_calib_ros.cli.main import main


def succeed(capsys, *arguments) -> tuple[str, str]:
    """Output and errors of a command that must answer, if only with a reject."""
    assert main([str(argument) for argument in arguments]) in (0, 1)
    output = capsys.readouterr()
    return output.out, output.err


def fail(capsys, *arguments) -> str:
    """The one line of a command that must be refused."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = stop.code
    output = capsys.readouterr()
    assert code == 2 and output.out == ""
    assert output.err.count("\n") == 1 and output.err.startswith("dvl-calib")
    return output.err


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file grows beyond so many bytes, by the kernel's limit: the same calls fail half-way as on a full disk."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    compiled, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # Python 3.11 keeps what was cut off
    try:
        yield
    finally:
        sys.dont_write_bytecode = compiled
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


def unfit(text: str) -> list[str]:
    """What must not come to a terminal, each with what is around it."""
    return [text[max(at - 60, 0) : at + 9] for at, c in enumerate(text) if not c.isprintable() and c not in "\n\t"]


def in_fresh_process(statement: str, modules: list[str]) -> list[str]:
    """Which of these modules a statement imports."""
    shown = f"print(*(m for m in {modules} if m in sys.modules))"
    script = f"import sys\ntry:\n    {statement}\nexcept SystemExit: pass\n{shown}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1].split()
