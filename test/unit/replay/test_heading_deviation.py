"""A heading that is off as it changes: named by size and headings, and not made of a clean one or of a reference's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.replay.heading_deviation import FIRST, heading_advice, heading_deviation


def recorded(rng, off, offset=(0.0, 0.0), legs=8, noise=0.03, scale=0.0):
    """Legs of 40 s at 1 m/s all around; off: (yaw, s) -> rad by which the heading reads too much to the right."""
    time = np.arange(0.0, 40.0 * legs, 0.2)
    yaw = np.floor(time / 40.0) * 2.0 * math.pi / 8.0
    velocity = np.tile([1.0, 0.0], (len(time), 1))
    error = rng.normal(0.0, noise, velocity.shape)
    error[:, 0] += scale + offset[0] * np.cos(yaw) + offset[1] * np.sin(yaw)
    error[:, 1] += off(yaw, time) - offset[0] * np.sin(yaw) + offset[1] * np.cos(yaw)
    return time, yaw, velocity, error


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.02, -0.015)])
def test_a_constant_error_of_the_heading_or_of_the_reference_is_no_deviation(seed, offset):
    rng = np.random.default_rng(seed)
    assert heading_deviation(*recorded(rng, lambda yaw, _: 0.02 + 0.0 * yaw, offset, scale=0.01)) is None


@pytest.mark.parametrize("cycles", [1, 2])
def test_a_compass_that_deviates_is_found_with_its_size_and_headings(rng, cycles):
    size = math.radians(2.0)
    found = heading_deviation(*recorded(rng, lambda yaw, _: size * np.sin(cycles * yaw)))
    assert found.rms == pytest.approx(size / math.sqrt(2.0), rel=0.25) and not found.by_time
    if cycles == 1:  # most at yaw 90 degrees, which is north
        assert min(found.most_at, 2.0 * math.pi - found.most_at) < 0.1
    (said,) = heading_advice(found)
    assert said.code == "HEADING_DEVIATION" and "with the heading" in said.says and "compass first" not in said.remedy


def test_a_gyro_that_drifts_is_named_by_time_and_beyond_three_degrees_the_compass_comes_first(rng):
    found = heading_deviation(*recorded(rng, lambda yaw, time: math.radians(6.0) * np.sin(yaw) + 0.0 * time))
    assert found.rms > FIRST and "calibrate the compass first" in heading_advice(found)[0].remedy
    drifts = heading_deviation(*recorded(rng, lambda _, time: math.radians(5.0) * time / time[-1], legs=16))
    assert drifts.by_time and "with time" in heading_advice(drifts)[0].says


def test_few_stretches_or_turns_alone_say_nothing(rng):
    time, yaw, velocity, error = recorded(rng, lambda yaw, _: np.sin(yaw), legs=2)
    assert heading_deviation(time, yaw, velocity, error) is None
    assert heading_deviation(time, time, velocity, error) is None
    assert heading_deviation(time[:0], yaw[:0], velocity[:0], error[:0]) is None
