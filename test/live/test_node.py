"""The real node over real DDS: in a process of its own, or in this one where a test looks inside."""

from __future__ import annotations

import itertools
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from conftest import ROOT
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from live_fixtures import LATCHED, Live, assert_agree
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros import NODE, World, refused_at_start, until
from std_srvs.srv import Trigger

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.models import BY_VELOCITY, MODELS
from dvl_calib_ros.calibration.models.parameters import SCHEMA, Parameters
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.demo.player import BagPlayer
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.node.calibration_node import CalibrationNode
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

# Bags are played much faster than recorded here, on machines that stall: topics may lag each other by minutes of
# stamps without being given up.
PATIENT = {"max_latency": 600.0}
SCENARIOS = {
    "enu reference, outage": Scenario(
        seconds=90, imu_rate=20, outages=((40, 60),),
        errors=DvlErrors((0.02, -0.03, 0.05), (0.005,) * 3, beam_std=0.005),
    ),
    "body reference at 1 Hz, mounted at 45 degrees": Scenario(
        trajectory="figure8", seconds=90, gnss_rate=1, imu_rate=0, gnss_frame=VelocityFrame.BODY,
        mounting_rpy=(0.0, 0.0, math.pi / 4), errors=DvlErrors((0, 0.01, -0.02), beam_std=0.005),
    ),
}  # fmt: skip


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "bag"
    write_bag(SCENARIOS["enu reference, outage"], path, Storage.MCAP, Compression.NONE)
    return path


def play(world: World, path: Path, **options) -> dict[str, int]:
    player = BagPlayer(world.node, [path], **options)
    player.wait_for_subscribers()
    return player.play(speed=100.0)


def as_arguments(parameters: dict) -> list[str]:
    return [f"{name}:={list(value) if isinstance(value, tuple) else value}" for name, value in parameters.items()]


def diagnosed(messages, key):
    """Latest value of a key in /diagnostics."""
    values = {item.key: item.value for message in messages[-1:] for item in message.status[0].values}
    return values.get(key)


# ---------------------------------------------------------------- a process of its own


@pytest.mark.spread(1)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_node_and_the_replay_of_one_bag_agree_in_every_model(scenario, world, tmp_path):
    bag, saved = tmp_path / "bag", tmp_path / "live.yaml"
    write_bag(SCENARIOS[scenario], bag, Storage.MCAP, Compression.NONE)
    given = PATIENT | {"mounting_rpy": SCENARIOS[scenario].mounting_rpy}
    with world.calibration_node(*as_arguments(given), f"result_file:={saved}"):
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        sent = play(world, bag)
        until(lambda: diagnosed(diagnostics, "dvl received") == str(sent["dvl/twist"]), "all DVL samples")
        until(lambda: diagnosed(diagnostics, "reference received") == str(sent["gnss/twist"]), "all GNSS samples")
        until(lambda: diagnosed(diagnostics, "imu received") == str(sent.get("imu/data", 0)), "all IMU samples")
        assert world.call(Trigger, f"{NODE}/save").success
        on_request = load_yaml(saved, "result file")
    at_shutdown = load_yaml(saved, "result file")
    offline = replay([bag], Parameters(**given)).result
    assert_agree(on_request, offline)
    assert_agree(at_shutdown, offline)
    if "outage" in scenario:
        assert len(offline.segments) == 4


@pytest.mark.slow
def test_the_papers_own_selection_is_published_whatever_is_selected(world, bag):
    with world.calibration_node("model:=unaided", *as_arguments(PATIENT)):
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        got = world.received(TwistWithCovarianceStamped, f"{NODE}/iac/estimate", LATCHED)
        sent = play(world, bag)
        until(lambda: diagnosed(diagnostics, "dvl received") == str(sent["dvl/twist"]), "all DVL samples")
        offline = replay([bag], Parameters()).result
        assert offline.iac_model == "M3"
        x = offline.estimates["M3"].state

        def angles():
            angular = got[-1].twist.twist.angular
            return np.array([angular.x, angular.y, angular.z])

        until(lambda: got and np.abs(angles() - x[:3]).max() < 1e-12, "the estimate of M3")
        assert diagnosed(diagnostics, "model of the paper") == "M3 (iac: GNSS is available)"
        covariance = got[-1].twist.covariance.reshape(6, 6)
        np.testing.assert_allclose(covariance[3:, 3:], offline.estimates["M3"].filter_covariance[:3, :3], atol=1e-12)


@pytest.mark.spread(1)
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_result_is_saved_whichever_way_the_node_is_stopped(stop, world, tmp_path):
    saved = tmp_path / "live.yaml"
    with world.calibration_node(f"result_file:={saved}", stop=stop) as process:
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        until(lambda: diagnostics, "the node to run")
    assert process.returncode == 0, process.output
    assert "Traceback" not in process.output
    assert load_yaml(saved, "result file")["model"] == "unaided"


def test_a_result_that_cannot_be_saved_at_the_end_is_printed_so_that_it_is_not_lost(world, tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    with world.calibration_node(f"result_file:={folder / 'result.yaml'}") as process:
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        until(lambda: diagnostics, "the node to run")
        folder.rmdir()
    assert process.returncode == 1
    assert "could not be written" in process.output
    assert "models:" in process.output and "covariance:" in process.output


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["-p", "gnss_timout:=2.0"], "gnss_timout: no such parameter, did you mean 'gnss_timeout'?"),
        (["-p", "prior_source:=reference"], "prior_source: reference needs recorded data"),
        (["-p", "result_file:=/no/such/folder/r.yaml"], "the folder /no/such/folder does not exist"),
        (["-p", "initial_calibration:=/no/such/file"], "/no/such/file: no such result file"),
        (["--params-file", "/no/such/file.yaml"], "/no/such/file.yaml"),
        (["-p", "dvl_type:=marine_acoustic_msgs/Dvl"], "sudo apt install ros-$ROS_DISTRO-marine-acoustic-msgs"),
        (["-p", "gnss_type:=dvl_msgs/DVL"], "gnss_type: 'dvl_msgs/DVL' is none of geometry_msgs/msg/Twist"),
        # a reference that is the DVL itself agrees with every mounting that it is given
        (["-r", "dvl/twist:=/a", "-r", "gnss/twist:=/a"], "dvl/twist and gnss/twist are both /a;"),
        (["-r", "gnss/twist:=/dvl_calibration/calibrated_twist"], "gnss/twist and ~/calibrated_twist are both /dvl_ca"),
    ],
)
def test_a_bad_configuration_is_refused_at_the_start_in_one_line(capfd, arguments, said):
    errors = refused_at_start(capfd, *arguments)
    assert said in errors
    own = [line for line in errors.splitlines() if "[rcl" not in line]  # rcl may add lines of its own
    assert len(own) == 1 and own[0].startswith("calibration_node: ")


PARAMETER_FILES = {
    "of another node": ("other: {ros__parameters: {min_speed: 0.5}}", "is for node /dvl_calibration, only for other"),
    "of a node in a namespace": ("/auv/dvl_calibration: {ros__parameters: {min_speed: 0.5}}", "only for /auv/dvl_cal"),
    "unknown under our name": ("dvl_calibration: {ros__parameters: {rate: 0.5}}", "rate: no such parameter"),
    "misspelt for all": ("/**: {ros__parameters: {min_spede: 0.5}}", "did you mean 'min_speed'"),
    "result over it": ("/**: {ros__parameters: {result_file: FILE}}", "would write over the input FILE"),
}


@pytest.mark.parametrize("what", PARAMETER_FILES)
def test_a_parameter_file_that_would_leave_the_node_on_its_defaults_is_refused(capfd, tmp_path, what):
    text, said = PARAMETER_FILES[what]
    path = tmp_path / "params.yaml"
    path.write_text(text.replace("FILE", str(path)))
    before = path.read_bytes()
    errors = refused_at_start(capfd, "--params-file", str(path))
    assert said.replace("FILE", str(path)) in errors and "Traceback" not in errors
    assert [line for line in errors.splitlines() if "[rcl" not in line][-1].startswith("calibration_node: ")
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["params.yaml"]


def test_what_a_parameter_file_sets_for_all_nodes_disturbs_ours_not_and_is_said(world, tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text("/**: {ros__parameters: {frame_rate: 30, camera: {exposure: 0.1}, min_speed: 0.7}}")
    with node_here(world, [path], cli_args=["--ros-args", "--params-file", str(path)]) as node:
        assert node._calibrator.parameters.min_speed == 0.7
        assert not node.has_parameter("frame_rate") and not node.has_parameter("camera.exposure")
        (tmp_path / "x.yaml").touch()
        node._result_folder = tmp_path
        answer = world.set_parameter("result_file", str(path))
        assert not answer.successful and "would write over the input" in answer.reason


def test_the_node_needs_nothing_that_a_ros_machine_does_not_have():
    """rosbags, mcap and rich are not in ROS: the node, and `dvl-calib run`, must do without."""
    code = (
        "import sys\n"
        "for name in ('rosbags', 'mcap', 'rich'): sys.modules[name] = None\n"
        "import dvl_calib_ros.node.main, dvl_calib_ros.node.calibration_node, dvl_calib_ros.cli.run\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------- in this process


@contextmanager
def stalled_node(world: World, files: Sequence[Path] = (), cli_args: Sequence[str] | None = None, **parameters):
    """The node, and what lets it run. files: parameter files that cli_args name."""
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    node = CalibrationNode(files, context=world.context, parameter_overrides=overrides, cli_args=cli_args)
    executor = SingleThreadedExecutor(context=world.context)
    executor.add_node(node)

    def spin():
        with suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    try:
        yield node, thread.start
    finally:
        executor.shutdown()
        if thread.ident is not None:
            thread.join()
        node.destroy_node()


@contextmanager
def node_here(world: World, files: Sequence[Path] = (), cli_args: Sequence[str] | None = None, **parameters):
    with stalled_node(world, files, cli_args, **parameters) as (node, run):
        run()
        yield node


def twist(seconds: float, velocity=(1.5, 0.0, 0.0), frame="dvl_link", variance=0.0):
    message = TwistWithCovarianceStamped()
    message.header.stamp.sec, message.header.stamp.nanosec = int(seconds), round(seconds % 1 * 1e9)
    message.header.frame_id = frame
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = velocity
    message.twist.covariance[[0, 7, 14]] = variance
    return message


class Publisher:
    """Publishes twists on a topic once the node hears it."""

    def __init__(self, world: World, topic="dvl/twist", reliability=ReliabilityPolicy.RELIABLE):
        profile = QoSProfile(depth=1000, reliability=reliability)
        self._publisher = world.node.create_publisher(TwistWithCovarianceStamped, topic, profile)
        until(lambda: self._publisher.get_subscription_count() == 1, "the node's subscription")

    def send(self, *messages):
        for message in messages:
            self._publisher.publish(message)


def received(node, stream="dvl"):
    return node._calibrator.counts[stream]["received"]


def test_models_are_switched_by_parameter_at_once_and_a_late_subscriber_gets_the_estimate(world):
    with node_here(world) as node:
        dvl, gnss = Publisher(world), Publisher(world, "gnss/twist")
        for i in range(100):
            gnss.send(twist(1000 + 0.2 * i, (1.5, 0.1, 0.0), "base_link"))
            dvl.send(twist(1000 + 0.2 * i, (1.51, 0.05, 0.02)))
        until(lambda: received(node) == 100 and received(node, "reference") == 100, "all samples")
        for name, model in ((name, MODELS[name]) for name in BY_VELOCITY):
            assert world.set_parameter("model", name).successful
            got = world.received(TwistWithCovarianceStamped, f"{NODE}/estimate", LATCHED)
            until(lambda got=got: got, "the latched estimate")
            state = node._calibrator.state(name)
            terms = model.error_terms_from_state @ state.x
            linear, angular = got[-1].twist.twist.linear, got[-1].twist.twist.angular
            np.testing.assert_array_equal([angular.x, angular.y, angular.z], terms[:3])
            np.testing.assert_array_equal([linear.x, linear.y, linear.z], terms[3:])
            diagonal = np.diag(got[-1].twist.covariance.reshape(6, 6))
            estimated = model.error_terms_from_state.any(axis=1)[[3, 4, 5, 0, 1, 2]]
            assert ((diagonal == -1.0) == ~estimated).all()
        assert node._calibrator.selected == BY_VELOCITY[-1]


@pytest.mark.parametrize(
    "name, value, reason",
    [
        ("model", "M9", "is not one of auto"),
        ("gnss_model", "M7", "is not one of M3"),
        ("gnss_timeout", 5.0, "read-only"),
        ("gnss_hysteresis", -1.0, ""),
        ("gnss_hysteresis", "long", "type"),
        ("target_drift", float("nan"), ""),
        ("result_file", "/no/such/folder/r.yaml", "a running node accepts only"),
        ("no_such_parameter", 1.0, ""),
        ("model", "positions", "needs positions"),
    ],
)
def test_a_bad_parameter_is_refused_live_with_the_reason_and_nothing_changes(name, value, reason, world):
    with node_here(world) as node:
        before = node._calibrator.parameters
        answer = world.set_parameter(name, value)
        assert not answer.successful
        assert answer.reason and reason in answer.reason
        assert node._calibrator.parameters == before


def test_every_parameter_is_declared_with_type_range_and_description(world):
    with node_here(world, gnss_timeout=3.0) as node:
        for name, spec in SCHEMA.items():
            described = node.describe_parameter(name)
            assert spec.description in described.description
            assert described.read_only == spec.read_only
        assert node.get_parameter("gnss_timeout").value == 3.0


def test_whole_numbers_are_accepted_for_doubles_in_a_file_and_live(world, tmp_path):
    """By ``NAME: 5`` in a file and ``ros2 param set NAME 5`` it is an integer."""
    file = tmp_path / "whole.yaml"
    file.write_text("/**: {ros__parameters: {min_speed: 1, lever_arm: [1, 0, -2], result_backups: 7}}")
    with node_here(world, [file], cli_args=["--ros-args", "--params-file", str(file)]) as node:
        started = node._calibrator.parameters
        assert (started.min_speed, started.lever_arm, started.result_backups) == (1.0, (1.0, 0.0, -2.0), 7.0)
        numbers = [name for name, spec in SCHEMA.items() if spec.kind == "double" and not spec.read_only]
        assert "result_backups" in numbers
        for name in numbers:
            value = next((n for n in (5, 1, 0) if SCHEMA[name].low <= n <= SCHEMA[name].high), None)
            if value is None:  # its range holds no whole number
                continue
            answer = world.set_parameter(name, value)
            assert answer.successful, answer.reason
            kept = world.parameter(name), getattr(node._calibrator.parameters, name)
            assert kept == (value, value) and {type(each) for each in kept} == {float}
        assert not world.set_parameter("result_backups", 101).successful
        assert not world.set_parameter("result_backups", True).successful
        assert "read-only" in world.set_parameter("min_speed", 2).reason


@pytest.mark.slow
def test_at_200_hz_each_sample_is_counted_in_one_place_at_any_time(world, tmp_path):
    account_at_200_hz(world, tmp_path, 1000)


def account_at_200_hz(world: World, folder: Path, n: int) -> dict[str, int]:
    """Send n samples, also of each kind that is not used, and count where the node says they are, each second."""
    keys = ("refused", "unusable", "unpaired", "waiting", "gathered", "used", "gated")
    refused = 0
    with world.calibration_node(f"result_file:={folder / 'live.yaml'}") as process:
        live = Live(world, process, folder / "live.yaml")
        began = time.monotonic()
        for i in range(n):
            at = 1000.0 + 0.005 * i
            velocity = (1.5 + 0.3 * math.sin(at), 0.1 * math.cos(3.0 * at), 0.01 * math.sin(7.0 * at))
            kind = i % 97
            refused += kind in (3, 7)
            sent = (math.nan, 0.0, 0.0) if kind == 3 else (0.0,) * 3 if kind == 5 else velocity
            live.publish([("dvl", twist(at - 0.005 * (kind == 7), sent))])
            if i % 40 == 0 and not 300 < i % 1000 < 700:
                live.publish([("reference", twist(at, velocity, "base_link"))])
            time.sleep(max(0.0, began + 0.005 * (i + 1) - time.monotonic()))
        until(lambda: diagnosed(live.diagnostics, "dvl received") == str(n), "all samples")
        said = [{each.key: each.value for each in message.status[0].values} for message in live.diagnostics]
    for values in said:
        assert sum(int(values[f"samples {key}"]) for key in keys) == int(values["dvl received"])
    places = {key: int(said[-1][f"samples {key}"]) for key in keys}
    assert places["refused"] == refused and min(places.values()) >= 0, places
    assert len({values["dvl received"] for values in said}) >= n / 250  # also on the way
    return places


def test_services_reset_and_save_answer_in_words(world, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with node_here(world, model="M7") as node:  # which waits for no IMU
        dvl = Publisher(world)
        dvl.send(*(twist(1000 + 0.2 * i) for i in range(10)))
        until(lambda: received(node) == 10, "all samples")
        answer = world.call(Trigger, f"{NODE}/save")
        assert not answer.success and "result_file" in answer.message
        target = tmp_path / "result.yaml"
        assert world.set_parameter("result_file", str(target)).successful
        for _ in range(2):
            answer = world.call(Trigger, f"{NODE}/save")
            assert answer.success and str(target) in answer.message
        assert (
            load_yaml(target, "result file")["used"] == load_yaml(tmp_path / "result.yaml.bak", "backup")["used"] == 10
        )
        assert world.call(Trigger, f"{NODE}/reset").success
        assert received(node) == 0
        answer = world.call(Trigger, f"{NODE}/save")
        assert not answer.success and "no sample was used, so there is nothing to save" in answer.message
        assert load_yaml(target, "result file")["used"] == 10
        dvl.send(*(twist(1000 + 0.2 * i) for i in range(10)))
        until(lambda: received(node) == 10, "all samples")
        target.unlink()
        (tmp_path / "result.yaml.bak").unlink()
        tmp_path.rmdir()
        answer = world.call(Trigger, f"{NODE}/save")
        assert not answer.success and "could not be written" in answer.message


@pytest.mark.slow
def test_after_a_stall_no_topic_runs_ahead_of_another(world, bag):
    """The bag comes while the node stands still, far longer than max_latency of it."""
    with stalled_node(world) as (node, run):
        play(world, bag)
        run()
        until(lambda: received(node) == 450 and received(node, "imu") == 1800, "all samples")
        live = node._calibrator.result()
    offline = replay([bag], Parameters()).result
    assert live.counts == offline.counts
    for name in BY_VELOCITY:
        np.testing.assert_allclose(live.estimates[name].state, offline.estimates[name].state, rtol=0, atol=1e-12)


def test_the_first_warning_of_each_code_is_in_the_log(world, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(CalibrationNode, "warn", lambda _, text: said.append(text))
    with node_here(world, discover=False):
        heard = world.received(DiagnosticArray, "/diagnostics")
        until(lambda: sum("DVL_NO_MESSAGE" in each.status[0].message for each in heard) > 2, "a silent DVL, thrice")
    assert [text for text in said if text.endswith("[DVL_NO_MESSAGE]")] == [said[0]]
    assert said[0].startswith("no DVL message yet; check the sensor")


def test_best_effort_and_reliable_publishers_are_both_heard(world):
    with node_here(world) as node:
        first = Publisher(world)
        first.send(twist(1000.0))
        until(lambda: received(node) == 1, "the reliable publisher's sample")
        profile = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        second = world.node.create_publisher(TwistWithCovarianceStamped, "dvl/twist", profile)
        stamps = itertools.count(1001)

        def heard(publish):  # best effort may lose some, above all while both sides are still finding each other
            before = received(node)
            publish(twist(float(next(stamps))))
            time.sleep(0.05)
            return received(node) > before

        until(lambda: heard(second.publish), "a sample of the best-effort publisher")
        until(lambda: heard(first.send), "a sample of the reliable publisher, still")


@pytest.mark.slow
def test_wrong_frames_and_a_silent_dvl_are_named_in_the_diagnostics(world):
    with node_here(world) as node:
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        Publisher(world, "gnss/twist").send(twist(1000.0, frame="gps_antenna"))
        Publisher(world).send(twist(1000.0, frame="base_link"), twist(1000.2), twist(1000.4, (math.nan, 0.0, 0.0)))
        until(lambda: received(node) == 3 and received(node, "reference") == 1, "the samples")
        count = len(diagnostics)
        until(lambda: len(diagnostics) > count + 1, "diagnostics after them")
        status = diagnostics[-1].status[0]
        assert status.level == DiagnosticStatus.WARN
        assert "gnss_frame" in status.message and "'gps_antenna'" in status.message
        assert "frame_id 'base_link'" in status.message and "dvl_frame" in status.message
        assert diagnosed(diagnostics, "dvl wrong_frame") == diagnosed(diagnostics, "dvl invalid") == "1"
        assert diagnosed(diagnostics, "model") == "unaided"
        until(lambda: diagnostics[-1].status[0].level == DiagnosticStatus.ERROR, "the DVL to be reported silent")
        assert "no usable DVL message for" in diagnostics[-1].status[0].message


def test_calibrated_twist_is_the_corrected_velocity_in_the_body_with_both_uncertainties(world, tmp_path):
    mounting = (0.0, 0.0, math.pi / 2)
    with node_here(world, mounting_rpy=list(mounting), model="M5") as node:
        topic = f"{NODE}/calibrated_twist"
        got = world.received(TwistWithCovarianceStamped, topic, 100, publisher=node._corrected_publisher)
        dvl = Publisher(world)
        dvl.send(*(twist(1000 + 0.2 * i, (0.05, -1.5, 0.01), variance=1e-4) for i in range(50)))
        until(lambda: len(got) == 50, "all corrected velocities")
        estimate = node._calibrator.estimate("M5")
        t = node._calibrator.parameters.rotation_dvl_from_body
        expected = estimate.corrected_velocity(np.array([0.05, -1.5, 0.01]), t)
        linear = got[-1].twist.twist.linear
        np.testing.assert_allclose([linear.x, linear.y, linear.z], expected, atol=1e-4)
        covariance = got[-1].twist.covariance.reshape(6, 6)
        assert got[-1].header.frame_id == "base_link"
        assert (np.diag(covariance)[:3] > 0.99e-4).all() and covariance[1, 1] > covariance[0, 0]
        assert (np.diag(covariance)[3:] == -1.0).all()


def test_the_node_runs_on_simulated_time_that_stands_still(world):
    with node_here(world, use_sim_time=True, model="M7") as node:
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        Publisher(world).send(*(twist(1000 + 0.2 * i) for i in range(5)))
        until(lambda: diagnosed(diagnostics, "samples used") == "5", "diagnostics on a standing clock")
        assert node.get_parameter("use_sim_time").value is True
