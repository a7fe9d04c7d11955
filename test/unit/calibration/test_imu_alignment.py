"""An IMU in a frame of its own: its samples become the body's attitude in ENU and the body's rates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import (
    ENU_FROM_NED,
    attitude_enu_flu_from_ned_frd,
    quaternion_from_rotation,
)
from dvl_calib_ros.calibration.numerics.samples import ImuSample, Stream, sample_block
from dvl_calib_ros.calibration.streams.imu_frame import ImuAlignment

ANGLES = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)


def as_matrix(quaternion) -> np.ndarray:
    return Rotation.from_quat(quaternion).as_matrix()


@pytest.mark.parametrize("frame", ["enu", "ned"])
@given(mounting=ANGLES, attitude=ANGLES, rate=ANGLES)
def test_an_imu_that_is_mounted_turned_gives_the_bodys_attitude_and_rates(frame, mounting, attitude, rate):
    enu_from_body = Rotation.from_euler("xyz", attitude).as_matrix()
    body_from_imu = Rotation.from_euler("xyz", mounting).as_matrix()
    world_from_enu = ENU_FROM_NED.T if frame == "ned" else np.eye(3)
    measured = ImuSample(
        7,
        quaternion_from_rotation(world_from_enu @ enu_from_body @ body_from_imu),
        tuple((body_from_imu.T @ np.array(rate)).tolist()),
    )
    turned = ImuAlignment(Parameters(imu_rpy=mounting, imu_frame=frame)).sample(measured)
    assert turned.stamp_ns == 7
    np.testing.assert_allclose(as_matrix(turned.orientation), enu_from_body, atol=1e-12)
    np.testing.assert_allclose(turned.angular_velocity, rate, atol=1e-12)


def test_a_heading_offset_turns_the_attitude_about_the_vertical_and_leaves_the_rates():
    attitude, rate = Rotation.from_euler("ZYX", [0.7, -0.2, 0.1]), (0.1, 0.2, 0.3)
    measured = ImuSample(0, tuple(attitude.as_quat().tolist()), rate)
    turned = ImuAlignment(Parameters(heading_offset=0.4)).sample(measured)
    wanted = Rotation.from_euler("ZYX", [1.1, -0.2, 0.1])
    np.testing.assert_allclose(as_matrix(turned.orientation), wanted.as_matrix(), atol=1e-12)
    assert turned.angular_velocity == pytest.approx(rate)


def test_a_marine_imu_forward_right_down_in_north_east_down_is_imu_frame_ned_and_imu_rpy_pi():
    rpy_ned = (0.1, -0.2, 1.3)
    measured = ImuSample(0, quaternion_from_rotation(Rotation.from_euler("xyz", rpy_ned).as_matrix()), None)
    turned = ImuAlignment(Parameters(imu_rpy=(math.pi, 0.0, 0.0), imu_frame="ned")).sample(measured)
    np.testing.assert_allclose(as_matrix(turned.orientation), attitude_enu_flu_from_ned_frd(rpy_ned), atol=1e-12)
    assert turned.angular_velocity is None


def test_columns_are_turned_as_live_samples_are_and_what_is_not_given_stays_so():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(6, 7))
    values[:, :4] /= np.linalg.norm(values[:, :4], axis=1)[:, None]
    values[2, :4] = np.nan
    values[4, 4:] = np.nan
    alignment = ImuAlignment(Parameters(imu_rpy=(0.3, -0.1, 2.0), imu_frame="ned"))
    block = sample_block(Stream.IMU, np.arange(6), values)
    one_by_one = [alignment.sample(sample) for sample in block.samples()]
    assert list(alignment.block(block).samples()) == one_by_one
    assert one_by_one[2].orientation is None and one_by_one[4].angular_velocity is None


def test_without_its_parameters_samples_pass_as_the_same_objects():
    alignment = ImuAlignment(Parameters())
    sample = ImuSample(0, (0.0, 0.0, 0.0, 1.0), None)
    block = sample_block(Stream.IMU, np.arange(1), np.zeros((1, 7)))
    assert alignment.sample(sample) is sample and alignment.block(block) is block
