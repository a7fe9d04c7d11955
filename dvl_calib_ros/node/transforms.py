"""What the node hears of where its sensors sit: /tf_static and robot_description, each latched by its publisher."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from ..discovery.transforms import FrameTree

# Transforms that are kept; more is garbage.
MOST_TRANSFORMS = 1000
_LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Transforms:
    """Subscribes on a node. `heard` grows with every message, so that nobody need look twice at the same."""

    def __init__(self, node: Node) -> None:
        self._transforms: dict[str, Any] = {}
        self._description = ""
        self.heard = 0
        self._subscriptions = [node.create_subscription(String, "robot_description", self._on_description, _LATCHED)]
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:  # ROS from PyPI is without it; the description alone will have to do
            return
        self._subscriptions.append(node.create_subscription(TFMessage, "/tf_static", self._on_transforms, _LATCHED))

    def _on_description(self, message: Any) -> None:
        self._description = message.data
        self.heard += 1

    def _on_transforms(self, message: Any) -> None:
        for each in message.transforms:
            if len(self._transforms) < MOST_TRANSFORMS:
                self._transforms[each.child_frame_id] = each
        self.heard += 1

    def tree(self) -> FrameTree:
        """What is known by now."""
        return FrameTree.of(self._transforms.values(), [self._description] if self._description else [])
