"""A reliable DVL and GNSS publisher at given rates, in a process of its own: ``publisher DVL_HZ GNSS_HZ SECONDS``."""

from __future__ import annotations

import random
import sys
import time

import rclpy
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

START_S = 1_760_000_000


def main() -> None:
    """Publish, wait until all is acknowledged, print how many DVL messages went out."""
    dvl_rate, gnss_rate, seconds = map(float, sys.argv[1:4])
    count = int(dvl_rate * seconds)
    rclpy.init()
    node = rclpy.create_node("benchmark_publisher")
    profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=count, reliability=ReliabilityPolicy.RELIABLE)
    dvl = node.create_publisher(TwistWithCovarianceStamped, "dvl/twist", profile)
    gnss = node.create_publisher(TwistWithCovarianceStamped, "gnss/twist", profile)
    while dvl.get_subscription_count() < 1:
        time.sleep(0.01)
    random.seed(0)
    started = time.monotonic()
    for i in range(count):
        dvl.publish(_twist("dvl_link", i / dvl_rate, 0.02))
        if gnss_rate and int((i + 1) * gnss_rate / dvl_rate) > int(i * gnss_rate / dvl_rate):
            gnss.publish(_twist("base_link", i / dvl_rate, 0.1))
        wait = started + (i + 1) / dvl_rate - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
    dvl.wait_for_all_acked(Duration(seconds=30))
    print(count)
    rclpy.shutdown()


def _twist(frame_id: str, at: float, std: float) -> TwistWithCovarianceStamped:
    message = TwistWithCovarianceStamped()
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = START_S + int(at), int(at % 1.0 * 1e9)
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = random.gauss(1.5, std), random.gauss(0.1, std), random.gauss(0.0, std)
    return message


if __name__ == "__main__":
    main()
