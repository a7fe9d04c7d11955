"""README.md and docs/: commands run as they stand there, and files, tests and pages that are named exist."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from conftest import ROOT
from documentation import PAGES, blocks, section
from report_fixtures import drawn

from dvl_calib_ros.cli.main import main
from dvl_calib_ros.cli.parameters import command_table

LANGUAGES = {"bash", "python", "text", "yaml", "xml", "json"}
TEXT = {page.relative_to(ROOT).as_posix(): page.read_text() for page in PAGES}
RUN = [each for page in PAGES for each in blocks(page) if each.language in ("bash", "python") and not each.why_not_run]
RAN: set[str] = set()
# long enough for all that is done with it; `python -m validation figures diagnosis_examples` takes what the page says
SHORT = "--duration", "150"
ROBOT = """<robot name="auv"><link name="base_link"/><link name="dvl_link"/>
<joint name="dvl_joint" type="fixed"><parent link="base_link"/><child link="dvl_link"/>
<origin xyz="0.5 0 -0.2" rpy="0 0 0"/></joint></robot>
"""


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Path:
    """A folder with all that the pages speak of, under the names that they use."""
    place = tmp_path_factory.mktemp("documentation")
    box = ("--trajectory", "box", *SHORT)
    vehicle = ("--misalignment", "1", "-1.5", "3", "--scale", "0.5", "--gnss-std", "0.03")
    for seed, name in (("4", "recorded_bag"), ("5", "my_bag")):  # the same on two days
        assert main(["simulate", str(place / name), *box, *vehicle, "--seed", seed]) == 0
    assert main(["simulate", str(place / "monday"), *box, "--gnss-std", "0.05", "--seed", "1"]) == 0
    shutil.copy(next((place / "recorded_bag").glob("*.mcap")), place / "tuesday.mcap")
    (place / "cut_off_bag").mkdir()
    whole = (place / "tuesday.mcap").read_bytes()
    (place / "cut_off_bag" / "cut_off_bag_0.mcap").write_bytes(whole[: len(whole) // 2])
    (place / "my_vehicle.yaml").write_text("/**:\n  ros__parameters:\n    min_speed: 0.3\n")
    (place / "robot.urdf").write_text(ROBOT)
    assert main(["replay", str(place / "monday"), "--save", str(place / "calibration.yaml")]) == 0
    return place


def run(command: str, capsys) -> None:
    """A command line of dvl-calib with an optional `> file`; what stands behind # is for the reader."""
    words = shlex.split(command, comments=True)
    target = None
    if ">" in words:
        words, (target,) = words[: words.index(">")], words[words.index(">") + 1 :]
    assert words[0] == "dvl-calib", f"{command}: say why it is not run"
    capsys.readouterr()
    code = main([*words[1:], *(SHORT if words[1] == "simulate" else ())])
    said = capsys.readouterr()
    assert code in (0, 1), f"{command}: {said.err}"  # 1: rejected
    if target is not None:
        Path(target).write_text(said.out)


def name(block) -> str:
    return f"{block.page.name}:{block.line}"


@pytest.mark.parametrize(
    "block", [pytest.param(each, marks=[pytest.mark.slow] * (each.mark == "slow"), id=name(each)) for each in RUN]
)
def test_what_a_page_tells_to_run_runs(block, workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    drawn(monkeypatch)  # they are looked at elsewhere
    for made in ("simulated", "again", "sound", "two", "whole_bag"):
        shutil.rmtree(made, ignore_errors=True)
    if block.language == "python":
        exec(compile(block.text, name(block), "exec"), {})
        return
    for command in block.commands:
        if command not in RAN or "simulate" in command or ">" in command:  # on another page, with the same files
            run(command, capsys)
            RAN.add(command)


def test_a_block_of_commands_runs_or_says_why_not():
    every = [each for page in PAGES for each in blocks(page)]
    assert [name(each) for each in every if each.language not in LANGUAGES] == []
    assert len(RUN) >= 10
    assert all(len(each.why_not_run) > 15 for each in every if each.mark.startswith("not run"))


def test_the_readme_is_read_in_five_minutes():
    assert len(TEXT["README.md"].split()) <= 1500


def test_the_table_of_commands_is_that_of_the_code():
    assert section("commands") == command_table().strip(), "take it from: dvl-calib parameters --commands"


def test_files_that_are_named_are_there():
    roots = (ROOT, ROOT / "dvl_calib_ros", ROOT / "docs")
    folders = (
        r"config|bags|test|docs|examples|\.ci|calibration|effects|files|messages|node|cli|replay|report|diagnosis|trial"
    )
    named = {each for text in TEXT.values() for each in re.findall(rf"`((?:{folders})/[\w./]*)`", text)}
    assert len(named) > 10
    assert [each for each in sorted(named) if not any((root / each).exists() for root in roots)] == []


def test_links_and_pictures_lead_somewhere():
    broken = []
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.name}: {target}")
    assert broken == []
    pictures = list((ROOT / "docs" / "images").glob("*.png"))
    assert len(pictures) >= 3 and all(picture.stat().st_size < 150_000 for picture in pictures)


def test_every_test_that_proves_a_promise_is_there():
    promises = TEXT["docs/quality.md"].partition("## Promises")[2].partition("\n## ")[0]
    named = re.findall(r"`(test_\w+)(\.\.\.)?`", promises)
    files = "\n".join(path.read_text() for path in (ROOT / "test").rglob("test_*.py"))
    there = re.findall(r"^def (test_\w+)", files, re.M)
    assert len(named) > 30
    assert [
        name for name, cut in named if not any(each == name or (cut and each.startswith(name)) for each in there)
    ] == []
