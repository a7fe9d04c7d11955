"""What the node hears of where its sensors sit: /tf_static and robot_description, each latched by its publisher."""

from __future__ import annotations

from collections import deque
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from ..discovery.transforms import FrameTree

# Transforms that are kept; more is garbage.
MOST_TRANSFORMS = 1000
# What this node broadcasts itself comes back within this many of its own.
OWN_TRANSFORMS = 100
_LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Transforms:
    """Subscribes on a node. `heard` grows with every message, so that nobody need look twice at the same."""

    def __init__(self, node: Node) -> None:
        self._transforms: dict[str, Any] = {}
        self._own: deque[Any] = deque(maxlen=OWN_TRANSFORMS)
        self._description = ""
        self.heard = 0
        # every event callback is one more thing that is waited for with every message
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        self._subscriptions = [
            node.create_subscription(String, "robot_description", self._on_description, _LATCHED, event_callbacks=quiet)
        ]
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:  # ROS from PyPI is without it; the description alone will have to do
            return
        self._subscriptions.append(
            node.create_subscription(TFMessage, "/tf_static", self._on_transforms, _LATCHED, event_callbacks=quiet)
        )

    def _on_description(self, message: Any) -> None:
        self._description = message.data
        self.heard += 1

    def _on_transforms(self, message: Any) -> None:
        others = [each for each in message.transforms if each not in self._own]
        for each in others:
            if len(self._transforms) < MOST_TRANSFORMS:
                self._transforms[each.child_frame_id] = each
        self.heard += bool(others)

    def own(self, transform: Any) -> None:
        """Let what this node is about to broadcast not be taken for another's: it would begin anew with its own."""
        self._own.append(transform)

    def has(self, frame: str) -> bool:
        """Whether another node has published a transform to this frame."""
        return frame in self._transforms

    def tree(self) -> FrameTree:
        """What is known by now."""
        return FrameTree.of(self._transforms.values(), [self._description] if self._description else [])
