"""Command line of ``dvl-calib``: parser, errors, signals, closed streams, and recordings that change meanwhile."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from ..standard_streams import give_up, open_streams, say
from ..version import __version__
from .commands import COMMANDS


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Help formatter that wraps paragraphs to the terminal's width and keeps a command to copy on one line."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        import textwrap

        paragraphs = text.split("\n\n")
        return "\n\n".join(
            each if each.startswith("example:") else textwrap.fill(" ".join(each.split()), width) for each in paragraphs
        )


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Print the usage error in one line and exit with 2."""
        from ..errors import printable

        self.exit(2, f"{self.prog}: {printable(message)}; see {self.prog} --help\n")

    def parse_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def, override]
        """Parse. An unknown option is an error of its command, whose help has the known ones."""
        arguments, unknown = self.parse_known_args(args, namespace)
        if unknown:
            self.prog = f"{self.prog} {arguments.command}"
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return arguments


def build_parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """Build the parser with all commands; import only the called command and add its arguments."""
    parser = _Parser(
        prog="dvl-calib",
        description="Calibrate a Doppler velocity log (DVL): live on ROS 2, or over recorded bags.",
        epilog="example: dvl-calib replay my_bag --models all",
    )
    parser.add_argument("--version", action="version", version=f"dvl-calib {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    for command in COMMANDS:
        subparser = commands.add_parser(
            command.name, help=command.help, epilog=f"example: {command.example}", formatter_class=_Formatter
        )
        if command.name in argv:
            module = command.load()
            subparser.description = (module.__doc__ or "").strip()
            subparser.set_defaults(run=module.run)
            module.add_arguments(subparser)
    return parser


def run(argv: Sequence[str]) -> int:
    """Run a command as `main.main`, but raise an interrupt instead of handling it."""
    if "_ARGCOMPLETE" in os.environ:
        _complete()
    open_streams()
    # Our matrices are small: more BLAS threads only wait for each other (2.5 times the CPU time in a diagnosis). This
    # must come before numpy is imported, which a command does when called.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without φ must not end the run
            stream.reconfigure(errors="replace")
    try:
        with _terminated_as_interrupted():
            return _run(argv)
    except ModuleNotFoundError as error:  # the package was built by colcon, which installs no dependencies
        name = (error.name or "").partition(".")[0]
        if name in ("", __name__.partition(".")[0]):
            raise
        called = next(command.name for command in COMMANDS if command.name in argv)
        return _fail(called, f"needs the Python package {name}, which is not installed; pip install {name}")


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end a command like Ctrl-C, so that temporary files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is signal.default_int_handler:  # not if the ending node ignores it now
                signal.signal(number, handler)


def _run(argv: Sequence[str]) -> int:
    """Parse and run. Return the exit code, with errors printed in one line."""
    parser = build_parser(argv)
    arguments = parser.parse_args(argv)
    from ..calibration.models.parameters import ParameterError
    from ..errors import InputError

    recordings = recordings_now(arguments)
    try:
        if hasattr(arguments, "profile"):
            from .common import with_profile

            arguments = parser.parse_args(with_profile(argv, arguments))
        if "" in argv and any(str(path) == "." for path in paths_in(arguments)):  # pathlib turns an empty name into "."
            raise InputError("the name of a file or folder is empty; is a variable of the shell not set?")
        code = int(arguments.run(arguments) or 0)
        sys.stdout.flush()
        for sentence in changed(recordings, recordings_now(arguments)):
            say(f"warning: {sentence}")
        return code
    except (InputError, ParameterError) as error:
        return _fail(arguments.command, str(error))
    except BrokenPipeError:  # | head
        give_up(sys.stdout)
        return 0
    except OSError as error:
        give_up(sys.stdout)  # in case standard output is the file that cannot be written
        name = "" if error.filename is None else f"{error.filename}: "
        return _fail(arguments.command, f"{name}{error.strerror or error}; check names, permissions and space")


def _complete() -> NoReturn:
    """Answer the shell's request for completions, and exit."""
    import argcomplete

    argcomplete.autocomplete(build_parser(os.environ.get("COMP_LINE", "").split()))
    sys.exit(1)  # not reached: autocomplete ends the process


def _fail(command: str, message: str) -> int:
    """Print a message in one line on standard error. Return exit code 2."""
    try:
        sys.stdout.flush()  # otherwise the interpreter complains about it at exit
    except OSError:
        give_up(sys.stdout)
    try:
        os.getcwd()
    except OSError:
        message += "; the folder that this was started in is gone, change to another"
    say(f"dvl-calib {command}: {' '.join(message.splitlines())}")
    return 2


State = tuple[int, int, int]
"""Inode, size in bytes and modification time in ns of a file."""
# recordings, and the journals of their recorders
_SUFFIXES = (".mcap", ".db3", ".bag", ".db3-wal", ".db3-journal", ".zstd")


def recordings_now(arguments: argparse.Namespace) -> dict[Path, State]:
    """Return the current state of all recording files in a command's arguments."""
    files: dict[Path, State] = {}
    for path in paths_in(arguments):
        with suppress(OSError, ValueError):  # the command itself reports unreadable files
            for file in _files(path):
                status = file.stat()
                files[file] = (status.st_ino, status.st_size, status.st_mtime_ns)
    return files


def changed(before: Mapping[Path, State], after: Mapping[Path, State]) -> list[str]:
    """Return a warning for every recording that changed or vanished."""
    return [
        f"{path}: changed while it was read, so the answer may describe only a part of it; run this again when "
        "nothing writes to it any more"
        for path, state in before.items()
        if after.get(path) != state
    ]


def paths_in(arguments: argparse.Namespace) -> Iterator[Path]:
    """Yield every path in a command's arguments."""
    for value in vars(arguments).values():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, Path):
                yield each


def _files(path: Path) -> list[Path]:
    """Return a folder's recordings, or a recording and its journals."""
    if path.is_dir():
        return [path / name for name in sorted(os.listdir(path)) if name.endswith(_SUFFIXES)]
    candidates = [path, *(path.with_name(path.name + journal) for journal in ("-wal", "-journal"))]
    return [file for file in candidates if file.name.endswith(_SUFFIXES) and file.exists()]
