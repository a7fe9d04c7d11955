"""Player of bags over DDS, with the bytes as recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from ..bags.reader import BagReader
from ..errors import InputError
from ..node.message_types import message_class
from ..recordings.topics import Topics

PATIENCE = Duration(seconds=30)
# topics sent once and kept for late subscribers, as robot_state_publisher and static broadcasters do
LATCHED = ("/tf_static", "/robot_description")
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
                    durability=DurabilityPolicy.TRANSIENT_LOCAL if name in LATCHED else DurabilityPolicy.VOLATILE,
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
                if at < start_s and channel.topic not in LATCHED:
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
