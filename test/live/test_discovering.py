"""A node whose topics do not exist finds those that do, by type and content, says so, and keeps to them."""

from __future__ import annotations

import threading
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from io_fixtures import rewrite, run, write_bag
from position_fixtures import USBL, write_positions
from ros import NODE, until
from std_srvs.srv import Trigger

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.demo.player import BagPlayer
from dvl_calib_ros.discovery.discover import discover
from validation.positions import Truth, driven

TARGETS = {"dvl/twist": "/a50/velocity", "gnss/twist": "/gps", "imu/data": "/imu"}
# A node that listens for a second
QUICKLY = (
    "import sys; from dvl_calib_ros.node import live_discovery, main; "
    "live_discovery.LISTEN_S = 1.0; sys.exit(main.main())"
)


@contextmanager
def repeated(player, speed=30.0):
    """A bag that is played again and again."""
    ended = threading.Event()

    def play() -> None:
        while not ended.is_set():
            player.play(speed, has_ended=ended.is_set)

    thread = threading.Thread(target=play)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def latest(messages):
    return {item.key: item.value for item in messages[-1].status[0].values} if messages else {}


def test_topics_that_nobody_named_are_found_and_calibrated_with(world, tmp_path):
    player = BagPlayer(world.node, [write_bag(tmp_path / "bag", run(120.0))], TARGETS)
    with repeated(player), world.calibration_node(entry=("-c", QUICKLY)) as node:
        said = world.received(DiagnosticArray, "/diagnostics")
        for stream in ("dvl", "reference", "imu"):
            until(lambda stream=stream: int(latest(said).get(f"{stream} received", 0)) > 20, f"{stream} to be heard")

        def hearers() -> list[str]:
            return [each.node_name for each in world.node.get_subscriptions_info_by_topic("/a50/velocity")]

        until(lambda: hearers() == [NODE], "what was recorded with to be gone")
        assert any("[TOPICS_FOUND]" in value for key, value in latest(said).items() if key.startswith("finding"))
    assert "the DVL's topic has no publisher" in node.output
    assert "DVL /a50/velocity (TwistWithCovarianceStamped" in node.output and "reference /gps" in node.output


@pytest.mark.slow
def test_the_unknown_frame_of_a_reference_is_chosen_by_the_data_as_in_a_replay(world, tmp_path):
    def in_gps(topic, message):
        if topic == "gnss/twist":
            message.header.frame_id = "gps"
        return message

    bag = rewrite(tmp_path / "bag", in_gps, run(120.0, VelocityFrame.BODY))
    chosen = discover([bag], Parameters()).values["gnss_frame"]
    # a faster bag has more jitter; in 40 s of it the vehicle turns
    quickly = QUICKLY.replace("1.0", "8.0")
    with repeated(BagPlayer(world.node, [bag]), 5.0), world.calibration_node(entry=("-c", quickly)) as node:
        said = world.received(DiagnosticArray, "/diagnostics")
        until(lambda: "REFERENCE_FRAME" in " ".join(latest(said).values()), "the frame to be unknown")
        until(lambda: int(latest(said)["pairing paired"]) > 50, lambda: f"the reference to be used: {latest(said)}")
    assert f"the reference is used as {chosen}" in node.output and chosen == "body"


@pytest.mark.slow
def test_a_usbl_with_a_fix_each_five_seconds_is_waited_for_found_and_calibrated_with(world, tmp_path):
    """In its own time until it is found, then once more, fast and to the end."""
    truth = Truth((0.0, 0.01, 0.03), 0.006, (0.5, 0.0, -0.3), 0.5)
    made = driven(np.random.default_rng(3), 600.0, truth=truth, fix_s=5.0)
    bag = write_positions(tmp_path / "bag", made)
    targets = {"dvl/twist": "/a50/velocity", USBL: "/usbl/pose", "imu/data": "/imu"}
    player, found = BagPlayer(world.node, [bag], targets), threading.Event()
    thread = threading.Thread(target=lambda: player.play(1.0, has_ended=found.is_set))
    with world.calibration_node("max_latency:=40.0", entry=("-c", QUICKLY)) as node:
        said = world.received(DiagnosticArray, "/diagnostics")
        thread.start()
        try:
            until(lambda: "TOPICS_FOUND" in " ".join(latest(said).values()), "the topics to be found")
        finally:
            found.set()
            thread.join()
        # what the node has of the first time it is to forget: where the stamps of the DVL go back, all is counted anew
        # from its second message on, and an IMU that comes before it, with the same stamp, is two short
        player.wait_for_subscribers()
        player.wait_until_received()
        heard = len(said)
        until(lambda: len(said) > heard + 1, "what waits to be fed")
        assert world.call(Trigger, f"{NODE}/reset").success
        sent = player.play(45.0)
        for stream, topic in (("dvl", "dvl/twist"), ("reference", USBL), ("imu", "imu/data")):
            until(
                lambda stream=stream, topic=topic: latest(said)[f"{stream} received"] == str(sent[topic]),
                lambda stream=stream, topic=topic: f"{stream}: {sent[topic]}, not {latest(said)[f'{stream} received']}",
            )
        assert latest(said)["calibration restarts"] == "0"
        until(lambda: latest(said)["model"] == "positions", lambda: f"legs of positions, not {latest(said)['model']}")
    assert "reference /usbl/pose (PoseWithCovarianceStamped" in node.output
