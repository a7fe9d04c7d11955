"""Ten minutes of operation in one: pytest -m soak. For longer ones: python -m benchmarks soak --minutes 600."""

from __future__ import annotations

import os

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from test_node import account_at_200_hz

from benchmarks.node import measure_soak

MINUTES = float(os.environ.get("DVL_CALIB_SOAK_MINUTES", "10"))


@pytest.mark.soak
def test_ten_minutes_of_operation_lose_no_sample():
    """Memory and CPU are the benchmark's to judge, on a quiet machine: where the node falls behind, queues grow."""
    samples, *others = measure_soak()
    print(*others, sep="\n")  # pytest -s
    assert samples.met, samples


@pytest.mark.soak
def test_ten_minutes_at_200_hz_account_for_each_sample(world, tmp_path):
    """For fewer: DVL_CALIB_SOAK_MINUTES."""
    print(account_at_200_hz(world, tmp_path, round(12_000 * MINUTES)))
