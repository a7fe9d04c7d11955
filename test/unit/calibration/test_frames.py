from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from dvl_calib_ros.calibration.numerics.error_model import correct, corrected_mounting, correction_jacobian, distort
from dvl_calib_ros.calibration.numerics.frames import (
    ENU_FROM_NED,
    FLU_FROM_FRD,
    attitude_enu_flu_from_ned_frd,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    rpy_from_rotation,
    skew,
    slerps,
    squared,
)

RPY = np.array([0.4, -0.7, 2.1])


def test_skew_is_the_cross_product(rng):
    a, b = rng.normal(size=(2, 7, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b))


@pytest.mark.parametrize("shape", [(3,), (500, 3), (500, 4), (20, 30, 2), (0, 3), (7, 1)])
def test_squared_is_the_sum_of_squares_to_the_last_bit(rng, shape):
    a = rng.normal(size=shape)
    for each in (a, np.asfortranarray(a), a[..., ::-1]):
        np.testing.assert_array_equal(squared(each), (each**2).sum(axis=-1))
    assert squared(np.array([np.nan, 1.0, 2.0])) != 5.0


def test_rpy_turns_about_fixed_axes_x_then_y_then_z_as_in_urdf():
    np.testing.assert_allclose(rotation_from_rpy(RPY), Rotation.from_euler("xyz", RPY).as_matrix())
    np.testing.assert_allclose(rotation_from_rpy([RPY, -RPY])[1], Rotation.from_euler("xyz", -RPY).as_matrix())


@pytest.mark.parametrize("rpy", [RPY, [0, 0, 0], [math.pi - 1e-9, 0.2, -3.0], [0.3, math.pi / 2, 0.1], [0, -1.5708, 2]])
def test_rpy_and_quaternion_of_a_rotation_give_it_back(rpy):
    rotation = rotation_from_rpy(rpy)
    np.testing.assert_allclose(rotation_from_rpy(rpy_from_rotation(rotation)), rotation, atol=1e-9)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-12)


def test_every_branch_of_the_quaternion_agrees_with_scipy(rng):
    for rotation in Rotation.random(200, random_state=1).as_matrix():
        expected = Rotation.from_matrix(rotation).as_quat(canonical=True)
        np.testing.assert_allclose(np.abs(np.dot(quaternion_from_rotation(rotation), expected)), 1.0)


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 0.3, 3.0])
def test_slerp_agrees_with_scipy_and_takes_the_shorter_arc(angle):
    q0 = Rotation.from_rotvec([0.1, 0.2, 0.3])
    q1 = q0 * Rotation.from_rotvec([0, angle, 0])
    expected = Slerp([0, 1], Rotation.concatenate([q0, q1]))([0.3]).as_matrix()[0]
    for sign in (1.0, -1.0):
        got = slerps(q0.as_quat()[None], sign * q1.as_quat()[None], np.array([0.3]))
        np.testing.assert_allclose(rotation_from_quaternion(got)[0], expected, atol=1e-9)


def test_a_north_heading_in_ned_is_yaw_90_degrees_in_enu():
    rotation = attitude_enu_flu_from_ned_frd([0.0, 0.0, 0.0])
    np.testing.assert_allclose(rpy_from_rotation(rotation), [0, 0, math.pi / 2], atol=1e-12)
    forward_north_ned = attitude_enu_flu_from_ned_frd([0.0, 0.0, math.pi / 2]) @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(forward_north_ned, [1.0, 0.0, 0.0], atol=1e-12)  # heading east


def test_attitude_conversion_agrees_with_turning_vectors_one_by_one(rng):
    rpy = np.array([0.1, -0.2, 1.3])
    v_flu = rng.normal(size=3)
    v_ned = rotation_from_rpy(rpy) @ (FLU_FROM_FRD.T @ v_flu)
    np.testing.assert_allclose(attitude_enu_flu_from_ned_frd(rpy) @ v_flu, ENU_FROM_NED @ v_ned, atol=1e-12)


def test_corrected_mounting_is_the_rotation_nearest_to_the_error_model(rng):
    for _ in range(20):
        misalignment, mounting = rng.normal(0, 0.1, 3), rotation_from_rpy(rng.uniform(-3, 3, 3)).T
        left, _, right = np.linalg.svd((np.eye(3) + skew(misalignment)) @ mounting)
        np.testing.assert_allclose(corrected_mounting(misalignment, mounting), (left @ right).T, atol=1e-12)


def test_correction_jacobian_is_the_derivative_of_the_correction(rng):
    velocity, mounting = rng.normal(size=3), rotation_from_rpy([0.3, -0.1, 2.0]).T
    jacobian, step = correction_jacobian(velocity, mounting), 1e-6
    for column in range(6):
        terms = np.zeros((2, 6))
        terms[:, column] = step, -step
        plus, minus = (correct(velocity, t[:3], t[3:], mounting) for t in terms)
        np.testing.assert_allclose((plus - minus) / (2 * step), jacobian[:, column], atol=1e-9)


def test_distort_and_correct_are_exact_inverses(rng):
    errors = rng.normal(0, 0.2, 3), rng.normal(0, 0.1, 3), rotation_from_rpy([1, 2, 3]).T
    velocity = rng.normal(size=(50, 3))
    np.testing.assert_allclose(correct(distort(velocity, *errors), *errors), velocity, atol=1e-12)
