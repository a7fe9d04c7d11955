"""Velocities over a window are made those of its middle."""

import numpy as np

from dvl_calib_ros.calibration.streams.position_velocities import of_moments

WINDOW_S = 1.0


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
    found = of_moments(times, means, WINDOW_S)
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
    assert np.abs(of_moments(times, means, WINDOW_S) - wave)[inside].max() < 0.02


def test_too_few_stay_as_they_are():
    means = np.ones((1, 3))
    assert of_moments(np.zeros(1), means, WINDOW_S) is means
