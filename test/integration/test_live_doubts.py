"""What a running calibration says against itself is what a replay says, and a file that it saves holds it."""

from __future__ import annotations

import numpy as np
import pytest
from io_fixtures import live

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.files.mounting import load_calibrated_mounting
from dvl_calib_ros.files.result_file import result_document, save_result
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.verdict.kinds import Severity
from validation.surveys.physics import draw, write_survey

# What both look for.
LOOKED_FOR = {
    "TILT_NOT_FOLLOWED", "TILT_NOT_SHOWN", "DVL_BIAS", "VELOCITY_SMOOTHED", "CIRCULAR_REFERENCE", "HEADING_DEVIATION",
    "LEVER_ARM_CONTRADICTED", "ONE_HEADING", "IMU_LEVEL",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "trajectory", "code"),
    [
        (["reference_lag:time_constant_s=1.5"], "free", "VELOCITY_SMOOTHED"),
        (["lever_arm:x_m=-1.5"], "free", "LEVER_ARM_CONTRADICTED"),
        ([], "straight", "ONE_HEADING"),
        ([], "free", ""),
    ],
)
def test_live_says_what_a_replay_says_and_what_it_saves_is_refused_as_well(effects, trajectory, code, tmp_path):
    errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
    made = Scenario(trajectory, 300.0, 3, errors, gnss_std=0.03, effects=tuple(map(injection, effects)))
    write_bag(made, tmp_path / "bag", Storage.MCAP, Compression.NONE)
    parameters = Parameters(lever_arm=(0.4, 0.0, 0.0) if "CONTRADICTED" in code else (0.0, 0.0, 0.0))
    replayed = replay([tmp_path / "bag"], parameters)
    said = {each.code for each in replayed.findings} & LOOKED_FOR
    assert code in said if code else not said
    calibrator = live(tmp_path / "bag", parameters)
    so_far = {each.code for each in calibrator.doubts(fresh=False)}  # by a look at two thirds and more
    assert code in so_far if code else not so_far & LOOKED_FOR
    result = calibrator.result()
    assert {each.code for each in result.doubts} & LOOKED_FOR == said
    rejects = {each.code for each in result.doubts if each.severity is Severity.REJECT}
    of_replay, of_live = (each.verifications[each.selected] for each in (replayed.result, result))
    assert of_live.verdict is of_replay.verdict
    assert {each.code for each in of_live.reasons} == {each.code for each in of_replay.reasons}
    for name in ("uncorrected", "corrected", "predicted"):  # live all but the block that is not complete
        assert getattr(of_live.held_out, name) == pytest.approx(getattr(of_replay.held_out, name), rel=0.1)
    save_result(tmp_path / "live.yaml", result_document(result), 0)
    loaded = load_calibrated_mounting(tmp_path / "live.yaml")
    assert bool(loaded.objections) == bool(rejects)
    assert all(each.says in " ".join((*loaded.objections, *loaded.doubts)) for each in result.doubts)
    np.testing.assert_allclose(result.estimate.state, replayed.result.estimate.state, atol=1e-9)


@pytest.mark.slow
def test_of_a_random_survey_what_a_replay_rejects_live_does_not_call_usable(tmp_path):
    write_survey(draw(36001), tmp_path / "bag")
    recording = open_recording([tmp_path / "bag"])
    found = discover(recording, Parameters())
    named = recording.of_types(found.topics, found.parameters)
    replayed = replay(recording, found.parameters, found.topics).result
    lived = live(tmp_path / "bag", named, found.topics).result()
    of_replay, of_live = (each.verifications[each.selected].verdict for each in (replayed, lived))
    assert of_live is of_replay
