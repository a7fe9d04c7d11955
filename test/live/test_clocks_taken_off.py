"""A clock that the data show to be off is taken off while the node runs, and what was named stands."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from ros import NODE, until
from std_srvs.srv import Trigger

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.demo.player import BagPlayer
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

ARM, LATE = -0.6, 2.5


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Of 200 s, whose reference is stamped late."""
    path = tmp_path_factory.mktemp("late") / "bag"
    effects = (injection(f"lever_arm:x_m={ARM}"), injection(f"reference_time_offset:seconds={LATE}"))
    errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
    made = Scenario("free", 200.0, 3, errors, gnss_std=0.05, imu_rate=10, effects=effects)
    write_bag(made, path, Storage.MCAP, Compression.NONE)
    return path


def result_of(world, bag, path, *arguments):
    """What the node saves after the bag."""
    with world.calibration_node("max_latency:=20.0", f"result_file:={path}", *arguments):
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        player = BagPlayer(world.node, [bag])
        player.wait_for_subscribers()
        player.play(speed=15.0)
        seen = len(diagnostics)
        until(lambda: len(diagnostics) >= seen + 2, "what is said at the end")
        said = diagnostics[-1].status[0].message
        assert world.call(Trigger, f"{NODE}/save").success
    return load_yaml(path, "result file"), said


@pytest.mark.slow
def test_a_late_reference_is_taken_off_and_calibrated_with(world, bag, tmp_path):
    """It was named, and every calibration rejected."""
    saved, said = result_of(world, bag, tmp_path / "result.yaml")
    assert "CLOCK_TAKEN_OFF" in said and "the reference's stamps are 2.5" in said
    assert "CONFIGURATION_WRONG" not in said and "suggestion" not in saved
    assert saved["parameters"]["reference_time_offset"] == pytest.approx(LATE, abs=0.1)
    at = MODELS["full"].state_names.index("lever_arm_x")
    assert saved["models"]["full"]["state"][at] == pytest.approx(ARM, abs=0.2)
    # what came before it was taken off has been fed again
    taken = Parameters(max_latency=20.0, reference_time_offset=saved["parameters"]["reference_time_offset"])
    replayed = replay([bag], taken).result
    assert saved["counts"]["dvl"] == dict(replayed.counts["dvl"])
    np.testing.assert_allclose(saved["models"]["full"]["state"], replayed.estimates["full"].state, rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_what_was_named_stands(world, bag, tmp_path):
    saved, said = result_of(world, bag, tmp_path / "result.yaml", "reference_time_offset:=0.0")
    assert "CLOCK_TAKEN_OFF" not in said and "the reference's stamps are 2.5" in said
    assert saved["parameters"]["reference_time_offset"] == 0.0
