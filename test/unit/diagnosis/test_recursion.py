"""Recursions along time against scipy's filter and a plain loop."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter, savgol_filter

from dvl_calib_ros.diagnosis.model.stream_curve import SMOOTH_SAMPLES, Curve
from dvl_calib_ros.diagnosis.noise.noise_model import Arma, Noise
from dvl_calib_ros.effects.base import recursion, slopes


def test_a_recursion_of_any_decay_is_that_of_a_loop(rng):
    decay, added = rng.uniform(-0.9, 0.9, 50), rng.normal(size=(50, 4))
    expected = added.copy()
    for n in range(1, 50):
        expected[n] += decay[n] * expected[n - 1]
    assert recursion(decay, added) == pytest.approx(expected)
    assert recursion(decay, added[:, 0]) == pytest.approx(expected[:, 0])
    assert recursion(decay[:0], added[:0]).shape == (0, 4)


@pytest.mark.parametrize("n", [2, 3, 50])
def test_slopes_are_those_of_numpy(rng, n):
    time, values = np.cumsum(rng.uniform(0.1, 2.0, n)), rng.normal(size=(n, 3))
    assert slopes(time, values) == pytest.approx(np.gradient(values, time, axis=0), abs=1e-12)


@pytest.mark.parametrize(("ar", "ma"), [(0.9, -0.5), (0.7, 0.0), (0.0, 0.4)])
def test_noise_is_whitened_stretch_by_stretch_each_as_if_it_were_alone(rng, ar, ma):
    arma = Arma(np.array([ar]) if ar else np.zeros(0), ma, 0.2, 1.3)
    stretches = (slice(0, 40), slice(40, 41), slice(41, 90))
    values = rng.normal(size=(90, 1, 5))
    whole = Noise(stretches, None, np.ones((90, 1)), (arma,)).whiten(values)
    for part in stretches:
        alone = lfilter([1.0, -ar], [1.0, ma], values[part, 0], axis=0) / 0.2
        alone[0] /= 1.3
        assert whole[part] == pytest.approx(alone)


def test_a_slow_stream_is_smoothed_by_the_cubic_through_the_samples_around(rng):
    values = rng.normal(size=(30, 3))
    smooth = Curve(np.arange(30.0), values).smooth.values
    assert smooth == pytest.approx(savgol_filter(values, SMOOTH_SAMPLES, 3, axis=0))
