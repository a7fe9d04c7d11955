"""Water properties from a running vehicle's topics, read once a second.

The newest message of each topic stays in the middleware until it is read, so waiting messages cost nothing.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from ..calibration.checks.speed_of_sound import Water
from ..errors import InputError
from ..messages.water_properties import WaterCollector, readers, water_of
from .message_queue import take
from .message_types import message_class

# interval of the search for new topics, s, and number of last readings kept per topic, one per second
LOOK_S, READINGS = 5, 600


class NeverCalled(CallbackGroup):
    """Callback group of subscriptions that no executor waits for."""

    def can_execute(self, entity: Any) -> bool:
        """Return False."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return False."""
        return False


class WaterHeard:
    """Readings of all water topics. looks_for: whether to subscribe to topics other than the DVL's."""

    def __init__(self, node: Node, looks_for: bool) -> None:
        self._node, self._looks_for = node, looks_for
        self._group = NeverCalled()
        self._subscriptions: dict[tuple[str, str], Any] = {}
        self._collectors: dict[tuple[str, str], WaterCollector] = {}
        self._seconds = 0

    def hear(self, own: Collection[str], dvl: tuple[str, str, Any]) -> Water | None:
        """Return the known water properties; called once a second.

        own: topics that the node already receives. dvl: topic, type and newest message of the DVL, None for none.
        """
        if self._looks_for and self._seconds % LOOK_S == 0:
            self._look(own)
        self._seconds += 1
        for key, subscription in self._subscriptions.items():
            if (arrived := take(subscription)) is not None:
                self._collectors[key].add(arrived.message)
        topic, kind, message = dvl
        if message is not None and readers(topic, kind):
            self._collector(topic, kind).add(message)
        return water_of([each for one in self._collectors.values() for each in one.readings()], topic)

    def _collector(self, topic: str, kind: str) -> WaterCollector:
        return self._collectors.setdefault((topic, kind), WaterCollector(topic, kind, READINGS))

    def _look(self, own: Collection[str]) -> None:
        """Subscribe to new topics with water properties."""
        for topic, kinds in self._node.get_topic_names_and_types():
            for kind in kinds:
                if topic in own or (topic, kind) in self._subscriptions or not readers(topic, kind):
                    continue
                try:
                    class_ = message_class(topic, kind)
                except InputError:  # not installed, so its messages cannot be read
                    continue
                profile = QoSProfile(
                    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
                )
                # the callback is never called (NeverCalled): `hear` takes the newest message
                self._subscriptions[topic, kind] = self._node.create_subscription(
                    class_, topic, lambda _: None, profile, callback_group=self._group
                )
                self._collector(topic, kind)
