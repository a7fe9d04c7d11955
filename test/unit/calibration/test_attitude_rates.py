"""An IMU's attitude and angular velocity are held against each other, with no other sensor."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.checks.imu_rate_consistency import CONVENTIONS, AttitudeRates
from dvl_calib_ros.calibration.numerics.frames import (
    ENU_FROM_NED,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
)

RATE_HZ, TILT = 20.0, np.radians(2.0)


def vehicle(seconds=120.0, turning=0.1, tilt=TILT, rate_hz=RATE_HZ, seed=0):
    """Times, quaternions and body rates of a vehicle that turns both ways and rolls and pitches in waves."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0.0, seconds, 0.005)
    yaw = 0.5 + np.cumsum(turning * np.sign(np.sin(2 * np.pi * fine / 60.0))) * 0.005
    roll, pitch = tilt * np.sin(1.05 * fine), tilt * np.sin(0.8 * fine + 1.0)
    rotation = rotation_from_rpy(np.column_stack([roll, pitch, yaw]))
    step = np.einsum("nji,njk->nik", rotation[:-1], rotation[1:])
    rates = np.column_stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]]
    )
    rates *= 0.5 / 0.005
    every = round(200.0 / rate_hz)
    times, rotation, rates = fine[:-1:every], rotation[:-1:every], rates[::every]
    orientation = np.array([quaternion_from_rotation(each) for each in rotation])
    noise = 0.0005 * rng.normal(size=orientation.shape)
    orientation = (orientation + noise) / np.linalg.norm(orientation + noise, axis=1, keepdims=True)
    return times, orientation, rates + 0.001 * rng.normal(size=rates.shape)


def says(times, orientation, rates, blocks=1):
    checked = AttitudeRates()
    for part in np.array_split(np.arange(len(times)), blocks):
        checked.add(times[part], orientation[part], rates[part])
    return checked.contradiction()


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 20.0, 100.0])
@pytest.mark.parametrize("turning", [0.0, 0.1, 0.5])
def test_of_an_imu_that_is_right_nothing_is_said(rate_hz, turning):
    assert says(*vehicle(rate_hz=rate_hz, turning=turning), blocks=12) is None


@pytest.mark.parametrize(
    "wrong",
    [
        lambda t, q, w: (t, q, w + np.array([0.01, -0.01, 0.005])),  # a bias
        lambda t, q, w: (t[3:], q[:-3], w[3:]),  # an attitude that is late by 0.15 s
        lambda t, q, w: (t, q, 0.9 * w),
        lambda t, q, w: (t, -q, w),  # the same attitude
    ],
)
def test_what_an_ordinary_imu_does_is_no_other_convention(wrong):
    assert says(*wrong(*vehicle())) is None


def inverted(q):
    return q * [-1, -1, -1, 1]


def compass(q, tilted=1.0):
    """Yaw as a compass counts it (0 = north, clockwise), in an ENU quaternion."""
    r = rotation_from_quaternion(q)
    yaw = np.pi / 2 - np.arctan2(r[:, 1, 0], r[:, 0, 0])
    pitch, roll = -np.arcsin(r[:, 2, 0]), np.arctan2(r[:, 2, 1], r[:, 2, 2])
    rpy = np.column_stack([tilted * roll, tilted * pitch, yaw])
    return np.array([quaternion_from_rotation(each) for each in rotation_from_rpy(rpy)])


def in_earth(q, w, earth=None):
    in_enu = np.einsum("nij,nj->ni", rotation_from_quaternion(q), w)
    return in_enu if earth is None else in_enu @ earth.T


@pytest.mark.parametrize(
    ("wrong", "code", "numbers"),
    [
        (lambda q, w: (q, -w), "RATES_NEGATED", {}),
        (lambda q, w: (q, 0.5 * w), "RATES_SCALED", {"times": 0.5}),
        (lambda q, w: (q, np.degrees(w)), "RATES_DEGREES", {}),
        (lambda q, w: (q, w * [1, -1, -1]), "IMU_AXES_MIXED", {}),
        (lambda q, w: (q, w[:, [1, 0, 2]]), "RATES_EXCHANGED", {"axes": "y, x, z"}),
        (lambda q, w: (q, w @ rotation_from_rpy([0.0, 0.0, 0.8])), "RATES_TURNED", {"degrees": 45.8}),
        (lambda q, w: (q, in_earth(q, w)), "RATES_IN_EARTH", {"frame": "ENU"}),
        (lambda q, w: (q, in_earth(q, w, ENU_FROM_NED)), "RATES_IN_EARTH", {"frame": "NED"}),
        (lambda q, w: (compass(q), w), "HEADING_CLOCKWISE", {}),
        (lambda q, w: (compass(q, tilted=0.0), w), "HEADING_CLOCKWISE", {}),
        (lambda q, w: (inverted(q), w), "ATTITUDE_INVERTED", {}),
    ],
)
def test_each_mix_of_conventions_is_named(wrong, code, numbers):
    times, orientation, rates = vehicle()
    found = says(times, *wrong(orientation, rates), blocks=12)
    (cause,) = [each for each in found.causes if each.code == code]
    is_number = code in ("RATES_SCALED", "RATES_TURNED")
    assert cause.numbers == (pytest.approx(numbers, rel=0.02) if is_number else numbers)


def test_nothing_is_said_of_too_little():
    times, orientation, rates = vehicle()
    assert says(times[:200], orientation[:200], -rates[:200]) is None
    still = vehicle(turning=0.0, tilt=1e-4)
    assert says(still[0], still[1], -still[2]) is None
    nothing = np.full_like(rates, np.nan)
    assert says(times, orientation, nothing) is None


def test_all_ways_to_exchange_and_negate_axes_are_looked_at_once():
    matrices = {tuple(matrix.ravel()) for _, matrix in CONVENTIONS}
    assert len(matrices) == len(CONVENTIONS) == 6 * 8 - 1


def test_rates_that_are_zero_while_the_attitude_turns_are_none():
    times, orientation, rates = vehicle()
    assert says(times, orientation, 0.0 * rates).code == "IMU_NO_RATES"
    still = np.tile(orientation[:1], (len(times), 1))
    assert says(times, still, 0.0 * rates) is None


def test_an_attitude_without_roll_and_pitch_is_a_heading_alone():
    for tilt, is_level in ((TILT, False), (0.0, True)):
        checked = AttitudeRates()
        times, orientation, rates = vehicle(tilt=tilt)
        if is_level:
            orientation[:, :2] = 0.0
            orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
        checked.add(times, orientation, rates)
        assert checked.is_level is is_level
