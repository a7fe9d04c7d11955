"""`dvl-calib param`: parameters of a running node without ros2cli."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from command_line import fail, succeed
from test_node import node_here

from dvl_calib_ros.calibration.models.parameters import SCHEMA
from dvl_calib_ros.cli import param


def test_parameters_of_a_running_node_are_listed_read_and_set(world, capsys, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(world.domain))
    with node_here(world) as node:
        out, _ = succeed(capsys, "param", "list")
        assert [line.partition(":")[0] for line in out.splitlines()] == list(SCHEMA)
        assert "model: auto\n" in out and "dvl_type: geometry_msgs/msg/TwistWithCovarianceStamped  # only" in out
        assert succeed(capsys, "param", "get", "lever_arm")[0].startswith("lever_arm: [0.0, 0.0, 0.0]")
        assert succeed(capsys, "param", "set", "model", "M4")[0] == "model: M4\n"
        assert node.get_parameter("model").value == "M4" and node._calibrator.selected == "M4"
        assert "target_drift: 3.5" in succeed(capsys, "param", "set", "target_drift", "3.5")[0]
        assert "dvl_type" in fail(capsys, "param", "set", "dvl_type", "geometry_msgs/msg/TwistStamped")
        assert "result_file" in fail(capsys, "param", "set", "result_file", "/etc/r.yaml")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["set", "model", "M99"], "M99"),
        (["set", "modell", "M4"], "model"),
        (["set", "lever_arm", "[1, 0, 0]"], "start the node with -p lever_arm:="),
        (["get", "modell"], "model"),
        (["get"], "give: list, get NAME, or set NAME VALUE"),
        (["set", "model"], "give: list"),
        (["list", "model"], "give: list"),
        (["get", "model", "--node", "/port/dvl"], "no node /port/dvl within"),
    ],
)
def test_what_cannot_be_asked_is_said_in_one_line(world, capsys, monkeypatch, words, says):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(world.domain))
    monkeypatch.setattr(param, "FOUND_WITHIN_S", 0.5)
    assert says in fail(capsys, "param", *words)
