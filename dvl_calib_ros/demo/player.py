"""Plays a bag to a running node over DDS, bytes as recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from ..bags.reader import BagReader
from ..errors import InputError
from ..node.message_types import message_class
from ..recordings.topics import Topics

PATIENCE = Duration(seconds=30)


class BagPlayer:
    """Publishes the DVL, GNSS and IMU topics of a bag on the node's topics, reliably."""

    def __init__(self, node: Node, paths: Sequence[Path], reliability: Any = ReliabilityPolicy.RELIABLE) -> None:
        self._paths = paths
        self._reliable = reliability == ReliabilityPolicy.RELIABLE
        defaults = Topics()
        self._publishers: dict[str, Any] = {}
        with BagReader(paths) as bag:
            found = defaults.found_in(bag.topics)
            for name, target in ((found.dvl, defaults.dvl), (found.gnss, defaults.gnss), (found.imu, defaults.imu)):
                if name in bag.topics:
                    kind = message_class(f"{name} of the bag holds", bag.topics[name])
                    # room for every message: none is overwritten before it is acknowledged, however fast we play
                    depth = max(bag.message_counts[name], 1)
                    profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability)
                    self._publishers[name] = node.create_publisher(kind, target, profile)

    def wait_for_subscribers(self, timeout_s: float = 30.0) -> None:
        """Wait until every publisher has a subscriber. Raises InputError if one has none in time."""
        deadline = time.monotonic() + timeout_s
        for topic, publisher in self._publishers.items():
            while publisher.get_subscription_count() < 1:
                if time.monotonic() > deadline:
                    raise InputError(f"nobody subscribes to {topic} within {timeout_s:.0f} s; is the node running?")
                time.sleep(0.01)

    def play(
        self, speed: float, on_time: Callable[[float, Mapping[str, int]], None] = lambda at, sent: None
    ) -> dict[str, int]:
        """Publish all messages, at most `speed` times as fast as recorded; topic -> number sent.

        on_time is called before every message with its time in s since the first and the numbers sent so far; as long
        as it takes, so long the bag stands still.
        """
        sent = dict.fromkeys(self._publishers, 0)
        with BagReader(self._paths) as bag:
            first_ns: int | None = None
            started = time.monotonic()
            for log_ns, channel, data in bag.raw_messages(self._publishers):
                first_ns = log_ns if first_ns is None else first_ns
                at = (log_ns - first_ns) * 1e-9
                asked = time.monotonic()
                on_time(at, sent)
                started += time.monotonic() - asked
                wait = started + at / speed - time.monotonic()
                if wait > 0.0:
                    time.sleep(wait)
                self._publishers[channel.topic].publish(data)
                sent[channel.topic] += 1
        self.wait_until_received()
        return sent

    def wait_until_received(self) -> None:
        """Wait until the node's middleware has all messages (of a reliable player)."""
        if self._reliable:
            for publisher in self._publishers.values():
                publisher.wait_for_all_acked(PATIENCE)
