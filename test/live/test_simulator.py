"""The simulator as a node, over real DDS: what is received is what a bag would hold, and it calibrates to the truth."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from conftest import ROOT, few
from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped
from live_fixtures import Offline, Sent
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros import PATIENCE_S, World, refused_at_start, until
from sensor_msgs.msg import Imu

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.messages.decode import stamp_ns
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import START_NS, Run, Scenario, motion_of, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors, equivalent_error_terms

DEGREES = (1.0, -2.0, 3.0)
EFFECTS = ("lever_arm:x_m=0.8,z_m=-0.2", "dvl_time_offset:seconds=0.3", "stale_samples:share=0.02")
OPTIONS = ["--misalignment", *map(str, DEGREES), "--scale", "0.8", "--gnss-std", "0.02", "--seed", "7",
           *[word for effect in EFFECTS for word in ("--effect", effect)]]  # fmt: skip
DEEP = QoSProfile(depth=20_000)


def scenario(seconds: float) -> Scenario:
    """What the options stand for."""
    errors = DvlErrors(tuple(np.deg2rad(DEGREES)), (0.008,) * 3, beam_std=0.005)
    effects = tuple(map(injection, EFFECTS))
    return Scenario("free", seconds, 7, errors, gnss_std=0.02, effects=effects)


@contextmanager
def simulator(world: World, *options: str, ends_by_itself: bool = False):
    """`dvl-calib simulate --live` in a process of its own; told to end, and to have ended well, at the end."""
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", "simulate", "--live", *options]
    environment = os.environ | {"ROS_DOMAIN_ID": str(world.domain), "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT
    )
    try:
        yield process
        if not ends_by_itself:
            process.send_signal(signal.SIGINT)
        process.output = process.communicate(timeout=PATIENCE_S)[0]  # type: ignore[attr-defined]
        assert process.returncode == 0, process.output
        assert "Traceback" not in process.output and "published" in process.output
    finally:
        process.kill()
        process.wait()


def listening(world: World) -> dict[str, list]:
    """What comes on the three topics."""
    return {
        "dvl": world.received(TwistWithCovarianceStamped, "dvl/twist", DEEP),
        "reference": world.received(TwistWithCovarianceStamped, "gnss/twist", DEEP),
        "imu": world.received(Imu, "imu/data", DEEP),
    }


def last_stamp(messages: list) -> int:
    return stamp_ns(messages[-1].header.stamp) if messages else 0


def assert_equal_to_the_bag(heard: dict[str, list], run: Run, late_ns: int, atol: float, until_s: float = np.inf):
    """late_ns: of stamps against those of the bag. until_s: of what was sent only as far as the odometry went."""
    for name, wanted in (("dvl", run.dvl), ("reference", run.gnss), ("imu", run.imu)):
        wanted = [sample for sample in wanted if sample.stamp_ns <= START_NS + 1e9 * until_s]
        got = [message for message in heard[name] if stamp_ns(message.header.stamp) - late_ns <= wanted[-1].stamp_ns]
        assert [stamp_ns(message.header.stamp) - late_ns for message in got] == [each.stamp_ns for each in wanted]
        for message, sample in zip(got, wanted, strict=True):
            vector = message.angular_velocity if name == "imu" else message.twist.twist.linear
            own = sample.angular_velocity if name == "imu" else sample.velocity
            np.testing.assert_allclose([vector.x, vector.y, vector.z], own, rtol=0.0, atol=atol)
            if name == "imu":
                q = message.orientation
                np.testing.assert_allclose([q.x, q.y, q.z, q.w], sample.orientation, rtol=0.0, atol=atol)
            elif sample.covariance is not None:
                np.testing.assert_array_equal(message.twist.covariance.reshape(6, 6)[:3, :3], sample.covariance)


def assert_calibrates_to_the_truth(heard: dict[str, list]) -> None:
    """With the lever arm and the delay known, as the simulator has them."""
    messages = [Sent(stream, message) for stream, each in heard.items() for message in each]
    messages.sort(key=lambda each: (stamp_ns(each.message.header.stamp), each.stream != "imu"))
    known = Parameters(lever_arm=(0.8, 0.0, -0.2), dvl_time_offset=0.3, max_latency=600.0)
    estimate = Offline(known).feed(messages).calibrator.result().estimates["M3"]
    misalignment, scale = equivalent_error_terms(scenario(1.0).errors)
    # roll shows only where the vehicle sways or heaves; that and the axes across it are not asked of one minute
    state = dict(zip(estimate.state_names, estimate.state.tolist(), strict=True))
    std = dict(zip(estimate.state_names, estimate.std.tolist(), strict=True))
    truth = {"phi_y": misalignment[1], "phi_z": misalignment[2], "delta_k": scale[0]}
    for name, value in truth.items():
        name = name if name in state else f"{name}_x"
        assert abs(state[name] - value) < 4.0 * std[name] + 1e-3, (name, state[name], value, std[name])
        assert std[name] < 0.01


def test_what_a_run_publishes_is_what_its_bag_would_hold_bit_by_bit_and_calibrates_to_the_truth(world):
    seconds = 60.0
    run = simulate(scenario(seconds))
    options = [*OPTIONS, "--trajectory", "free", "--duration", str(seconds), "--speed", "60", "--wait"]
    with simulator(world, *options, ends_by_itself=True) as process:
        heard = listening(world)
        process.wait(PATIENCE_S)
        until(lambda: len(heard["imu"]) == len(run.imu) and len(heard["dvl"]) == len(run.dvl), "all that was sent")
        until(lambda: len(heard["reference"]) == len(run.gnss), "all of GNSS")
    late_ns = stamp_ns(heard["dvl"][0].header.stamp) - run.dvl[0].stamp_ns
    assert_equal_to_the_bag(heard, run, late_ns, atol=0.0)
    assert_calibrates_to_the_truth(heard)
    assert f"published {len(run.imu) + len(run.gnss) + len(run.dvl)} messages" in process.output


@pytest.mark.parametrize(
    "reliability", few([ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT], [ReliabilityPolicy.BEST_EFFORT])
)
def test_what_follows_an_odometry_is_what_a_bag_of_its_motion_would_hold(world, reliability):
    seconds = 40.0 if reliability is ReliabilityPolicy.RELIABLE else 3.0
    motion, _ = motion_of(scenario(seconds))
    start_ns = 1_790_000_000_000_000_000
    profile = QoSProfile(depth=20_000, reliability=reliability)
    publisher = world.node.create_publisher(Odometry, "odom", profile)
    with simulator(world, *OPTIONS, "--follow", "odom", "--wait"):
        heard = listening(world)
        until(lambda: publisher.get_subscription_count() > 0, "the simulator to hear the odometry")
        for i, time in enumerate(motion.time):
            publisher.publish(odometry(motion, i, start_ns + round(1e9 * float(time))))
            if i % 500 == 499 and reliability is ReliabilityPolicy.RELIABLE:  # the node's queue holds a thousand
                reached = start_ns + 1e9 * (float(time) - 1.0)
                until(lambda reached=reached: last_stamp(heard["imu"]) >= reached, "the simulator to keep up")
        last = {"dvl": seconds - 0.4, "imu": seconds - 0.2}
        if reliability is ReliabilityPolicy.RELIABLE:
            for name, until_s in last.items():
                reached = start_ns + 1e9 * until_s
                until(
                    lambda name=name, reached=reached: (
                        heard[name] and stamp_ns(heard[name][-1].header.stamp) >= reached
                    ),
                    f"{name} up to the end",
                )
        else:
            until(lambda: heard["imu"], "anything")
    if reliability is ReliabilityPolicy.RELIABLE:
        run = simulate(scenario(seconds))
        assert_equal_to_the_bag(heard, run, start_ns - START_NS, atol=1e-12, until_s=seconds - 0.4)
        assert_calibrates_to_the_truth(heard)


def odometry(motion, i: int, stamp: int) -> Odometry:
    message = Odometry()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    message.header.frame_id, message.child_frame_id = "odom", "base_link"
    q = message.pose.pose.orientation
    q.x, q.y, q.z, q.w = quaternion_from_rotation(motion.rotation_enu_from_body[i])
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z = motion.velocity_body[i].tolist()
    angular.x, angular.y, angular.z = motion.angular_velocity[i].tolist()
    return message


@pytest.mark.slow
def test_a_simulator_that_is_reset_begins_anew(world):
    motion, _ = motion_of(scenario(3.0))
    publisher = world.node.create_publisher(Odometry, "odom", DEEP)
    start_ns = 1_790_000_000_000_000_000
    with simulator(world, *OPTIONS, "--follow", "odom", "--wait"):
        heard = listening(world)
        until(lambda: publisher.get_subscription_count() > 0, "the simulator to hear the odometry")
        for begin in (start_ns, start_ns - 100_000_000_000):
            for i, time in enumerate(motion.time):
                publisher.publish(odometry(motion, i, begin + round(1e9 * float(time))))
        until(lambda: heard["imu"] and stamp_ns(heard["imu"][-1].header.stamp) > start_ns - 98e9, "the second start")
        until(lambda: stamp_ns(heard["imu"][-1].header.stamp) < start_ns, "the second start")
    assert stamp_ns(heard["imu"][0].header.stamp) == start_ns
    second = [each for each in heard["imu"] if stamp_ns(each.header.stamp) < start_ns]
    assert stamp_ns(second[0].header.stamp) == start_ns - 100_000_000_000


@pytest.mark.slow
def test_a_request_that_ros_itself_cannot_read_ends_no_simulator(world):
    unknown = ParameterMessage(name="use_sim_time", value=ParameterValue(type=77))
    with simulator(world, "--trajectory", "box") as process:
        world.received(Imu, "imu/data", DEEP)
        request = SetParameters.Request(parameters=[unknown])
        assert world.call(SetParameters, "dvl_simulator/set_parameters", request).results == []
        assert process.poll() is None


@pytest.mark.parametrize(
    "options",
    [("--dvl-topic", "//bad//"), ("--follow", ""), ("--follow", "a b"), ("--imu-topic", "dvl/twist")],
    ids=" ".join,
)
def test_a_topic_that_cannot_be_had_is_refused_in_one_line(world, options, monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(world.domain))
    capfd.readouterr()
    assert main(["simulate", "--live", *options]) == 2
    errors = capfd.readouterr().err
    assert "name another" in errors and sum("topic" in line for line in errors.splitlines()) == 1


def test_two_sensors_on_one_topic_are_refused_at_the_start_of_the_node(world, monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(world.domain))
    assert "name another" in refused_at_start(capfd, "-r", "dvl/twist:=/x", "-r", "imu/data:=/x")


@pytest.mark.slow
def test_another_type_of_the_dvls_messages_can_be_had(world):
    options = ["--trajectory", "box", "--duration", "5", "--speed", "5", "--wait"]
    with simulator(world, *options, "--dvl-type", "geometry_msgs/msg/TwistStamped", ends_by_itself=True) as process:
        heard = world.received(TwistStamped, "dvl/twist", DEEP)
        others = world.received(TwistWithCovarianceStamped, "gnss/twist", DEEP), world.received(Imu, "imu/data", DEEP)
        process.wait(PATIENCE_S)
        until(lambda: len(heard) == 25 and all(others), "25 messages")
    assert heard[3].twist.linear.x == pytest.approx(1.0, abs=0.6)


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    ("mode", "stop"),
    [
        (["--trajectory", "box", "--duration", "60"], signal.SIGTERM),
        (["--follow", "odom"], signal.SIGINT),
        (["--wait"], signal.SIGINT),
    ],
)
def test_it_ends_at_once_and_well_when_it_is_told_to(world, mode, stop):
    with simulator(world, *mode, ends_by_itself=True) as process:
        world.received(Imu, "imu/data", DEEP)
        process.send_signal(stop)
