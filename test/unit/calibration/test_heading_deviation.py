"""A heading that is off as it changes: named by size and headings, and not made of a clean one or of a reference's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.checks.heading_deviation import heading_deviation, heading_warning
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame

START_NS, STEP_S, LEG_S = 1_600_000_000_000_000_000, 0.5, 40.0
YAW = math.radians(1.0)  # of the DVL in the vehicle


def recorded(seed, off, offset=(0.0, 0.0), legs=16, every=math.pi / 4.0, **parameters):
    """Legs of 40 s at 1 m/s, each turned by `every` from the one before; off: (yaw, s) -> by what the heading is off.

    offset: m/s, of the reference east and north. Returns the calibrator, times (N,) and true yaws (N,).
    """
    rng = np.random.default_rng(seed)
    exact_dvl = Parameters(gnss_aided_std=0.03, dvl_bias_std=0.0, **parameters)
    calibrator = Calibrator(exact_dvl, block_size=64, models=("full",))
    time = np.arange(0.0, LEG_S * legs, STEP_S)
    yaw = np.floor(time / LEG_S) * every + 0.2
    for at, heading in zip(time.tolist(), yaw.tolist(), strict=True):
        stamp = START_NS + round(at * 1e9)
        turned = rotation_from_rpy([0.0, 0.0, heading + off(heading, at)])
        velocity = rotation_from_rpy([0.0, 0.0, heading])[:, 0] + (*offset, 0.0) + rng.normal(0.0, 0.03, 3)
        dvl = rotation_from_rpy([0.0, 0.0, YAW])[:, 0] + rng.normal(0.0, 0.005, 3)
        calibrator.feed_imu(ImuSample(stamp, quaternion_from_rotation(turned), (0.0, 0.0, 0.0)))
        calibrator.feed_reference(ReferenceSample(stamp, tuple(velocity.tolist()), None, VelocityFrame.ENU))
        calibrator.feed_dvl(DvlSample(stamp, tuple(dvl.tolist())))
    calibrator.finish()
    return calibrator, time, yaw


def deviation(*args, **more):
    calibrator, _, yaw = recorded(*args, **more)
    return heading_deviation(yaw, calibrator.heading_deviation)


@pytest.mark.spread(1)
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, -0.009)])
def test_a_constant_error_of_the_heading_or_of_the_reference_is_no_deviation(offset):
    assert deviation(0, lambda *_: 0.02, offset) is None


@pytest.mark.spread(1)
@pytest.mark.parametrize("cycles", [1, 2])
def test_a_compass_that_deviates_is_found_with_its_size_and_headings(cycles):
    size = math.radians(2.0)
    found = deviation(1, lambda yaw, _: size * math.sin(cycles * yaw))
    assert found.rms == pytest.approx(size / math.sqrt(2.0), rel=0.25)
    if cycles == 1:  # most at the heading next to yaw 90 degrees, which is north
        assert min(found.most_at, 2.0 * math.pi - found.most_at) < 0.25
    said = heading_warning(found)
    assert said.code == "HEADING_DEVIATION" and "with the heading" in said.says and "compass first" not in said.remedy


@pytest.mark.slow
@pytest.mark.parametrize(
    ("every", "size"),
    [(math.pi / 4.0, 2.0), (math.pi, 2.0), (math.pi / 4.0, 0.0)],
    ids=["around", "to and fro", "none"],
)
def test_yaw_is_within_its_sigma(every, size):
    off = []
    for seed in range(4):
        deviates = lambda yaw, _, at=seed: math.radians(size) * math.sin(yaw + 1.6 * at)  # noqa: E731
        calibrator, *_ = recorded(seed, deviates, legs=16, every=every)
        estimate = calibrator.estimate("full")
        off.append((estimate.state[2] - YAW) / estimate.recording_std[2])
        assert estimate.recording_std[2] < math.radians(0.35 + 0.5 * size)
    assert np.abs(off).max() < 3.0, off


def test_on_one_heading_sigma_of_yaw_holds_what_the_heading_may_be_off_by():
    calibrator, *_ = recorded(0, lambda *_: math.radians(0.8), every=0.0, reference_offset_std=0.001)
    estimate = calibrator.estimate("full")
    assert math.radians(0.45) < estimate.recording_std[2] < math.radians(0.8)
    assert abs(estimate.state[2] - YAW) < 2.0 * estimate.recording_std[2]


def test_few_headings_or_nothing_at_all_say_nothing():
    assert deviation(3, lambda yaw, _: math.sin(yaw) * 0.05, legs=1) is None
    assert heading_deviation(np.zeros(0), GaussianState(np.zeros(4), np.eye(4))) is None
