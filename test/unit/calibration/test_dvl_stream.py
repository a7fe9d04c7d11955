"""Messages that no one DVL measures are named; those of a DVL, however quiet, slow or shaken, are not."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.checks.dvl_self_consistency import DvlStream


def measured(rng, seconds=300.0, hz=5.0, noise=0.01, wave=0.1, speed=1.5):
    """Velocity (N, 3) m/s in waves, with turns."""
    times = np.arange(0.0, seconds, 1.0 / hz)
    ahead = speed + wave * np.sin(times * 1.1)
    true = np.column_stack([ahead, 0.15 * np.sin(times / 9.0), wave * np.sin(times * 1.3 + 1.0)])
    return true + rng.normal(0.0, noise, true.shape)


def said(velocity, block=50):
    stream = DvlStream()
    for start in range(0, len(velocity), block):
        stream.add(velocity[start : start + block])
    return stream.contradiction()


@pytest.mark.parametrize("hz", [2.0, 5.0, 25.0])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01, 0.05])
@pytest.mark.parametrize("wave", [0.0, 0.1, 0.6])
def test_one_dvl_is_one_dvl(rng, hz, noise, wave):
    assert said(measured(rng, hz=hz, noise=noise, wave=wave)) is None


def test_two_on_one_topic_are_told_by_the_messages_going_to_and_fro(rng):
    one, other = measured(rng), measured(rng, speed=1.2)
    both = np.stack([one, other], axis=1).reshape(-1, 3)
    assert said(both).code == "DVL_TWO_ON_TOPIC"


@pytest.mark.parametrize("step", [0.1, 0.25])
@pytest.mark.parametrize("way", [np.round, np.trunc])
def test_rounding_by_a_decimetre_per_second_is_named_and_by_a_centimetre_is_not(rng, step, way):
    velocity = measured(rng, noise=0.005, wave=0.02)
    found = said(way(velocity / step) * step)
    assert found.code == "DVL_ROUNDED" and found.numbers["step"] == pytest.approx(step)
    assert said(way(velocity / 0.01) * 0.01) is None


def test_an_axis_of_zeros_beside_a_measured_one_is_none(rng):
    velocity = measured(rng)
    velocity[:, 2] = 0.0
    found = said(velocity)
    assert found.code == "DVL_AXIS_DEAD" and found.numbers == {"axes": "z"}
    flat = measured(rng, noise=0.0)  # of a simulator without noise, in the plane
    flat[:, 2] = 0.0
    assert said(flat) is None


def test_few_samples_say_nothing(rng):
    velocity = measured(rng, seconds=20.0)
    velocity[:, 2] = 0.0
    assert said(velocity) is None and said(velocity[:3]) is None
