"""A live node in a process of its own, for tests that feed it samples and look at what it says and saves."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros import NODE, PATIENCE_S, World, until
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import BY_VELOCITY, MODELS, Needs
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.calibration.results.results import Result
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.messages.decode import stamp_ns
from dvl_calib_ros.messages.live_feed import MessageFeed

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
FRAMES = {VelocityFrame.BODY: "base_link", VelocityFrame.ENU: "map", VelocityFrame.NED: "ned"}
STREAMS = {"dvl": "dvl/twist", "reference": "gnss/twist", "imu": "imu/data"}


class Sent(NamedTuple):
    """A message and the stream (of `STREAMS`) that it is sent on."""

    stream: str
    message: Any


def sent(sample: DvlSample | ReferenceSample | ImuSample, frame_id: str | None = None) -> Sent:
    """The message that becomes this sample; frame_id: another than the stream's own."""
    if isinstance(sample, ImuSample):
        message = Imu()
        q, w = message.orientation, message.angular_velocity
        q.x, q.y, q.z, q.w = sample.orientation
        w.x, w.y, w.z = sample.angular_velocity
        stream, own = "imu", "base_link"
    else:
        message = TwistWithCovarianceStamped()
        linear = message.twist.twist.linear
        linear.x, linear.y, linear.z = sample.velocity
        if sample.covariance is not None:
            message.twist.covariance.reshape(6, 6)[:3, :3] = sample.covariance
        is_dvl = isinstance(sample, DvlSample)
        stream, own = ("dvl", "dvl_link") if is_dvl else ("reference", FRAMES[sample.frame])
    message.header.frame_id = frame_id or own
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(sample.stamp_ns, 1_000_000_000)
    return Sent(stream, message)


class Offline:
    """A replay of the same messages."""

    def __init__(self, parameters: Parameters, initial: Mapping[str, GaussianState] | None = None) -> None:
        self.calibrator = Calibrator(parameters, initial=initial, block_size=64)
        feed = MessageFeed(self.calibrator, lambda _: None)
        self._take = {"dvl": feed.dvl, "reference": feed.reference, "imu": feed.imu}

    def feed(self, messages: Sequence[Sent]) -> Offline:
        for stream, message in messages:
            self._take[stream](message, 0)
        return self


def received(counts: dict[str, dict[str, int]]) -> dict[str, int]:
    return {stream: counts[stream]["received"] for stream in STREAMS}


def assert_agree(saved: dict, result: Result) -> None:
    for name in BY_VELOCITY:
        live, expected = saved["models"][name], result.estimates[name]
        np.testing.assert_allclose(live["state"], expected.state, rtol=0, atol=1e-12)
        np.testing.assert_allclose(live["covariance"], expected.covariance, rtol=0, atol=1e-12)
        assert (live["used"], live["gated"]) == (expected.used, expected.gated)
    assert saved["model"] == result.selected
    assert [(each["from_ns"], each["model"]) for each in saved["selected"]] == list(result.segments)
    assert saved["counts"] == result.counts


def assert_counts_add_up(counts: dict[str, dict[str, int]], models: dict[str, dict]) -> None:
    """See `Calibrator.counts`. models: name -> used, gated."""
    dvl, pairing = counts["dvl"], counts["pairing"]
    assert all(value >= 0 for tally in counts.values() for value in tally.values())
    refused = ("invalid", "wrong_frame", "duplicate", "out_of_order", "stray", "held")
    assert dvl["received"] == dvl["accepted"] + sum(dvl[key] for key in refused)
    unused = ("slow", "frozen", "turning", "no_turn_rate", "awaiting_imu")
    assert dvl["accepted"] == dvl["usable"] + sum(dvl[key] for key in unused)
    decided = dvl["accepted"] - dvl["awaiting_imu"] - pairing["awaiting_reference"]
    assert decided == pairing["paired"] + pairing["unpaired"]
    assert dvl["usable"] == sum(pairing[key] for key in ("oriented", "not_oriented", "awaiting_attitude"))
    given = {
        Needs.NOTHING: dvl["usable"],
        Needs.ATTITUDE: pairing["oriented"],
        Needs.ATTITUDE_IF_KNOWN: pairing["oriented"] + pairing["not_oriented"],
        Needs.REFERENCE: pairing["paired"],
    }
    for name, model in ((name, MODELS[name]) for name in BY_VELOCITY):
        taken = models[name]["used"] + models[name]["gated"]
        if MODELS[name].estimator:  # takes references, also those of the last block that wait for their pair
            assert taken <= counts["reference"]["received"]
        else:
            assert taken == given[model.needs] or (model.aided and taken <= given[model.needs])


class Live:
    """A running node with reliable publishers on its inputs, and what it says in /diagnostics."""

    def __init__(self, world: World, process: subprocess.Popen[str], result_file: Path) -> None:
        self.world = world
        self.process = process
        self.result_file = result_file
        self.diagnostics: list[DiagnosticArray] = world.received(DiagnosticArray, "/diagnostics")
        self._corrected = world.received(TwistWithCovarianceStamped, f"{NODE}/calibrated_twist", 100)
        kinds = {"dvl": TwistWithCovarianceStamped, "reference": TwistWithCovarianceStamped, "imu": Imu}
        self.publishers = {stream: self.publisher(kinds[stream], topic) for stream, topic in STREAMS.items()}

    def publisher(self, kind: type, topic: str, **qos: Any) -> Any:
        """A publisher that the node hears."""
        publisher = self.world.node.create_publisher(kind, topic, QoSProfile(depth=10_000, **qos))
        until(lambda: publisher.get_subscription_count() > 0, f"the node's subscription of {topic}")
        return publisher

    def reset(self) -> None:
        assert self.world.call(Trigger, f"{NODE}/reset").success
        self._corrected.clear()

    def publish(self, messages: Sequence[Sent]) -> None:
        for stream, message in messages:
            self.publishers[stream].publish(message)

    def when_like(self, replay: Offline) -> dict:
        """What the node saves once it has received as many messages as the replay, on each stream."""

        def enough() -> dict | None:
            saved = self.saved()
            return saved if received(saved["counts"]) == expected else None

        expected = received(replay.calibrator.counts)
        last_ns = replay.calibrator.last_ns  # saving is slow: first see that it is worth while
        until(lambda: self._corrected and stamp_ns(self._corrected[-1].header.stamp) == last_ns, "the last DVL sample")
        return until(enough, f"the node to receive {expected}")

    def when_heard(self, replay: Offline) -> None:
        """Wait as `when_like`, by what /diagnostics says."""
        expected = {(f"{stream} received", str(n)) for stream, n in received(replay.calibrator.counts).items()}
        until(
            lambda: expected <= {(each.key, each.value) for each in self.status().values},
            f"the node to receive {expected}",
        )

    def save_and_die(self) -> None:
        """Ask a node to save that does not survive it."""
        client = self.world.node.create_client(Trigger, f"{NODE}/save")
        assert client.wait_for_service(PATIENCE_S)
        client.call_async(Trigger.Request())
        self.process.wait(PATIENCE_S)

    def saved(self) -> dict:
        answer = self.world.call(Trigger, f"{NODE}/save_anyway")  # faults may make the result worse than the last one's
        assert answer.success, answer.message
        return load_yaml(self.result_file, "result file")

    def status(self) -> DiagnosticStatus:
        """What /diagnostics says from now on."""
        count = len(self.diagnostics)
        until(lambda: len(self.diagnostics) > count, "/diagnostics")
        return self.diagnostics[-1].status[0]

    def wait_until_it_says(self, words: str) -> DiagnosticStatus:
        """The first status from now on with these words in its message."""
        return until(
            lambda: words in (status := self.status()).message and status,
            lambda: f"/diagnostics to say {words!r}; it says {self.diagnostics[-1].status[0].message!r}",
        )

    def has_said(self, words: str, since: int) -> bool:
        """Whether these words were in a message of /diagnostics, of which there have been so many before."""
        return any(words in each.status[0].message for each in self.diagnostics[since:])
