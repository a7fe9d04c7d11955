"""One cause, one answer: doctor, replay and diagnose name the same clock and by how much it is late."""

from __future__ import annotations

import heapq
import json

import pytest
from io_fixtures import rewrite

import dvl_calib_ros as dc
from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.discovery.discovery import Given
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, simulate, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

ARM = -0.6
OFFSETS = {
    "dvl_time_offset": "the DVL's",
    "reference_time_offset": "the reference's",
    "attitude_time_offset": "the IMU's",
}


def bag_of(folder, late, trajectory="free", **scenario):
    effects = [injection(f"lever_arm:x_m={ARM}"), *(injection(f"{n}:seconds={s}") for n, s in late.items())]
    errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
    made = Scenario(trajectory, 300.0, 3, errors, gnss_std=0.05, effects=tuple(effects), **scenario)
    write_bag(made, folder / "late", Storage.MCAP, Compression.NONE)
    return folder / "late"


def said(command, bag, tmp_path, capsys, *options):
    """What a command prints, and its JSON."""
    main([command, str(bag), "--json", str(tmp_path / f"{command}.json"), *options])
    return " ".join(capsys.readouterr().out.split()), json.loads((tmp_path / f"{command}.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    "late",
    [{"attitude_time_offset": 2.0}, {"dvl_time_offset": 5.0, "reference_time_offset": 2.5}],
    ids=lambda late: ", ".join(f"{name[:3]} {seconds}" for name, seconds in late.items()),
)
def test_doctor_replay_and_diagnose_name_the_same_clock(late, tmp_path, capsys):
    """By 2.5 s one said yes, one 1.2 s or more, and one was exact; by 5 s a scale was 6 % off."""
    bag = bag_of(tmp_path, late)
    doctor, examined = said("doctor", bag, tmp_path, capsys)
    applied = tmp_path / "applied.yaml"
    _, diagnosed = said("diagnose", bag, tmp_path, capsys, "--apply", str(applied))
    assert examined["verdict"] == "yes"
    found = discover([bag], Parameters())
    for name, seconds in late.items():
        near = pytest.approx(seconds, abs=0.05 + 0.03 * seconds)
        parameter = name.replace("attitude", "imu")
        assert getattr(found.parameters, parameter) == near
        sentence = next(each for each in found.found if each.startswith(f"{OFFSETS[name]} stamps are"))
        assert " ".join(sentence.split()) in doctor
        effects = {each["name"]: each["parameters"] for each in diagnosed["effects"]}
        assert effects[name]["seconds"]["value"] == near
        assert getattr(load_parameters(applied), parameter) == near  # it was twice as much
    replayed = replay([bag], found.parameters, found.topics)
    verification = replayed.result.verifications[replayed.result.selected]
    assert verification.verdict.value == "accept", verification.reasons
    assert replayed.result.estimate.state[5] == pytest.approx(ARM, abs=0.15)


@pytest.mark.slow
def test_a_reference_in_the_body_is_calibrated_with_and_the_other_reading_is_said(tmp_path):
    bag = bag_of(tmp_path, {"reference_time_offset": 5.0}, gnss_frame=VelocityFrame.BODY)
    found = discover([bag], Parameters())
    assert found.parameters.reference_time_offset == pytest.approx(5.0, abs=0.2)
    assert any("or the DVL's as much early" in each for each in found.found)


@pytest.mark.spread(1)
@pytest.mark.parametrize("trajectory", ["free", "straight"])
def test_clocks_in_time_or_not_shown_are_left_alone(trajectory, tmp_path):
    found = discover([bag_of(tmp_path, {}, trajectory)], Parameters())
    assert not any("stamps are" in each for each in found.found)
    assert found.clocks is None or found.clocks.offsets == {}


def test_what_the_user_gives_stands(tmp_path):
    bag = bag_of(tmp_path, {"reference_time_offset": 5.0})
    given = Given(parameters=frozenset({"reference_time_offset"}))
    parameters = Parameters().replace(reference_time_offset=5.0)
    assert discover([bag], parameters, given).parameters.reference_time_offset == 5.0


@pytest.mark.slow
def test_a_clock_that_is_off_beside_the_log_is_taken_off_and_no_reason_against_the_recording(tmp_path, capsys):
    """Doctor said that the stamps had to be corrected; replay had done so."""
    errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
    run = simulate(Scenario("free", 300.0, 3, errors, gnss_std=0.05))
    samples = heapq.merge(run.imu, run.gnss, run.dvl, key=lambda sample: sample.stamp_ns)

    def change(name, message):
        if "gnss" in name:
            message.header.stamp.sec += 18
        return message

    ahead = rewrite(tmp_path / "ahead", change, samples)
    doctor, examined = said("doctor", ahead, tmp_path, capsys)
    assert examined["verdict"] == "yes" and "stamps are 18.0" in doctor
    calibration = dc.replay(ahead, history=False)
    assert calibration.verdict == "accept", calibration.reasons


@pytest.mark.slow
def test_at_one_speed_a_diagnosis_says_that_the_clock_may_be_an_arm_and_what_is_known_of_both(tmp_path):
    """It named the clock alone, 0.4 s off by ± 0.03."""
    (effect,) = dc.diagnose(bag_of(tmp_path, {"reference_time_offset": 2.5}, "lawnmower", dvl_rate=1.0)).effects
    assert effect.name == "reference_time_offset" and "lever_arm" in effect.equivalent_to
    _, low, high = effect.parameters["seconds"]
    assert low < 2.5 < high and high - low > 0.5
    known = effect.combination
    assert known is not None and known.parameter == "x_m" and known.speed == pytest.approx(-1.5, abs=0.1)
    _, low, high = known.value  # the clock is the reference's: later, it turns the other way
    assert low < ARM - known.speed * 2.5 < high and high - low < 0.3


@pytest.mark.slow
def test_on_legs_that_repeat_a_dvl_far_behind_is_found_and_calibrated_with(tmp_path):
    """It was a delay of 3 s, marginal."""
    late = 7.5
    bag = bag_of(tmp_path, {"dvl_time_offset": late}, "lawnmower", dvl_rate=1.0, gnss_rate=1.0)
    run = dc.replay(bag, history=False)
    assert run.verdict == "accept"
    assert run.replayed.result.parameters["dvl_time_offset"] == pytest.approx(late, abs=0.05 + 0.04 * late)
    (clock,) = (each for each in dc.diagnose(bag).effects if each.name == "dvl_time_offset")
    found, low, high = clock.parameters["seconds"]  # legs at one speed tell the clock of the reference no better
    assert low < late < high and found == pytest.approx(late, abs=0.05 + 0.08 * late)
