"""Options, profiles, progress, reports and tables that several commands share."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from ..errors import InputError, needing_page, needing_ros, printable
from ..recordings.topics import Topics
from ..standard_streams import give_up, say

if TYPE_CHECKING:
    from rich.console import Console

    from ..calibration.models.parameters import Parameters
    from ..discovery.discovery import Discovery, Given
    from ..node.services import AnsweringNode
    from ..node.shutdown import Ending
    from ..present.document import Document
    from ..recordings.recording import Recording


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --params and -p, as in ROS 2, and --profile, which stores them."""
    parser.add_argument(
        "--profile", metavar="NAME",
        help="profile of topics and parameters: NAME.yaml in ~/.config/dvl-calib, or a file, or none for no profile; "
        f"default: {IN_FOLDER} of this folder",
    )  # fmt: skip
    parser.add_argument("--params", type=Path, metavar="FILE", help="ROS 2 parameter file (YAML), as for the node")
    override = parser.add_argument(
        "-p", dest="overrides", action="append", default=[], metavar="NAME:=VALUE", help="set one parameter; repeatable"
    )
    override.completer = _parameter_completions  # type: ignore[attr-defined]  # argcomplete's convention


def _parameter_completions(**_: Any) -> list[str]:
    """Return the completions of -p: ``name:=`` and, for a choice, each of its values."""
    from ..calibration.models.parameters import SCHEMA

    choices = [f"{name}:={choice}" for name, spec in SCHEMA.items() for choice in spec.choices]
    return choices + [f"{name}:=" for name, spec in SCHEMA.items() if not spec.choices]


def add_topic_options(parser: argparse._ActionsContainer) -> None:
    """Add --dvl-topic, --gnss-topic and --imu-topic of the node."""
    for role, default in vars(Topics()).items():
        parser.add_argument(f"--{role}-topic", default=default, metavar="TOPIC", help=f"default: {default}")


def add_discovery_options(parser: argparse.ArgumentParser) -> None:
    """Add the parameters, and the topics of recordings, whose defaults are found by type and content."""
    add_parameter_options(parser)
    for role, default in vars(Topics()).items():
        none = "" if role == "dvl" else "; none: do without"
        help_ = f"default: {default}, else found by type and content{none}"
        parser.add_argument(f"--{role}-topic", metavar="TOPIC", help=help_)
    add = parser.add_argument
    add("--dvl-fields", dest="overrides", action="append", type="dvl_fields:={}".format, metavar="MAP",
        help="how to read an unlisted DVL message type: velocity=vel.x,vel.y,vel.z,valid=lock")  # fmt: skip
    add("--restamp", dest="overrides", action="append", type="restamp:={}".format, metavar="log|TOPICS",
        help="use recording times instead of stamps, for all messages or for topics (A,B)")  # fmt: skip


def opened(bags: Sequence[Path], parameters: Parameters) -> Recording:
    """Open recordings. Raises InputError."""
    from ..recordings.recording import open_recording

    with progress("reading") as on_progress:
        return open_recording(bags, None, parameters, on_progress)


def discovered(
    arguments: argparse.Namespace, bags: Sequence[Path], parameters: Parameters
) -> tuple[Recording, Discovery]:
    """Open recordings and find their topics, mounting and frames; options take precedence. Raises InputError.

    parameters: as loaded by `load` from the same options.
    """
    from ..discovery.discover import discover

    recording = opened(bags, parameters)
    return recording, discover(recording, parameters, given(arguments))


def given(arguments: argparse.Namespace) -> Given:
    """Return the topics and parameters that the options name. Raises InputError."""
    from ..discovery.discovery import Given
    from ..files.parameter_files import given_parameters

    named = given_parameters(arguments.params, arguments.overrides)
    return Given(arguments.dvl_topic, arguments.gnss_topic, arguments.imu_topic, named)


def options_given(arguments: argparse.Namespace) -> list[str]:
    """Return the options that name parameters and topics, for the command that is suggested next."""
    from ..present.numbers import options

    topics = [(role, getattr(arguments, f"{role}_topic")) for role in ("dvl", "gnss", "imu")]
    return options(topics, arguments.overrides, arguments.params)


def found_lines(discovery: Discovery, bags: Sequence[Path]) -> list[str]:
    """Return the discovered values with their sources in sentences, first the topics of the bags."""
    names = ", ".join(bag.name or str(bag) for bag in bags)
    return [f"{names}: {discovery.found[0]}", *discovery.found[1:]]


def print_found(discovery: Discovery, bags: Sequence[Path], first_only: bool = False) -> None:
    """Print the discovered values with their sources, dim. first_only: only the topics."""
    from rich.markup import escape

    out = console()
    for sentence in found_lines(discovery, bags)[: 1 if first_only else None]:
        out.print(f"[dim]{escape(sentence)}[/]")


def add_storage_options(parser: argparse.ArgumentParser) -> None:
    """Add --storage and --compression of a bag to write."""
    from ..bags.writer import Compression, Storage

    storages, compressions = [each.value for each in Storage], [each.value for each in Compression]
    parser.add_argument("--storage", choices=storages, default="mcap", help="default: %(default)s")
    parser.add_argument(
        "--compression", choices=compressions, default="none", help="chunk only for mcap; default: %(default)s"
    )


def load(arguments: argparse.Namespace, defaults: Mapping[str, Any] | None = None) -> Parameters:
    """Load parameters from --params and -p. defaults: values instead of the schema's defaults."""
    from ..files.parameter_files import load_parameters

    return load_parameters(arguments.params, arguments.overrides, defaults)


def chosen(option: str, text: str, names: Sequence[str]) -> list[str]:
    """Return the unique names in an option such as ``M3,M7`` or ``all``. Raises InputError for unknown names."""
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
    """Raise InputError before work is done if an output cannot be written or is also an input.

    Also without the libraries that --report needs.

    files, folders: options that name outputs. All other paths in the arguments and the parameters are inputs.
    also_read: further inputs. also_written: further outputs, by their names in errors.
    """
    from ..disk.atomic import check_folder_writable, check_writable
    from ..files.output_paths import check_outputs as check_apart
    from ..files.output_paths import check_report_name

    given = {name: value for name, value in vars(arguments).items() if isinstance(value, Path)}
    for path in [*(given[name] for name in files if name in given), *(also_written or {}).values()]:
        check_writable(path)
    read = [*also_read, *(path for name, path in given.items() if name not in (*files, *folders))]
    read += [path for value in vars(arguments).values() if isinstance(value, list) for path in value
             if isinstance(path, Path)]  # fmt: skip
    if hasattr(arguments, "overrides") and (initial := load(arguments).initial_calibration):
        read.append(Path(initial))
    for folder in (given[name] for name in folders if name in given):
        if os.path.islink(folder) and not folder.exists():
            raise InputError(f"{folder}: is a link that leads nowhere; give another name, or remove it first")
        check_folder_writable(folder)
    as_options = [{f"--{name}": given[name] for name in names if name in given} for names in (files, folders)]
    check_apart(as_options[0] | dict(also_written or {}), read, as_options[1])
    if "report" in given:
        check_report_name(given["report"], *([".png"] if arguments.command == "compare" else []))
        with needing_page("--report"):
            from ..present import page  # noqa: F401


def console(stderr: bool = False) -> Console:
    """Return a rich console, without styles if the output is no terminal. Each printed string becomes one line."""
    from rich.console import Console as RichConsole

    class Console(RichConsole):
        def print(self, *objects: Any, **options: Any) -> None:
            super().print(*(printable(each) if isinstance(each, str) else each for each in objects), **options)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # main handles it; rich would exit with 1

    return Console(stderr=stderr, width=_width(sys.stderr if stderr else sys.stdout), highlight=False, emoji=False)


def _width(stream: TextIO) -> int | None:
    """Return None for a terminal, else 160 columns, enough for every table."""
    return None if stream.isatty() else 160


def print_warnings(notes: Sequence[str]) -> None:
    """Print warnings on standard error."""
    from rich.markup import escape

    errors = console(stderr=True)
    try:
        for note in notes:
            errors.print(f"[yellow]warning:[/] {escape(note)}", soft_wrap=not sys.stderr.isatty())
    except OSError:
        give_up(sys.stderr)  # the result is still printed if standard error is closed


def print_document(document: Document, warnings: Sequence[str] = ()) -> None:
    """Print a result: the answer, its warnings on standard error, then the sections.

    warnings: further ones, before those of the document.
    """
    from rich.text import Text

    from ..present.terminal import answer_shown, sections_shown

    out = console()
    for each in answer_shown(document):
        out.print(each)
    sys.stdout.flush()
    print_warnings([*warnings, *document.warnings])
    for each in sections_shown(document):
        out.print(each, soft_wrap=isinstance(each, Text) and bool(each.no_wrap))


@contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on standard error, if that is a terminal; yields the function that sets the share 0..1."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(escape(printable(what)), total=1.0)
        yield lambda share: bar.update(task, completed=share)


def write_json(path: Path, document: Any) -> None:
    """Write JSON atomically."""
    from ..disk.text_files import write_json as write

    write(path, document)


def deliver(answer: Callable[[], None], *writes: tuple[Path | None, Callable[[Path], object]]) -> None:
    """Write the results and print the answer, each even if another fails.

    writes: path (None: not wanted) and the function that writes it. Raises InputError at the end for failed writes.
    """

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
    """Start a node in this process. what: the command or option, for errors. Raises InputError.

    Yields the node and the watch for signals that end the process.
    """
    from ..node.shutdown import Ending

    with Ending() as ending:
        with needing_ros(what):
            import rclpy

            from ..node.services import AnsweringNode, init_ros
        init_ros([])
        node = AnsweringNode(name)
        try:
            yield node, ending
        finally:
            node.destroy_node()  # type: ignore[no-untyped-call]
            rclpy.try_shutdown()


def share_folder() -> Path:
    """Return the folder of bags/ and config/: the source tree or share/dvl_calib_ros. Raises InputError."""
    candidates = [Path(__file__).resolve().parents[2], Path(sys.prefix) / "share" / "dvl_calib_ros"]
    try:
        from ament_index_python.packages import get_package_share_directory

        candidates.append(Path(get_package_share_directory("dvl_calib_ros")))
    except Exception:  # not installed through ament, or no ROS
        pass
    for folder in candidates:
        if (folder / "bags").is_dir():
            return folder
    raise InputError(f"the shipped bags are not installed; looked in {', '.join(map(str, candidates))}")


def add_report_option(parser: argparse.ArgumentParser) -> None:
    """Add --report FILE."""
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a report to look at (HTML, one file)")


def write_page(path: Path, result: object) -> None:
    """Write a result's report, as `page.write_report`."""
    from ..present.page import write_report

    write_report(path, result)


def result_files(arguments: argparse.Namespace, result: Any) -> list[tuple[Path | None, Callable[[Path], object]]]:
    """Return --json and --report with the functions that write a result, for `deliver`."""

    def write_plain_data(path: Path) -> None:
        from ..present.result_documents import PLAIN_DATA

        write_json(path, PLAIN_DATA[type(result)](result))

    return [(arguments.json, write_plain_data), (arguments.report, partial(write_page, result=result))]


# A vehicle's topics and parameters, stored in a file and used by every command that takes them.

IN_FOLDER = Path(".dvl-calib.yaml")
# Options that a profile may hold next to `parameters`. None names an output file.
OPTIONS = ("dvl-topic", "gnss-topic", "imu-topic", "params")


def with_profile(argv: Sequence[str], arguments: argparse.Namespace) -> list[str]:
    """Return a command line with the profile's options in front of its own, which override them.

    Prints the profile and its options on standard error. Raises InputError.
    """
    path = _profile_file(arguments.profile)
    if path is None:
        return [*argv]
    words = _profile_words(path)
    say(f"profile {path}: {shlex.join(words)}")
    after = list(argv).index(arguments.command) + 1
    return [*argv[:after], *words, *argv[after:]]


def _profile_file(name: str | None) -> Path | None:
    """Return the file of a profile, by default the one in the current folder, if any."""
    if name is None:
        return IN_FOLDER if IN_FOLDER.exists() else None
    if name == "none":
        return None
    if "/" in name or name.endswith(".yaml"):
        return Path(name)
    folder = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "dvl-calib"
    path = folder / f"{name}.yaml"
    if not path.exists():
        existing = ", ".join(sorted(each.stem for each in folder.glob("*.yaml"))) or "none"
        raise InputError(f"--profile: {path} does not exist; profiles there: {existing}")
    return path


def _profile_words(path: Path) -> list[str]:
    """Return a profile's content as command-line words. Raises InputError."""
    from ..disk.text_files import load_yaml
    from ..files.parameter_files import as_yaml

    content = load_yaml(path, "profile")
    allowed = (*OPTIONS, "parameters")
    if not isinstance(content, dict) or not content.keys() <= set(allowed):
        other = ", ".join(map(repr, content.keys() - set(allowed))) if isinstance(content, dict) else "no names"
        raise InputError(f"{path}: no profile ({other}); it holds {', '.join(allowed)}")
    parameters = content.pop("parameters", {})
    if not isinstance(parameters, dict):
        raise InputError(f"{path}: parameters is not a list of name: value")
    for name, value in content.items():
        if not isinstance(value, str):
            raise InputError(f"{path}: {name} is no text")
    if "params" in content:  # the path is relative to the profile
        content["params"] = path.parent / content["params"]
    words = [f"--{name}={value}" for name, value in content.items()]
    return words + [word for name, value in parameters.items() for word in ("-p", f"{name}:={as_yaml(value)}")]
