"""The mounting as a pose: its covariance is that of poses drawn from the state."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.own import DELAY
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.error_model import corrected_mounting
from dvl_calib_ros.calibration.numerics.frames import rpy_from_rotation
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.results.results import mounting_pose, rpy_std, scale_and_delay

PARAMETERS = Parameters(
    mounting_rpy=(0.3, -0.2, 2.1), lever_arm=(0.5, 0.0, 0.2), dvl_time_offset=0.25, dvl_position="from_reference"
)


def state_of(name: str, rng) -> GaussianState:
    n = MODELS[name].n_state
    root = rng.normal(0.0, 0.003, (n, n))
    return GaussianState(rng.normal(0.0, 0.02, n), root @ root.T)


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
def test_the_covariance_is_that_of_poses_drawn_from_the_state(rng, turned):
    model, state = MODELS["full"], state_of("full", rng)
    found = mounting_pose(model, state, PARAMETERS, turned)
    middle = Rotation.from_matrix(found.rotation_body_from_dvl)
    drawn = []
    for x in state.x + spread(rng, 2000, state.p):
        pose = mounting_pose(model, GaussianState(x, state.p), PARAMETERS, turned)
        turn = Rotation.from_matrix(pose.rotation_body_from_dvl) * middle.inv()
        drawn.append([*np.subtract(pose.position, found.position), *turn.as_rotvec()])
    scale = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(
        np.cov(np.transpose(drawn)) / np.outer(scale, scale), found.covariance / np.outer(scale, scale), atol=0.03
    )


def spread(rng, n: int, covariance):
    """Normal (n, k) with this very covariance: what is compared is then off by what is bent, not by chance."""
    white = rng.standard_normal((n, len(covariance)))
    white -= white.mean(axis=0)
    white = np.linalg.solve(np.linalg.cholesky(np.cov(white.T)), white.T)
    return (np.linalg.cholesky(covariance) @ white).T


def test_where_the_reference_point_is_comes_off_and_where_nothing_says_so_there_is_no_position(rng):
    model, state = MODELS["full"], state_of("full", rng)
    at = np.array(mounting_pose(model, state, PARAMETERS).position)
    antenna = PARAMETERS.replace(reference_position=(-0.3, 0.0, 0.4))
    np.testing.assert_allclose(
        mounting_pose(model, state, antenna).position, at + np.array((-0.3, 0.0, 0.4)), atol=1e-12
    )
    told = mounting_pose(model, state, antenna.replace(dvl_position="told"))  # not what was found from who knows where
    np.testing.assert_allclose(told.position, (0.2, 0.0, 0.6), atol=1e-12)
    np.testing.assert_array_equal(told.covariance[:3, :3], -np.eye(3))
    unknown = mounting_pose(model, state, PARAMETERS.replace(dvl_position="unknown"))
    assert np.isnan(unknown.position).all()
    np.testing.assert_array_equal(
        unknown.covariance[:3], [[-1, 0, 0, 0, 0, 0], [0, -1, 0, 0, 0, 0], [0, 0, -1, 0, 0, 0]]
    )


@pytest.mark.parametrize("given", [(0.5, 0.0, 0.2), (0.0, 0.0, 0.0)])
def test_an_axis_that_the_data_do_not_show_is_where_it_was_said_to_be_or_unknown(rng, given):
    model, state = MODELS["full"], state_of("full", rng)
    height = model.state_names.index("lever_arm_z")
    p = state.p.copy()
    p[height] = p[:, height] = 0.0
    p[height, height] = PARAMETERS.initial_std_lever_arm**2
    position = mounting_pose(model, GaussianState(state.x, p), PARAMETERS.replace(lever_arm=given)).position
    assert position[2] == 0.2 and position[0] != 0.5 if any(given) else np.isnan(position).all()


def test_what_a_model_does_not_estimate_is_the_parameters_with_variance_minus_one(rng):
    found = mounting_pose(MODELS["M3"], state_of("M3", rng), PARAMETERS)
    assert found.position == PARAMETERS.lever_arm
    np.testing.assert_array_equal(found.covariance[:3, :3], -np.eye(3))
    beside = scale_and_delay(MODELS["unaided"], state_of("unaided", rng), PARAMETERS)
    assert (beside.scale, beside.scale_std, beside.time_offset, beside.time_offset_std) == (0.0, None, 0.25, None)


def test_scale_and_delay_are_what_was_set_and_what_was_found(rng):
    state = state_of("full", rng)
    beside = scale_and_delay(
        MODELS["full"], state, Parameters(mounting_rpy=(0.0, 0.0, np.pi / 2), dvl_time_offset=0.25)
    )
    assert beside.time_offset == pytest.approx(0.25 + state.x[DELAY])
    assert beside.scale == pytest.approx(state.x[4])  # the DVL's y looks ahead
    assert beside.scale_std == pytest.approx(np.sqrt(state.p[4, 4]))


@pytest.mark.parametrize(
    "rpy", [*((0.0, 0.0, np.radians(yaw)) for yaw in (0, 30, 45, 90, 180)), (0.3, -0.2, 2.1), (np.pi, 0.0, -np.pi / 2)]
)
def test_the_std_of_roll_pitch_and_yaw_is_that_of_angles_drawn_from_the_state(rng, rpy):
    """Of a DVL at 45 degrees, a roll of the body that is not known is as much pitch as roll."""
    parameters, model = Parameters(mounting_rpy=rpy), MODELS["full"]
    t = parameters.rotation_dvl_from_body
    p = np.zeros((model.n_state, model.n_state))
    p[:3, :3] = t @ np.diag([0.02, 0.001, 0.002]) ** 2 @ t.T
    found = rpy_std(np.zeros(3), p, parameters)
    drawn = [
        rpy_from_rotation(corrected_mounting(phi, t)) for phi in rng.multivariate_normal(np.zeros(3), p[:3, :3], 4000)
    ]
    spread = np.angle(np.exp(1j * (np.array(drawn) - rpy))).std(axis=0)
    np.testing.assert_allclose(found, spread, rtol=0.05)
    if rpy[2] == np.pi / 4:
        assert found[1] > 0.014
