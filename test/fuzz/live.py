"""Fuzz target of the live node: messages, services, parameters and diagnostics in any order, in this process.

Without ROS 2 there is none.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import rclpy
import yaml
from drawn import Drawn
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from wholes import assert_sound

from dvl_calib_ros.calibration.models.parameters import SCHEMA
from dvl_calib_ros.cli.demo import give_back, take_domain
from dvl_calib_ros.files.result_file import load_result
from dvl_calib_ros.node.calibration_node import CalibrationNode

_STEPS_NS = (0, 50_000_000, 200_000_000, -50_000_000, 3 * 10**9, -(10**9), 60 * 10**9, 10**17)
_AT_RUN_TIME = tuple(name for name, spec in SCHEMA.items() if not spec.read_only and name != "result_file")
_TOPICS = ("dvl/twist", "gnss/twist", "imu/data")
_MOST_STEPS = 40


_domains: dict[CalibrationNode, int] = {}


@cache
def _node(folder: Path) -> CalibrationNode:
    """One for all inputs, heard by nobody, until `end`."""
    context, domain = rclpy.Context(), take_domain()
    with patch.dict(os.environ, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_LOG_DIR": str(folder)}):
        rclpy.init(context=context, domain_id=domain)
    result = Parameter("result_file", value=str(folder / "live.yaml"))
    node = CalibrationNode(context=context, parameter_overrides=[result])
    node.get_logger().set_level(LoggingSeverity.FATAL)
    _domains[node] = domain
    return node


def end() -> None:
    """End the node, which would else be the first participant of this process for all tests behind."""
    while _domains:
        node, domain = _domains.popitem()
        node.destroy_node()
        rclpy.shutdown(context=node.context)
        give_back(domain)
    _node.cache_clear()


def run_live(data: bytes, folder: Path) -> None:
    """After whatever comes every message is counted, and what is published and saved is finite."""
    node, drawn = _node(folder), Drawn(data)
    node._on_reset(Trigger.Request(), Trigger.Response())
    received = dict.fromkeys(_TOPICS, 0)
    stamp_ns = 1_700_000_000_000_000_000
    for number in range(_MOST_STEPS):
        if not drawn.has_more:
            break
        step = drawn.byte()
        if step < 248:
            topic = _TOPICS[step % 3]
            stamp_ns += drawn.one_of(_STEPS_NS)
            message = _imu(drawn) if topic == "imu/data" else _twist(drawn, topic)
            # 2106 is the last year of a stamp
            seconds, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            message.header.stamp.sec = min(max(seconds, -(2**31)), 2**31 - 1)
            node._on_message(topic, message, {"received_timestamp": number, "source_timestamp": number})
            received[topic] += 1
        elif step < 250:
            node._on_reset(Trigger.Request(), Trigger.Response())
            received = dict.fromkeys(_TOPICS, 0)
        elif step < 252:
            assert _saved(node, folder, read_back=step == 250 and len(data) % 8 == 0)
        elif step < 254:
            name = drawn.one_of(_AT_RUN_TIME)
            spec = SCHEMA[name]
            value = drawn.one_of(spec.choices) if spec.choices else drawn.near(spec.default)
            (answer,) = node.set_parameters([Parameter(name, value=value)])
            assert answer.successful or answer.reason
        else:
            node._publish_diagnostics()
    counts = node._calibrator.counts
    if not node._calibrator.restarts:  # a start anew counts anew
        assert [counts[stream]["received"] for stream in ("dvl", "reference", "imu")] == list(received.values())
    node._publish_diagnostics()
    assert_sound(node._calibrator)


def _saved(node: CalibrationNode, folder: Path, read_back: bool) -> bool:
    """Whether the node saves a file that can be loaded, or says why it saves none.

    Reading YAML takes as long as a hundred messages, so not every file is read back.
    """
    for each in folder.glob("live.yaml*"):  # a save reads the backups, which takes longer than all the rest
        each.unlink()
    with patch("yaml.SafeDumper", yaml.CSafeDumper):  # the same bytes in a tenth of the time
        response = node._on_save(Trigger.Request(), Trigger.Response())
    if not response.success or not read_back:
        return bool(response.message)
    _, states = load_result(folder / "live.yaml")
    return all(np.isfinite(state.x).all() and np.isfinite(state.p).all() for state in states.values())


def _twist(drawn: Drawn, topic: str) -> TwistWithCovarianceStamped:
    message = TwistWithCovarianceStamped()
    message.header.frame_id = drawn.text() if drawn.byte() > 250 else "dvl_link" if topic == "dvl/twist" else "map"
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = drawn.near(1.5), drawn.near(0.0), drawn.near(0.0)
    message.twist.covariance[[0, 7, 14]] = [drawn.near(0.05) for _ in range(3)]
    if drawn.byte() > 250:
        message.twist.covariance[drawn.byte() % 36] = drawn.number()
    return message


def _imu(drawn: Drawn) -> Imu:
    message = Imu()
    message.header.frame_id = "base_link"
    half = drawn.near(0.0) * math.pi
    q, w = message.orientation, message.angular_velocity
    q.x, q.y, q.z, q.w = (
        drawn.near(0.0),
        drawn.near(0.0),
        (math.sin(half) if math.isfinite(half) else half),
        drawn.near(1.0),
    )
    w.x, w.y, w.z = drawn.near(0.0), drawn.near(0.0), drawn.near(0.1)
    if drawn.byte() > 250:
        message.orientation_covariance[0] = drawn.number()
    return message


def live_seeds() -> Iterator[bytes]:
    twist = bytes([1, 0, 128, 128, 128, 128, 128, 128, 0])
    imu = bytes([1, 128, 128, 128, 128, 128, 128, 128, 0])
    dvl, reference, imu = bytes([0]) + twist, bytes([1]) + twist, bytes([2]) + imu
    yield (imu + reference + dvl) * 9
    yield (imu + reference + dvl) * 3 + bytes([250, 254, 252, 0, 3, 248]) + (imu + reference + dvl) * 4 + bytes([251])
