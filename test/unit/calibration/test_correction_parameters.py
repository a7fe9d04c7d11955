"""From a correction's parameters to the errors: the maximum of the posterior is found wherever there is one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from dvl_calib_ros.calibration.numerics.error_model import (
    PriorOnErrors,
    correction_from_errors,
    errors_from_correction,
    of_unseen_roll,
)
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy, skew
from dvl_calib_ros.calibration.numerics.kalman import GaussianState

# of misalignment (rad) and scale: such as a user would give, and hardly any
PRIORS = {"tight": (0.05, 0.006), "wide": (0.5, 0.006), "of any scale": (0.5, 0.03)}
TRUTH = np.array([np.radians(5.0), np.radians(-4.0), np.radians(3.0), 0.012, 0.009])
STD = 0.02  # m/s
ASKEW = of_unseen_roll(rotation_from_rpy([0.0, 0.0, 0.7]).T)
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
@pytest.mark.parametrize("roll", [None, ASKEW], ids=["along", "askew"])
def test_the_maximum_of_the_posterior_is_found_and_is_one(motion, widths, size, roll):
    angle, scale = PRIORS[widths]
    prior = GaussianState(np.zeros(5), np.diag(np.square([angle] * 3 + [scale] * 2)))
    held, h, z = filtered(np.array(MOTIONS[motion]), size * TRUTH, prior)
    found = PriorOnErrors(prior, prior, roll).to_errors(held)

    def cost(correction):
        left, errors = (z - h @ correction) / STD, errors_from_correction(correction, roll).errors
        return 0.5 * (left @ left + errors @ np.linalg.solve(prior.p, errors))

    at = correction_from_errors(found.x, roll)
    assert np.linalg.eigvalsh(found.p)[0] > 0.0
    # nobody finds a better one from around there, by a method that knows nothing of this one
    corners = np.vstack([at, at + np.diag(np.minimum(np.sqrt(np.diag(held.p)) / 3.0, 0.1))])
    better = minimize(cost, at, method="Nelder-Mead", options={"initial_simplex": corners, "maxfev": 4000})
    assert better.fun > cost(at) - 1e-6 * max(1.0, cost(at))


@pytest.mark.parametrize("roll", [None, ASKEW], ids=["along", "askew"])
def test_an_errors_derivatives_are_those_of_differences(roll):
    at = np.array([0.1, -0.2, 0.15, 0.05, -0.03])
    together = errors_from_correction(np.stack([at, 0.5 * at]), roll)
    for one, errors, jacobian in zip((at, 0.5 * at), *together, strict=True):
        alone = errors_from_correction(one, roll)
        assert np.allclose(alone.errors, errors, atol=1e-15) and np.allclose(alone.jacobian, jacobian, atol=1e-15)
        steps = [
            (errors_from_correction(one + e, roll).errors - errors_from_correction(one - e, roll).errors) / 2e-6
            for e in 1e-6 * np.eye(5)
        ]
        assert np.allclose(jacobian, np.array(steps).T, atol=1e-8)
        np.testing.assert_allclose(correction_from_errors(errors, roll), one, atol=1e-14)


@pytest.mark.parametrize("mounted_deg", [30.0, 45.0, -45.0, 135.0])
def test_a_scale_beyond_its_prior_makes_no_roll_that_nothing_shows(mounted_deg):
    """Of 1.1 per cent, on straight legs, a DVL at 45 degrees was found to be rolled by 5 degrees, as if to 1.4."""
    nominal = rotation_from_rpy([0.0, 0.0, math.radians(mounted_deg)]).T
    ahead, prior = nominal[:, 0], GaussianState(np.zeros(5), np.diag(np.square([0.05] * 3 + [0.006] * 2)))
    rng = np.random.default_rng(0)
    along, sway = rng.uniform(0.7, 1.0, 2000), rng.normal(0.0, 0.01, 2000)
    velocity = np.outer(along, ahead) + np.outer(sway, nominal[:, 1])
    measured = 1.012 * velocity
    z = measured - velocity + rng.normal(0.0, 0.1, velocity.shape)
    h = np.concatenate([-skew(measured), measured[:, :, None] * np.eye(3)[:, :2]], axis=-1).reshape(-1, 5)
    information = np.linalg.inv(prior.p) + h.T @ h / 0.1**2
    p = np.linalg.inv(information)
    found = PriorOnErrors(prior, prior, of_unseen_roll(nominal)).to_errors(
        GaussianState(p @ h.T @ z.ravel() / 0.1**2, p)
    )
    std = math.sqrt(ahead @ found.p[:3, :3] @ ahead)
    assert abs(found.x[:3] @ ahead) < 0.02 and std == pytest.approx(0.05, rel=0.05)
