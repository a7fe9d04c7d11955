"""Every model against independent oracles, in two frame conventions and with a tilted mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from dvl_calib_ros.calibration.filters.filter_bank import RelativeHeight, groups_of
from dvl_calib_ros.calibration.filters.filter_setup import Assembler
from dvl_calib_ros.calibration.models import LINEAR_MODELS, MODELS
from dvl_calib_ros.calibration.models.base import Observations
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics import kalman
from dvl_calib_ros.calibration.numerics.error_model import correct, distort
from dvl_calib_ros.calibration.numerics.frames import FLU_FROM_FRD, rotation_from_rpy

# T = rotation_dvl_from_body: flush, a DVL turned by 45 degrees, a tilted one, and one hung upside down
MOUNTINGS = {"none": (0, 0, 0), "yaw45": (0, 0, np.pi / 4), "tilted": (0.1, -0.2, 0.8), "inverted": (np.pi, 0.1, 0)}
FRAMES = {"flu": np.eye(3), "frd": FLU_FROM_FRD}
PRIOR = np.array([0.12, -0.07])
each_model = pytest.mark.parametrize("name", [model.name for model in LINEAR_MODELS])
each_mounting = pytest.mark.parametrize("mounting", MOUNTINGS)
each_frame = pytest.mark.parametrize("frame", FRAMES)


def body_velocities(model, rng, n=200):
    """Velocities that fulfil the model's own assumptions, nuisance states zero."""
    velocity = np.column_stack([rng.uniform(0.8, 2.5, n), rng.normal(0, 0.3, n), rng.normal(0, 0.3, n)])
    if model.name in ("M3", "M4"):
        velocity[:, 2] = 0.0
    if not model.aided:
        velocity[:, 1:] = PRIOR if model.needs_prior else 0.0
    return velocity


def observations(velocity_dvl, velocity_body, t, sway_heave=PRIOR, frame="flu", noise=None):
    """With attitude, but for every fifth sample: all headings, rolling and pitching a little, turning."""
    n = len(velocity_dvl)
    oriented = np.arange(n) % 5 > 0
    angles = np.column_stack([0.1 * np.sin(np.arange(n)), 0.2 * np.cos(0.7 * np.arange(n)), 0.3 * np.arange(n)])
    rates = np.column_stack([np.zeros(n), np.zeros(n), 0.2 * np.sin(0.4 * np.arange(n))])
    angles[~oriented], rates[~oriented] = 0.0, 0.0
    return Observations(
        velocity_dvl,
        velocity_body,
        None,
        t,
        sway_heave,
        noise=np.eye(3)[None] if noise is None else noise,
        rotation_enu_from_body=rotation_from_rpy(angles) @ FRAMES[frame],
        angular_velocity=rates @ FRAMES[frame],
        interval=np.full(n, 0.2),
        earth_in_body=(rotation_from_rpy(angles) @ FRAMES[frame]).swapaxes(1, 2)[:, :, :2],
        height=5.0 * np.sin(0.3 * np.arange(n)),
        oriented=oriented,
    )


def state_to_terms(model, state):
    terms = model.error_terms_from_state @ state
    return terms[:3], terms[3:]


def level_heave(seen):
    """Heave of a vehicle whose velocity is horizontal, given its attitude and its motion ahead and aside."""
    up, v = seen.rotation_enu_from_body[:, 2], seen.velocity_dvl @ seen.rotation_dvl_from_body
    return -(up[:, 0] * v[:, 0] + up[:, 1] * v[:, 1]) / up[:, 2]


def shows_scale(velocity_dvl, t):
    """(N, 3): axes that are slower say nothing of their scale, but those that are mounted along the way."""
    speed = np.linalg.norm(velocity_dvl, axis=1, keepdims=True)
    return (np.abs(velocity_dvl) > 0.3) | (speed > 0.3) & (np.abs(t[:, 0]) > 0.4)


# The oracle of H: z as the nonlinear error model predicts it for a given state, written from models.md, or for our own
# models from what they assume of the motion, on its own.
def predicted_z(model, state, seen):
    velocity_dvl, velocity_body, t = seen.velocity_dvl, seen.reference_body, seen.rotation_dvl_from_body
    phi, dk = state_to_terms(model, state)
    speed = np.linalg.norm(velocity_dvl, axis=1)
    expected = np.column_stack([speed, np.tile(PRIOR, (len(speed), 1))])
    if model.aided:  # the measured velocity is what the errors make of the reference
        level = velocity_body * [1, 1, 0] if model.name in ("M3", "M4") else velocity_body
        return level @ t.T - distort(level, phi, dk, t)
    if model.name == "M5":
        return expected @ t.T - distort(expected, phi, dk, t)
    corrected = correct(velocity_dvl, phi, dk, t) - velocity_dvl @ t  # what the correction changes
    if not model.nuisance:
        return corrected if model.name == "M6" else corrected[:, :1]
    _, _, _, east, north, skid, dive, heave, shear_east, shear_north, sway = state
    flow = np.array([east, north, 0.0]) + seen.height[:, None] * [shear_east, shear_north, 0.0]
    current = np.einsum("nij,ni->nj", seen.rotation_enu_from_body, flow)[:, 1]
    turn = skid * seen.angular_velocity[:, 2] * (velocity_dvl @ t)[:, 0]
    oriented = np.column_stack([current + turn, dive * level_heave(seen) + heave]) - corrected[:, 1:]
    ahead = (velocity_dvl @ t) * [1, 0, 0] @ t.T  # without attitude only the motion ahead turns
    constant = np.array([sway, heave]) - (correct(ahead, phi, dk, t) - ahead @ t)[:, 1:]
    return np.where(seen.oriented[:, None], oriented, constant)


@each_model
@each_mounting
@each_frame
def test_h_is_the_derivative_of_the_nonlinear_error_model(name, mounting, frame, rng):
    model, t = MODELS[name], rotation_from_rpy(MOUNTINGS[mounting]).T
    velocity_body = rng.normal([1.5, 0.2, 0.1], 0.3, (20, 3)) @ FRAMES[frame].T
    velocity_dvl = velocity_body @ t.T + rng.normal(0, 0.1, (20, 3))
    seen = observations(velocity_dvl, velocity_body, t, frame=frame)
    _, h = model.linearise(seen)
    step = 1e-6
    for column in range(model.n_state):
        state = np.zeros(model.n_state)
        state[column] = step
        plus, minus = predicted_z(model, state, seen), predicted_z(model, -state, seen)
        np.testing.assert_allclose(h[:, :, column], (plus - minus) / (2 * step), atol=1e-8)


@each_model
@each_mounting
@each_frame
def test_z_is_zero_on_data_without_errors(name, mounting, frame, rng):
    model, t = MODELS[name], rotation_from_rpy(MOUNTINGS[mounting]).T
    velocity = body_velocities(model, rng)
    flip = FRAMES[frame]
    seen = observations(velocity @ flip.T @ t.T, velocity @ flip.T, t, np.diag(flip)[1:] * PRIOR, frame)
    if name == "unaided":
        seen = level_motion(seen, velocity @ flip.T)
    z, h = model.linearise(seen)
    if name == "M7" or not model.needs_prior:
        np.testing.assert_allclose(z, 0.0, atol=1e-12)
    else:  # the speed holds prior sway and heave, too: the paper's reference is too long by the difference
        speed = np.linalg.norm(velocity, axis=1)
        assert np.abs(z).max() <= np.abs(speed - velocity[:, 0]).max() + 1e-12
    assert h.shape == (len(velocity), model.n_measurement, model.n_state)


def level_motion(seen, velocity_body):
    """The same observations with the heave that holds the depth."""
    level = velocity_body.copy()
    level[:, 2] = level_heave(replace(seen, velocity_dvl=velocity_body @ seen.rotation_dvl_from_body.T))
    return replace(seen, velocity_dvl=level @ seen.rotation_dvl_from_body.T)


@pytest.mark.parametrize("name", [model.name for model in LINEAR_MODELS if model.aided])
@each_mounting
@each_frame
def test_noiseless_errors_are_recovered(name, mounting, frame, rng):
    """GNSS models: the state comes out as it went in, to the second order that linearisation leaves (none here)."""
    model, t = MODELS[name], rotation_from_rpy(MOUNTINGS[mounting]).T
    truth = np.zeros(model.n_state)
    truth[: model.n_errors] = np.array([0.02, -0.03, 0.04, 0.006, 0.002])[: model.n_errors] * 1e-3
    velocity = body_velocities(model, rng) @ FRAMES[frame].T
    measured = distort(velocity, *state_to_terms(model, truth), t)
    state = run_filter(model, measured, velocity, t)
    np.testing.assert_allclose(correct(measured, *state_to_terms(model, state), t), velocity, atol=1e-7)
    if len(model.scale_axes) == 1:  # one per axis cannot all be told apart from tilts of a tilted mounting
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
    parameters = Parameters(initial_std_misalignment=1.0, initial_std_scale=0.5, gate_probability=0.0)
    [group] = groups_of([model], parameters)
    seen = observations(velocity_dvl, velocity_body, t, sway_heave, noise=np.eye(3)[None] * 1e-6)
    n = len(velocity_dvl)
    group.update(np.arange(n), seen, np.ones(n), np.ones(n, dtype=bool))
    return group.state(model.name).x


@each_model
def test_a_model_beside_others_in_its_group_is_the_model_alone(name, rng):
    model, parameters = MODELS[name], Parameters()
    velocity_body = rng.normal([1.5, 0.1, 0.0], 0.2, (60, 3))
    seen = observations(
        velocity_body + rng.normal(0, 0.1, (60, 3)), velocity_body, np.eye(3), noise=0.04 * np.eye(3)[None]
    )
    group = next(each for each in groups_of(LINEAR_MODELS, parameters) if name in each.index)
    stamps_ns = 200_000_000 * np.arange(60)
    group.update(stamps_ns, seen, np.ones(60), np.ones(60, dtype=bool))
    z, h = model.linearise(replace(seen, height=RelativeHeight().add(stamps_ns, seen.rising)))
    m = model.n_measurement
    r = (seen.noise if model.noise is None else model.noise(seen))[:, :m, :m]
    weight = seen.motion_weight if model.motion_is_noise else np.ones(60)
    gate = chi2.ppf(parameters.gate_probability, m)
    alone = kalman.recursion(
        *Assembler([model], parameters).start,
        kalman.Measurements(z[None], h[None], r[None], weight[None], np.ones((1, 60), dtype=bool), np.array([[gate]])),
    )
    after, k = group.snapshot(1), group.index[name]
    np.testing.assert_allclose(after.x[0, k], alone.x[0], atol=1e-12)
    np.testing.assert_allclose(after.p[0, k], alone.p[0], atol=1e-12)


def test_a_tilted_mounting_keeps_its_known_tilt_when_heave_is_zeroed(rng):
    """The paper's r_z := 0 in the DVL frame would undo a mounting's pitch; zero heave in the body frame does not."""
    t = rotation_from_rpy((0.0, 0.3, 0.0)).T
    velocity = np.column_stack([rng.uniform(1, 2, 100), rng.normal(0, 0.2, 100), np.zeros(100)])
    for name in ("M3", "M4"):
        np.testing.assert_allclose(run_filter(MODELS[name], velocity @ t.T, velocity, t), 0.0, atol=1e-12)
