"""Options, progress, reports and tables that several commands share."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from ..standard_streams import give_up
from . import profile

if TYPE_CHECKING:
    from rich.console import Console

    from ..calibration.models.parameters import Parameters
    from ..discovery.discovery import Discovery, Given
    from ..node.services import AnsweringNode
    from ..node.shutdown import Ending
    from ..present.document import Document
    from ..recordings.recording import Recording


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """--params and -p, as ROS 2 users know them, and --profile, which stores them."""
    profile.add_option(parser)
    parser.add_argument("--params", type=Path, metavar="FILE", help="ROS 2 parameter file (YAML), as for the node")
    override = parser.add_argument(
        "-p", dest="overrides", action="append", default=[], metavar="NAME:=VALUE", help="set one parameter; repeatable"
    )
    override.completer = _parameter_completions  # type: ignore[attr-defined]  # argcomplete's convention


def _parameter_completions(**_: Any) -> list[str]:
    from ..calibration.models.parameters import SCHEMA

    choices = [f"{name}:={choice}" for name, spec in SCHEMA.items() for choice in spec.choices]
    return choices + [f"{name}:=" for name, spec in SCHEMA.items() if not spec.choices]


def add_topic_options(parser: argparse._ActionsContainer) -> None:
    """--dvl-topic, --gnss-topic, --imu-topic, of the node."""
    for role, default in (("dvl", "dvl/twist"), ("gnss", "gnss/twist"), ("imu", "imu/data")):
        parser.add_argument(f"--{role}-topic", default=default, metavar="TOPIC", help=f"default: {default}")


def add_discovery_options(parser: argparse.ArgumentParser) -> None:
    """--dvl-topic, --gnss-topic, --imu-topic of recordings, where they are looked for by type and content."""
    for role, default in (("dvl", "dvl/twist"), ("gnss", "gnss/twist"), ("imu", "imu/data")):
        none = "" if role == "dvl" else "; none: do without"
        help_ = f"default: {default}, else found by type and content{none}"
        parser.add_argument(f"--{role}-topic", metavar="TOPIC", help=help_)
    add = parser.add_argument
    add("--dvl-fields", dest="overrides", action="append", type="dvl_fields:={}".format, metavar="MAP",
        help="how a DVL's type that is not listed is read: velocity=vel.x,vel.y,vel.z,valid=lock")  # fmt: skip
    add("--restamp", dest="overrides", action="append", type="restamp:={}".format, metavar="log|TOPICS",
        help="times of recording instead of stamps, of all messages or of topics (A,B)")  # fmt: skip


def opened(bags: Sequence[Path], parameters: Parameters) -> Recording:
    """Recordings, read once. Raises InputError."""
    from ..recordings.recording import open_recording

    with progress("reading") as on_progress:
        return open_recording(bags, None, parameters, on_progress)


def discovered(arguments: argparse.Namespace, recording: Recording, parameters: Parameters) -> Discovery:
    """What a recording says of topics, mounting and frames, under what options give. Raises InputError.

    parameters: as `load` made them of the same options.
    """
    from ..discovery.discover import discover

    return discover(recording, parameters, given(arguments))


def given(arguments: argparse.Namespace) -> Given:
    """What the options of a command name, which is not looked for. Raises InputError."""
    from ..discovery.discovery import Given
    from ..files.parameter_files import given_parameters

    named = given_parameters(arguments.params, arguments.overrides)
    return Given(arguments.dvl_topic, arguments.gnss_topic, arguments.imu_topic, named)


def options_given(arguments: argparse.Namespace) -> list[str]:
    """Return the options that name parameters and topics, for the command to type next."""
    from ..present.numbers import options

    topics = [(role, getattr(arguments, f"{role}_topic")) for role in ("dvl", "gnss", "imu")]
    return options(topics, arguments.overrides, arguments.params)


def print_found(discovery: Discovery, bags: Sequence[Path], first_only: bool = False) -> None:
    """Print what was found in recordings, and where, dim. first_only: the topics alone."""
    from rich.markup import escape

    out = console()
    names = ", ".join(bag.name or str(bag) for bag in bags)
    for sentence in (f"{names}: {discovery.found[0]}", *([] if first_only else discovery.found[1:])):
        out.print(f"[dim]{escape(sentence)}[/]")


def add_storage_options(parser: argparse.ArgumentParser) -> None:
    """--storage and --compression of a bag to write."""
    from ..bags.writer import Compression, Storage

    storages, compressions = [each.value for each in Storage], [each.value for each in Compression]
    parser.add_argument("--storage", choices=storages, default="mcap", help="default: %(default)s")
    parser.add_argument(
        "--compression", choices=compressions, default="none", help="chunk is MCAP's own; default: %(default)s"
    )


def load(arguments: argparse.Namespace, defaults: Mapping[str, Any] | None = None) -> Parameters:
    """Parameters from --params and -p; defaults: values, other than the schema's own, of what neither sets."""
    from ..files.parameter_files import load_parameters

    return load_parameters(arguments.params, arguments.overrides, defaults)


def chosen(option: str, text: str, names: Sequence[str]) -> list[str]:
    """What an option such as ``M3,M7`` or ``all`` names, each once. Raises InputError for what is not in names."""
    from ..errors import InputError

    if text == "all":
        return list(names)
    given = [name.strip() for name in text.split(",") if name.strip()]
    for name in given:
        if name not in names:
            raise InputError(f"{option}: {name!r} is none of {', '.join(names)}, or all")
    if not given:
        raise InputError(f"{option}: name at least one of {', '.join(names)}, or all")
    return list(dict.fromkeys(given))


def check_outputs(
    arguments: argparse.Namespace,
    *files: str,
    folders: Sequence[str] = (),
    also_read: Sequence[Path] = (),
    also_written: Mapping[str, Path] | None = None,
) -> None:
    """Raise InputError if what options name could not be written, or is read by the same command, before work is done.

    files, folders: options that name what is written. Every other path in the arguments, and what the parameters name,
    is read. also_read: what is read beside. also_written: files that are made beside, by how an error calls them.
    """
    from ..disk.atomic import check_folder_writable, check_writable
    from ..errors import InputError
    from ..files.output_paths import check_outputs as check_apart

    given = {name: value for name, value in vars(arguments).items() if isinstance(value, Path)}
    for name in files:
        if name in given:
            check_writable(given[name])
    for path in (also_written or {}).values():
        check_writable(path)
    read = [*also_read, *(path for name, path in given.items() if name not in (*files, *folders))]
    read += [path for value in vars(arguments).values() if isinstance(value, list) for path in value
             if isinstance(path, Path)]  # fmt: skip
    if hasattr(arguments, "overrides") and (initial := load(arguments).initial_calibration):
        read.append(Path(initial))
    for name in folders:
        if name in given and os.path.islink(given[name]) and not given[name].exists():
            raise InputError(f"{given[name]}: is a link that leads nowhere; give another name, or remove it first")
        if name in given:
            check_folder_writable(given[name])
    as_options = [{f"--{name}": given[name] for name in names if name in given} for names in (files, folders)]
    check_apart(as_options[0] | dict(also_written or {}), read, as_options[1])


def console(stderr: bool = False) -> Console:
    """A rich console; plain text where the output is no terminal. What it prints as a string is one line."""
    from rich.console import Console as RichConsole

    from ..errors import printable

    class Console(RichConsole):
        def print(self, *objects: Any, **options: Any) -> None:
            super().print(*(printable(each) if isinstance(each, str) else each for each in objects), **options)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # main knows what to do; rich would exit with 1

    return Console(stderr=stderr, width=_width(sys.stderr if stderr else sys.stdout), highlight=False, emoji=False)


def _width(stream: TextIO) -> int | None:
    """None for a terminal, which knows its own; elsewhere a table has all the room that it needs."""
    return None if stream.isatty() else 160


def print_warnings(notes: Sequence[str]) -> None:
    """What the user should know, on standard error."""
    from rich.markup import escape

    errors = console(stderr=True)
    try:
        for note in notes:
            errors.print(f"[yellow]warning:[/] {escape(note)}", soft_wrap=True)
    except OSError:
        give_up(sys.stderr)  # who does not read warnings gets the result all the same


def print_document(document: Document) -> None:
    """A result as it is said, its warnings on standard error."""
    from rich.text import Text

    from ..present.terminal import shown

    print_warnings(document.warnings)
    out = console()
    for each in shown(document):
        out.print(each, soft_wrap=isinstance(each, Text) and bool(each.no_wrap))


@contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """A progress bar for a share of 0..1, on standard error and only if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.markup import escape
    from rich.progress import Progress

    from ..errors import printable

    with Progress(console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(escape(printable(what)), total=1.0)
        yield lambda share: bar.update(task, completed=share)


def write_json(path: Path, document: Any) -> None:
    """Write JSON, whole or not at all."""
    from ..disk.text_files import write_json as write

    write(path, document)


def deliver(answer: Callable[[], None], *writes: tuple[Path | None, Callable[[Path], object]]) -> None:
    """Write what was found, and print it, each also where another fails.

    writes: where to, None for nowhere, and how. Raises InputError of what could not be written, in the end.
    """
    from ..errors import InputError

    failed = []
    for path, write in writes:
        try:
            if path is not None:
                write(path)
        except InputError as error:
            failed.append(str(error))
    try:
        answer()
        sys.stdout.flush()
    except OSError:
        if not failed:
            raise
        give_up(sys.stdout)
    if failed:
        raise InputError("; ".join(failed))


@contextmanager
def ros_node(what: str, name: str) -> Iterator[tuple[AnsweringNode, Ending]]:
    """A node of this process, and what asks the process to end. what: the command or option. Raises InputError."""
    from ..errors import needing_ros
    from ..node.shutdown import Ending

    with Ending() as ending:
        with needing_ros(what):
            import rclpy
            from rclpy.signals import SignalHandlerOptions

            from ..node.services import AnsweringNode
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = AnsweringNode(name)
        try:
            yield node, ending
        finally:
            node.destroy_node()  # type: ignore[no-untyped-call]
            rclpy.try_shutdown()


def share_folder() -> Path:
    """Where bags/ and config/ are: in the source tree, or installed under share/dvl_calib_ros. Raises InputError."""
    from ..errors import InputError

    candidates = [
        Path(__file__).resolve().parents[2],
        Path(sys.prefix) / "share" / "dvl_calib_ros",
    ]
    try:
        from ament_index_python.packages import get_package_share_directory

        candidates.append(Path(get_package_share_directory("dvl_calib_ros")))
    except Exception:  # not installed through ament, or no ROS at all
        pass
    for folder in candidates:
        if (folder / "bags").is_dir():
            return folder
    raise InputError(f"the shipped bags are not installed; looked in {', '.join(map(str, candidates))}")


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
