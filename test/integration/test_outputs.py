"""No command writes over what it reads, or writes one file twice, whatever the names are that lead there."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from io_fixtures import replayed, run, selected_alone, write_bag

from dvl_calib_ros.cli.command_line import build_parser
from dvl_calib_ros.cli.commands import COMMANDS
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.files.urdf import numbers


class Command(NamedTuple):
    """arguments: before the outputs, inputs by their names in the folder. files, folders: options that write."""

    arguments: str
    inputs: tuple[str, ...]
    files: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()


LOOSE = "loose/run.db3"
COMMAND = {
    "replay": Command(
        "replay bag --params params.yaml -p initial_calibration:=initial.yaml",
        ("bag", "bag/bag.mcap", "bag/metadata.yaml", "params.yaml", "initial.yaml"), ("--json", "--save", "--report"),
    ),
    "replay of a file": Command("replay loose/run.db3", (LOOSE, f"{LOOSE}-wal"), ("--json", "--save", "--report")),
    "diagnose": Command(
        "diagnose bag --params params.yaml", ("bag", "bag/bag.mcap", "params.yaml"), ("--json", "--apply", "--report"),
        ("--twin",),
    ),
    "diagnose two": Command("diagnose bag loose/run.db3", ("bag", "bag/bag.mcap", LOOSE), ("--json", "--apply")),
    "diagnose against a simulator": Command(
        f"diagnose bag --simulator {LOOSE} --simulator-params params.yaml",
        ("bag", "bag/bag.mcap", LOOSE, "params.yaml"), ("--json", "--report"),
    ),
    "diagnose in rounds": Command(
        f"diagnose bag --simulator {LOOSE} --rounds 1", ("bag", "bag/bag.mcap", LOOSE), ("--json", "--report"),
        ("--keep",),
    ),
    "doctor": Command(
        "doctor bag --params params.yaml", ("bag", "bag/bag.mcap", "params.yaml"), ("--json", "--report"),
    ),
    "evaluate": Command(
        "evaluate runs --partial --params params.yaml", ("runs", "runs/T_dvl.npy", "params.yaml"),
        ("--json", "--csv", "--report"),
    ),
    "evaluate bags": Command("evaluate bag loose/run.db3", ("bag", "bag/bag.mcap", LOOSE), ("--json", "--report")),
    "apply": Command("apply result.yaml", ("result.yaml",), ("--launch", "--fusion")),
    "apply to a URDF": Command(
        "apply result.yaml --urdf r.urdf", ("result.yaml", "r.urdf"), ("-o", "--launch", "--fusion")
    ),
    "apply to an instrument": Command("apply result.yaml --instrument ardupilot", ("result.yaml",), ("--settings",)),
    "apply in place": Command("apply result.yaml", ("result.yaml",), ("--urdf", "--launch")),
    "compare": Command("compare result.yaml bag", ("result.yaml", "bag", "bag/bag.mcap"), ("--json", "--report")),
    "export": Command("export gazebo result.yaml", ("result.yaml",), ("-o",)),
    "fleet": Command("fleet bag loose/run.db3", ("bag", "bag/bag.mcap", LOOSE), (), ("--out",)),
    "salvage": Command("salvage bag loose/run.db3", ("bag", "bag/bag.mcap", LOOSE), (), ("-o",)),
    "import": Command(
        "import runs/T_dvl.npy --gnss runs/T_gnss.npy", ("runs/T_dvl.npy", "runs/T_gnss.npy"), (), ("-o",)
    ),
    "import a folder": Command("import runs", ("runs", "runs/T_dvl.npy"), (), ("-o",)),
    "simulate": Command(
        "simulate --motion-of bag --diagnosis result.yaml", ("bag", "bag/bag.mcap", "result.yaml"), (), ("",)
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    """A folder with an input of every kind."""
    folder = tmp_path_factory.mktemp("outputs") / "original"
    folder.mkdir()
    bag = write_bag(folder / "bag", run(30.0))
    write_bag(folder / "loose_bag", run(30.0), "sqlite3")
    (folder / "loose").mkdir()
    (folder / "loose_bag" / "loose_bag.db3").rename(folder / LOOSE)
    shutil.rmtree(folder / "loose_bag")
    (folder / f"{LOOSE}-wal").touch()
    text = selected_alone(replayed(bag).result)
    for name in ("result.yaml", "initial.yaml"):
        (folder / name).write_text(text)
    (folder / "params.yaml").write_text("/**: {ros__parameters: {min_speed: 0.5}}\n")
    (folder / "runs").mkdir()
    for name in ("T_dvl", "T_gnss"):
        np.save(folder / "runs" / name, [[0.2 * i, 1.5, 0.1, 0.0] for i in range(20)])
    rpy = numbers(np.zeros(3))
    (folder / "r.urdf").write_text(
        f'<robot name="r"><joint name="j" type="fixed"><parent link="base_link"/><child link="dvl_link"/>'
        f'<origin xyz="0 0 0" rpy="{rpy}"/></joint></robot>'
    )
    return folder


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# How an input is named once more: (folder, input) -> the name for the output
ALIASES: dict[str, Callable[[Path, Path], Path]] = {}


def alias(function: Callable[[Path, Path], Path]) -> Callable[[Path, Path], Path]:
    ALIASES[function.__name__] = function
    return function


@alias
def the_same(folder: Path, path: Path) -> Path:
    return path


@alias
def roundabout(folder: Path, path: Path) -> Path:
    return Path("runs") / ".." / path


@alias
def link(folder: Path, path: Path) -> Path:
    (folder / "alias").symlink_to(folder / path)
    return Path("alias")


@alias
def through_a_linked_folder(folder: Path, path: Path) -> Path:
    (folder / "elsewhere").symlink_to(folder / path.parent)
    return Path("elsewhere") / path.name


@alias
def hard_link(folder: Path, path: Path) -> Path:
    if (folder / path).is_dir():
        return path
    os.link(folder / path, folder / "alias")
    return Path("alias")


@alias
def by_descriptor(folder: Path, path: Path) -> Path:
    handle = os.open(folder / path, os.O_RDONLY)
    return Path(f"/proc/self/fd/{handle}")


@alias
def what_its_backup_would_replace(folder: Path, path: Path) -> Path:
    if (folder / path).is_dir():
        return path
    (folder / path).rename(folder / "alias.bak")
    (folder / path).symlink_to(folder / "alias.bak")
    return Path("alias")


@alias
def new_inside(folder: Path, path: Path) -> Path:
    return path / "new" if (folder / path).is_dir() else path


@pytest.fixture
def scratch(original, tmp_path, monkeypatch):
    """Makes the folder anew, and makes it the working directory."""
    monkeypatch.chdir(tmp_path)

    def make() -> Path:
        folder = tmp_path / "folder"
        os.chdir(tmp_path)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(original, folder)
        os.chdir(folder)
        return folder

    return make


def refused(capsys, words: list[str]) -> str:
    try:
        code = main(words)
    except SystemExit as stop:
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2, words
    assert error.count("\n") == 1 and "Traceback" not in error
    return error


@pytest.mark.spread(6)
@pytest.mark.parametrize("name", COMMAND)
def test_no_output_of_a_command_can_be_one_of_its_inputs_by_any_name(scratch, capsys, name):
    command = COMMAND[name]
    for path in command.inputs:
        for number, option in enumerate(command.files + command.folders):
            for how, other_name in ALIASES.items():
                if number and how not in ("the_same", "link"):
                    continue  # all outputs of a command are looked at by one function
                if command.folders and how == "what_its_backup_would_replace":
                    continue  # a new folder replaces nothing
                if name == "import a folder" and how == "new_inside":
                    continue  # its bags may lie beside what they are made of
                folder = scratch()
                output = other_name(folder, Path(path))
                before = snapshot(folder)
                error = refused(capsys, [*command.arguments.split(), *([option] if option else []), str(output)])
                assert snapshot(folder) == before, (path, option, how)
                assert str(output) in error
                if how == "by_descriptor":
                    os.close(int(output.name))


# Options that name what is read; what is not among these is written, and has to be in `COMMAND`
READ = {"--params", "--urdf", "--gnss", "--attitude", "--motion-of", "--diagnosis", "--simulator", "--simulator-params"}
# the demo's bag is its own
APART = {("demo", "--report")}


def test_every_option_that_writes_is_tried_here():
    tried = {(c.arguments.split()[0], option) for c in COMMAND.values() for option in c.files + c.folders}
    for command in COMMANDS:
        parser = build_parser([command.name])._subparsers._group_actions[0].choices[command.name]
        for action in parser._actions:
            option = next(iter(action.option_strings), "")
            if action.type is Path and option and option not in READ:
                assert (command.name, option) in tried | APART


@pytest.mark.parametrize("name", [name for name, command in COMMAND.items() if len(command.files) > 1])
def test_no_two_outputs_can_be_one_file_by_any_name(scratch, capsys, name):
    command = COMMAND[name]
    for number, one in enumerate(command.files):
        for other in command.files[number + 1 :]:
            for how in ("the_same", "link", "hard_link", "through_a_linked_folder", "backup"):
                folder = scratch()
                (folder / "out").write_text("before")
                second = Path("out.bak") if how == "backup" else ALIASES[how](folder, Path("out"))
                before = snapshot(folder)
                error = refused(capsys, [*command.arguments.split(), one, "out", other, str(second)])
                assert "a name of its own" in error
                assert snapshot(folder) == before


@pytest.mark.parametrize(("one", "other"), [("out.json", "OUT.json"), ("é.json", "e\u0301.json"), ("a/x", "A/y")])
def test_names_that_are_one_on_other_file_systems_are_not_written_both(scratch, capsys, one, other):
    """macOS and Windows know no case; macOS knows one form of an accented letter."""
    folder = scratch()
    for name in ("a", "A"):
        (folder / name).mkdir()
    before = snapshot(folder)
    words = ["replay", "bag", "--json", one, "--save", other]
    if one == "a/x":  # other folders, other names
        assert main(words) == 0
        return
    assert "a name of its own" in refused(capsys, words)
    assert snapshot(folder) == before


@pytest.fixture
def mounted(scratch):
    """The folder, with its bag at a second place."""
    folder = scratch()
    (folder / "twice").mkdir()
    done = subprocess.run(["mount", "--bind", folder / "bag", folder / "twice"], capture_output=True)
    if done.returncode:
        pytest.skip("who may not mount cannot try what is mounted twice")
    yield folder
    subprocess.run(["umount", folder / "twice"], check=True)


def test_a_bag_that_is_mounted_in_two_places_is_written_into_by_neither_name(mounted, capsys):
    before = snapshot(mounted)
    for words in (
        "compare result.yaml bag --json twice/new.json", "replay bag --save twice/metadata.yaml",
        "salvage bag -o twice/new", "simulate --motion-of bag twice/new", "diagnose bag --twin twice/new",
        "replay twice --json bag/new.json",
    ):  # fmt: skip
        assert "the input" in refused(capsys, words.split())
    words = "replay loose/run.db3 --json bag/new.json --save twice/new.json"
    assert "a name of its own" in refused(capsys, words.split())
    assert snapshot(mounted) == before


def test_what_export_writes_beside_is_no_input_and_is_called_by_its_option(scratch, capsys):
    folder = scratch()
    (folder / "result.yaml").rename(folder / "dvl.sdf.missing.json")
    before = snapshot(folder)
    error = refused(capsys, ["export", "gazebo", "dvl.sdf.missing.json", "-o", "dvl.sdf"])
    assert "--output, for missing effects," in error
    assert snapshot(folder) == before


@pytest.mark.parametrize("how", ["the_same", "link", "hard_link"])
@pytest.mark.parametrize("read_as", ["--params", "--json"])
def test_what_apply_writes_for_each_of_several_recordings_is_no_other_file_of_the_command(
    scratch, capsys, how, read_as
):
    folder = scratch()
    (folder / "params.yaml").rename(folder / "kept.yaml")
    own = ALIASES[how](folder, Path("kept.yaml"))
    os.rename(own, folder / "found.run.yaml")  # what --apply found.yaml names after loose/run.db3
    other = "found.run.yaml" if how == "the_same" else "kept.yaml"
    before = snapshot(folder)
    error = refused(capsys, ["diagnose", "bag", LOOSE, "--apply", "found.yaml", read_as, other])
    assert "--apply of run" in error
    assert snapshot(folder) == before


def test_parameter_files_of_several_recordings_need_a_file_and_not_a_stream(scratch, capsys):
    scratch()
    assert "name a file" in refused(capsys, ["diagnose", "bag", LOOSE, "--apply", "/dev/stdout"])


def test_twins_that_are_there_already_are_refused_before_any_work(scratch, capsys):
    folder = scratch()
    (folder / "twins" / "bag_with").mkdir(parents=True)
    assert "exists already" in refused(capsys, ["diagnose", "bag", "--twin", "twins"])
