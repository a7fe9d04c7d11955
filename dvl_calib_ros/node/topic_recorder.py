"""Recorder of a running system's topics for calibration; keeps the bytes as received over DDS."""

from __future__ import annotations

import time
from collections import Counter
from contextlib import suppress
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import MessageDefinitionFormat

from ..bags.channels import Channel, Definition
from ..bags.writer import BagWriter
from ..errors import InputError
from ..recordings.columns import is_kept
from ..recordings.recording import is_static
from .message_types import message_class

DEPTH = 1000


class TopicRecorder:
    """Writer of ROS messages into a bag. counts: messages by topic. left_out: topics of missing types, and why."""

    def __init__(self, node: Node, writer: BagWriter) -> None:
        self._node, self._writer = node, writer
        self._seen: set[tuple[str, str]] = set()
        self._subscriptions: list[Any] = []
        self._static: set[str] = set()
        self.counts: Counter[str] = Counter()
        self.left_out: dict[str, str] = {}
        self.failed: InputError | None = None
        """Why no more is written: a full disk."""

    @property
    def topics(self) -> list[str]:
        """Recorded topics that are not static."""
        return [heard.topic_name for heard in self._subscriptions if heard.topic_name not in self._static]

    def look(self) -> bool:
        """Subscribe to new topics. Return whether there are any."""
        before = len(self._subscriptions)
        own_prefix = f"{self._node.get_fully_qualified_name()}/"
        for topic, kinds in self._node.get_topic_names_and_types():
            for kind in kinds:
                is_new = (topic, kind) not in self._seen and not topic.startswith(own_prefix)
                if is_new and (is_kept(kind) or is_static(topic, kind)):
                    self._seen.add((topic, kind))
                    try:
                        self._subscribe(topic, kind)
                    except InputError as error:
                        self.left_out[topic] = str(error)
        return len(self._subscriptions) > before

    def _subscribe(self, topic: str, kind: str) -> None:
        """Subscribe with the publishers' QoS, to record serialized messages."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        if is_static(topic, kind) or not publishers:
            self._static.add(topic)
        is_reliable = all(publisher.qos_profile.reliability is ReliabilityPolicy.RELIABLE for publisher in publishers)
        is_latched = bool(publishers) and all(
            publisher.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL for publisher in publishers
        )
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE,
        )
        definition = None  # for a driver's own type, the definition that bag readers need
        with suppress(LookupError):
            text, _ = self._writer.typestore.generate_msgdef(kind, ros_version=2)
            definition = Definition(MessageDefinitionFormat.MSG, text)
        channel = Channel(topic, kind, definition)
        on_message = partial(self._write_message, channel)
        self._subscriptions.append(
            self._node.create_subscription(message_class(topic, kind), topic, on_message, profile, raw=True)
        )

    def close(self) -> None:
        """Stop receiving."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def _write_message(self, channel: Channel, data: bytes) -> None:
        """Write a received message and count it, until writing fails."""
        if self.failed is not None:
            return
        try:
            self._writer.raw(channel, time.time_ns(), data)
        except InputError as error:
            self.failed = error
        self.counts[channel.topic] += 1
