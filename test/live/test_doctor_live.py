"""`dvl-calib doctor --live`: what is on the topics now, without knowing their names."""

from __future__ import annotations

import json
import threading

import pytest

pytest.importorskip("rclpy", reason="listening needs ROS 2: pip install '.[ros]'")

from command_line import fail, succeed
from io_fixtures import run, write_bag
from rclpy.qos import ReliabilityPolicy

from dvl_calib_ros.demo.player import BagPlayer


@pytest.mark.spread(1)
@pytest.mark.parametrize("reliability", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
def test_what_is_on_the_topics_is_found_and_looked_at(world, tmp_path, capsys, reliability):
    bag = write_bag(tmp_path / "bag", run(60.0))
    targets = {"dvl/twist": "/a50/velocity", "gnss/twist": "/gps", "imu/data": "/imu"}
    player = BagPlayer(world.node, [bag], targets, reliability)
    ended = threading.Event()
    playing = threading.Thread(target=player.play, args=(20.0,), kwargs={"has_ended": ended.is_set})
    playing.start()
    out, _ = succeed(capsys, "doctor", "--live", "2", "--json", tmp_path / "d.json")
    ended.set()
    playing.join()
    found = json.loads((tmp_path / "d.json").read_text())["topics"]
    assert {role: each["topic"] for role, each in found.items()} == {
        "dvl": "/a50/velocity", "reference": "/gps", "imu": "/imu",
    }  # fmt: skip
    said = " ".join(out.split())
    assert "dvl-calib run --watch --dvl-topic /a50/velocity --gnss-topic /gps --imu-topic /imu" in said


def test_where_nothing_comes_it_is_said(world, capsys):
    assert "no message of a DVL, a reference or an IMU came within 1 s" in fail(capsys, "doctor", "--live", "1")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "name a BAG"),
        (["bag", "--live"], "not both"),
        (["--live", "0.5"], "outside"),
        (["--live", "nan"], "outside"),
    ],
)
def test_what_cannot_be_looked_at_is_said_in_one_line(capsys, arguments, said):
    assert said in fail(capsys, "doctor", *arguments)
