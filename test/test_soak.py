"""Ten minutes of operation in one: pytest -m soak. For longer ones: dvl-calib benchmark soak --minutes 600."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from dvl_calib_ros.benchmark.node import measure_soak


@pytest.mark.soak
def test_ten_minutes_of_operation_lose_no_sample_and_no_memory():
    samples, memory, _ = measure_soak()
    assert samples.met, samples
    assert memory.met, memory
