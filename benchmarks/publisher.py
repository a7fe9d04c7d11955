"""A vehicle under way, in a process of its own: publishes reliably, and listens for what comes back.

Prints one line of JSON: DVL messages sent, p50 and p99 (s) from a DVL message to the echo with its stamp.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

START_S = 1_760_000_000
# Messages that may wait for their acknowledgement; none is overwritten before.
DEPTH = 100_000
SPEED_MPS, TURN_RATE = 1.5, 0.05
# Of every minute of a vehicle with an IMU, GNSS is away for so long, s.
OUTAGE_S, MINUTE_S = 10.0, 60.0
PATIENCE_S = 60.0


class Vehicle:
    """Publishers, and messages for a time (s since the start) in the run."""

    def __init__(self, node: Any, with_imu: bool) -> None:
        profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._with_imu = with_imu
        self._dvl = node.create_publisher(TwistWithCovarianceStamped, "dvl/twist", profile)
        self._gnss = node.create_publisher(TwistWithCovarianceStamped, "gnss/twist", profile)
        self._imu = node.create_publisher(Imu, "imu/data", profile)

    def wait_for_subscribers(self) -> None:
        """Wait until the DVL, and where it has an IMU, all topics are heard. TimeoutError if they are not."""
        until = time.monotonic() + PATIENCE_S
        for publisher in (self._dvl, self._gnss, self._imu) if self._with_imu else (self._dvl,):
            while publisher.get_subscription_count() < 1:
                if time.monotonic() > until:
                    raise TimeoutError(f"nobody subscribes to {publisher.topic_name}")
                time.sleep(0.01)

    def wait_until_received(self) -> None:
        """Wait until all is acknowledged."""
        for publisher in (self._dvl, self._gnss, self._imu):
            publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))

    def dvl(self, at: float) -> tuple[int, int]:
        """Publish a DVL message; its stamp."""
        message = _twist("dvl_link", at, SPEED_MPS, 0.1, 0.02)
        self._dvl.publish(message)
        return message.header.stamp.sec, message.header.stamp.nanosec

    def gnss(self, at: float) -> None:
        """Publish a GNSS message: in the body frame, or with an IMU in ENU and with outages."""
        if not self._with_imu:
            self._gnss.publish(_twist("base_link", at, SPEED_MPS, 0.1, 0.1))
        elif at % MINUTE_S < MINUTE_S - OUTAGE_S:
            yaw = TURN_RATE * at
            east, north = SPEED_MPS * math.cos(yaw), SPEED_MPS * math.sin(yaw)
            self._gnss.publish(_twist("map", at, east, north, 0.1))

    def imu(self, at: float) -> None:
        """Publish an IMU message."""
        message = Imu()
        message.header.frame_id = "base_link"
        _stamp(message, at)
        message.orientation.z, message.orientation.w = math.sin(0.5 * TURN_RATE * at), math.cos(0.5 * TURN_RATE * at)
        message.angular_velocity.z = TURN_RATE
        self._imu.publish(message)


class Echo:
    """Notes when messages are sent and when one with their stamp comes back."""

    def __init__(self, node: Any, topic: str) -> None:
        self._latencies_s: list[float] = []
        self._sent_at: dict[tuple[int, int], float] = {}
        node.create_subscription(TwistWithCovarianceStamped, topic, self._on_echo, 1000)

    def sent(self, stamp: tuple[int, int], at_s: float) -> None:
        """Take note of a message sent at a time (s, monotonic clock)."""
        self._sent_at[stamp] = at_s

    def is_back(self, stamp: tuple[int, int]) -> bool:
        """Whether the message with this stamp has come back."""
        return stamp not in self._sent_at

    def percentiles_s(self) -> dict[str, float]:
        """p50 and p99 of the latencies (s) so far; nothing if there are none."""
        if not self._latencies_s:
            return {}
        p50, p99 = np.percentile(self._latencies_s, [50.0, 99.0])
        return {"p50": float(p50), "p99": float(p99)}

    def _on_echo(self, message: TwistWithCovarianceStamped) -> None:
        stamp = message.header.stamp
        at_s = self._sent_at.pop((stamp.sec, stamp.nanosec), None)
        if at_s is not None:
            self._latencies_s.append(time.monotonic() - at_s)


def main() -> None:
    """Publish for so long; see --help."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("dvl-rate", "gnss-rate", "imu-rate"):
        parser.add_argument(f"--{name}", type=float, default=0.0, help="Hz of the run's time")
    parser.add_argument("--seconds", type=float, required=True, help="length of the run, s of its own time")
    parser.add_argument("--speed", type=float, default=1.0, help="the run's seconds per second")
    parser.add_argument("--burst", type=float, default=0.0, help="first seconds of the run, sent without waiting")
    parser.add_argument("--echo", metavar="TOPIC", help="listen here for a message with the stamp of each DVL message")
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node("benchmark_publisher")
    random.seed(0)
    vehicle = Vehicle(node, options.imu_rate > 0.0)
    echo = Echo(node, options.echo) if options.echo else None
    wait = _spinning(node) if echo else time.sleep
    vehicle.wait_for_subscribers()
    started = time.monotonic()
    sent, gnss_sent, imu_sent, stamp = 0, 0, 0, (0, 0)
    for i in range(int(options.dvl_rate * options.seconds)):
        at = i / options.dvl_rate
        early_s = started + (at - options.burst) / options.speed - time.monotonic()
        if early_s > 0.0:
            wait(early_s)
        while imu_sent < at * options.imu_rate:
            vehicle.imu(imu_sent / options.imu_rate)
            imu_sent += 1
        before_s = time.monotonic()
        stamp = vehicle.dvl(at)
        if echo:
            echo.sent(stamp, before_s)
        sent += 1
        while gnss_sent < at * options.gnss_rate:
            vehicle.gnss(gnss_sent / options.gnss_rate)
            gnss_sent += 1
    vehicle.wait_until_received()
    until = time.monotonic() + PATIENCE_S
    while echo and not echo.is_back(stamp) and time.monotonic() < until:
        wait(0.1)  # the last one back: the node has dealt with all
    print(json.dumps({"sent": sent} | (echo.percentiles_s() if echo else {})))
    rclpy.shutdown()


def _spinning(node: Any) -> Callable[[float], None]:
    """A sleep (s) in which the node's callbacks run."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def wait(seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=left)

    return wait


def _twist(frame_id: str, at: float, x: float, y: float, std: float) -> TwistWithCovarianceStamped:
    message = TwistWithCovarianceStamped()
    message.header.frame_id = frame_id
    _stamp(message, at)
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = random.gauss(x, std), random.gauss(y, std), random.gauss(0.0, std)
    return message


def _stamp(message: Any, at: float) -> None:
    nanoseconds = round(at * 1e9)
    message.header.stamp.sec = START_S + nanoseconds // 1_000_000_000
    message.header.stamp.nanosec = nanoseconds % 1_000_000_000


if __name__ == "__main__":
    main()
