"""Ten minutes of operation in one: pytest -m soak. For longer ones: python -m benchmarks soak --minutes 600."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from benchmarks.node import measure_soak


@pytest.mark.soak
def test_ten_minutes_of_operation_lose_no_sample():
    """Memory and CPU are the benchmark's to judge, on a quiet machine: where the node falls behind, queues grow."""
    samples, *others = measure_soak()
    print(*others, sep="\n")  # pytest -s
    assert samples.met, samples
