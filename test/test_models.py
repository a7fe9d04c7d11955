"""Every model against independent oracles, in two frame conventions and with a tilted mounting."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration import kalman
from dvl_calib_ros.calibration.bank import ModelBank
from dvl_calib_ros.calibration.error_model import correct, distort
from dvl_calib_ros.calibration.frames import FLU_FROM_FRD, rotation_from_rpy
from dvl_calib_ros.calibration.models import MODELS, Observations
from dvl_calib_ros.calibration.parameters import Parameters

# T = rotation_dvl_from_body: flush, a DVL turned by 45 degrees, a tilted one, and one hung upside down
MOUNTINGS = {"none": (0, 0, 0), "yaw45": (0, 0, np.pi / 4), "tilted": (0.1, -0.2, 0.8), "inverted": (np.pi, 0.1, 0)}
FRAMES = {"flu": np.eye(3), "frd": FLU_FROM_FRD}
PRIOR = np.array([0.12, -0.07])
each_model = pytest.mark.parametrize("name", MODELS)
each_mounting = pytest.mark.parametrize("mounting", MOUNTINGS)
each_frame = pytest.mark.parametrize("frame", FRAMES)


def body_velocities(model, rng, n=200):
    """Velocities that fulfil the model's own assumptions."""
    velocity = np.column_stack([rng.uniform(0.8, 2.5, n), rng.normal(0, 0.3, n), rng.normal(0, 0.3, n)])
    if model.name in ("M3", "M4"):
        velocity[:, 2] = 0.0
    if not model.aided:
        velocity[:, 1:] = PRIOR if model.needs_prior else 0.0
    return velocity


def observations(velocity_dvl, velocity_body, t, sway_heave=PRIOR):
    return Observations(velocity_dvl, velocity_body, None, t, sway_heave)


def state_to_terms(model, state):
    terms = model.error_terms_from_state @ state
    return terms[:3], terms[3:]


# The oracle of H: z as the nonlinear error model predicts it for a given state, written from models.md on its own.
def predicted_z(model, state, velocity_dvl, velocity_body, t):
    phi, dk = state_to_terms(model, state)
    speed = np.linalg.norm(velocity_dvl, axis=1)
    expected = np.column_stack([speed, np.tile(PRIOR, (len(speed), 1))])
    if model.aided:  # the measured velocity is what the errors make of the reference
        level = velocity_body * [1, 1, 0] if model.name in ("M3", "M4") else velocity_body
        return level @ t.T - distort(level, phi, dk, t)
    if model.name == "M5":
        return expected @ t.T - distort(expected, phi, dk, t)
    corrected = correct(velocity_dvl, phi, dk, t) - velocity_dvl @ t  # M6, M7: what the correction changes
    return corrected if model.name == "M6" else corrected[:, :1]


@each_model
@each_mounting
@each_frame
def test_h_is_the_derivative_of_the_nonlinear_error_model(name, mounting, frame, rng):
    model, t = MODELS[name], rotation_from_rpy(MOUNTINGS[mounting]).T
    velocity_body = rng.normal([1.5, 0.2, 0.1], 0.3, (20, 3)) @ FRAMES[frame].T
    velocity_dvl = velocity_body @ t.T + rng.normal(0, 0.1, (20, 3))
    _, h = model.linearise(observations(velocity_dvl, velocity_body, t))
    step = 1e-6
    for column in range(model.n_state):
        state = np.zeros(model.n_state)
        state[column] = step
        plus = predicted_z(model, state, velocity_dvl, velocity_body, t)
        minus = predicted_z(model, -state, velocity_dvl, velocity_body, t)
        np.testing.assert_allclose(h[:, :, column], (plus - minus) / (2 * step), atol=1e-8)


@each_model
@each_mounting
@each_frame
def test_z_is_zero_on_data_without_errors(name, mounting, frame, rng):
    model, t = MODELS[name], rotation_from_rpy(MOUNTINGS[mounting]).T
    velocity = body_velocities(model, rng)
    flip = FRAMES[frame]
    seen = observations(velocity @ flip.T @ t.T, velocity @ flip.T, t, np.diag(flip)[1:] * PRIOR)
    z, h = model.linearise(seen)
    if name == "M7" or not model.needs_prior:
        np.testing.assert_allclose(z, 0.0, atol=1e-12)
    else:  # the speed holds prior sway and heave, too: the paper's reference is too long by the difference
        speed = np.linalg.norm(velocity, axis=1)
        assert np.abs(z).max() <= np.abs(speed - velocity[:, 0]).max() + 1e-12
    assert h.shape == (len(velocity), model.n_measurement, model.n_state)


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if model.aided])
@each_mounting
@each_frame
def test_noiseless_errors_are_recovered(name, mounting, frame, rng):
    """GNSS models: the state comes out as it went in, to the second order that linearisation leaves (none here)."""
    model, t = MODELS[name], rotation_from_rpy(MOUNTINGS[mounting]).T
    truth = np.array([0.02, -0.03, 0.04, 0.006][: model.n_state]) * 1e-3
    velocity = body_velocities(model, rng) @ FRAMES[frame].T
    measured = distort(velocity, *state_to_terms(model, truth), t)
    state = run_filter(model, measured, velocity, t)
    np.testing.assert_allclose(state, truth, atol=2e-8)  # second order: 4e-5 squared


@pytest.mark.parametrize("name", ["M5", "M6"])
@each_frame
def test_the_models_without_gnss_find_pitch_and_yaw_of_a_straight_level_run(name, frame, rng):
    model = MODELS[name]
    truth = np.array([0.0, -3e-5, 4e-5])
    velocity = np.column_stack([rng.uniform(1, 2, 100), np.zeros(100), np.zeros(100)])
    measured = distort(velocity, truth, np.zeros(3), np.eye(3))
    state = run_filter(model, measured, None, np.eye(3), np.zeros(2))
    np.testing.assert_allclose(state[1:], truth[1:], atol=1e-8)


def test_m7_finds_half_the_angle_as_the_paper_leaves_it(rng):
    """‖v‖ - v_x is second order in the misalignment: the linear update stops at half of it."""
    velocity = np.tile([1.5, 0.0, 0.0], (20000, 1))
    measured = distort(velocity, np.array([0.0, 0.0, 0.04]), np.zeros(3), np.eye(3))
    state = run_filter(MODELS["M7"], measured, None, np.eye(3))
    np.testing.assert_allclose(state, [0.0, 0.0, 0.02], atol=5e-4)


def run_filter(model, velocity_dvl, velocity_body, t, sway_heave=PRIOR):
    bank = ModelBank([model], Parameters(initial_std_misalignment=1.0, initial_std_scale=0.5, gate_probability=0.0))
    seen = observations(velocity_dvl, velocity_body, t, sway_heave)
    n = len(velocity_dvl)
    noise = np.eye(3)[None] * 1e-6
    bank.update(range(n), seen, noise, np.ones(n), np.ones(n, dtype=bool))
    return bank.state(model.name).x


@each_model
def test_a_padded_model_in_the_bank_is_the_model_alone(name, rng):
    """Padding to the largest model changes nothing: the bank's state is that of a filter of the model's own size."""
    model, parameters = MODELS[name], Parameters()
    velocity_body = rng.normal([1.5, 0.1, 0.0], 0.2, (60, 3))
    seen = observations(velocity_body + rng.normal(0, 0.1, (60, 3)), velocity_body, np.eye(3))
    bank = ModelBank(list(MODELS.values()), parameters)
    bank.update(range(60), seen, 0.04 * np.eye(3)[None], np.ones(60), np.ones(60, dtype=bool))
    z, h = model.linearise(seen)
    m = model.n_measurement
    alone = kalman.recursion(
        np.zeros((1, model.n_state)),
        np.diag([0.05**2] * 3 + [0.006**2] * (model.n_state - 3))[None],
        kalman.Measurements(
            z[None], h[None], 0.04 * np.eye(m)[None, None], np.ones(60), np.ones((1, 60), dtype=bool),
            np.array([bank._gate[list(MODELS).index(name)]]),
        ),
    )  # fmt: skip
    np.testing.assert_allclose(bank.state(name).x, alone.x[0], atol=1e-12)
    np.testing.assert_allclose(bank.state(name).p, alone.p[0], atol=1e-12)


def test_a_tilted_mounting_keeps_its_known_tilt_when_heave_is_zeroed(rng):
    """The paper's r_z := 0 in the DVL frame would undo a mounting's pitch; zero heave in the body frame does not."""
    t = rotation_from_rpy((0.0, 0.3, 0.0)).T
    velocity = np.column_stack([rng.uniform(1, 2, 100), rng.normal(0, 0.2, 100), np.zeros(100)])
    for name in ("M3", "M4"):
        np.testing.assert_allclose(run_filter(MODELS[name], velocity @ t.T, velocity, t), 0.0, atol=1e-12)
