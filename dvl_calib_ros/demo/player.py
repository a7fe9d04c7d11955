"""Player of bags over DDS, with the bytes as recorded, and observer of the node meanwhile."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rich.console import Group
from rich.table import Table
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from ..bags.reader import BagReader
from ..calibration.results.results import NOT_ESTIMATED
from ..errors import InputError
from ..files.parameter_files import NODE_NAME
from ..node.message_queue import QUEUE
from ..node.message_types import message_class
from ..node.services import LATCHED, AnsweringNode
from ..recordings.topics import Topics

PATIENCE = Duration(seconds=30)
# topics sent once and kept for late subscribers, as robot_state_publisher and static broadcasters do
KEPT_TOPICS = ("/tf_static", "/robot_description")
# longest delay of a request to end, s
BREATH_S = 0.05


def sensors_of(bag: BagReader) -> dict[str, str]:
    """Return DVL, GNSS and IMU topic of a bag -> the calibration node's own name for it."""
    defaults = Topics()
    found = defaults.found_in(bag.topics)
    named = {found.dvl: defaults.dvl, found.gnss: defaults.gnss, found.imu: defaults.imu}
    return {name: target for name, target in named.items() if name in bag.topics}


def wait_until(time_s: float, has_ended: Callable[[], bool]) -> None:
    """Wait until a time of `time.monotonic`, or until `has_ended`."""
    while (remaining := time_s - time.monotonic()) > 0.0 and not has_ended():
        time.sleep(min(remaining, BREATH_S))


class BagPlayer:
    """Reliable publisher of a bag's topics.

    targets: topic of the bags -> published name; by default DVL, GNSS and IMU -> the calibration node's names.
    clock_hz: rate of /clock in time of the bag, 0 for never. Raises InputError.
    """

    def __init__(
        self,
        node: Node,
        paths: Sequence[Path],
        targets: Mapping[str, str] | None = None,
        reliability: Any = ReliabilityPolicy.RELIABLE,
        clock_hz: float = 0.0,
    ) -> None:
        """Create a publisher for each topic to play. reliability: QoS policy of the publishers."""
        self._paths = paths
        self._reliable = reliability == ReliabilityPolicy.RELIABLE
        self._publishers: dict[str, Any] = {}
        self._node = node
        self._description: list[Any] = []
        with BagReader(paths) as bag:
            for name, target in (sensors_of(bag) if targets is None else targets).items():
                kind = message_class(f"{name} of the bag holds", bag.topics[name])
                # room for every message: none is overwritten before it is acknowledged, at any speed
                profile = QoSProfile(
                    history=HistoryPolicy.KEEP_LAST,
                    depth=max(bag.message_counts[name], 1),
                    reliability=reliability,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL if name in KEPT_TOPICS else DurabilityPolicy.VOLATILE,
                )
                self._publishers[name] = node.create_publisher(kind, target, profile)
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock_hz else None
        self._tick_s = 1.0 / clock_hz if clock_hz else float("inf")

    def describe(self, text: str, topic: str) -> None:
        """Publish a robot description (URDF) once, also for late subscribers. Raises InputError."""
        profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._description.append(self._node.create_publisher(String, topic, profile))
        self._description[-1].publish(String(data=text))

    @property
    def unheard(self) -> list[str]:
        """Published topics without a subscriber."""
        publishers = (*self._publishers.values(), *self._description)
        return [publisher.topic_name for publisher in publishers if publisher.get_subscription_count() < 1]

    def wait_for_subscribers(self, timeout_s: float = 30.0) -> None:
        """Wait until every publisher has a subscriber. Raises InputError after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while unheard := self.unheard:
            if time.monotonic() > deadline:
                raise InputError(f"no subscriber of {unheard[0]} within {timeout_s:.0f} s; is the node running?")
            time.sleep(0.01)

    def play(
        self,
        speed: float,
        on_time: Callable[[float, Mapping[str, int]], None] = lambda at, sent: None,
        start_s: float = 0.0,
        duration_s: float = float("inf"),
        has_ended: Callable[[], bool] = lambda: False,
    ) -> dict[str, int]:
        """Publish all messages, at most `speed` times as fast as recorded. Return topic -> number sent.

        on_time is called before every message with its time in s since the bag's first and the numbers sent so far;
        playback waits for it. start_s, duration_s: part of the bag; before it only latched topics are published.
        has_ended: whether to stop.
        """
        sent = dict.fromkeys(self._publishers, 0)
        with BagReader(self._paths) as bag:
            first_ns = bag.span_ns[0]
            began, next_tick = time.monotonic() - start_s / speed, start_s
            for log_ns, channel, data in bag.raw_messages(self._publishers):
                at = (log_ns - first_ns) * 1e-9
                if at > start_s + duration_s or has_ended():
                    break
                if at < start_s and channel.topic not in KEPT_TOPICS:
                    continue
                published_s = time.monotonic()
                on_time(at, sent)
                began += time.monotonic() - published_s
                while next_tick <= at and not has_ended():
                    wait_until(began + next_tick / speed, has_ended)
                    self._publish_clock(first_ns + round(next_tick * 1e9))
                    next_tick += self._tick_s
                wait_until(began + at / speed, has_ended)
                if has_ended():
                    break
                self._publishers[channel.topic].publish(data)
                sent[channel.topic] += 1
        if not has_ended():
            self.wait_until_received()
        return sent

    def _publish_clock(self, nanoseconds: int) -> None:
        """Publish the recording's time, if requested."""
        if self._clock is not None:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 1_000_000_000)
            self._clock.publish(message)

    def wait_until_received(self) -> None:
        """Wait until the subscribers' middleware has all messages (of a reliable player)."""
        if self._reliable:
            for publisher in self._publishers.values():
                publisher.wait_for_all_acked(PATIENCE)


# place in the covariance diagonal of ~/estimate, factor to the displayed unit
SHOWN = {
    "phi_x": ("φx °", 3, math.degrees(1.0)),
    "phi_y": ("φy °", 4, math.degrees(1.0)),
    "phi_z": ("φz °", 5, math.degrees(1.0)),
    "delta_k": ("δk %", 0, 100.0),
}

# keys of the node's counts of messages received
RECEIVED = {Topics.dvl: "dvl received", Topics.gnss: "reference received", Topics.imu: "imu received"}
# A busy machine falls behind a bag played fast. At most this number of messages of a topic may wait, half of the node's
# queue. A node silent for PATIENCE_S is not waited for.
WAITING, PATIENCE_S = QUEUE // 2, 30.0


class Watcher:
    """Player of bags to the node, with the node's answers for `render`. truth: in degrees and per cent."""

    def __init__(self, paths: Sequence[Path], truth: Mapping[str, float]) -> None:
        """Subscribe to the answers of the node, and create the publishers of the bags."""
        self._truth = truth
        self._node = AnsweringNode("dvl_calib_demo")
        self._node.create_subscription(TwistWithCovarianceStamped, f"{NODE_NAME}/estimate", self._on_estimate, LATCHED)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._parameters = AsyncParameterClient(self._node, NODE_NAME)
        self._player = BagPlayer(self._node, paths)
        self._time = 0.0
        self._estimate: TwistWithCovarianceStamped | None = None
        self._diagnostics: dict[str, str] = {}
        self._events: list[str] = []
        self._shown_why = ""

    def run(self, speed: float, switch_at_s: float, switch_to: str, back_at_s: float) -> None:
        """Play everything. Set parameter model to switch_to at switch_at_s, and back to auto at back_at_s."""
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)

        def spin() -> None:
            with suppress(ExternalShutdownException):  # Ctrl-C ends the demo without a traceback
                executor.spin()

        spinning = threading.Thread(target=spin, daemon=True)
        spinning.start()
        switches = [(switch_at_s, switch_to), (back_at_s, "auto")]

        def on_time(at: float, sent: Mapping[str, int]) -> None:
            """Switch the model when its time has come, and wait for the node to catch up."""
            self._time = at
            if switches and at >= switches[0][0]:
                self._switch(switches.pop(0)[1])
            self._wait_until_at_most(WAITING, sent)

        try:
            self._player.wait_for_subscribers()
            self._wait_until_at_most(0, self._player.play(speed, on_time))
        finally:
            executor.shutdown()
            spinning.join(5.0)
            self._node.destroy_node()

    def _wait_until_at_most(self, waiting: int, sent: Mapping[str, int]) -> None:
        """Wait until at most `waiting` messages of a topic wait in the node, by its own counts."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            received = (int(self._diagnostics.get(key, 0)) for key in RECEIVED.values())
            if all(sent.get(topic, 0) - n <= waiting for topic, n in zip(RECEIVED, received, strict=True)):
                return
            time.sleep(0.02)

    def _switch(self, model: str) -> None:
        self._events.append(f"{self._time:6.1f} s  ros2 param set /{NODE_NAME} model {model}")
        self._parameters.set_parameters([Parameter("model", value=model)])

    def _on_estimate(self, message: TwistWithCovarianceStamped) -> None:
        self._estimate = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep the newest values, and note a change of model."""
        self._diagnostics = {item.key: item.value for status in message.status for item in status.values}
        why = f"running {self._diagnostics.get('model')} ({self._diagnostics.get('why')})"
        if why != self._shown_why:
            self._shown_why = why
            self._events.append(f"{self._time:6.1f} s  {why}")

    def render(self) -> Any:
        """Return the current state for a rich display."""
        table = Table(title=f"{self._time:6.1f} s", title_justify="left")
        for column in ("", "truth", "estimate", "± 1σ"):
            table.add_column(column, justify="right", no_wrap=True, min_width=9)
        for name, (label, place, factor) in SHOWN.items():
            table.add_row(label, f"{self._truth[name]:+.2f}", *self._cells(place, factor))
        used, gated = self._diagnostics.get("samples used", "-"), self._diagnostics.get("samples gated", "-")
        state = self._diagnostics.get("convergence", "waiting for data")
        table.caption = f"model {self._diagnostics.get('model', '-')}, {state}, {used} used, {gated} gated"
        return Group(table, self._diagnostics.get("gnss", ""), *self._events[-10:])

    def _cells(self, place: int, factor: float) -> tuple[str, str]:
        """Return value and σ of one component of the estimate as text, in a unit by `factor` from SI."""
        if self._estimate is None:
            return "-", "-"
        twist = self._estimate.twist
        variance = float(twist.covariance[7 * place])
        if variance == NOT_ESTIMATED:
            return "-", "-"
        linear, angular = twist.twist.linear, twist.twist.angular
        value = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)[place]
        return f"{factor * value:+.2f}", f"{factor * math.sqrt(variance):.2f}"
