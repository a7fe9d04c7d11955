"""Simulator node: publishes DVL, GNSS and IMU of a simulated run or of a followed motion.

In a run, a sample is published when the time of its stamp comes. When following an odometry topic, it is published when
the odometry has reached the stamp and is one message past the time of measurement (`simulation.live_simulation`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from ..calibration.numerics.frames import rotation_from_quaternion
from ..calibration.numerics.samples import DvlSample, ReferenceSample
from ..calibration.streams.screening import unit_quaternion
from ..errors import InputError
from ..messages.decode import stamp_ns
from ..messages.drivers import TWIST_TYPE, TYPES_OF, VELOCITY_TYPES
from ..messages.encode import FRAME_IDS
from ..recordings.topics import Topics
from ..simulation.live_simulation import Follower, MotionSample, Sample, in_order, shifted
from ..simulation.scenario import START_NS, Scenario, simulate
from .message_types import fill, message_class, set_stamp
from .services import AnsweringNode, init_ros
from .shutdown import Ending

NODE_NAME = "dvl_simulator"
# messages that may wait for a slow subscriber, or in the queue of the odometry
QUEUE = 1000
PATIENCE = Duration(seconds=10)
# longest wait without checking for a request to end, s
BREATH_S = 0.05


@dataclass(frozen=True)
class Outputs(Topics):
    """Topics, and the DVL's message type (a name of `messages.drivers`). Raises InputError for an unknown type."""

    dvl_type: str = TWIST_TYPE

    def __post_init__(self) -> None:
        if self.dvl_type not in TYPES_OF["dvl_type"]:
            raise InputError(f"--dvl-type {self.dvl_type}: none of {', '.join(TYPES_OF['dvl_type'])}")


class SimulatorNode(AnsweringNode):
    """Publishers of the three sensors. depth: messages that may wait for a subscriber. Raises InputError."""

    def __init__(self, outputs: Outputs, depth: int = QUEUE) -> None:
        kind = message_class("--dvl-type", outputs.dvl_type)
        super().__init__(NODE_NAME)
        self._dvl_class, self._dvl_type = kind, VELOCITY_TYPES[outputs.dvl_type]
        profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE)
        self._dvl = self.create_publisher(kind, outputs.dvl, profile)
        self._gnss = self.create_publisher(TwistWithCovarianceStamped, outputs.gnss, profile)
        self._imu = self.create_publisher(Imu, outputs.imu, profile)
        self.sent = 0

    @property
    def is_heard(self) -> bool:
        """Return whether every topic has a subscriber."""
        return all(publisher.get_subscription_count() > 0 for publisher in (self._dvl, self._gnss, self._imu))

    def publish(self, samples: Sequence[Sample]) -> None:
        """Publish samples, in order."""
        for sample in samples:
            if isinstance(sample, DvlSample):
                self._dvl.publish(fill(self._dvl_class(), self._dvl_type, sample))
            elif isinstance(sample, ReferenceSample):
                self._gnss.publish(
                    fill(TwistWithCovarianceStamped(), VELOCITY_TYPES[TWIST_TYPE], sample, FRAME_IDS[sample.frame])
                )
            else:
                self._imu.publish(_imu_message(sample))
            self.sent += 1

    def finish(self) -> None:
        """Wait until subscribers have received all messages."""
        for publisher in (self._dvl, self._gnss, self._imu):
            publisher.wait_for_all_acked(PATIENCE)

    def follow(self, topic: str, scenario: Scenario) -> None:
        """Publish the sensors' measurements on the motion of an odometry topic. Raises InputError."""
        self._scenario = scenario
        Follower(scenario)  # raises InputError for an invalid scenario
        self._follower: Follower | None = None
        self._start_ns, self._last_ns = 0, 0
        self._subscribe(topic, ReliabilityPolicy.RELIABLE)

    def _subscribe(self, topic: str, reliability: ReliabilityPolicy) -> None:
        """Subscribe reliably, and change to best effort if a best-effort publisher appears."""

        def resubscribe() -> None:
            self.destroy_subscription(subscription)
            self._subscribe(topic, ReliabilityPolicy.BEST_EFFORT)

        subscription = self.subscribe(Odometry, topic, self._on_odometry, QUEUE, resubscribe, reliability)

    def _on_odometry(self, message: Any) -> None:
        """Publish the samples that a new odometry message makes computable; restart if its time goes back."""
        now_ns = stamp_ns(message.header.stamp)
        orientation = message.pose.pose.orientation
        q = unit_quaternion((orientation.x, orientation.y, orientation.z, orientation.w))
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        velocity, rates = np.array([linear.x, linear.y, linear.z]), np.array([angular.x, angular.y, angular.z])
        if q is None or not np.isfinite(velocity).all() or not np.isfinite(rates).all():
            self.get_logger().warning("odometry without attitude, velocity or turn rates is left out", once=True)
            return
        if self._follower is None or now_ns < self._last_ns:
            if self._follower is not None:
                self.info("odometry went back in time; starting again")
            self._follower, self._start_ns = Follower(self._scenario, now_ns), now_ns
        elif now_ns == self._last_ns:
            return
        self._last_ns = now_ns
        sample = MotionSample(1e-9 * (now_ns - self._start_ns), velocity, rotation_from_quaternion(q), rates)
        self.publish(self._follower.add(sample))


def run_until(
    ending: Ending, scenario: Scenario, outputs: Outputs, ros_args: Sequence[str], follow: str | None, speed: float,
    wait: bool,
) -> int:  # fmt: skip
    """Publish until the run or `ending` ends it. Return the number of messages sent. Raises InputError.

    follow: odometry topic; None runs the scenario's own motion at `speed` times real time. wait: start when every topic
    has a subscriber.
    """
    run = simulate(scenario) if follow is None else None
    samples: list[Sample] = [] if run is None else in_order(run)
    init_ros([NODE_NAME, *ros_args])
    node = None
    try:
        node = SimulatorNode(outputs, max(QUEUE, len(samples)))
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        ending.call_on_request(lambda: executor.create_task(lambda: None))
        while wait and not node.is_heard and not ending.requested:
            executor.spin_once(timeout_sec=BREATH_S)
        if follow is not None:
            node.follow(follow, scenario)
            while not ending.requested:
                executor.spin_once()
        else:
            _play(node, executor, ending, samples, speed)
        return node.sent
    finally:
        ending.stop_calling()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _play(
    node: SimulatorNode, executor: SingleThreadedExecutor, ending: Ending, samples: list[Sample], speed: float
) -> None:
    """Publish samples at their stamps, starting now, at `speed` times real time."""
    start_ns = node.get_clock().now().nanoseconds
    began = time.monotonic()
    for sample in shifted(samples, start_ns - START_NS):
        due = began + 1e-9 * (sample.stamp_ns - start_ns) / speed
        while (remaining := due - time.monotonic()) > 0.0 and not ending.requested:
            executor.spin_once(timeout_sec=min(remaining, BREATH_S))
        if ending.requested:
            return
        node.publish([sample])
    node.finish()


def _imu_message(sample: Any) -> Any:
    """Return an IMU sample as a message without acceleration."""
    message = Imu()
    set_stamp(message.header.stamp, sample.stamp_ns)
    message.header.frame_id = "base_link"
    q, w = message.orientation, message.angular_velocity
    q.x, q.y, q.z, q.w = sample.orientation
    w.x, w.y, w.z = sample.angular_velocity
    message.linear_acceleration_covariance[0] = -1.0
    return message
