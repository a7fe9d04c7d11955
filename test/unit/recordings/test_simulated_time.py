"""Recordings in simulated time: stamps from near 0 that run faster or slower than the log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from io_fixtures import TOPICS, rewrite, run

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.examination.examine import examine

SECONDS, SIMULATED_FROM_S, WALL_NS = 90.0, 12, 1_700_000_000_000_000_000


def from_zero(topic: str, message):
    message.header.stamp.sec += SIMULATED_FROM_S - run(SECONDS)[0].stamp_ns // 1_000_000_000
    return message


def without_covariance(topic: str, message):
    if topic == "gnss/twist":
        message.twist.covariance = np.zeros(36)
    return from_zero(topic, message)


def at_factor(path: Path, factor: float) -> Path:
    """The run in simulated time, logged by a computer that runs it so many times as fast."""
    source = rewrite(path.with_name(f"{path.name}_even"), without_covariance, run(SECONDS))
    with BagReader([source]) as bag, BagWriter(path) as writer:
        messages = list(bag.raw_messages(TOPICS))
        for log_ns, channel, data in messages:
            writer.raw(channel, WALL_NS + round((log_ns - messages[0][0]) / factor), data)
    return path


@pytest.mark.spread(1)
@pytest.mark.parametrize("factor", [0.3, 4.0])
def test_rates_and_what_is_found_are_those_of_the_stamps(tmp_path, factor):
    examined = examine([at_factor(tmp_path / "bag", factor)], Parameters())
    assert examined.seconds == pytest.approx(SECONDS, abs=0.3)
    rates = {each.role: each.rate_hz for each in examined.contents}
    assert rates == pytest.approx({"DVL": 5.0, "reference": 5.0, "IMU": 20.0}, rel=0.01)
    found = discover([tmp_path / "bag"], Parameters())
    even = discover([at_factor(tmp_path / "another", 1.0)], Parameters())
    assert "reference gnss/twist (TwistWithCovarianceStamped, enu, 5 Hz)" in found.found[0]
    # the noise of a reference that claims none is measured, which takes streams that are compared at the same times
    assert found.values["gnss_aided_std"] == pytest.approx(even.values["gnss_aided_std"], rel=0.3)


def test_jitter_of_the_log_is_no_simulated_time(tmp_path):
    source = rewrite(tmp_path / "even", from_zero, run(SECONDS))
    with BagReader([source]) as bag, BagWriter(tmp_path / "bag") as writer:
        messages = list(bag.raw_messages(TOPICS))
        for log_ns, channel, data in messages:  # a computer that writes twice a second
            writer.raw(channel, WALL_NS + -(-(log_ns - messages[0][0]) // 500_000_000) * 500_000_000, data)
    assert examine([tmp_path / "bag"], Parameters()).seconds == pytest.approx(SECONDS, abs=0.6)
