"""Several recordings in one replay: held against each other before they are averaged; nights are no dropouts."""

from __future__ import annotations

import gc
import heapq
import json
import math
import re
import weakref
from pathlib import Path

import pytest
from command_line import fail, succeed
from io_fixtures import run, write_bag

import dvl_calib_ros as dc
from dvl_calib_ros.bag_replay.checked_replay import checked_replay
from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.present.replay import next_commands
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.verdict.kinds import Severity

DAY_NS = 86_400_000_000_000


def recorded(path: Path, day: float, yaw_deg: float, streams: str = "dgi", seconds: float = 120.0) -> Path:
    """A recording on some day of a DVL turned by so much. streams: which of DVL, GNSS and IMU are in it."""
    errors = DvlErrors((0.01, -0.02, math.radians(yaw_deg)), (0.004,) * 3, beam_std=0.005)
    samples = simulate(Scenario(seconds=seconds, trajectory="box", errors=errors, gnss_std=0.05, seed=int(10 * day)))
    each = {"d": samples.dvl, "g": samples.gnss, "i": samples.imu}
    merged = heapq.merge(*(each[name] for name in streams), key=lambda sample: sample.stamp_ns)
    shift = int(day * DAY_NS)
    return write_bag(path, (sample._replace(stamp_ns=sample.stamp_ns + shift) for sample in merged))


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("several")
    for name, day, yaw in (("monday", 0, 2.0), ("tuesday", 1, 2.0), ("wednesday", 2, 5.2)):
        recorded(folder / name, day, yaw)
    return folder


@pytest.mark.slow
def test_recordings_of_one_mounting_are_averaged_and_the_night_is_no_dropout(place):
    bags = [place / "monday", place / "tuesday"]
    plain, checked = replay(bags, Parameters()), checked_replay(bags, Parameters())
    assert plain.result.counts["dvl"]["dropouts"] == 1  # the night
    assert checked.result.counts["dvl"]["dropouts"] == 0
    assert not any(found.code == "DVL_DROPOUTS" for found in checked.findings)
    assert not any("dropped out" in note for note in checked.notes)
    assert checked.recordings is not None and checked.recordings.same_mounting
    assert (checked.result.estimate.state == plain.result.estimate.state).all()
    assert checked.result.verifications["M3"].verdict is plain.result.verifications["M3"].verdict


@pytest.mark.slow
def test_a_mounting_that_moved_between_two_is_named_and_not_averaged_in_silence(place, capsys, tmp_path):
    bags = [place / "wednesday", place / "monday", place / "tuesday"]  # in any order
    out, _ = succeed(capsys, "replay", *bags, "--json", tmp_path / "r.json", "--save", tmp_path / "r.yaml")
    said = " ".join(out.split())
    assert re.search(r"reject: Do not use this calibration. The mounting differs in yaw by \+?-?[23]\.\d\d° ± 0", said)
    assert "5 Hz" in said and "360 s of data" in said  # the nights are not counted
    assert "(tuesday) and" in said and "(wednesday), so the average" in said
    document = json.loads((tmp_path / "r.json").read_text())
    assert document["recordings"]["moved"][0]["first_after"] == "wednesday"
    assert document["verification"]["M3"]["verdict"] == "reject"
    # applying what was saved of it is refused, as of all that is rejected
    assert "the mounting differs" in fail(capsys, "apply", tmp_path / "r.yaml", "--launch", tmp_path / "x.xml")


@pytest.mark.slow
def test_a_mounting_that_moved_is_not_hidden_by_the_bias_of_the_dvl(place):
    """10 mm/s are 0.6° at 1 m/s, on every day the same."""
    biased = Parameters(dvl_bias_std=0.01)
    recordings = checked_replay([place / "tuesday", place / "wednesday"], biased).recordings
    assert recordings is not None and recordings.word == "moved"
    assert recordings.pairs[0].std[2] < recordings.calibrations[0].std[2], "two that share nothing: 1.4 times"


@pytest.mark.slow
def test_who_asks_to_merge_gets_it_with_a_note(place):
    run = dc.replay([place / "monday", place / "wednesday"], merge=True)
    assert run.verdict != "reject"
    assert any(note.startswith("merged as asked: the mounting differs in yaw by") for note in run.replayed.notes)


@pytest.mark.slow
def test_a_reference_in_a_bag_of_its_own_belongs_to_the_recording_of_its_time(tmp_path):
    bags = [
        recorded(tmp_path / "dvl0", 0, 2.0, "di"), recorded(tmp_path / "gnss0", 0, 2.0, "g"),
        recorded(tmp_path / "day1", 1, 5.2),
    ]  # fmt: skip
    recordings = checked_replay(bags, Parameters()).recordings
    assert recordings is not None
    assert [each.name for each in recordings.calibrations] == ["dvl0 + gnss0", "day1"]
    assert not recordings.same_mounting


def test_two_recordings_of_the_same_time_are_said_to_be(place, tmp_path):
    other = recorded(tmp_path / "other", 0, 2.0)
    bags = [place / "monday", other]
    replayed = checked_replay(bags, Parameters(model="M3"))
    verification = replayed.result.verifications["M3"]
    assert verification.verdict is Severity.REJECT
    assert verification.reasons[0].code == "BAGS_OVERLAP"
    assert verification.reasons[0].full_sentence.startswith("The DVL is in monday and in other at the same time")
    assert next_commands(replayed, bags, None, (), doubts=False)[0].startswith("dvl-calib compare ")
    assert checked_replay([other], Parameters()).result.verifications["M3"].verdict is Severity.ACCEPT  # by itself


def test_a_recording_too_short_to_be_calibrated_alone_is_said_to_be_unchecked(place, tmp_path):
    short = recorded(tmp_path / "short", 3, 2.0, seconds=3.0)
    replayed = checked_replay([place / "monday", short], Parameters())
    assert any(note.startswith("short: too little to be calibrated alone") for note in replayed.notes)


@pytest.mark.slow
def test_an_initial_calibration_that_the_data_contradict_is_said_and_left_out(place, tmp_path, capsys):
    for name in ("monday", "wednesday"):
        succeed(capsys, "replay", place / name, "--save", tmp_path / f"{name}.yaml")
    contradicted = Parameters(initial_calibration=str(tmp_path / "wednesday.yaml"))
    replayed = checked_replay([place / "tuesday"], contradicted)
    (found,) = [each for each in replayed.findings if each.code == "INITIAL_CONTRADICTED"]
    assert re.search(r"the mounting has moved in yaw by -3\.[0-4]", found.says)
    alone = replay([place / "tuesday"], Parameters()).result
    assert (replayed.result.estimate.state == alone.estimate.state).all()
    fitting = checked_replay([place / "tuesday"], Parameters(initial_calibration=str(tmp_path / "monday.yaml")))
    assert not any(each.code == "INITIAL_CONTRADICTED" for each in fitting.findings)
    assert fitting.result.estimate.std[2] < alone.estimate.std[2]  # it went on from there


def test_a_calibrator_is_freed_as_soon_as_its_replay_is_done(tmp_path):
    """Calibrators refer to themselves: many replays in one process grew it until the garbage collector ran."""
    calibrators = []
    gc.disable()
    try:
        bag = write_bag(tmp_path / "bag", run(30.0))
        replay([bag], Parameters(), on_finished=lambda each: calibrators.append(weakref.ref(each)))
        assert [each() for each in calibrators] == [None]
    finally:
        gc.enable()
