"""The live node on other message types than the default: over DDS where they are installed, else without it."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from driver_fixtures import A50, MARINE, TWIST, Maker, as_plain
from geometry_msgs.msg import TwistWithCovarianceStamped
from io_fixtures import run
from live_fixtures import sent
from nav_msgs.msg import Odometry
from position_fixtures import write_positions
from ros import until
from test_node import as_arguments, assert_agree, diagnosed, node_here, play, received

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.models import POSITIONS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.messages.drivers import POSE_TYPES, VELOCITY_TYPES
from dvl_calib_ros.messages.live_feed import MessageFeed
from dvl_calib_ros.node import calibration_node
from dvl_calib_ros.node.calibration_node import CalibrationNode
from dvl_calib_ros.node.diagnostics import RecentCounts, Silence, diagnose
from dvl_calib_ros.node.message_types import message_class
from dvl_calib_ros.verdict.reasons import finding
from validation.positions import Truth, driven

WHEREABOUTS = ("refused", "unusable", "unpaired", "waiting", "gathered", "used", "gated")


def test_what_is_missing_is_named_as_it_was_remapped(world):
    with node_here(world, cli_args=["--ros-args", "-r", "dvl/twist:=/a50/velocity"]) as node:
        silent = node._silence.faults(node._calibrator, node._calibrator.counts, 1e9)
        assert silent["dvl"].numbers["topic"] == "/a50/velocity"
        assert "ros2 topic hz" in silent["dvl"].remedy and "/a50/velocity" in silent["dvl"].remedy


@pytest.mark.slow
@pytest.mark.spread(1)
def test_the_node_takes_noisy_positions_over_legs_as_the_replay_does(world, tmp_path):
    positions, saved = driven(np.random.default_rng(3), 500.0, truth=Truth((0.0, 0.0, 0.03))), tmp_path / "live.yaml"
    patient = {"max_latency": 100.0}
    bag = write_positions(tmp_path / "bag", positions, "gnss/twist")
    with world.calibration_node(*as_arguments(patient | {"gnss_type": POSE_TYPES[0]}), f"result_file:={saved}"):
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        sent = play(world, bag)
        for topic, stream in (("dvl/twist", "dvl"), ("gnss/twist", "reference"), ("imu/data", "imu")):
            until(lambda s=stream, t=topic: diagnosed(diagnostics, f"{s} received") == str(sent[t]), f"all of {topic}")
        until(lambda: diagnosed(diagnostics, "model") == POSITIONS.name, "the node to say so")
    live, offline = load_yaml(saved, "result file"), replay([bag], Parameters(**patient)).result
    assert_agree(live, offline)
    estimate = offline.estimates[POSITIONS.name]
    assert live["model"] == offline.selected == POSITIONS.name
    np.testing.assert_allclose(live["models"][POSITIONS.name]["state"], estimate.state, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(live["models"][POSITIONS.name]["covariance"], estimate.covariance, rtol=0.0, atol=1e-12)
    assert live["verification"]["held_out"] is not None


@pytest.mark.slow
def test_a_publisher_of_another_type_is_named_with_the_parameter_to_set(world):
    with world.calibration_node():  # in one process, DDS would refuse the second type
        diagnostics = world.received(DiagnosticArray, "/diagnostics")
        publisher = world.node.create_publisher(Odometry, "dvl/twist", 10)
        until(
            lambda: any("set dvl_type" in str(message.status[0].message) for message in diagnostics),
            "the diagnostics to say what to set",
        )
        # its name may be discovered later than its topic
        named = "test_client publishes nav_msgs/msg/Odometry instead of"
        until(lambda: named in diagnostics[-1].status[0].message, "the diagnostics to name it")
        world.node.destroy_publisher(publisher)
        until(lambda: "Odometry" not in diagnostics[-1].status[0].message, "diagnostics without it")


def test_a_drivers_messages_reach_the_calibration_where_its_package_is_installed(world, monkeypatch):
    """Stands in for a package that there is no wheel of: DDS is left out, all else is the node's."""
    package, kind = MARINE.split("/msg/")
    stub = ModuleType(f"{package}.msg")
    setattr(stub, kind, type(kind, (), {"__module__": f"{package}.msg._{kind.lower()}"}))
    monkeypatch.setitem(sys.modules, package, ModuleType(package))
    monkeypatch.setitem(sys.modules, f"{package}.msg", stub)
    subscribed = {}

    def subscribe(node, message_type, topic, callback, *_, **__):
        subscribed[topic] = (message_type, callback)
        return SimpleNamespace(topic_name=f"/{topic}", msg_type=message_type)

    monkeypatch.setattr(CalibrationNode, "create_subscription", subscribe)
    monkeypatch.setattr(calibration_node, "take", lambda _: None)
    maker, samples = Maker(), [sample for sample in run() if isinstance(sample, DvlSample)]
    with node_here(world, dvl_type=MARINE) as node:
        message_type, callback = subscribed["dvl/twist"]
        assert message_type is getattr(stub, kind)
        assert subscribed["gnss/twist"][0] is TwistWithCovarianceStamped
        messages = [as_plain(maker.velocity(MARINE, sample)) for sample in samples]
        messages[3].altitude, messages[3].beam_ranges_valid = -1.0, False
        for message in messages:
            callback(message, {"received_timestamp": 0, "source_timestamp": 0})
        counts = node._calibrator.counts["dvl"]
        assert (received(node), counts["no_bottom"], counts["accepted"]) == (len(samples), 1, len(samples) - 1)
        assert node._feed.decoder.turns_dvl


def test_a_dvl_that_sends_nothing_but_refused_messages_is_silent_and_what_is_wrong_with_them_is_said():
    calibrator, kind = Calibrator(Parameters(dvl_type=MARINE)), VELOCITY_TYPES[MARINE]
    feed, silence, recent = MessageFeed(calibrator, lambda _: None), Silence(0.0, {}), RecentCounts()
    for second in range(8):
        message = Maker().velocity(MARINE, DvlSample(second * 10**9, (1.5, 0.0, 0.0)))
        message.beam_velocities_valid = False
        feed.dvl(message, 0)
        status = diagnose(calibrator, kind, [], silence, recent, float(second))
    assert status.level == DiagnosticStatus.ERROR
    assert "no usable DVL message for 7 s" in status.message
    assert "8 DVL messages are not used: beam_velocities_valid is false" in status.message
    assert {item.key: item.value for item in status.values}["dvl flagged_invalid"] == "8"


@pytest.mark.spread(1)
@pytest.mark.parametrize("turned", [False, True])
def test_what_is_usable_follows_the_verdict(turned):
    """Of two DVLs on one topic, of which one is turned by 180°, no angle is known; of two that agree one is."""
    calibrator, silence, recent = Calibrator(Parameters(), worker=AtOnce()), Silence(0.0, {}), RecentCounts()
    take = {DvlSample: calibrator.feed_dvl, ReferenceSample: calibrator.feed_reference, ImuSample: calibrator.feed_imu}
    said, at_s = [], 0.0
    for sample in run(91.0):
        take[type(sample)](sample)
        if not isinstance(sample, DvlSample):
            continue
        x, y, z = sample.velocity
        second = sample._replace(
            stamp_ns=sample.stamp_ns + 20_000_000, velocity=(-x, -y, z) if turned else sample.velocity
        )
        calibrator.feed_dvl(second)
        at_s += 0.2
        if round(at_s * 5) % 150 == 1:
            status = diagnose(calibrator, VELOCITY_TYPES[TWIST], [], silence, recent, at_s)
            values = {each.key: each.value for each in status.values}
            said.append(values["usable"])
            assert values["usable"] == "no" or values["verdict"] != "reject"
            received = sum(int(values[f"samples {name}"]) for name in WHEREABOUTS)
            assert received == int(values["dvl received"])
    assert said == (["no"] * 4 if turned else ["no", "yes", "yes", "yes"])


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    ("model", "rate", "goes_on"),
    [
        ("auto", 1.0, "full still corrects with its last estimate, but learns nothing more"),
        ("unaided", 1.0, "unaided continues, but learns nothing that needs GNSS, such as the scale"),
        ("M3", 1.0, "M3 still corrects with its last estimate, but learns nothing more"),
        ("auto", 4.0, ""),
    ],
)
def test_an_outage_of_gnss_is_said_in_these_words_first_with_what_goes_on(model, rate, goes_on):
    """rate: how much faster than recorded a bag is played: no clock differs in it."""
    calibrator, silence, recent = Calibrator(Parameters(model=model), worker=AtOnce()), Silence(0.0, {}), RecentCounts()
    take = {DvlSample: calibrator.feed_dvl, ReferenceSample: calibrator.feed_reference, ImuSample: calibrator.feed_imu}
    said, dvl = {}, 0
    for sample in run(90.0):
        at_s = dvl / 5.0
        if not (isinstance(sample, ReferenceSample) and 40.0 < at_s < 60.0):
            take[type(sample)](sample)
        dvl += isinstance(sample, DvlSample)
        if isinstance(sample, DvlSample) and not dvl % (5 * rate):
            status = diagnose(calibrator, VELOCITY_TYPES[TWIST], [], silence, recent, at_s / rate)
            said[round(at_s)] = status.message
    assert not any("CLOCKS_DIFFER" in message for message in said.values())
    if rate > 1.0:
        return
    outage = [at_s for at_s, message in said.items() if "no GNSS for" in message]
    assert 44 <= outage[0] <= 47 and 59 <= outage[-1] <= 62
    assert said[55].startswith(("no GNSS for 14 s", "no GNSS for 15 s")) and goes_on in said[55]


def test_a_reference_whose_frame_is_not_known_is_said_first_and_not_as_an_outage_of_gnss():
    problem = finding("REFERENCE_FRAME", frame_id="gps", base="base_link")
    calibrator, silence, recent = Calibrator(Parameters(), worker=AtOnce()), Silence(0.0, {}), RecentCounts()
    feed = MessageFeed(calibrator, lambda _: None)
    for second in range(30):
        calibrator.feed_dvl(DvlSample(second * 10**9, (1.5, 0.0, 0.0)))
        _, message = sent(ReferenceSample(second * 10**9, (1.5, 0.0, 0.0)), "gps")
        feed.reference(message, 0)
        others = [finding("TF_NOT_THERE"), *feed.decoder.problems.values()]
        status = diagnose(calibrator, VELOCITY_TYPES[TWIST], others, silence, recent, float(second))
    assert status.message.startswith(str(problem)[:40]) and "no GNSS" not in status.message


def test_positions_that_come_every_ten_seconds_are_out_only_after_several_that_are_missing():
    calibrator, silence, out = Calibrator(Parameters()), Silence(0.0, {}), []
    for second in range(130):
        calibrator.feed_dvl(DvlSample(second * 10**9, (1.5, 0.0, 0.0)))
        if second < 60 and second % 10 == 0:
            calibrator.feed_reference(ReferenceSample(second * 10**9, (1.5, 0.0, 0.0)))
        out += ["reference" in silence.faults(calibrator, calibrator.counts, float(second))]
    assert out.index(True) == 101 and all(out[101:])


def test_a_package_or_class_that_is_not_there_is_named_with_the_remedy():
    assert message_class("dvl_type", TWIST) is TwistWithCovarianceStamped
    with pytest.raises(
        InputError, match=r"the message package dvl_msgs is not installed .* build the driver's dvl_msgs"
    ):
        message_class("dvl_type", A50)
    with pytest.raises(InputError, match=r"dvl_type nav_msgs/msg/Dvl: .* install nav_msgs, and source"):
        message_class("dvl_type", "nav_msgs/msg/Dvl")


def test_topics_that_were_named_are_kept_and_none_is_looked_for_if_nobody_wants_it(world):
    for options in ({}, {"discover": False}, {"cli_args": ["--ros-args", "-r", "dvl/twist:=/a50/velocity"]}):
        with node_here(world, **options) as node:
            assert (node._discovering is not None) == options.get("discover", True)
            named = {role for role, topic in node._named_topics(has_dvl=False).items() if topic is not None}
            assert named == ({"dvl"} if "cli_args" in options else set())
