"""`dvl-calib evaluate BAG BAG`: lever arm and delay are corrected across bags, with drift and pictures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import succeed
from report_fixtures import drawn

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.evaluation import cross_check as evaluation_of_bags


@pytest.fixture(scope="module")
def bags(tmp_path_factory) -> list[Path]:
    """Two days of a DVL 1.5 m aft of the reference point, whose clock is 0.6 s and 0.3 s late."""
    folder = tmp_path_factory.mktemp("evaluate")
    for name, late in (("monday", "0.6"), ("tuesday", "0.3")):
        effects = ("--effect", "lever_arm:x_m=-1.5", "--effect", f"dvl_time_offset:seconds={late}")
        common = ("--trajectory", "figure8", "--duration", "180", "--gnss-std", "0.02", "--gnss-frame", "body")
        assert main(["simulate", str(folder / name), *common, *effects, "--seed", late[-1]]) == 0
    return [folder / "monday", folder / "tuesday"]


@pytest.mark.slow
def test_g2_of_one_day_corrects_the_other_with_its_lever_arm_and_the_days_own_delay(
    bags, tmp_path, monkeypatch, capsys
):
    drawn(monkeypatch)  # they are counted, not looked at
    page, out = tmp_path / "x.html", tmp_path / "x.json"
    said, _ = succeed(capsys, "evaluate", *bags, "--models", "M3,full", "--jobs", "1", "--report", page, "--json", out)
    document = json.loads(out.read_text())
    monday, tuesday = map(str, bags)
    by_monday = document["corrected"][monday]
    assert by_monday["full"][tuesday] < 0.06 and by_monday["full"][tuesday] < 0.6 * by_monday["M3"][tuesday]
    assert document["selected"][monday] == "full"
    navigation = document["navigation"][monday][tuesday]
    assert navigation["drift_m_per_km"]["after"] < navigation["drift_m_per_km"]["before"]
    assert "Dead reckoning on the other bags" in said
    text = page.read_text()
    assert text.count("<img") == 4 and "Track, monday" in text and "Error of position, tuesday" in text


@pytest.mark.slow
def test_topics_are_found_as_by_replay_and_the_answer_is_said_first_with_warnings_of_the_models_asked_for(
    bags, tmp_path, capsys
):
    renamed = {"dvl/twist": "/a50/velocity", "gnss/twist": "/rtk/velocity", "imu/data": "/ahrs/imu"}
    named = []
    for bag in bags:
        named.append(tmp_path / bag.name)
        with BagReader([bag]) as source, BagWriter(named[-1]) as target:
            for topic, log_ns, message, _ in source.messages(list(renamed)):
                target.message(renamed[topic], message.__msgtype__, log_ns, message)
    said, warned = succeed(capsys, "evaluate", *named, "--models", "M3", "--jobs", "1")
    # M3 knows nothing of the arm and the clock that these days differ by
    assert said.startswith("not_better: On the other bags, M3 leaves a velocity error of ")
    assert "DVL /a50/velocity" in said and "reference /rtk/velocity" in said
    assert not any(f"{name}: " in warned for name in ("full", "M7", "unaided"))


def test_the_table_for_spreadsheets_is_for_trajectories_only(bags, tmp_path, capsys):
    assert main(["evaluate", *map(str, bags), "--csv", str(tmp_path / "x.csv")]) == 2
    assert "only for a folder of trajectories" in capsys.readouterr().err


def test_a_bag_whose_replay_fails_is_named_and_the_others_are_checked(bags, tmp_path, monkeypatch, capsys):
    real, out = evaluation_of_bags._replay_one, tmp_path / "x.json"

    def failing(*asked):
        if asked[-1] == bags[0]:
            raise ZeroDivisionError("division by zero")
        return real(*asked)

    monkeypatch.setattr(evaluation_of_bags, "_replay_one", failing)
    _, warned = succeed(capsys, "evaluate", *bags, "--models", "M3", "--jobs", "1", "--json", out)
    why = "failed, and is in none of the figures: replay: ZeroDivisionError: division by zero"
    assert why in " ".join(warned.split())
    document = json.loads(out.read_text())
    assert document["notes"][0] == f"{bags[0]}: {why}"
    assert document["paired"][str(bags[0])] == 0 and document["paired"][str(bags[1])] > 100
    monkeypatch.setattr(evaluation_of_bags, "_replay_one", lambda *_: real())
    assert main(["evaluate", *map(str, bags), "--models", "M3", "--jobs", "1"]) == 2
    error = capsys.readouterr().err
    assert "no bag is left to check" in error and "TypeError" in error and error.count("\n") == 1
