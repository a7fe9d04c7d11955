"""Positions with metres of noise, as recordings hold them: read, chosen by `auto`, live as in replay, and verified."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from command_line import fail
from conftest import ROOT
from position_fixtures import USBL, write_positions

import dvl_calib_ros as dc
from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import POSITIONS
from dvl_calib_ros.calibration.models.parameters import ParameterError, Parameters
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.examination.examine import examine
from dvl_calib_ros.logs.trajectories import ImportOptions, import_recording
from dvl_calib_ros.messages.live_feed import MessageFeed
from dvl_calib_ros.recordings.recording import open_bags, open_recording
from dvl_calib_ros.recordings.topics import Topics
from validation.positions import Noise, Truth, driven

TRUTH = Truth((0.0, 0.01, 0.03), 0.006, (0.5, 0.0, -0.3), 0.5)
TOPICS = Topics(gnss=USBL)


@cache
def run(noise=Noise(), seconds=900.0, fix_s=1.0):  # noqa: B008
    return driven(np.random.default_rng(3), seconds, truth=TRUTH, noise=noise, fix_s=fix_s)


@pytest.fixture(scope="module")
def usbl(tmp_path_factory):
    return write_positions(tmp_path_factory.mktemp("usbl") / "bag", run())


def test_auto_takes_legs_of_noisy_positions_and_verifies_them_on_legs_not_seen(usbl):
    replayed = replay([usbl], Parameters(), TOPICS)
    result = replayed.result
    assert result.selected == POSITIONS.name and "compared over legs" in str(result.selected_because)
    x, std = result.estimate.state, result.estimate.recording_std
    assert abs(x[2] - TRUTH.phi[2]) < 3.0 * std[2] < math.radians(1.0)
    assert abs(x[3] - TRUTH.scale) < 3.0 * std[3] < 0.02
    observed = {each.axis: each.observed for each in result.estimate.observability}
    assert observed["yaw"] and not observed["roll"] and not observed["pitch"]
    held_out = result.verifications[POSITIONS.name].held_out
    assert held_out is not None and held_out.corrected < 0.9 * held_out.uncorrected
    assert held_out.corrected < 1.2 * held_out.predicted
    assert result.verifications[POSITIONS.name].verdict.value == "accept"
    navigation = replayed.navigation
    assert navigation is not None and navigation.after.per_km < navigation.before.per_km
    assert navigation.after.end < 0.5 * navigation.before.end  # of one fix, noise is less the longer the way


@pytest.mark.slow
def test_a_wrong_calibration_of_positions_is_not_verified(usbl, monkeypatch):
    """Folds that say something else: what is judged is what dead reckoning makes of legs not seen."""
    from dvl_calib_ros.calibration.estimators import displacement_estimator as of_positions

    solve = of_positions.solve

    def solved(legs, parameters, errors):
        fit = solve(legs, parameters, errors)
        if fit is not None:
            fit.state.x[2] -= 0.1
        return fit

    monkeypatch.setattr(of_positions, "solve", solved)
    verification = replay([usbl], Parameters(), TOPICS).result.verifications[POSITIONS.name]
    assert verification.verdict.value == "reject"


@pytest.mark.slow
def test_where_velocities_of_positions_are_good_auto_does_not(tmp_path):
    bag = write_positions(tmp_path / "bag", run(Noise(0.02), seconds=200.0))
    result = replay([bag], Parameters(), TOPICS).result
    assert result.selected == "full"
    assert {segment.model for segment in result.segments}.isdisjoint({POSITIONS.name})


@pytest.mark.slow
def test_live_and_replay_agree_in_state_and_in_when_it_was_chosen(tmp_path):
    usbl = write_positions(tmp_path / "bag", run(seconds=200.0))
    recording = open_recording([usbl], TOPICS)
    parameters = recording.of_types(TOPICS, Parameters())
    with ThreadPoolExecutor(1) as worker:
        feed = MessageFeed(Calibrator(parameters, worker=worker))
        take = {"dvl/twist": feed.dvl, USBL: feed.reference, "imu/data": feed.imu}
        with open_bags([usbl]) as bag:
            for topic, log_ns, message, _ in bag.messages(take):
                take[topic](message, log_ns)
        live = feed.calibrator.result()
    offline = replay(recording, Parameters(), TOPICS).result
    assert live.selected == offline.selected == POSITIONS.name
    assert live.segments == offline.segments
    np.testing.assert_allclose(live.estimate.state, offline.estimate.state, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(live.estimate.covariance, offline.estimate.covariance, rtol=0.0, atol=1e-12)


def test_a_pose_is_discovered_only_where_its_name_says_that_it_was_measured(tmp_path, usbl):
    """All that navigates sends poses, most of them with the DVL in them."""
    other = write_positions(tmp_path / "bag", run(seconds=300.0), topic="/navigator/pose")
    assert discover(open_recording([usbl]), Parameters()).topics.gnss == USBL
    assert discover(open_recording([other]), Parameters()).topics.gnss != "/navigator/pose"


@pytest.mark.slow
def test_a_usbl_that_gives_a_position_each_10_s_is_discovered_and_calibrated_with(tmp_path, capsys):
    bag = write_positions(tmp_path / "bag", run(seconds=900.0, fix_s=10.0))
    found = dc.replay(bag, history=False)
    result = found.replayed.result
    assert found.discovery.topics.gnss == USBL and result.selected == POSITIONS.name
    assert "too infrequent" in str(result.selected_because)
    assert abs(result.estimate.state[2] - TRUTH.phi[2]) < 3.0 * result.estimate.recording_std[2]
    examined = dc.doctor(bag)
    assert not {"DOCTOR_TOO_FEW", "DOCTOR_SLOW_REFERENCE"} & {each.code for each in examined.findings}
    assert "dvl-calib replay calibrates with them (model positions)" in fail(capsys, "diagnose", bag)


def test_half_a_minute_of_a_slow_usbl_which_a_live_node_looks_through_is_enough_to_find_it(tmp_path):
    bag = write_positions(tmp_path / "bag", run(seconds=32.0, fix_s=10.0))
    assert discover(open_recording([bag]), Parameters()).topics.gnss == USBL


@pytest.mark.slow
def test_a_diagnosis_of_noisy_positions_says_what_to_do(usbl):
    assert any("replay calibrates with them (model positions)" in each for each in dc.diagnose(usbl).notes)


def test_the_model_of_positions_is_refused_where_there_are_velocities():
    with pytest.raises(ParameterError, match=r"needs positions, but .*Twist.* holds velocities; name another"):
        Calibrator(Parameters(model=POSITIONS.name))


def test_latitude_and_longitude_are_imported_beside_speed_and_course(tmp_path):
    (tmp_path / "dvl.csv").write_text("t_s,vx_mps,vy_mps,vz_mps\n" + "".join(f"{i},1,0,0\n" for i in range(5)))
    rows = [f"{i},1.0,90.0,52.34,{12.99 + 1.5e-5 * i}\n" for i in range(5)]
    gnss = tmp_path / "gnss.csv"
    gnss.write_text("t_s,speed_mps,course_deg,latitude_deg,longitude_deg\n" + "".join(rows))
    imported = import_recording(tmp_path / "dvl.csv", gnss, None, tmp_path / "bag", ImportOptions(frame="flu"))
    assert imported.counts["gnss/fix"] == imported.counts["gnss/twist"] == 5
    with open_bags([tmp_path / "bag"]) as bag:
        fixes = [message for _, _, message, _ in bag.messages(["gnss/fix"])]
    assert [fix.longitude for fix in fixes] == pytest.approx([12.99 + 1.5e-5 * i for i in range(5)], abs=1e-12)
    assert fixes[0].position_covariance_type == 0


@pytest.mark.slow
def test_a_boats_positions_alone_tell_what_its_velocities_tell(tmp_path):
    """Lake Caputh, DGPS at 10 Hz."""
    named = os.environ.get("DVL_CALIB_CAPUTH")
    folder = Path(named) if named else ROOT.parent / "shared" / "data" / "caputh"
    name = "20250117163514"
    if not folder.is_dir():
        pytest.skip(f"no data in {folder}")
    parts = [folder / f"{name}_{role}.csv" for role in ("dvl", "gnss", "attitude")]
    import_recording(*parts, tmp_path / "bag", ImportOptions(frame="flu"))
    by_velocity = replay([tmp_path / "bag"], Parameters()).result.estimate
    by_position = replay([tmp_path / "bag"], Parameters(model=POSITIONS.name), Topics(gnss="gnss/fix")).result.estimate
    yaw = by_position.state[2] - by_velocity.state[2]
    assert abs(yaw) < 2.0 * math.hypot(by_position.recording_std[2], by_velocity.recording_std[2])
    assert math.degrees(by_position.std[2]) <= 0.5
    scale = by_position.state[3] - by_velocity.state[3]
    assert abs(scale) < 2.0 * math.hypot(by_position.recording_std[3], by_velocity.recording_std[3])


@pytest.mark.slow
def test_doctor_says_of_noisy_positions_what_a_replay_gives(usbl):
    """Velocities made of them are not what is used: neither their unit nor their covariance is held against it."""
    seen = examine([usbl], Parameters())
    assert [found.code for found in seen.findings if found.code in ("DOCTOR_UNITS", "DOCTOR_COVARIANCE")] == []
    yaw = next(each for each in seen.shown if each.name == "yaw")
    assert yaw.std < 0.5 and not yaw.needs
    (reference,) = (each for each in seen.contents if each.role == "reference")
    assert reference.covariance.removesuffix(" always") == "±2 m"  # poses without a height, of 2 m to the side
