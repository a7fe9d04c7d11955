"""The models beyond the paper: what they promise that M1-M7 do not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from runs import START_NS, MatchedRun, calibrate, make_samples, only

from dvl_calib_ros.calibration.filters.filter_bank import LONGEST_STEP_S, MEMORY_S, RelativeHeight
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.error_model import correct
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.simulation.sensors import DvlErrors, equivalent_error_terms, measure_dvl

SECOND = 1_000_000_000


# ---------------------------------------------------------------- full: with GNSS


@pytest.mark.slow
def test_noise_of_the_receiver_pulls_the_scale_of_m1_down_but_not_of_full():
    """Straight ahead at 1.5 m/s with 0.2 m/s of noise: M1 is pulled by -3 σ²/‖v‖² = -5.3 %, full is not."""
    parameters = Parameters(initial_std_scale=0.5, gnss_aided_std=0.2)
    found = []
    for seed in range(10):
        run = MatchedRun("straight", 600.0, gnss_std=0.2, dvl_std=0.01, seed=seed)
        calibrator = calibrate(make_samples(run), parameters, models=("M1", "full"))
        found.append([calibrator.estimate(name).scale[0] for name in ("M1", "full")])
    pulled, free = np.mean(found, axis=0)
    assert pulled == pytest.approx(-3 * 0.04 / 1.5**2, rel=0.15)
    assert abs(free) < 0.002


def calibrated_on(velocity, measured, **parameters):
    """A calibrator that was fed velocities (N, 3) and what the DVL made of them, once a second, without GNSS noise."""
    samples = [
        sample
        for i, (v, g) in enumerate(zip(measured.tolist(), velocity.tolist(), strict=True))
        for sample in (ReferenceSample(i * SECOND, tuple(g)), DvlSample(i * SECOND, tuple(v)))
    ]
    return calibrate(samples, Parameters(**parameters), models=("M3", "full"))


def test_full_finds_a_scale_of_its_own_for_each_axis_that_the_motion_shows(rng):
    scale = np.array([0.005, -0.01, 0.0])
    velocity = np.column_stack([rng.uniform(1, 2, 400), rng.normal(0, 0.6, 400), np.zeros(400)])
    estimate = calibrated_on(velocity, velocity * (1 + scale), gnss_aided_std=0.01, initial_std_scale=0.02).estimate(
        "full"
    )
    np.testing.assert_allclose(estimate.scale[:2], scale[:2], atol=3e-4)


@pytest.mark.parametrize("degrees", [(5.0, -0.5, 2.5), (-1.0, -2.5, -3.0)])
def test_full_finds_5_degrees_but_for_what_the_error_model_cannot_hold(degrees, rng):
    """At up to 2 m/s; M3 is exact in this noiseless case, full is so with a noisy reference as well."""
    velocity = np.column_stack([rng.uniform(1, 2, 400), rng.normal(0, 0.4, 400), np.zeros(400)])
    errors = DvlErrors(misalignment_rpy=tuple(np.deg2rad(degrees)), scale=(0.005,) * 3)
    measured = measure_dvl(velocity, errors, np.eye(3), rng)
    wide = {"initial_std_misalignment": 0.5, "initial_std_scale": 0.5, "gnss_aided_std": 0.001, "gnss_axes": "xyz"}
    estimate = calibrated_on(velocity, measured, **wide).estimate("full")
    misalignment, scale = equivalent_error_terms(errors)
    np.testing.assert_allclose(estimate.misalignment, misalignment, atol=2.5e-3)
    np.testing.assert_allclose(estimate.scale[:2], scale[:2], atol=5e-4)
    residual = np.linalg.norm(estimate.corrected_velocity(measured, np.eye(3)) - velocity, axis=1)
    assert residual.max() < 0.01  # the symmetric part of a rotation, which neither ψ and κ nor φ and δk hold


# ---------------------------------------------------------------- unaided: without a reference


def run_without_gnss(headings_deg, current_enu, misalignment, rng, trim=0.0, seconds_each=100):
    """DVL and IMU samples at 1 Hz of legs at 1.5 m/s through the water, level, pitched by `trim`."""
    samples = []
    for i in range(seconds_each * len(headings_deg)):
        heading = np.deg2rad(headings_deg[i // seconds_each])
        rotation = rotation_from_rpy((0.0, -trim, heading))
        east, north = 1.5 * np.cos(heading) + current_enu[0], 1.5 * np.sin(heading) + current_enu[1]
        samples += seen(i, rotation, rotation.T @ np.array([east, north, 0.0]), misalignment, rng)
    return samples


def seen(second: int, rotation, velocity_body, misalignment, rng):
    """The samples of IMU and DVL at a time."""
    velocity = velocity_body + rng.normal(0, 0.01, 3)
    measured = velocity + np.cross(misalignment, velocity)
    orientation = quaternion_from_rotation(rotation)
    stamp_ns = second * SECOND
    return ImuSample(stamp_ns, orientation, (0.0, 0.0, 0.0)), DvlSample(stamp_ns, tuple(measured.tolist()))


def test_two_headings_tell_yaw_from_a_current(rng):
    samples = run_without_gnss((20.0, 200.0), (0.2, -0.1), (0.0, 0.0, 0.04), rng)
    calibrator = calibrate(samples, Parameters(current_std=0.3))
    estimate = calibrator.estimate("unaided")
    assert estimate.misalignment[2] == pytest.approx(0.04, abs=0.004)
    across = dict(zip(estimate.state_names, estimate.state, strict=True))
    heading = np.deg2rad(20.0)
    found = -np.sin(heading) * across["current_east"] + np.cos(heading) * across["current_north"]
    assert found == pytest.approx(-np.sin(heading) * 0.2 - np.cos(heading) * 0.1, abs=0.01)
    assert estimate.observability[2].observed
    assert abs(calibrator.estimate("M7").misalignment[2] - 0.04) > 0.01


def run_through_a_shear(misalignment, rng):
    """DVL and IMU samples at 1 Hz of eight legs on opposite headings, each at two depths, rising and sinking between.

    The current to the north changes by 0.01 m/s per m. The vehicle moves where it points.
    """
    samples, height = [], 0.0
    for i in range(800):
        heading = np.deg2rad(20.0 + 180.0 * (i // 100 % 2))
        rising = 0.25 * (1.0 if i // 50 % 4 in (0, 3) else -1.0) * (i // 100 % 4 < 2 or i // 50 % 2)
        height += rising
        rotation = rotation_from_rpy((0.0, -np.arcsin(rising / 1.5), heading))
        samples += seen(i, rotation, rotation.T @ (0.0, 0.01 * height, 0.0) + (1.5, 0.0, 0.0), misalignment, rng)
    return samples


@pytest.mark.parametrize("pitch_error", [0.0, 0.05, -0.05])
def test_a_current_that_changes_with_depth_is_not_taken_for_the_mounting(pitch_error, rng):
    estimate = calibrate(run_through_a_shear((0.0, pitch_error, 0.04), rng)).estimate("unaided")
    # by a constant current alone it comes out as 0.071
    assert estimate.misalignment[2] == pytest.approx(0.04, abs=0.02)
    found = dict(zip(estimate.state_names, estimate.state, strict=True))
    assert found["shear_north"] == pytest.approx(0.01, abs=0.005)


def test_one_heading_does_not_and_the_model_says_so(rng):
    samples = run_without_gnss((20.0,), (0.2, -0.1), (0.0, 0.0, 0.04), rng)
    calibrator = calibrate(samples)
    estimate = calibrator.estimate("unaided")
    yaw = estimate.observability[2]
    assert not yaw.observed
    assert yaw.axis == "yaw"
    assert "heading" in yaw.missing
    assert abs(estimate.misalignment[2] - 0.04) < abs(calibrator.estimate("M7").misalignment[2] - 0.04)


def test_holding_depth_shows_pitch_however_the_vehicle_is_trimmed(rng):
    samples = run_without_gnss((20.0, 200.0), (0.0, 0.0), (0.0, 0.03, 0.0), rng, trim=np.deg2rad(-3.0))
    estimates = calibrate(samples).result().estimates
    assert estimates["unaided"].misalignment[1] == pytest.approx(0.03, abs=0.012)
    assert abs(estimates["M7"].misalignment[1] - 0.03) > 0.015


def test_without_attitude_sway_and_heave_are_constants():
    samples = only(make_samples(MatchedRun("straight", phi=(0.0, 0.02, 0.03))), DvlSample)
    calibrator = calibrate(samples)
    estimate, parameters = calibrator.estimate("unaided"), Parameters()
    waiting = calibrator.counts["pairing"]["awaiting_attitude"]  # for as long as an IMU may be late
    assert estimate.used == calibrator.counts["pairing"]["not_oriented"] == len(samples) - waiting
    assert waiting == 5
    # the share of the sway that counts as yaw, by the priors
    yaw, current = 1.5 * parameters.initial_std_misalignment, parameters.current_std
    assert estimate.misalignment[2] == pytest.approx(0.03 * yaw**2 / (yaw**2 + current**2), rel=0.2)
    assert estimate.misalignment[1] == pytest.approx(0.02, abs=0.004)


def test_no_number_of_headings_tells_yaw_better_than_a_vehicle_swims_straight(rng):
    samples = run_without_gnss((20.0, 200.0) * 4, (0.2, -0.1), (0.0, 0.0, 0.04), rng)
    yaw = calibrate(samples, Parameters(current_std=0.3)).estimate("unaided").std[2]
    assert np.deg2rad(0.34) < yaw < np.deg2rad(0.55)


@pytest.mark.parametrize("trim_deg", [3.0, -3.0])
def test_a_trimmed_vehicle_on_one_heading_is_not_taken_for_a_pitch(trim_deg, rng):
    """A vehicle that holds its depth nose up is not one that moves where it points."""
    samples = run_without_gnss((20.0,) * 3, (0.0, 0.0), (0.0, 0.03, 0.0), rng, trim=np.deg2rad(trim_deg))
    estimate = calibrate(samples).estimate()
    assert estimate.model == "unaided"
    assert abs(estimate.misalignment[1] - 0.03) < 3.0 * estimate.std[1]


def test_an_imu_that_starts_late_changes_little(rng):
    """Samples without attitude have a sway of their own, which is no current."""
    samples = run_without_gnss((20.0, 200.0), (0.2, -0.1), (0.0, 0.0, 0.04), rng)
    late = [each for each in samples if isinstance(each, DvlSample) or each.stamp_ns > 30 * SECOND]
    whole, part = (calibrate(each, Parameters(current_std=0.3)).estimate("unaided") for each in (samples, late))
    assert part.used == whole.used
    assert part.misalignment[2] == pytest.approx(0.04, abs=0.006)


def test_unaided_finds_more_of_the_angle_than_m7_on_a_straight_run(rng):
    samples = run_without_gnss((20.0,), (0.0, 0.0), (0.0, 0.03, -0.04), rng, seconds_each=400)
    calibrator = calibrate(samples, Parameters(current_std=0.05))
    truth = np.array([0.0, 0.03, -0.04])
    errors = {name: np.abs(calibrator.estimate(name).misalignment - truth)[1:] for name in ("M7", "unaided")}
    assert (errors["unaided"] < 0.8 * errors["M7"]).all()


@pytest.mark.slow
def test_a_faster_dvl_does_not_make_the_models_of_motion_surer():
    run = MatchedRun("box", 300.0, dvl_std=0.01)
    slow, fast = (calibrate(make_samples(replace(run, dvl_every=every))) for every in (100, 10))
    np.testing.assert_allclose(fast.estimate("unaided").std[:3], slow.estimate("unaided").std[:3], rtol=0.2)


def test_corrected_velocities_use_the_errors_not_the_nuisance():
    estimate = calibrate(make_samples(MatchedRun("box", 60.0, phi=(0.0, 0.0, 0.02)))).estimate("unaided")
    velocity = np.array([[1.5, 0.1, 0.0]])
    expected = correct(velocity, estimate.state[:3], np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(estimate.corrected_velocity(velocity, np.eye(3)), expected)


# ---------------------------------------------------------------------- unaided: the path is level


STEP_S, SPEED = 0.2, 1.4
ROLL, PITCH, YAW = (math.radians(each) for each in (0.5, -1.0, 2.0))


def pitch_found(climb, error_up: float) -> tuple[float, float]:
    """Return error and σ of the pitch, degrees, of legs to four courses. climb: m/s of times (N,) s."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 480.0, STEP_S)
    course = np.convolve(np.radians(90.0) * (time // 60.0), np.ones(20) / 20.0, "same")
    up = climb(time)
    roll = 0.02 * np.sin(1.2 * time)
    pitch = 0.02 * np.sin(time) - np.arcsin(up / SPEED)
    turns = np.array([rotation_from_rpy(each) for each in zip(roll, pitch, course, strict=True)])
    earth = np.column_stack([SPEED * np.cos(course), SPEED * np.sin(course), up])
    body = np.einsum("nji,nj->ni", turns, earth)
    change = np.einsum("nji,njk->nik", turns[:-1], turns[1:]) / STEP_S
    rates = np.column_stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]])
    rates = np.vstack([rates, rates[-1:]])
    dvl = body @ rotation_from_rpy((ROLL, PITCH, YAW)) + rng.normal(0.0, 0.01, body.shape)
    reference = earth + np.array([0.0, 0.0, error_up]) + rng.normal(0.0, 0.02, earth.shape)
    samples: list[DvlSample | ReferenceSample | ImuSample] = []
    for at in range(len(time)):
        stamp = START_NS + round(1e9 * time[at])
        samples.append(ImuSample(stamp, quaternion_from_rotation(turns[at]), tuple(rates[at])))
        samples.append(ReferenceSample(stamp, tuple(reference[at]), None, VelocityFrame.ENU))
        samples.append(DvlSample(stamp + 1000, tuple(dvl[at])))
    calibrator = calibrate(samples, Parameters())
    calibrator.finish()
    estimate = calibrator.result().estimate
    return math.degrees(-estimate.misalignment[1] - PITCH), math.degrees(estimate.recording_std[1])


def test_a_vertical_error_of_the_reference_does_not_turn_a_level_vehicles_pitch():
    off, std = pitch_found(lambda time: 0.0 * time, 0.06)
    assert abs(off) < min(2.0 * std, 0.5) and std < 0.7  # of 0.06 m/s it would be 2.5 degrees


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    "climb",
    [
        pytest.param(lambda time: np.where(time < 60.0, -0.17, 0.0), id="dives, then level"),
        pytest.param(lambda time: 0.15 * np.sin(0.03 * time), id="yo-yo"),
    ],
)
def test_a_vehicle_that_dives_keeps_its_pitch(climb):
    off, std = pitch_found(climb, 0.0)
    assert abs(off) < 2.0 * std and abs(off) < 1.0


# ---------------------------------------------------------------------- relative height


def test_a_vehicle_that_rises_is_higher_by_as_much_and_in_what_blocks_it_comes_changes_nothing(rng):
    stamps_ns = np.cumsum(rng.integers(SECOND // 10, SECOND, 40))
    rising = rng.normal(0.0, 0.3, 40)
    whole = RelativeHeight().add(stamps_ns, rising)
    parts = RelativeHeight()
    np.testing.assert_array_equal(
        np.concatenate([parts.add(stamps_ns[at], rising[at]) for at in (slice(0, 1), slice(1, 17), slice(17, 40))]),
        whole,
    )
    steps = np.diff(stamps_ns, prepend=stamps_ns[0]) * 1e-9
    np.testing.assert_allclose(whole, np.cumsum(rising * steps), atol=0.3)  # nearly nothing is forgotten in 20 s


def test_a_velocity_that_is_wrong_by_a_constant_adds_up_to_a_constant():
    stamps_ns = SECOND * np.arange(2000)
    heights = RelativeHeight().add(stamps_ns, np.full(2000, 0.05))
    assert heights[-1] == pytest.approx(0.05 * MEMORY_S, rel=1e-3)
    assert np.ptp(heights[1000:]) < 1e-3


def test_of_a_gap_nobody_knows_how_far_it_rose():
    height = RelativeHeight()
    before = height.add(SECOND * np.arange(10), np.full(10, 0.5))[-1]
    after = height.add(np.array([9 * SECOND + round((LONGEST_STEP_S + 1.0) * 1e9)]), np.array([0.5]))[0]
    assert 0.9 * before < after < before
    height.end_day()
    assert height.add(np.array([0]), np.array([0.5]))[0] == 0.0
