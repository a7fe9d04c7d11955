"""Transforms and water of the node: subscribes to /tf_static, robot_description and topics of water properties.

Publishes ~/mounting and TF.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from ..calibration.checks.speed_of_sound import Water
from ..calibration.numerics.frames import quaternion_from_rotation
from ..calibration.results.results import MountingPose
from ..discovery.transforms import FrameTree
from ..errors import InputError
from ..messages.water_properties import WaterCollector, readers, water_of
from ..verdict.reasons import Reason, finding
from .message_queue import take
from .message_types import message_class

# number of transforms kept; a system with more is faulty
MOST_TRANSFORMS = 1000
# number of own broadcasts that are remembered, to recognise them when they are received
OWN_TRANSFORMS = 100
_LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Transforms:
    """Subscriber to transforms. `n_messages` counts its messages, so that callers can skip an unchanged tree."""

    def __init__(self, node: Node) -> None:
        """Subscribe to /robot_description, and to /tf_static if its message package is installed."""
        self._transforms: dict[str, Any] = {}
        self._own: deque[Any] = deque(maxlen=OWN_TRANSFORMS)
        self._description = ""
        self.n_messages = 0
        # every event callback is one more entity that is waited for with every message
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        self._subscriptions = [
            node.create_subscription(String, "robot_description", self._on_description, _LATCHED, event_callbacks=quiet)
        ]
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:  # ROS from PyPI has no tf2_msgs; only the description is used
            return
        self._subscriptions.append(
            node.create_subscription(TFMessage, "/tf_static", self._on_transforms, _LATCHED, event_callbacks=quiet)
        )

    def _on_description(self, message: Any) -> None:
        self._description = message.data
        self.n_messages += 1

    def _on_transforms(self, message: Any) -> None:
        """Keep the newest transform of each child frame, except this node's own."""
        others = [transform for transform in message.transforms if transform not in self._own]
        for other in others:
            if len(self._transforms) < MOST_TRANSFORMS:
                self._transforms[other.child_frame_id] = other
        self.n_messages += bool(others)

    def own(self, transform: Any) -> None:
        """Remember an own broadcast: received as another node's, it would restart the calibration."""
        self._own.append(transform)

    def has(self, frame: str) -> bool:
        """Return whether another node has published a transform to this frame."""
        return frame in self._transforms

    def tree(self) -> FrameTree:
        """Return the current tree."""
        return FrameTree.of(self._transforms.values(), [self._description] if self._description else [])


class MountingOutput:
    """Publisher of mounting poses, which also broadcasts them to TF if requested and tf2_ros is installed.

    problems: faults of the transform caused by other nodes or by the installation.
    """

    def __init__(self, node: Any, publisher: Any, broadcasts: bool, warn: Callable[[str], None]) -> None:
        """Set up. broadcasts: also publish a TF transform. warn: receives a warning if tf2_ros is missing."""
        self._publisher = publisher
        self._broadcaster: Any = None
        self._unknown_in = ""
        if not broadcasts:
            return
        try:
            from tf2_ros import StaticTransformBroadcaster
        except ImportError:  # ROS from PyPI has no tf2_ros
            warn(str(finding("TF_NOT_THERE")))
            return
        self._broadcaster = StaticTransformBroadcaster(node)

    def publish(self, pose: MountingPose, stamp: Any, base: str, dvl: str, transforms: Transforms | None) -> None:
        """Publish the pose of frame `dvl` in `base`. transforms: subscriber that must recognise this broadcast."""
        message = PoseWithCovarianceStamped()
        message.header.stamp, message.header.frame_id = stamp, base
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        at.x, at.y, at.z = pose.position
        turn.x, turn.y, turn.z, turn.w = quaternion_from_rotation(pose.rotation_body_from_dvl)
        message.pose.covariance = pose.covariance.ravel()
        self._publisher.publish(message)
        self._unknown_in = "" if math.isfinite(at.x) else base
        if self._broadcaster is None or self._unknown_in:
            return
        transform = TransformStamped()
        transform.header, transform.child_frame_id = message.header, dvl
        move = transform.transform.translation
        move.x, move.y, move.z = pose.position
        transform.transform.rotation = turn
        if transforms is not None:
            transforms.own(transform)
        self._broadcaster.sendTransform(transform)

    def problems(self, dvl: str, transforms: Transforms | None) -> list[Reason]:
        """Report an unknown position, or other publishers of a transform to frame `dvl`."""
        if self._broadcaster is not None and self._unknown_in:
            return [finding("POSITION_UNKNOWN", base=self._unknown_in)]
        if self._broadcaster is None or transforms is None or not transforms.has(dvl):
            return []
        return [finding("TF_TWICE", frame=dvl)]


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

    def update(self, received: Collection[str], dvl: tuple[str, str, Any]) -> Water | None:
        """Return the known water properties; called once a second.

        received: topics that the node already receives. dvl: topic, type and newest message of the DVL, None for none.
        """
        if self._looks_for and self._seconds % LOOK_S == 0:
            self._subscribe_new(received)
        self._seconds += 1
        for key, subscription in self._subscriptions.items():
            if (arrived := take(subscription)) is not None:
                self._collectors[key].add(arrived.message)
        topic, kind, message = dvl
        if message is not None and readers(topic, kind):
            self._collector(topic, kind).add(message)
        return water_of([reading for one in self._collectors.values() for reading in one.readings()], topic)

    def _collector(self, topic: str, kind: str) -> WaterCollector:
        return self._collectors.setdefault((topic, kind), WaterCollector(topic, kind, READINGS))

    def _subscribe_new(self, received: Collection[str]) -> None:
        """Subscribe to new topics with water properties."""
        for topic, kinds in self._node.get_topic_names_and_types():
            for kind in kinds:
                if topic in received or (topic, kind) in self._subscriptions or not readers(topic, kind):
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
