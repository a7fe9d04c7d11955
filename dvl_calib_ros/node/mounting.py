"""The DVL's pose in the body as topic ~/mounting and, where asked for, as a static transform."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped

from ..calibration.frames import quaternion_from_rotation
from ..calibration.mounting_pose import MountingPose
from ..verdict.reasons import Reason, finding
from .transforms import Transforms


class MountingOutput:
    """Publishes poses with this publisher, and broadcasts them from this node if it is to and tf2_ros is there.

    problems: what others or the installation do to the transform.
    """

    def __init__(self, node: Any, publisher: Any, broadcasts: bool, warn: Callable[[str], None]) -> None:
        self._publisher = publisher
        self._broadcaster: Any = None
        self._unknown_in = ""
        if not broadcasts:
            return
        try:
            from tf2_ros import StaticTransformBroadcaster
        except ImportError:  # ROS from PyPI is without it
            warn(str(finding("TF_NOT_THERE")))
            return
        self._broadcaster = StaticTransformBroadcaster(node)

    def publish(self, pose: MountingPose, stamp: Any, base: str, dvl: str, transforms: Transforms | None) -> None:
        """Publish a pose of frame `dvl` in `base`. transforms: what hears transforms, so that it knows ours."""
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
        """Whether others publish a transform to frame `dvl` beside ours."""
        if self._broadcaster is not None and self._unknown_in:
            return [finding("POSITION_UNKNOWN", base=self._unknown_in)]
        if self._broadcaster is None or transforms is None or not transforms.has(dvl):
            return []
        return [finding("TF_TWICE", frame=dvl)]
