"""A vehicle's topics and parameters are stored once, are used by every command, and are shown when they are."""

from __future__ import annotations

import json
from argparse import Namespace

import pytest
from command_line import fail, succeed
from io_fixtures import run, write_bag

from dvl_calib_ros.cli.common import with_profile

PROFILE = """
dvl-topic: /dvl/twist
params: {folder}vehicle.yaml
parameters: {{model: M5, mounting_rpy: [0, 0, 1deg]}}
"""
VEHICLE = "/**: {ros__parameters: {model: M3, gate_probability: 0.5}}"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a bag, which is also the user's home, and is where commands are given."""
    write_bag(tmp_path / "bag", run(15.0))
    (tmp_path / "vehicle.yaml").write_text(VEHICLE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return tmp_path


def settled(capsys, *options: str) -> tuple[dict, str]:
    """The parameters that replay went by, and what it said on standard error."""
    _, errors = succeed(capsys, "replay", "bag", "--json", "replay.json", *options)
    return json.loads(open("replay.json").read())["parameters"], errors


def test_the_profile_of_the_folder_is_used_and_shown_and_options_win(capsys, folder):
    without, said_without = settled(capsys)
    assert "profile" not in said_without
    (folder / ".dvl-calib.yaml").write_text(PROFILE.format(folder=""))
    stored, said = settled(capsys)
    (shown,) = [line for line in said.splitlines() if line.startswith("profile")]
    options = "--dvl-topic=/dvl/twist --params=vehicle.yaml -p model:=M5 -p 'mounting_rpy:=[0, 0, 1deg]'"
    assert shown == f"profile .dvl-calib.yaml: {options}"
    assert (stored["model"], stored["gate_probability"]) == ("M5", 0.5)
    assert stored["mounting_rpy"] == pytest.approx([0.0, 0.0, 0.0174533])
    assert settled(capsys, "-p", "model:=M3")[0] == stored | {"model": "M3"}
    assert settled(capsys, "--profile", "none") == (without, said_without)
    assert "/other" in fail_after_the_profile(capsys, "replay", "bag", "--dvl-topic", "/other")


def test_the_next_command_has_each_parameter_once(capsys, folder):
    (folder / ".dvl-calib.yaml").write_text("parameters: {target_drift: 5}")
    out, _ = succeed(capsys, "doctor", "bag", "-p", "target_drift:=3")
    assert "next  dvl-calib replay bag -p target_drift:=3 --save calibration.yaml" in out


def fail_after_the_profile(capsys, *arguments: str) -> str:
    from dvl_calib_ros.cli.main import main

    assert main([*arguments]) == 2
    profile, error = capsys.readouterr().err.splitlines()
    assert profile.startswith("profile ")
    return error


@pytest.mark.parametrize("name", ["boat", "home/dvl-calib/boat.yaml"])
def test_a_named_profile_is_used_instead_of_the_folders_and_finds_its_parameter_file(capsys, folder, name):
    (folder / ".dvl-calib.yaml").write_text("parameters: {model: M7}")
    (folder / "home" / "dvl-calib").mkdir(parents=True)
    (folder / "home" / "dvl-calib" / "boat.yaml").write_text(PROFILE.format(folder="../../"))
    assert settled(capsys, "--profile", name)[0]["model"] == "M5"


def test_what_follows_ros_args_stays_behind_the_profile(folder):
    (folder / ".dvl-calib.yaml").write_text("imu-topic: /ahrs")
    given = ["run", "--watch", "--ros-args", "-r", "__ns:=/run"]
    expected = ["run", "--imu-topic=/ahrs", *given[1:]]
    assert with_profile(given, Namespace(profile=None, command="run")) == expected


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("save: /etc/passwd", ".dvl-calib.yaml: no profile ('save'); it holds dvl-topic, gnss-topic, "),
        ("- a", "no profile (no names)"),
        ("dvl-topic: [a]", "dvl-topic is no text"),
        ("parameters: 3", "parameters is not a list of name: value"),
        ("parameters: {modell: M3}", "modell"),
        ("a: [", ".dvl-calib.yaml"),
    ],
)
def test_a_profile_that_is_none_is_said_in_one_line(capsys, folder, content, says):
    (folder / ".dvl-calib.yaml").write_text(content)
    fail_ = fail_after_the_profile if "modell" in content else fail
    assert says in fail_(capsys, "replay", "bag")


def test_a_name_that_is_not_there_is_said_with_those_that_are(capsys, folder):
    (folder / "home" / "dvl-calib").mkdir(parents=True)
    (folder / "home" / "dvl-calib" / "boat.yaml").write_text("parameters: {}")
    assert "ship.yaml does not exist; profiles there: boat" in fail(capsys, "replay", "bag", "--profile", "ship")
