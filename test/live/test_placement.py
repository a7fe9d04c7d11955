"""The live node takes its mounting from the description of the robot, as the replay does from the bag."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from io_fixtures import TOPICS
from live_fixtures import LATCHED
from rclpy.duration import Duration
from ros import NODE, PATIENCE_S, until
from std_msgs.msg import String
from std_srvs.srv import Trigger

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter, Compression, Storage
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.demo.player import BagPlayer
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

YAW = math.pi / 4
URDF = f"""<robot name="auv"><link name="base_link"/><link name="dvl_link"/>
<joint name="dvl_joint" type="fixed"><parent link="base_link"/><child link="dvl_link"/>
<origin xyz="-0.6 0.1 -0.2" rpy="0 0 {YAW}"/></joint></robot>"""


@pytest.mark.spread(1)
@pytest.mark.parametrize("given", [(), ("use_transforms:=false",), ("mounting_rpy:=[0.0, 0.0, 0.7]",)])
def test_mounting_and_lever_arm_come_from_robot_description_unless_given(world, tmp_path, given):
    bag, saved = tmp_path / "bag", tmp_path / "live.yaml"
    errors = DvlErrors((0.0, 0.01, 0.02), beam_std=0.005)
    scenario = Scenario(
        seconds=5.0 if given else 60.0, mounting_rpy=(0.0, 0.0, YAW), errors=errors, gnss_std=0.05,
        effects=(injection("lever_arm:x_m=-0.6,y_m=0.1,z_m=-0.2"),),
    )  # fmt: skip
    write_bag(scenario, bag, Storage.MCAP, Compression.NONE)
    arm = (0.0, 0.0, 0.0) if given and "use_transforms" in given[0] else (-0.6, 0.1, -0.2)
    publisher = world.node.create_publisher(String, "robot_description", LATCHED)
    publisher.publish(String(data=URDF))
    with world.calibration_node("max_latency:=600.0", "model:=M3", f"result_file:={saved}", *given):
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        until(lambda: diagnostics, "the node to run")
        if not given or "use_transforms" not in given[0]:
            until(lambda: publisher.get_subscription_count(), "the node to listen")
            # found is not heard: a node that hears of it after the last DVL message has nothing to place
            assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))
        player = BagPlayer(world.node, [bag])
        player.wait_for_subscribers()
        player.play(speed=100.0)

        assert world.call(Trigger, f"{NODE}/save").success
    result = load_yaml(saved, "result file")
    np.testing.assert_allclose(result["parameters"]["lever_arm"], arm, rtol=0, atol=1e-9)
    nominal = {(): YAW, ("use_transforms:=false",): 0.0}.get(given, 0.7)
    np.testing.assert_allclose(result["parameters"]["mounting_rpy"], (0.0, 0.0, nominal), atol=1e-9)
    if not given:
        assert result["mounting"]["corrected_rpy"][2] == pytest.approx(YAW + 0.02, abs=0.02)
        assert result["counts"]["dvl"]["accepted"] > 250


@pytest.mark.slow
@pytest.mark.spread(1)
@pytest.mark.parametrize("given", [(), ("heading_deviation_std:=0.01",)])
def test_what_the_imu_claims_of_its_heading_is_taken_unless_given(world, tmp_path, given):
    sound, bag, saved = tmp_path / "sound", tmp_path / "bag", tmp_path / "live.yaml"
    write_bag(Scenario(seconds=5.0, gnss_std=0.05), sound, Storage.MCAP, Compression.NONE)
    with BagReader([sound]) as read, BagWriter(bag, storage=Storage.MCAP) as written:
        for topic, log_ns, message, _ in read.messages(TOPICS):
            if topic == "imu/data":
                message.orientation_covariance = np.diag([0.0, 0.0, math.radians(2.0) ** 2]).ravel()
            written.message(topic, TOPICS[topic], log_ns, message)
    with world.calibration_node("max_latency:=600.0", "model:=M3", f"result_file:={saved}", *given):
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        until(lambda: diagnostics, "the node to run")
        player = BagPlayer(world.node, [bag])
        player.wait_for_subscribers()
        player.play(speed=100.0)
        seen = len(diagnostics)
        until(lambda: len(diagnostics) >= seen + 2, "what is said at the end")
        assert world.call(Trigger, f"{NODE}/save").success
    found = load_yaml(saved, "result file")["parameters"]["heading_deviation_std"]
    assert found == (0.01 if given else discover([bag], Parameters()).parameters.heading_deviation_std)
    assert given or found == 0.035
