"""A node whose topics do not exist finds those that do, by type and content, says so, and keeps to them."""

from __future__ import annotations

import threading

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from io_fixtures import run, write_bag
from ros import NODE, until

from dvl_calib_ros.demo.player import BagPlayer

TARGETS = {"dvl/twist": "/a50/velocity", "gnss/twist": "/gps", "imu/data": "/imu"}
# A node that listens for a second
QUICKLY = (
    "import sys; from dvl_calib_ros.node import discovering, main; discovering.LISTEN_S = 1.0; sys.exit(main.main())"
)


@pytest.fixture
def playing(world, tmp_path):
    """A vehicle whose topics nobody named, again and again."""
    player = BagPlayer(world.node, [write_bag(tmp_path / "bag", run(120.0))], TARGETS)
    ended = threading.Event()

    def play() -> None:
        while not ended.is_set():
            player.play(30.0, has_ended=ended.is_set)

    thread = threading.Thread(target=play)
    thread.start()
    yield player
    ended.set()
    thread.join()


def latest(messages):
    return {item.key: item.value for item in messages[-1].status[0].values} if messages else {}


def test_topics_that_nobody_named_are_found_and_calibrated_with(world, playing):
    with world.calibration_node(entry=("-c", QUICKLY)) as node:
        said = world.received(DiagnosticArray, "/diagnostics")
        for stream in ("dvl", "reference", "imu"):
            until(lambda stream=stream: int(latest(said).get(f"{stream} received", 0)) > 20, f"{stream} to be heard")

        def hearers() -> list[str]:
            return [each.node_name for each in world.node.get_subscriptions_info_by_topic("/a50/velocity")]

        until(lambda: hearers() == [NODE], "what was recorded with to be gone")
        assert any("[TOPICS_FOUND]" in value for key, value in latest(said).items() if key.startswith("finding"))
    assert "nobody publishes the DVL's topic" in node.output
    assert "DVL /a50/velocity (TwistWithCovarianceStamped" in node.output and "reference /gps" in node.output
