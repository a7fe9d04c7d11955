"""Figures of the pages: each from its command, in its block; what is not is named by page, block and both figures."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from dvl_calib_ros.errors import InputError
from validation.__main__ import main
from validation.figures import command, pages, performance, pictures, registry, stored
from validation.figures.unmarked import unmarked

# What looks measured and is not, by page: parameters, limits, arithmetic, what the paper says, examples of output
DEFINITIONS = {
    "evaluation.md": ("R 0.2 m/s with GNSS and 0.025 m/s without",),
    "models.md": ("(1.9988, -0.0698, 0)", "**A constant heading error** ψ (σ 10°)"),
    "recordings.md": ("median speed below 0.3 m/s",),
    "operate.md": ("A scale error of 0.5 % corresponds to 7.5 m/s of speed of sound",),
}


def test_every_block_of_every_page_is_what_the_stored_measurements_say():
    assert pages.differing() == []


def test_every_mark_in_running_text_is_a_template():
    """Two pages showed the letter that stood in for a figure, because their template did not end with a brace."""
    for page in pages.pages():
        marks = [each for each in re.findall(r"<!-- (.*?) -->", page.read_text()) if "{" in each]
        assert len(marks) == page.read_text().count("<!-- end -->"), page.name
        assert [each for each in marks if each[0] + each[-1] != "{}"] == [], page.name


def test_figures_that_look_measured_stand_in_blocks():
    found = {page.name: page.read_text() for page in pages.pages()}
    for name, allowed in DEFINITIONS.items():
        assert [each for each in allowed if each not in found[name]] == [], f"{name}: not on the page any more"
    loose = [
        f"{name}:{line}: {text}"
        for name, page in found.items()
        for line, text in unmarked(page)
        if not any(each in page.splitlines()[line - 1] for each in DEFINITIONS.get(name, ()))
    ]
    assert loose == [], "put it into a block (validation/figures), or take it out"


@pytest.mark.parametrize(
    "line",
    [
        "On five recordings the error is 0.024 m/s rms.",
        "The yaw was found to be 0.67° ± 0.03°.",
        "It names the effect in 15 of 16 pairs.",
        "A replay takes 1.3 s.",
        "Replay is 17 times faster than filterpy.",
        "The mean over ten seeds is 0.0259.",
        "A run of 22 November, at a load of 10.",
        "| T01 | 0.196 | 0.025 |",
    ],
)
def test_a_figure_that_was_measured_is_seen(line):
    assert [each.text for each in unmarked(f"{line}\n")] == [line]
    assert unmarked(f"<!-- {{recordings[T01.full]:.3f}} -->{line}<!-- end -->\n") == []


@pytest.mark.parametrize(
    "line",
    [
        "Blocks of 10 s are left out in turn.",
        "`marginal` from 2° to 5° of misalignment.",
        "Set `min_speed` to 0.5 m/s or more.",
        "| a promise | `test_that_it_holds` | 10 of 10 counted |",
        "```text\nerror 0.024 m/s rms\n```",
    ],
)
def test_a_definition_is_not_taken_for_a_measurement(line):
    assert unmarked(f"{line}\n") == []


def test_every_measurement_that_a_page_uses_is_registered_and_every_template_is_used():
    uses = pages.uses()
    assert {use.measurement for use in uses} <= set(command.MEASUREMENTS)
    templates = {path.stem for path in (stored.FOLDER / "blocks").glob("*.md")}
    assert templates - {use.block for use in uses} == set()
    for name in {use.measurement for use in uses}:
        measured = stored.load(name)
        assert measured.commit and measured.date and measured.command
        tolerances = [each.tolerance for each in measured.values.values() if not isinstance(each.value, str)]
        assert all(tolerance >= 0.0 for tolerance in tolerances)


# ------------------------------------------------------------------ the command


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A small project with a history: a page with one block and one figure in its text, of one measurement."""
    (tmp_path / "dvl_calib_ros").mkdir()
    (tmp_path / "dvl_calib_ros" / "measured.py").write_text("")
    who = ("-c", "user.name=nobody", "-c", "user.email=nobody@localhost")
    for words in (("init", "-q"), ("add", "dvl_calib_ros"), (*who, "commit", "-q", "-m", "what is measured")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    (tmp_path / "docs" / "images").mkdir(parents=True)
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "calibration.yaml").write_text((ROOT / "config" / "calibration.yaml").read_text())
    (tmp_path / "blocks").mkdir()
    (tmp_path / "blocks" / "speeds.md").write_text("| fast | {speeds[fast]:.2f} |\n| slow | {speeds[slow]:.1f} |\n")
    (tmp_path / "README.md").write_text("Up to <!-- {speeds[fast]:.1f} -->?<!-- end --> m/s.\n")
    (tmp_path / "docs" / "page.md").write_text("<!-- speeds -->\n?\n<!-- end speeds -->\n")
    for module in (pages, stored):
        monkeypatch.setattr(module, "ROOT", tmp_path)
        monkeypatch.setattr(module, "FOLDER", tmp_path)
    monkeypatch.setattr(pictures, "TARGET", tmp_path / "docs" / "images")
    monkeypatch.setattr(command, "MEASUREMENTS", {})
    pages.forget()
    yield tmp_path
    pages.forget()


def measures(monkeypatch, run) -> None:
    tolerances = {"fast": 0.1, "*": "10%"}
    one = registry.Measurement("speeds", registry.CHEAP, "a command", "seed 3", tolerances, run)
    monkeypatch.setitem(command.MEASUREMENTS, "speeds", one)


def test_what_is_measured_is_stored_with_where_it_is_from_and_written_into_the_pages(place, monkeypatch):
    measures(monkeypatch, lambda _: {"fast": 2.345, "slow": (0.5, 0.4, 0.6, 12)})
    assert main(["figures"]) == 0
    assert (place / "README.md").read_text() == "Up to <!-- {speeds[fast]:.1f} -->2.3<!-- end --> m/s.\n"
    assert "| fast | 2.35 |\n| slow | 0.5 |\n<!-- end speeds -->" in (place / "docs" / "page.md").read_text()
    document = json.loads((place / "speeds.json").read_text())
    assert document["commit"] and document["date"] and document["seeds"] == "seed 3" and len(document["load"]) == 2
    assert document["values"]["slow"] == {"value": 0.5, "tolerance": 0.05, "low": 0.4, "high": 0.6, "n": 12}
    assert main(["figures", "--check"]) == 0


@pytest.fixture
def rendered(place, monkeypatch, capsys) -> Path:
    """The project with its figures measured."""
    measures(monkeypatch, lambda _: {"fast": 2.345, "slow": 0.5})
    main(["figures"])
    capsys.readouterr()
    return place


def test_a_figure_that_is_off_is_named_by_page_block_and_both_values(rendered, monkeypatch, capsys):
    measures(monkeypatch, lambda _: {"fast": 2.4, "slow": 0.8})
    assert main(["figures", "--check"]) == 1
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        "page.md, block speeds: slow of speeds is 0.5 on the page, 0.8 as measured now; it may differ by 0.05"
    ]
    assert "3 figures checked, 0 skipped" in said.out


def test_a_page_that_was_edited_by_hand_is_named(rendered, capsys):
    page = rendered / "README.md"
    page.write_text(page.read_text().replace(">2.3<", ">9.9<"))
    assert main(["figures", "--check"]) == 1
    assert "README.md, block {speeds[fast]:.1f}: not what --render writes" in capsys.readouterr().err
    assert main(["figures", "--render"]) == 0 and ">2.3<" in page.read_text()


@pytest.mark.usefixtures("rendered")
def test_without_its_data_a_measurement_is_skipped_with_the_reason_and_its_figures_counted(monkeypatch, capsys):
    def missing(_):
        raise registry.MissingDataError("no data in x; name it in Y")

    measures(monkeypatch, missing)
    assert main(["figures", "--check"]) == 0
    out = capsys.readouterr().out
    assert "skipped: speeds: no data in x; name it in Y; 3 figures not checked" in out
    assert "0 figures checked, 3 skipped" in out


def test_a_picture_that_does_not_say_of_which_commit_it_is_fails_the_check(place, capsys):
    (place / "README.md").write_text("No figures.\n")
    (place / "docs" / "page.md").unlink()
    picture = place / "docs" / "images" / "one.png"
    Image.new("P", (2, 2)).save(picture)
    assert main(["figures", "--check"]) == 1
    assert "docs/images/one.png: says no commit" in capsys.readouterr().err
    said = PngInfo()
    said.add_text(pictures.COMMIT, "0" * 40)
    Image.new("P", (2, 2)).save(picture, pnginfo=said)
    assert main(["figures", "--check"]) == 1
    assert "which is not in the history" in capsys.readouterr().err
    pictures.save(picture, "one")
    assert main(["figures", "--check"]) == 0


def test_texts_may_differ_in_the_last_digit_of_a_number_and_in_nothing_else():
    one = stored.Value("falls from 99.4 to 88.0 mm/s")
    assert not one.differs(stored.Value("falls from 99.5 to 88.0 mm/s"))
    assert one.differs(stored.Value("falls from 99.7 to 88.0 mm/s"))
    assert one.differs(stored.Value("rises from 99.4 to 88.0 mm/s"))
    with pytest.raises(InputError, match="make it with: python -m validation figures nothing"):
        stored.load("nothing")


def test_benchmarks_are_taken_from_files_of_different_parts_and_only_their_ratios_are_compared(tmp_path):
    for part, ratio in (("batch", 20.0), ("replay", 0.3)):
        line = {"what": part, "ours": "1 s", "peer": "2 s", "ratio": f"{ratio}", "target": "", "ratio_value": ratio}
        document = {"commit": "abc", "load": [0.1, 0.2], "parts": {part: {"measurements": [line], "failed": None}}}
        (tmp_path / f"{part}.json").write_text(json.dumps(document))
    performance.take([tmp_path / "batch.json", tmp_path / "replay.json"])
    found = performance.benchmarks(tmp_path)
    assert found["ratio.batch.batch"] == 20.0 and found["ratio.replay.replay"] == 0.3
    assert found["rows"] == "| batch | 1 s | 2 s | 20.0 |  |\n| replay | 1 s | 2 s | 0.3 |  |"
    assert found["at"].startswith("batch at commit abc, load 0.1 before and 0.2 after; replay at")
    (tmp_path / "none.json").write_text("{}")
    performance.take([tmp_path / "none.json"])
    with pytest.raises(InputError, match=r"none\.json: is not of `python -m benchmarks --json`"):
        performance.benchmarks(tmp_path)
    performance.take([])
