"""What a running node hears of the water: said in /diagnostics as a replay says it, and kept in what it saves."""

from __future__ import annotations

import re

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from command_line import succeed
from diagnostic_msgs.msg import DiagnosticArray
from ros import NODE, until
from std_srvs.srv import Trigger
from water_fixtures import with_water

import dvl_calib_ros as dc
from dvl_calib_ros.demo.player import BagPlayer
from dvl_calib_ros.disk.text_files import load_yaml

TOPICS = ("dvl/twist", "gnss/twist", "imu/data", "dvl/temperature", "dvl/salinity", "dvl/sound_speed")


def shape(sentence: str) -> str:
    return re.sub(r"\d+\.\d+", "#", sentence)


@pytest.mark.slow
def test_a_running_node_says_the_scale_in_its_cause_and_apply_takes_it(world, tmp_path, capsys):
    bag = with_water(tmp_path / "bag")
    replayed = dc.replay(bag, history=False, dvl_topic="dvl/twist", gnss_topic="gnss/twist").replayed
    player = BagPlayer(world.node, [bag], {topic: topic for topic in TOPICS})
    saved = tmp_path / "result.yaml"
    with world.calibration_node(f"result_file:={saved}", "max_latency:=60.0"):
        said = world.received(DiagnosticArray, "/diagnostics")

        def latest() -> dict[str, str]:
            return {item.key: item.value for item in said[-1].status[0].values} if said else {}

        player.wait_for_subscribers()  # those of the water among them
        sent = player.play(60.0)
        until(lambda: latest().get("dvl received") == str(sent["dvl/twist"]), "all of the DVL")
        # the last seconds are in a block that has not ended
        expected = shape(replayed.cause_of_scale.sentence.replace("(dvl/", "(/dvl/"))
        until(
            lambda: shape(latest().get("cause of the scale", "")) == expected,
            lambda: f"{expected!r}; it says {latest()}",
        )
        assert latest()["speed of sound to set [m/s]"].startswith("149")
        assert world.call(Trigger, f"{NODE}/save").success
    assert load_yaml(saved, "result")["water"]["salinity"] == 35.0
    told, _ = succeed(capsys, "apply", saved, "--force", "--instrument", "waterlinked")
    assert "(as recorded) -> 149" in told
