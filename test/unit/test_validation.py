"""`python -m validation`: what it has, and what it says to a wrong call."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
from conftest import ROOT

import dvl_calib_ros as dc
from validation import combinations, mutants, surveys
from validation.__main__ import COMMANDS, MODULES, main
from validation.combinations.recordings import physics_path, write_combination
from validation.drawn import share
from validation.stacks import mounting_errors


def test_every_command_is_listed_and_there(capsys):
    assert main(["--help"]) == 0
    listed = capsys.readouterr().out
    for name, what in COMMANDS.items():
        assert f"  {name:<12}  {what}\n" in listed
        assert callable(importlib.import_module(f"validation.{MODULES.get(name, name)}").main)


@pytest.mark.parametrize("wrong", [["nonsense"], ["repeat", "--times", "0"], ["mutants", "nonsense"]])
def test_a_wrong_call_is_refused_in_one_line(capsys, wrong):
    assert main(wrong) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("python -m validation: ") and said.err.count("\n") == 1


def test_every_mutant_changes_one_place_that_is_there_and_its_tests_are():
    for each in mutants.MUTANTS:
        assert (ROOT / each.path).read_text().count(each.old) == 1 and each.old != each.new, each.rule
        for test in each.tests:
            path, _, name = test.partition("::")
            assert f"def {name}" in (ROOT / path).read_text(), test
    assert len({each.rule for each in mutants.MUTANTS}) == 10


@pytest.mark.parametrize(
    ("text", "failed", "said"),
    [
        ("def test_good(): pass", None, ""),
        ("def test_bad(): assert False", "test_it.py::test_bad", ""),
        ("import nothing_like_it", None, "nothing_like_it"),  # no test has seen anything then
    ],
)
def test_only_a_test_that_fails_kills_a_mutant(tmp_path, text, failed, said):
    (tmp_path / "pytest.ini").write_text("[pytest]")
    (tmp_path / "test_it.py").write_text(text)
    by, output = mutants.tests_in(tmp_path, ["test_it.py"])
    assert by == failed and (said in output if said else output == "")


@pytest.mark.parametrize("command", ["stacks", "combinations"])
def test_without_the_shared_folder_it_is_skipped_with_a_reason(monkeypatch, tmp_path, capsys, command):
    monkeypatch.setenv("DVL_CALIB_SHARED", str(tmp_path))
    assert main([command]) == 0
    assert "skipped" in capsys.readouterr().out


def test_the_judge_of_stacks_sees_an_angle_a_position_and_a_delay_that_are_wrong():
    mounting = {
        "corrected_rpy": [0.0, 0.0, 0.02],
        "pose_covariance": (1e-6 * np.eye(6)).tolist(),
        "scale_error_ahead": 0.0, "scale_error_ahead_std": 0.001,
        "position": [0.7, 0.0, -0.6], "dvl_time_offset": 0.3, "dvl_time_offset_std": 0.01,
    }  # fmt: skip
    truth = {"scale": 0.0, "arm": [0.4, 0.0, -0.2], "late": 0.3}
    (wrong,) = mounting_errors(mounting, truth, (0.0, 0.0, math.degrees(0.02)))
    assert "position" in wrong
    errors = mounting_errors({**mounting, "position": None}, {"late": 0.0}, (0.0, 0.0, 2.5))
    assert [each.split()[0] for each in errors] == ["yaw", "late"]


@pytest.mark.slow
def test_a_survey_is_the_same_for_a_seed_and_its_judge_sees_what_is_wrong(tmp_path):
    drawn, judge = surveys.draw(7), surveys.SURVEYS
    assert drawn == surveys.draw(7) != surveys.draw(8)
    truth = surveys.write_survey(drawn, tmp_path / "bag")
    assert (tmp_path / "bag" / "metadata.yaml").exists()
    right = {
        **truth,
        "seed": 7,
        "verdict": "reject",
        "reason": "",
        "model": "full",
        "off_deg": [9.0, 0.6, 0.4],
        "std_deg": [0.1] * 3,
        "asked": False,
    }
    yaw = {**right, "verdict": "accept", "off_deg": [0.0, 0.0, 0.6]}
    pitch = {**right, "verdict": "marginal", "off_deg": [0.0, 0.8, 0.0]}
    unsure = {**yaw, "std_deg": [0.1, 0.1, 0.3]}
    assert [judge.is_wrong(each) for each in (right, yaw, pitch, unsure)] == [False, True, True, False]
    said = judge.summary([right, {**right, "asked": True}, yaw, pitch, unsure])
    assert said[0].startswith("usable and wrong: 2 of 3") and said[1].startswith("rejected though right: 1 of 5")
    assert "; 1 more as asked: they are mounted 5° or more beside what was told" in said[1]
    assert any(line.startswith("  wrong 7: ") and "yaw +0.60 ± 0.10" in line and "roll" not in line for line in said)
    assert share(0, 0) == "0 of 0" and "bounds 0.0 to 3.6" in share(0, 100)


def test_the_judge_of_combinations_sees_a_scale_and_a_roll_that_are_wrong():
    judge, right = combinations.COMBINATIONS, {"off_deg": [0.4, 0.0, 0.6, 0.4], "std_deg": [0.1, 0.1, 0.3, 0.1]}
    assert not judge.is_wrong(right) and not judge.is_wrong({**right, "off_deg": [0.0] * 3})
    assert judge.is_wrong({**right, "off_deg": [0.0, 0.0, 0.0, 0.6]}) and judge.is_wrong(
        {**right, "off_deg": [0.6, 0, 0]}
    )


@pytest.mark.skipif(not physics_path().exists(), reason="cases/traps is not in the shared folder")
@pytest.mark.slow
def test_a_combination_is_the_same_for_a_seed_and_its_truth_is_what_replay_finds(tmp_path):
    """Nothing is wrong with it."""
    truth = write_combination(14, tmp_path / "bag")
    run = dc.replay(tmp_path / "bag", history=False)
    assert run.verdict == "accept" and truth["drawn"]["defect"] == "none"
    found = np.append(np.subtract(run.mounting.rpy_deg, truth["rpy_deg"]), run.mounting.scale_percent - truth["scale"])
    assert np.abs(found / [*run.mounting.std_deg, run.mounting.scale_std_percent]).max() < 3.0
    assert truth == write_combination(14, tmp_path / "again")
