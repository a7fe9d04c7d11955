"""Velocities of the earth's frame are told by the heading alone."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NED, rotation_from_rpy
from dvl_calib_ros.calibration.registration.configuration_check import Directions

SURVEY = np.repeat(np.radians([20.0, 110.0, 200.0, 110.0]), 100)
WANDERS = np.radians(20.0) + 0.05 * np.sin(np.arange(400) / 9.0)


def directions(velocity, yaw):
    attitude = rotation_from_rpy(np.column_stack([0.02 * np.sin(np.arange(len(yaw))), np.zeros(len(yaw)), yaw]))
    found = Directions()
    for part in np.array_split(np.arange(len(yaw)), 7):
        found.add(velocity[part], attitude[part])
    return found


def ahead(yaw, seed=0):
    return np.random.default_rng(seed).normal([1.5, 0.0, 0.0], 0.01, (len(yaw), 3))


def in_enu(velocity, yaw):
    return np.einsum("nij,nj->ni", rotation_from_rpy(np.column_stack([0 * yaw, 0 * yaw, yaw])), velocity)


@pytest.mark.parametrize("yaw", [SURVEY, WANDERS])
def test_a_velocity_in_enu_turns_with_the_heading(yaw):
    assert directions(in_enu(ahead(yaw), yaw), yaw).turn_with_heading


def test_a_velocity_in_ned_turns_against_it():
    assert directions(in_enu(ahead(SURVEY), SURVEY) @ ENU_FROM_NED.T, SURVEY).turn_with_heading


def test_a_velocity_in_the_body_does_not():
    found = directions(ahead(SURVEY), SURVEY)
    assert found.stay_in_the_body
    assert not found.turn_with_heading


def test_a_vehicle_that_yaws_in_waves_and_goes_straight_on_is_not_in_the_earths_frame():
    straight_on = np.column_stack([np.cos(WANDERS.mean() - WANDERS), np.sin(WANDERS.mean() - WANDERS), 0 * WANDERS])
    found = directions(1.5 * straight_on, WANDERS)
    assert not found.turn_with_heading
    assert not found.stay_in_the_body  # one heading shows nothing of either


def test_a_vehicle_that_goes_anywhere_tells_nothing():
    rng = np.random.default_rng(1)
    found = directions(rng.normal(size=(400, 3)), SURVEY)
    assert not found.turn_with_heading
    assert not found.stay_in_the_body


def test_too_few_samples_or_too_slow_tell_nothing():
    for velocity, yaw in ((ahead(SURVEY)[::20], SURVEY[::20]), (0.1 * ahead(SURVEY), SURVEY)):
        found = directions(in_enu(velocity, yaw), yaw)
        assert not found.turn_with_heading
        assert not found.stay_in_the_body
