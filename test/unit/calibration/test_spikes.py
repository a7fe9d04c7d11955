"""Spikes are left out, what a vehicle does is not."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.streams.outliers import without_spikes


def stream(n=100, noise=0.01, seed=0):
    """A vehicle that speeds up and turns, (n, 3) m/s at 5 Hz."""
    time = np.arange(n) / 5.0
    rng = np.random.default_rng(seed)
    smooth = np.column_stack([1.5 + 0.3 * np.tanh(time - 8.0), 0.3 * np.sin(0.5 * time), 0.05 * np.sin(time)])
    return smooth + rng.normal(0, noise, smooth.shape)


@pytest.mark.parametrize("at", [[40], [40, 41], [10, 40, 70], [0], [1], [98], [99], [0, 50, 99]])
def test_spikes_go_and_nothing_else(at):
    values = stream()
    values[at] += np.array([1.5, -1.0, 0.8])
    kept = without_spikes(values, smallest=0.01, also_at_ends=True)
    np.testing.assert_array_equal(np.flatnonzero(~kept), at)


def test_noise_and_manoeuvres_stay():
    assert all(without_spikes(stream(seed=seed), smallest=0.01, also_at_ends=True).all() for seed in range(50))


def test_the_edges_of_a_gap_stay():
    values = stream(200)
    with_gap = np.delete(values, slice(60, 140), axis=0)
    assert without_spikes(with_gap, smallest=0.01, also_at_ends=True).all()


def test_of_few_samples_all_stay():
    assert without_spikes(np.array([[0.0], [5.0], [0.0]])).all()
    assert without_spikes(np.zeros((0, 3))).all()
