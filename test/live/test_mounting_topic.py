"""~/mounting and the transform: where and how the DVL sits, for those who know nothing of misalignments."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from live_fixtures import LATCHED
from ros import NODE, until
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger
from test_node import Publisher, node_here, received, twist

from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.demo.player import BagPlayer
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

MOUNTING = (0.1, -0.2, 0.7)


def said(messages) -> dict[str, str]:
    return {item.key: item.value for message in messages[-1:] for item in message.status[0].values}


@pytest.mark.slow
def test_the_mounting_of_a_played_bag_is_that_of_the_result_file_for_who_comes_late(world, tmp_path):
    bag, saved = tmp_path / "bag", tmp_path / "live.yaml"
    scenario = Scenario(
        "figure8", 150.0, mounting_rpy=MOUNTING, imu_rate=20, gnss_std=0.03,
        errors=DvlErrors((0.02, -0.03, 0.05), (0.004,) * 3, beam_std=0.005),
        effects=(injection("lever_arm:x_m=-1.2,y_m=0.1,z_m=-0.2"), injection("dvl_time_offset:seconds=0.4")),
    )  # fmt: skip
    write_bag(scenario, bag, Storage.MCAP, Compression.NONE)
    with world.calibration_node(
        "max_latency:=40.0",
        f"mounting_rpy:={list(MOUNTING)}",
        f"result_file:={saved}",
        "model:=full",
        "publish_tf:=true",
        "dvl_position:=from_reference",
    ) as process:
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        player = BagPlayer(world.node, [bag])
        player.wait_for_subscribers()
        sent = player.play(speed=50.0)
        until(lambda: said(diagnostics).get("dvl received") == str(sent["dvl/twist"]), "all DVL samples")
        until(lambda: said(diagnostics).get("imu received") == str(sent["imu/data"]), "all IMU samples")
        n = len(diagnostics)
        until(lambda: len(diagnostics) > n + 2, "more diagnostics")
        assert world.call(Trigger, f"{NODE}/save").success
        poses = world.received(PoseWithCovarianceStamped, f"{NODE}/mounting", LATCHED)
        until(lambda: poses, "the latched mounting")
    if find_spec("tf2_ros") is None:
        assert "publish_tf is set, but tf2_ros is not installed" in process.output
    result = load_yaml(saved, "result file")
    mounting, pose = result["mounting"], poses[-1].pose
    assert result["model"] == "full"
    assert poses[-1].header.frame_id == "base_link"
    at, turn = pose.pose.position, pose.pose.orientation
    assert mounting["position"] == mounting["lever_arm"]  # the reference is that of the body's own point
    turned = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
    differs = (turned * Rotation.from_quat(mounting["corrected_quaternion_xyzw"]).inv()).as_rotvec()
    differs = np.hstack([np.subtract([at.x, at.y, at.z], mounting["position"]), differs])
    np.testing.assert_allclose(differs, 0.0, atol=1e-12)
    covariance = pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance, mounting["pose_covariance"], rtol=1e-9, atol=1e-12)
    true = Rotation.from_euler("xyz", MOUNTING) * Rotation.from_rotvec([0.02, -0.03, 0.05])
    wrong = (Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]) * true.inv()).as_rotvec()
    assert wrong @ np.linalg.solve(covariance[3:, 3:], wrong) < 25.0
    assert at.x == pytest.approx(-1.2, abs=5.0 * np.sqrt(covariance[0, 0]))
    values = said(diagnostics)
    late_std = mounting["dvl_time_offset_std"]
    assert float(values["dvl_time_offset [s]"]) == pytest.approx(mounting["dvl_time_offset"], abs=late_std)
    assert 0.9 * late_std < float(values["sigma dvl_time_offset [s]"]) < 2.0 * late_std
    scale_std = 100.0 * mounting["scale_error_ahead_std"]
    assert float(values["scale error ahead [%]"]) == pytest.approx(100.0 * mounting["scale_error_ahead"], abs=scale_std)
    assert mounting["dvl_time_offset"] == pytest.approx(0.4, abs=0.1)


def test_a_model_without_lever_arm_gives_the_one_that_is_set_and_says_that_it_is_not_estimated(world):
    with node_here(world, model="M7", lever_arm=[0.3, 0.0, -0.1], dvl_position="from_reference"):
        poses = world.received(PoseWithCovarianceStamped, f"{NODE}/mounting", LATCHED)
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        Publisher(world).send(*(twist(1000 + 0.2 * i) for i in range(30)))
        until(lambda: poses, "the mounting")
        until(lambda: diagnostics, "diagnostics")
        at = poses[-1].pose.pose.position
        assert (at.x, at.y, at.z) == (0.3, 0.0, -0.1)
        np.testing.assert_array_equal(np.diag(poses[-1].pose.covariance.reshape(6, 6))[:3], -1.0)
        assert said(diagnostics)["sigma dvl_time_offset [s]"] == "not estimated"


class Broadcaster:
    """What tf2_ros has under this name."""

    def __init__(self, node):
        self.sent = SENT[node.get_name()] = []

    def sendTransform(self, transform):  # noqa: N802
        self.sent.append(transform)


SENT: dict[str, list] = {}


@pytest.fixture
def sent(monkeypatch) -> dict[str, list]:
    """What is broadcast, by the node."""
    stub = ModuleType("tf2_ros")
    stub.StaticTransformBroadcaster = Broadcaster
    monkeypatch.setitem(sys.modules, "tf2_ros", stub)
    SENT.clear()
    return SENT


@pytest.mark.slow
def test_with_publish_tf_the_transform_is_that_pose_and_another_of_the_same_frame_is_warned_of(world, sent):
    with node_here(world, publish_tf=True, dvl_frame="dvl_a50", dvl_position="told") as node:
        poses = world.received(PoseWithCovarianceStamped, f"{NODE}/mounting", LATCHED)
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        Publisher(world).send(*(twist(1000 + 0.2 * i, frame="dvl_a50") for i in range(30)))
        until(lambda: received(node) == 30 and poses and sent[NODE], "the mounting")
        transform, pose = sent[NODE][-1], poses[-1].pose.pose
        assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "dvl_a50")
        assert transform.transform.rotation == pose.orientation
        move = transform.transform.translation
        assert (move.x, move.y, move.z) == (pose.position.x, pose.position.y, pose.position.z)
        until(lambda: diagnostics, "diagnostics")
        assert "TF_TWICE" not in diagnostics[-1].status[0].message
        heard = node._transforms.n_messages
        node._transforms._on_transforms(SimpleNamespace(transforms=[transform]))  # it comes back to its sender
        assert node._transforms.n_messages == heard
        other = TransformStamped()
        other.child_frame_id = "dvl_a50"
        node._transforms._on_transforms(SimpleNamespace(transforms=[other]))
        until(lambda: "TF_TWICE" in diagnostics[-1].status[0].message, "the warning")


def test_no_transform_is_broadcast_of_a_dvl_whose_place_nobody_knows_and_that_is_said(world, sent):
    with node_here(world, publish_tf=True, lever_arm=[0.3, 0.0, -0.1]) as node:
        poses = world.received(PoseWithCovarianceStamped, f"{NODE}/mounting", LATCHED)
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        Publisher(world).send(*(twist(1000 + 0.2 * i) for i in range(30)))
        until(lambda: received(node) == 30 and poses, "the mounting")
        assert np.isnan(poses[-1].pose.pose.position.x)
        until(lambda: diagnostics and "POSITION_UNKNOWN" in diagnostics[-1].status[0].message, "the finding")
        assert not sent[NODE]


def test_no_transform_is_broadcast_unless_asked_for(world, sent):
    with node_here(world):
        pass
    assert not sent
