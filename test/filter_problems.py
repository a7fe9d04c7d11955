"""Random problems for the filter and what judges it."""

from __future__ import annotations

import numpy as np

from dvl_calib_ros.calibration.numerics.kalman import Measurements


def random_problem(rng, k=3, n_samples=150, n=4, m=3, outliers=0.0, weights=False, gate=np.inf):
    truth = rng.normal(0, 0.05, (k, n))
    h = rng.normal(0, 1.5, (k, n_samples, m, n))
    factor = rng.normal(0, 0.1, (k if weights else 1, n_samples, m, m))
    r = factor @ factor.transpose(0, 1, 3, 2) + 0.01 * np.eye(m)
    noise = np.linalg.cholesky(r) @ rng.normal(size=(1, n_samples, m, 1))
    z = np.einsum("knmi,ki->knm", h, truth) + noise[..., 0]
    z[:, rng.random(n_samples) < outliers] += 3.0
    weight = rng.uniform(0.1, 1.0, (k, n_samples)) if weights else np.ones((1, n_samples))
    usable = rng.random((k, n_samples)) < 0.9
    data = Measurements(z, h, r, weight, usable, np.full((k, 1), gate))
    return np.zeros((k, n)), np.tile(np.diag([0.05**2] * n), (k, 1, 1)), data
