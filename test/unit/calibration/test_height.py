"""Height over where a vehicle has been of late."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.filters.filter_bank import LONGEST_STEP_S, MEMORY_S, RelativeHeight

SECOND = 1_000_000_000


def test_a_vehicle_that_rises_is_higher_by_as_much_and_in_what_blocks_it_comes_changes_nothing(rng):
    stamps_ns = np.cumsum(rng.integers(SECOND // 10, SECOND, 40))
    rising = rng.normal(0.0, 0.3, 40)
    whole = RelativeHeight().add(stamps_ns, rising)
    parts = RelativeHeight()
    np.testing.assert_array_equal(
        np.concatenate([parts.add(stamps_ns[at], rising[at]) for at in (slice(0, 1), slice(1, 17), slice(17, 40))]),
        whole,
    )
    steps = np.diff(stamps_ns, prepend=stamps_ns[0]) * 1e-9
    np.testing.assert_allclose(whole, np.cumsum(rising * steps), atol=0.3)  # nearly nothing is forgotten in 20 s


def test_a_velocity_that_is_wrong_by_a_constant_adds_up_to_a_constant():
    stamps_ns = SECOND * np.arange(2000)
    heights = RelativeHeight().add(stamps_ns, np.full(2000, 0.05))
    assert heights[-1] == pytest.approx(0.05 * MEMORY_S, rel=1e-3)
    assert np.ptp(heights[1000:]) < 1e-3


def test_of_a_gap_nobody_knows_how_far_it_rose():
    height = RelativeHeight()
    before = height.add(SECOND * np.arange(10), np.full(10, 0.5))[-1]
    after = height.add(np.array([9 * SECOND + round((LONGEST_STEP_S + 1.0) * 1e9)]), np.array([0.5]))[0]
    assert 0.9 * before < after < before
    height.end_day()
    assert height.add(np.array([0]), np.array([0.5]))[0] == 0.0
