"""The filter against weighted least squares, the batch against the filter."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import searched
from filter_problems import random_problem
from hypothesis import given
from hypothesis import strategies as st

from dvl_calib_ros.calibration.numerics import kalman
from dvl_calib_ros.calibration.numerics.kalman import Measurements, covariance_of


def least_squares(x, p, data, k):
    """Prior-regularised weighted least squares, by stacking everything and calling lstsq."""
    own = min(k, len(data.r) - 1)
    rows, right = [np.linalg.cholesky(np.linalg.inv(p[k])).T], [np.linalg.cholesky(np.linalg.inv(p[k])).T @ x[k]]
    for i in np.flatnonzero(data.usable[k]):
        root = np.linalg.cholesky(np.linalg.inv(data.r[own, i]) * data.weight[own, i]).T
        rows.append(root @ data.h[k, i])
        right.append(root @ data.z[k, i])
    a = np.vstack(rows)
    return np.linalg.lstsq(a, np.concatenate(right), rcond=None)[0], np.linalg.inv(a.T @ a)


@pytest.mark.parametrize("weights", [False, True])
def test_the_filter_equals_weighted_least_squares(rng, weights):
    x, p, data = random_problem(rng, weights=weights)
    after = kalman.recursion(x, p, data)
    for k in range(len(x)):
        state, covariance = least_squares(x, p, data, k)
        np.testing.assert_allclose(after.x[k], state, atol=1e-12)
        np.testing.assert_allclose(after.p[k], covariance, atol=1e-12)


@pytest.mark.parametrize("weights", [False, True])
def test_least_squares_over_growing_windows_equals_the_filter_after_each(rng, weights):
    x, p, data = random_problem(rng, weights=weights)
    ends = [0, 1, 40, 150]
    assert_of_filters_stopped(kalman.least_squares(x, p, data, ends), x, p, data, ends, 1e-12)


def assert_of_filters_stopped(found, x, p, data, ends, atol: float) -> None:
    for index, end in enumerate(ends):
        stopped = kalman.recursion(x, p, data.part(slice(0, end)))
        np.testing.assert_allclose(found.x[index], stopped.x, atol=atol)
        np.testing.assert_allclose(found.p[index], stopped.p, atol=atol)


@searched(30)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_samples=st.integers(1, 80),
    n=st.integers(1, 6),
    m=st.integers(1, 3),
    outliers=st.sampled_from([0.0, 0.05, 0.5]),
    gate=st.sampled_from([np.inf, 16.3, 3.0]),
    weights=st.booleans(),
)
def test_the_batch_equals_the_filter_whatever_the_gate_decides(seed, n_samples, n, m, outliers, gate, weights):
    x, p, data = random_problem(np.random.default_rng(seed), 2, n_samples, n, m, outliers, weights, gate)
    assert_batch_is_filter(x, p, data)


def assert_batch_is_filter(x, p, data):
    one, all_at_once = kalman.recursion(x, p, data), kalman.batch(x, p, data)
    np.testing.assert_array_equal(one.used, all_at_once.used)
    np.testing.assert_allclose(one.x, all_at_once.x, atol=1e-10)
    np.testing.assert_allclose(one.p, all_at_once.p, atol=1e-10)
    np.testing.assert_allclose(one.nis, all_at_once.nis, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("unseen", [[1], [0, 2], [0, 1, 2, 3]], ids=str)
def test_states_that_no_sample_sees_follow_those_that_they_are_correlated_with(rng, unseen):
    x, p, data = random_problem(rng, outliers=0.05, gate=16.3, weights=True)
    data.h[..., unseen] = 0.0
    root = 0.05 * rng.normal(size=p.shape)
    assert_batch_is_filter(x, root @ root.swapaxes(1, 2) + 1e-4 * np.eye(4), data)


@pytest.mark.parametrize("way", [kalman.batch, lambda x, p, data, ends: kalman.recursion(x, p, data, None, ends)])
@pytest.mark.parametrize("outliers, gate", [(0.0, np.inf), (0.05, 16.3), (0.5, 1.0)])
def test_the_states_on_the_way_are_those_of_a_filter_stopped_there(rng, outliers, gate, way):
    x, p, data = random_problem(rng, n_samples=40, outliers=outliers, gate=gate, weights=True)
    ends = np.array([0, 1, 1, 17, 40])
    assert_of_filters_stopped(way(x, p, data, ends).at, x, p, data, ends, 1e-10)


def test_gating_that_does_not_settle_falls_back_to_the_filter(rng, monkeypatch):
    x, p, data = random_problem(rng, outliers=0.5, gate=3.0)
    expected = kalman.recursion(x, p, data)
    monkeypatch.setattr(kalman, "MAX_GATE_PASSES", 1)
    np.testing.assert_array_equal(kalman.batch(x, p, data).x, expected.x)


def test_the_covariance_stays_symmetric_positive_definite_over_precise_updates(rng):
    """Nearly dependent measurements far more precise than the prior: where a plain (I - KH)P loses definiteness."""
    h = np.tile([[1.0, 1.0 + 1e-7, 0.0]], (1, 5000, 1, 1)).reshape(1, 5000, 1, 3)
    data = Measurements(
        np.zeros((1, 5000, 1)),
        h,
        np.full((1, 1, 1, 1), 1e-12),
        np.ones((1, 5000)),
        np.ones((1, 5000), bool),
        np.array([[np.inf]]),
    )
    x, p = np.zeros((1, 3)), np.eye(3)[None]
    for _ in range(4):
        after = kalman.recursion(x, p, data)
        x, p = after.x, after.p
        np.testing.assert_array_equal(p, p.transpose(0, 2, 1))
        assert np.linalg.eigvalsh(p[0])[0] > 0.0


def test_process_noise_adds_to_the_covariance_before_each_update(rng):
    x, p, data = random_problem(rng, k=1, n_samples=5)
    q = np.tile(1e-4 * np.eye(4), (5, 1, 1, 1))
    expected_x, expected_p = x[0], p[0]
    for i in range(5):  # textbook form, one step at a time
        expected_p = expected_p + q[i, 0]
        if data.usable[0, i]:
            h = data.h[0, i]
            gain = expected_p @ h.T @ np.linalg.inv(h @ expected_p @ h.T + data.r[0, i])
            expected_x = expected_x + gain @ (data.z[0, i] - h @ expected_x)
            expected_p = (np.eye(4) - gain @ h) @ expected_p
    after = kalman.recursion(x, p, data, q)
    np.testing.assert_allclose(after.x[0], expected_x, atol=1e-12)
    np.testing.assert_allclose(after.p[0], expected_p, atol=1e-12)


def test_a_sample_that_must_not_be_used_changes_nothing_at_all(rng):
    x, p, data = random_problem(rng, n_samples=3)
    unusable = Measurements(data.z, data.h, data.r, data.weight, np.zeros((3, 3), bool), data.gate)
    after = kalman.recursion(x, p, unusable)
    np.testing.assert_array_equal(after.x, x)
    np.testing.assert_array_equal(after.p, p)
    assert not after.used.any()


def test_information_of_very_different_size_leaves_positive_variances():
    """A rate of 1e9 rad/s made the variance of the lever arm negative, and the next step a square root of it."""
    row, prior = np.array([1e9, 2e9, -3e9]), np.diag([0.25, 0.25, 0.25])
    information = prior + np.outer(row, row)
    found = covariance_of(information, prior)
    assert (np.diag(found) > 0.0).all() and (np.diag(found) < 4.0).all()
    np.testing.assert_allclose(covariance_of(prior, prior), 4.0 * np.eye(3))
