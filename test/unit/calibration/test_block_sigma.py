"""σ of every model is the larger of what its filter claims and what blocks of time show, and both are to be seen."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import ReferenceSample
from dvl_calib_ros.files.result_file import result_document

CLAIMED = Parameters(gnss_aided_std=0.03)


@cache
def run(wander: float):
    """A box of 300 s whose reference has white noise as claimed and one that wanders over half a minute (m/s)."""
    samples = make_samples(MatchedRun("box", 300.0, gnss_std=0.03, dvl_std=0.005, imu_every=20))
    rng = np.random.default_rng(4)
    error, found = np.zeros(3), []
    for sample in samples:
        if isinstance(sample, ReferenceSample):
            keep = np.exp(-0.2 / 30.0)
            error = keep * error + wander * np.sqrt(1.0 - keep**2) * rng.normal(size=3)
            sample = sample._replace(velocity=tuple((sample.velocity + error).tolist()))
        found.append(sample)
    return tuple(found)


@pytest.mark.parametrize("name", ["M3", "G1", "G2"])
def test_noise_that_lasts_raises_sigma_and_noise_as_claimed_hardly_does(name):
    lasting, white = (calibrate(run(wander), CLAIMED).estimate(name) for wander in (0.1, 0.0))
    assert lasting.std[2] > 2.0 * lasting.filter_std[2]
    assert np.all(white.std >= white.filter_std * (1.0 - 1e-12))
    assert white.std[2] < 1.6 * white.filter_std[2]


@pytest.mark.parametrize("block_size", [1, 500])
def test_how_samples_are_gathered_changes_nothing(block_size):
    for name in ("M3", "G1", "F1", "A1"):
        one, other = (calibrate(run(0.1), CLAIMED, block_size=size).estimate(name) for size in (64, block_size))
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-7, atol=1e-12)


def test_a_random_walk_is_left_as_the_filter_has_it():
    estimate = calibrate(run(0.1), CLAIMED.replace(process_std_misalignment=1e-4)).estimate("G1")
    np.testing.assert_allclose(estimate.std, estimate.filter_std)


def test_the_state_is_the_same_and_the_result_file_has_both_sigmas():
    calibrator = calibrate(run(0.1), CLAIMED)
    np.testing.assert_array_equal(calibrator.published("G1").x, calibrator.state("G1").x)
    document = result_document(calibrator.result())
    yaw, by_filter = (float(document[key]["phi_z"].split()[0]) for key in ("std", "std_by_filter"))
    assert yaw > 2.0 * by_filter
