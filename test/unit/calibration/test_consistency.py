"""Whether the filters' covariances tell the truth, where their assumptions hold."""

from __future__ import annotations

import numpy as np
import pytest
from runs import MatchedRun, calibrate, make_samples
from scipy.stats import chi2

from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters

pytestmark = pytest.mark.slow  # hundreds of simulated runs

N_RUNS = 60


def normalised_estimation_error_squared(**options) -> dict[str, np.ndarray]:
    """(N_RUNS,) per model: truth drawn from the prior, DVL noise as R says, the reference without noise."""
    # without noise, the depth that is held would pass for a receiver without a vertical velocity
    measured = {"gnss_axes": "xyz", "gnss_aided_std": 0.05, "gnss_free_std": 0.05}
    parameters = Parameters(**measured, gate_probability=0.0, **options)
    rng = np.random.default_rng(5)
    found: dict[str, list[float]] = {name: [] for name in MODELS}
    for seed in range(N_RUNS):
        phi = tuple(rng.normal(0, parameters.initial_std_misalignment, 3))
        for name, scale in (("M1", rng.normal(0, parameters.initial_std_scale)), ("M5", 0.0)):
            aided = MODELS[name].aided
            run = MatchedRun(
                trajectory="box" if aided else "straight", seconds=60, phi=phi, scale=scale, dvl_std=0.05, seed=seed
            )
            # M2 and M4 hold a scale along x only, which this truth is not
            asked = tuple(
                each
                for each, model in MODELS.items()
                if model.aided == aided and not model.nuisance and all(axes != (0,) for _, axes in model.scale_axes)
            )
            calibrator = calibrate(make_samples(run), parameters, models=asked)
            for each in asked:
                truth = np.array([*phi, scale][: MODELS[each].n_state])
                error = calibrator.state(each).x - truth
                found[each].append(error @ np.linalg.solve(calibrator.state(each).p, error))
    return {name: np.array(values) for name, values in found.items()}


@pytest.fixture(scope="module")
def nees():
    return normalised_estimation_error_squared()


@pytest.mark.parametrize("name", ["M1", "M3", "M5"])
def test_errors_are_as_large_as_the_covariance_says(nees, name):
    low, high = chi2.ppf([0.005, 0.995], N_RUNS * MODELS[name].n_state)
    assert low < nees[name].sum() < high


def test_m6_is_overconfident_because_noise_in_its_regressor_looks_like_motion(nees):
    """The measured velocity's own noise is taken for sway and heave, and so for knowledge of roll."""
    assert nees["M6"].mean() > 2.0 * MODELS["M6"].n_state
