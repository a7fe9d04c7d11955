"""`dvl-calib play`: what was recorded comes over DDS as it was, and nothing else."""

from __future__ import annotations

import os
import signal
import threading
from itertools import pairwise

import pytest

pytest.importorskip("rclpy", reason="playing needs ROS 2: pip install '.[ros]'")

from geometry_msgs.msg import TwistWithCovarianceStamped
from io_fixtures import mcap_bytes, raw, run, write_bag
from rclpy.serialization import deserialize_message
from ros import World, until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

from dvl_calib_ros.cli import play
from dvl_calib_ros.cli.main import main


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("play") / "bag", run(10.0))


def listening(world: World, message_type: type, topic: str) -> list:
    """Messages of a topic that is not there yet."""
    messages: list = []
    world.node.create_subscription(message_type, topic, messages.append, 5000)
    return messages


def stamps_ns(messages: list) -> list[int]:
    return [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in messages]


def test_everything_comes_as_it_was_recorded_by_its_new_name_with_a_clock(world, bag, capsys):
    dvl, reference = (listening(world, TwistWithCovarianceStamped, name) for name in ("a50/velocity", "gnss/twist"))
    imu, clock = listening(world, Imu, "imu/data"), listening(world, Clock, "/clock")
    assert main(["play", str(bag), "--rate", "20", "--wait", "--clock", "10", "-m", "dvl/twist:=a50/velocity"]) == 0
    twist = TwistWithCovarianceStamped
    for topic, kind, messages in (("dvl/twist", twist, dvl), ("gnss/twist", twist, reference), ("imu/data", Imu, imu)):
        recorded = [deserialize_message(data, kind) for name, _, data in raw(bag) if name == topic]
        until(lambda got=messages, sent=recorded: len(got) == len(sent), topic)
        assert messages == recorded
    ticks = [each.clock.sec + 1e-9 * each.clock.nanosec for each in clock]
    assert 90 < len(ticks) <= 101
    assert all(0.09 < later - sooner < 0.11 for sooner, later in pairwise(ticks))
    assert f"published {len(raw(bag))} messages of 3 topics" in capsys.readouterr().out


def test_a_part_of_some_topics_is_played(world, bag):
    dvl, imu = listening(world, TwistWithCovarianceStamped, "dvl/twist"), listening(world, Imu, "imu/data")
    part = ["--start-offset", "4", "--playback-duration", "3", "--topics", "/dvl/twist"]
    assert main(["play", str(bag), "--rate", "100", "--wait", *part]) == 0
    first_ns = min(log_ns for _, log_ns, _ in raw(bag))
    expected = [name for name, log_ns, _ in raw(bag) if name == "dvl/twist" and 4e9 <= log_ns - first_ns <= 7e9]
    until(lambda: len(dvl) == len(expected), "the part")
    assert not imu


def test_who_is_waited_for_is_said(world, bag, capsys, monkeypatch):
    monkeypatch.setattr(play, "SAID_AFTER_S", 0.1)
    ended = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    ended.start()
    assert main(["play", str(bag), "--wait", "--topics", "dvl/twist"]) == 0
    said = capsys.readouterr()
    assert "published 0 messages" in said.out and said.err == "waiting for subscribers of /dvl/twist\n"


def test_a_loop_goes_on_until_ctrl_c_and_ends_cleanly(world, bag, capsys):
    imu: list = []
    n = sum(name == "imu/data" for name, _, _ in raw(bag))

    def take(message: Imu) -> None:
        imu.append(message)
        if len(imu) == n + 5:
            os.kill(os.getpid(), signal.SIGINT)

    world.node.create_subscription(Imu, "imu/data", take, 5000)
    assert main(["play", str(bag), "--rate", "50", "--loop", "--wait", "--topics", "imu/data"]) == 0
    assert stamps_ns(imu[:5]) == stamps_ns(imu[n : n + 5])
    assert "published" in capsys.readouterr().out


def test_a_topic_of_a_package_that_is_not_installed_is_said_and_the_others_are_played(world, tmp_path, capsys):
    sonar = {"sonar": ("unheard_msgs/msg/Ping", "float64 range")}
    path = tmp_path / "two.mcap"
    messages = raw(write_bag(tmp_path / "bag", run(2.0)))
    path.write_bytes(mcap_bytes([("sonar", messages[0][1], bytes(12)), *messages], sonar))
    imu = listening(world, Imu, "imu/data")
    assert main(["play", str(path), "--rate", "100", "--topics", "imu/data", "--wait"]) == 0
    until(lambda: len(imu) > 10, "the others")
    capsys.readouterr()
    assert main(["play", str(path), "--rate", "1000"]) == 0
    said = capsys.readouterr()
    assert "unheard_msgs is not installed" in said.err and "not played" in said.err
    assert main(["play", str(path), "--topics", "sonar"]) == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rate", "0.001"], "--rate: 0.001 is outside"),
        (["--rate", "nan"], "--rate: nan is outside"),
        (["--clock", "1e6"], "--clock"),
        (["--topics", "/sonar"], "/sonar is not in the recording, which has dvl/twist, gnss/twist, imu/data"),
        (["--remap", "dvl/twist=x"], "'dvl/twist=x' is not OLD:=NEW"),
        (["--remap", "dvl/twist:=2 x"], "topic '2 x' cannot be had"),
        (["--start-offset", "11"], "the recording has 1"),
        (["--delay", "-1"], "--delay"),
        (["--playback-duration", "0"], "--playback-duration"),
    ],
)
def test_what_cannot_be_played_is_said_in_one_line(bag, capsys, options, said):
    assert main(["play", str(bag), *options]) == 2
    errors = capsys.readouterr().err
    assert said in errors and len(errors.splitlines()) == 1
