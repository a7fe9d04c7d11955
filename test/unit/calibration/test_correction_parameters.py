"""From a correction's parameters to the errors: the maximum of the posterior is found wherever there is one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from dvl_calib_ros.calibration.correction_parameters import (
    PriorOnErrors,
    correction_from_errors,
    errors_from_correction,
)
from dvl_calib_ros.calibration.frames import skew
from dvl_calib_ros.calibration.kalman import GaussianState

# of misalignment (rad) and scale: such as a user would give, and hardly any
PRIORS = {"tight": (0.05, 0.006), "wide": (0.5, 0.006), "of any scale": (0.5, 0.03)}
TRUTH = np.array([np.radians(5.0), np.radians(-4.0), np.radians(3.0), 0.012, 0.009])
STD = 0.02  # m/s
# body's velocities m/s of which roll is not seen, hardly, and well
MOTIONS = {
    "straight ahead": [[1.9, 0.0, 0.0]] * 100,
    "ahead with a little sway": [[1.9, 0.05 * np.sin(n), 0.01 * np.cos(n)] for n in range(100)],
    "in circles": [[np.cos(0.1 * n), np.sin(0.1 * n), 0.2] for n in range(100)],
}


def filtered(velocity, truth, prior):
    """What a filter on ψ and κ holds that started from the prior's first-order image."""
    b = np.linalg.inv(
        np.eye(3) - skew(correction_from_errors(truth)[:3]) - np.diag([*correction_from_errors(truth)[3:], 0])
    )
    measured = velocity @ b.T + np.random.default_rng(0).normal(0.0, STD, velocity.shape)
    # z = v - v_body = [ψ×] v + diag(κ) v
    h = np.concatenate([-skew(measured), measured[:, :, None] * np.eye(3)[:, :2]], axis=-1).reshape(-1, 5)
    z = (measured - velocity).ravel()
    information = np.linalg.inv(prior.p) + h.T @ h / STD**2
    p = np.linalg.inv(information)
    return GaussianState(p @ h.T @ z / STD**2, p), h, z


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("widths", PRIORS)
@pytest.mark.parametrize("size", [0.0, 0.5, 1.0, -1.0, 2.0])
def test_the_maximum_of_the_posterior_is_found_and_is_one(motion, widths, size):
    angle, scale = PRIORS[widths]
    prior = GaussianState(np.zeros(5), np.diag(np.square([angle] * 3 + [scale] * 2)))
    held, h, z = filtered(np.array(MOTIONS[motion]), size * TRUTH, prior)
    found = PriorOnErrors(prior, prior).to_errors(held)

    def cost(correction):
        left, errors = (z - h @ correction) / STD, errors_from_correction(correction).errors
        return 0.5 * (left @ left + errors @ np.linalg.solve(prior.p, errors))

    at = correction_from_errors(found.x)
    assert np.linalg.eigvalsh(found.p)[0] > 0.0
    # nobody finds a better one from around there, by a method that knows nothing of this one
    corners = np.vstack([at, at + np.diag(np.minimum(np.sqrt(np.diag(held.p)) / 3.0, 0.1))])
    better = minimize(cost, at, method="Nelder-Mead", options={"initial_simplex": corners, "maxfev": 4000})
    assert better.fun > cost(at) - 1e-6 * max(1.0, cost(at))


def test_an_errors_derivatives_are_those_of_differences():
    at = np.array([0.1, -0.2, 0.15, 0.05, -0.03])
    jacobian = errors_from_correction(at).jacobian
    steps = [
        (errors_from_correction(at + e).errors - errors_from_correction(at - e).errors) / 2e-6 for e in 1e-6 * np.eye(5)
    ]
    assert np.allclose(jacobian, np.array(steps).T, atol=1e-8)
