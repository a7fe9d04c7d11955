"""Velocities over a window are made those of its middle."""

import numpy as np
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.streams.interpolation import ImuColumns
from dvl_calib_ros.calibration.streams.position_velocities import of_moments

WINDOW_S = 1.0
NO_IMU = ImuColumns(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 3)))
WINDOWS = Parameters(position_window=WINDOW_S)


def path(times):
    """Positions (N, 3) of a circle in waves."""
    return np.stack([20.0 * np.sin(0.1 * times), 20.0 * np.cos(0.1 * times), 0.05 * np.sin(1.2 * times)], axis=1)


def over_windows(times):
    return (path(times + 0.5 * WINDOW_S) - path(times - 0.5 * WINDOW_S)) / WINDOW_S


def velocity(times):
    step = 1e-5
    return (path(times + step) - path(times - step)) / (2.0 * step)


def test_a_wave_is_as_large_as_in_the_middle_but_beside_ends_and_outages():
    times = np.arange(0.0, 60.0, 0.2)
    times = times[(times < 20.0) | (times > 30.0)]
    means = over_windows(times)
    found = of_moments(times, means, NO_IMU, WINDOWS)
    apart = np.min([times, np.abs(times - 19.8), np.abs(times - 30.2), 59.8 - times], axis=0)
    np.testing.assert_array_equal(found[apart < 0.9], means[apart < 0.9])
    left, before = (np.abs(each - velocity(times))[apart > 1.1].max() for each in (found, means))
    assert before > 0.003 and left < 0.2 * before


def test_a_swing_of_little_more_than_three_windows_keeps_its_size():
    """An antenna on a mast that rolls in 3.3 s: its arm was -2.21 m ± 0.00 for -2.30."""
    times = np.arange(0.0, 60.0, 0.2)
    wave = np.cos(2.0 * np.pi * times / 3.3)[:, None] * np.ones(3)
    means = np.sinc(WINDOW_S / 3.3) * wave
    inside = slice(20, -20)
    assert np.abs(of_moments(times, means, NO_IMU, WINDOWS) - wave)[inside].max() < 0.02


def test_the_swing_of_a_configured_arm_keeps_its_size_at_any_period():
    """Rolling in 2.2 s: the arm was -2.10 m ± 0.00 for -2.30, and the calibration was rejected."""
    moments, times = np.arange(0.0, 60.0, 0.02), np.arange(0.0, 60.0, 0.1)
    arm, rate = np.array([0.4, 0.0, -2.3]), 2.0 * np.pi / 2.2

    def attitude(at):
        return Rotation.from_euler("ZYX", np.column_stack([0.3 * at, 0.05 * np.cos(at), 0.12 * np.sin(rate * at)]))

    after, before = attitude(moments + 1e-4), attitude(moments - 1e-4)
    imu = ImuColumns(moments, attitude(moments).as_quat(), (before.inv() * after).as_rotvec() / 2e-4)
    ends = attitude(times + 0.5 * WINDOW_S).apply(arm) - attitude(times - 0.5 * WINDOW_S).apply(arm)
    swing = (attitude(times + 1e-4).apply(arm) - attitude(times - 1e-4).apply(arm)) / 2e-4
    found = of_moments(times, -ends / WINDOW_S, imu, WINDOWS.replace(lever_arm=tuple(arm)))
    assert np.abs(found + swing)[20:-20].max() < 0.02 * np.abs(swing).max()


def test_too_few_stay_as_they_are():
    means = np.ones((1, 3))
    assert of_moments(np.zeros(1), means, NO_IMU, WINDOWS) is means
