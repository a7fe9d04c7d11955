"""`dvl-calib play`: what was recorded comes over DDS as it was, and nothing else."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="playing needs ROS 2: pip install '.[ros]'")

from geometry_msgs.msg import TwistWithCovarianceStamped
from io_fixtures import mcap_bytes, raw, run, write_bag
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from ros import World, until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from stacks import TWIST, Told
from std_msgs.msg import String
from test_node import node_here, received

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.cli import play
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.files.urdf import parse_urdf

PLAYED = ["dvl/twist", "gnss/twist", "imu/data", "/tf_static", "/robot_description"]


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


@pytest.fixture(scope="module")
def mounted(tmp_path_factory):
    """A bag whose DVL sits at 90 degrees and off the middle, as /tf_static alone says; a description has the IMU."""
    told = Told()
    told.dvl("dvl/twist", TWIST, "dvl & co", (0.0, 0.0, math.pi / 2))
    told.reference("gnss/twist", TWIST, "map", "enu")
    told.imu("imu/data", "imu_link")
    told.robot_description(
        '<robot name="auv"><link name="base_link"/><link name="imu_link"/><joint name="imu" type="fixed">'
        '<parent link="base_link"/><child link="imu_link"/></joint></robot>'
    )
    told.tf_static(told.transform("base_link", "dvl & co", (0.0, 0.0, math.pi / 2), (-0.6, 0.1, -0.2)))
    return told.write(tmp_path_factory.mktemp("mounted") / "bag")


@pytest.mark.slow
def test_the_node_takes_the_mounting_of_a_played_tf_static_as_replay_does(world, mounted, capsys, monkeypatch):
    """Also where tf2_msgs is not installed, which pip does not have."""
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    replayed = discover([mounted], Parameters()).parameters
    with node_here(world) as node:
        assert main(["play", str(mounted), "--rate", "50", "--wait", "--topics", *PLAYED]) == 0
        until(lambda: received(node) > 100, "the DVL's messages")
        live = node._calibrator.parameters
    assert live.mounting_rpy == pytest.approx(replayed.mounting_rpy, abs=1e-12)
    assert live.lever_arm == pytest.approx(replayed.lever_arm, abs=1e-12)
    assert live.mounting_rpy[2] == pytest.approx(math.pi / 2) and live.lever_arm == pytest.approx((-0.6, 0.1, -0.2))
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(
        "warning: /tf_static is published as joints of /robot_description: tf2_msgs is not installed"
    )
    assert "apt install ros-jazzy-tf2-msgs" in said


@pytest.mark.slow
def test_who_comes_late_hears_the_recorded_description_with_the_transforms_as_joints(world, mounted, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    heard: list = []
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    late = threading.Timer(2.0, world.node.create_subscription, (String, "/robot_description", heard.append, latched))
    late.start()
    assert main(["play", str(mounted), "--playback-duration", "6", "--topics", *PLAYED]) == 0
    (description,) = heard
    joints = parse_urdf(Path("description"), description.data.encode()).joints
    assert {(each.parent, each.child) for each in joints} == {("base_link", "imu_link"), ("base_link", "dvl & co")}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rate", "0"], "--rate: 0 is outside"),
        (["--rate", "0.001"], "--rate: 0.001 is outside"),
        (["--rate", "nan"], "--rate: nan is outside"),
        (["--clock", "1e6"], "--clock"),
        (["--topics", "/sonar"], "/sonar is not in the recording, which has dvl/twist, gnss/twist, imu/data"),
        (["--remap", "dvl/twist=x"], "'dvl/twist=x' is not OLD:=NEW"),
        (["--remap", "dvl/twist:=2 x"], "topic '2 x' cannot be used"),
        (["--start-offset", "11"], "the recording has 1"),
        (["--delay", "-1"], "--delay"),
        (["--playback-duration", "0"], "--playback-duration"),
    ],
)
def test_what_cannot_be_played_is_said_in_one_line(bag, capsys, options, said):
    assert main(["play", str(bag), *options]) == 2
    errors = capsys.readouterr().err
    assert said in errors and len(errors.splitlines()) == 1
