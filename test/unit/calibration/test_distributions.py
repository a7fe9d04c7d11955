"""Tails and quantiles against `scipy.stats`, which is not imported where speed counts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from dvl_calib_ros.calibration.numerics import distributions, tests
from dvl_calib_ros.calibration.numerics.robust import median, robust_std

TAILS = (1e-12, 1e-4, 0.01, 0.3, 0.5, 0.9, 0.9999)


@pytest.mark.parametrize("dof", [0.3, 1.0, 2.0, 5.7, 99.0, 9000.0])
def test_chi_square_in_plain_python_is_that_of_scipy(dof):
    for p in TAILS:
        x = stats.chi2.isf(p, dof)
        assert tests.chi2_isf(p, dof) == pytest.approx(x, rel=1e-10)
        assert tests.chi2_sf(x, dof) == pytest.approx(p, rel=1e-10)
        assert tests.chi2_cdf(x, dof) == pytest.approx(stats.chi2.cdf(x, dof), rel=1e-10)
    assert (tests.chi2_cdf(math.inf, dof), tests.chi2_sf(0.0, dof)) == (1.0, 1.0)


def test_distributions_of_arrays_are_those_of_scipy(rng):
    x, dof = np.array([0.0, 1.0, 5.0, 300.0, 5000.0]), np.array([1, 2, 6, 7, 3])
    assert distributions.chi2_logsf(x, dof) == pytest.approx(stats.chi2.logsf(x, dof))
    assert distributions.chi2_sf(x, dof) == pytest.approx(stats.chi2.sf(x, dof))
    for p in TAILS:
        assert distributions.normal_isf(p) == pytest.approx(stats.norm.isf(p), abs=1e-12)
        assert distributions.chi2_isf(p, 3) == pytest.approx(stats.chi2.isf(p, 3))
    assert distributions.normal_sf(7.0) == pytest.approx(stats.norm.sf(7.0))
    assert distributions.f_sf(2.3, 3, 20) == pytest.approx(stats.f.sf(2.3, 3, 20))
    values = rng.normal(size=(101, 3))
    scatter = stats.median_abs_deviation(values, axis=0, scale="normal")
    assert robust_std(values) == pytest.approx(scatter)
    assert np.isnan(robust_std(values[:0])).all()


@pytest.mark.parametrize("n", [1, 2, 5, 8])
def test_the_median_is_numpys_to_the_last_bit(rng, n):
    values = rng.normal(size=(n, 3))
    assert median(values).tolist() == np.median(values, axis=0).tolist()


@pytest.mark.parametrize(("count", "n", "p"), [(0, 9, 0.1), (3, 10, 0.2), (40, 3000, 1e-3), (7, 7, 0.5)])
def test_a_share_has_the_exact_interval_and_the_probability_of_so_many_or_more(count, n, p):
    expected = stats.binomtest(count, n, p, "greater")
    assert distributions.binomial_sf(count, n, p) == pytest.approx(expected.pvalue, rel=1e-9)
    interval = stats.binomtest(count, n).proportion_ci()
    assert distributions.binomial_interval(count, n) == pytest.approx((interval.low, interval.high), abs=1e-9)
