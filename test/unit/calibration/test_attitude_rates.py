"""The IMU: conventions that contradict each other, a compass that deviates, and how it is mounted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.checks.heading_deviation import heading_deviation, heading_warning
from dvl_calib_ros.calibration.checks.imu_rate_consistency import CONVENTIONS, AttitudeRates
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import (
    ENU_FROM_NED,
    attitude_enu_flu_from_ned_frd,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
)
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.numerics.samples import (
    DvlSample,
    ImuSample,
    ReferenceSample,
    Stream,
    VelocityFrame,
    sample_block,
)
from dvl_calib_ros.calibration.streams.imu_frame import ImuAlignment

RATE_HZ, TILT = 20.0, np.radians(2.0)


def vehicle(seconds=120.0, turning=0.1, tilt=TILT, rate_hz=RATE_HZ, seed=0):
    """Times, quaternions and body rates of a vehicle that turns both ways and rolls and pitches in waves."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0.0, seconds, 0.005)
    yaw = 0.5 + np.cumsum(turning * np.sign(np.sin(2 * np.pi * fine / 60.0))) * 0.005
    roll, pitch = tilt * np.sin(1.05 * fine), tilt * np.sin(0.8 * fine + 1.0)
    rotation = rotation_from_rpy(np.column_stack([roll, pitch, yaw]))
    step = np.einsum("nji,njk->nik", rotation[:-1], rotation[1:])
    rates = np.column_stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]]
    )
    rates *= 0.5 / 0.005
    every = round(200.0 / rate_hz)
    times, rotation, rates = fine[:-1:every], rotation[:-1:every], rates[::every]
    orientation = np.array([quaternion_from_rotation(each) for each in rotation])
    noise = 0.0005 * rng.normal(size=orientation.shape)
    orientation = (orientation + noise) / np.linalg.norm(orientation + noise, axis=1, keepdims=True)
    return times, orientation, rates + 0.001 * rng.normal(size=rates.shape)


def says(times, orientation, rates, blocks=1):
    checked = AttitudeRates()
    for part in np.array_split(np.arange(len(times)), blocks):
        checked.add(times[part], orientation[part], rates[part])
    return checked.contradiction()


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 20.0, 100.0])
@pytest.mark.parametrize("turning", [0.0, 0.1, 0.5])
def test_of_an_imu_that_is_right_nothing_is_said(rate_hz, turning):
    assert says(*vehicle(rate_hz=rate_hz, turning=turning), blocks=12) is None


@pytest.mark.parametrize(
    "wrong",
    [
        lambda t, q, w: (t, q, w + np.array([0.01, -0.01, 0.005])),  # a bias
        lambda t, q, w: (t[3:], q[:-3], w[3:]),  # an attitude that is late by 0.15 s
        lambda t, q, w: (t, q, 0.9 * w),
        lambda t, q, w: (t, -q, w),  # the same attitude
    ],
)
def test_what_an_ordinary_imu_does_is_no_other_convention(wrong):
    assert says(*wrong(*vehicle())) is None


def inverted(q):
    return q * [-1, -1, -1, 1]


def compass(q, tilted=1.0):
    """Yaw as a compass counts it (0 = north, clockwise), in an ENU quaternion."""
    r = rotation_from_quaternion(q)
    yaw = np.pi / 2 - np.arctan2(r[:, 1, 0], r[:, 0, 0])
    pitch, roll = -np.arcsin(r[:, 2, 0]), np.arctan2(r[:, 2, 1], r[:, 2, 2])
    rpy = np.column_stack([tilted * roll, tilted * pitch, yaw])
    return np.array([quaternion_from_rotation(each) for each in rotation_from_rpy(rpy)])


def in_earth(q, w, earth=None):
    in_enu = np.einsum("nij,nj->ni", rotation_from_quaternion(q), w)
    return in_enu if earth is None else in_enu @ earth.T


@pytest.mark.parametrize(
    ("wrong", "code", "numbers"),
    [
        (lambda q, w: (q, -w), "RATES_NEGATED", {}),
        (lambda q, w: (q, 0.5 * w), "RATES_SCALED", {"times": 0.5}),
        (lambda q, w: (q, np.degrees(w)), "RATES_DEGREES", {}),
        (lambda q, w: (q, w * [1, -1, -1]), "IMU_AXES_MIXED", {}),
        (lambda q, w: (q, w[:, [1, 0, 2]]), "RATES_EXCHANGED", {"axes": "y, x, z"}),
        (lambda q, w: (q, w @ rotation_from_rpy([0.0, 0.0, 0.8])), "RATES_TURNED", {"degrees": 45.8}),
        (lambda q, w: (q, in_earth(q, w)), "RATES_IN_EARTH", {"frame": "ENU"}),
        (lambda q, w: (q, in_earth(q, w, ENU_FROM_NED)), "RATES_IN_EARTH", {"frame": "NED"}),
        (lambda q, w: (compass(q), w), "HEADING_CLOCKWISE", {}),
        (lambda q, w: (compass(q, tilted=0.0), w), "HEADING_CLOCKWISE", {}),
        (lambda q, w: (inverted(q), w), "ATTITUDE_INVERTED", {}),
    ],
)
def test_each_mix_of_conventions_is_named(wrong, code, numbers):
    times, orientation, rates = vehicle()
    found = says(times, *wrong(orientation, rates), blocks=12)
    (cause,) = [each for each in found.causes if each.code == code]
    is_number = code in ("RATES_SCALED", "RATES_TURNED")
    assert cause.numbers == (pytest.approx(numbers, rel=0.02) if is_number else numbers)


def test_nothing_is_said_of_too_little():
    times, orientation, rates = vehicle()
    assert says(times[:200], orientation[:200], -rates[:200]) is None
    still = vehicle(turning=0.0, tilt=1e-4)
    assert says(still[0], still[1], -still[2]) is None
    nothing = np.full_like(rates, np.nan)
    assert says(times, orientation, nothing) is None


def test_all_ways_to_exchange_and_negate_axes_are_looked_at_once():
    matrices = {tuple(matrix.ravel()) for _, matrix in CONVENTIONS}
    assert len(matrices) == len(CONVENTIONS) == 6 * 8 - 1


def test_rates_that_are_zero_while_the_attitude_turns_are_none():
    times, orientation, rates = vehicle()
    assert says(times, orientation, 0.0 * rates).code == "IMU_NO_RATES"
    still = np.tile(orientation[:1], (len(times), 1))
    assert says(times, still, 0.0 * rates) is None


def test_an_attitude_without_roll_and_pitch_is_a_heading_alone():
    for tilt, is_level in ((TILT, False), (0.0, True)):
        checked = AttitudeRates()
        times, orientation, rates = vehicle(tilt=tilt)
        if is_level:
            orientation[:, :2] = 0.0
            orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
        checked.add(times, orientation, rates)
        assert checked.is_level is is_level


BIAS = np.array([0.004, -0.003, 0.006])


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0])
def test_the_bias_of_the_gyroscopes_is_what_the_attitude_does_not_turn_by(rate_hz):
    checked = AttitudeRates()
    times, orientation, rates = vehicle(rate_hz=rate_hz)
    for part in np.array_split(np.arange(len(times)), 12):
        checked.add(times[part], orientation[part], rates[part] + BIAS)
    np.testing.assert_allclose(checked.bias, BIAS, atol=3e-4)
    checked.end_day()
    assert not checked.bias.any()


def test_what_is_no_bias_of_the_gyroscopes_is_not_removed():
    times, orientation, rates = vehicle()
    level = orientation * [0.0, 0.0, 1.0, 1.0]
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    for wrong in (
        (times, level, rates + BIAS),
        (times, orientation, -rates),
        (times[:1], orientation[:1], BIAS[None]),
    ):
        checked = AttitudeRates()
        checked.add(*wrong)
        assert not checked.bias.any()


# ---------------------------------------------------------------------- a compass that deviates


START_NS, STEP_S, LEG_S = 1_600_000_000_000_000_000, 0.5, 40.0
YAW = math.radians(1.0)  # of the DVL in the vehicle


def recorded(seed, off, offset=(0.0, 0.0), legs=16, every=math.pi / 4.0, **parameters):
    """Legs of 40 s at 1 m/s, each turned by `every` from the one before; off: (yaw, s) -> by what the heading is off.

    offset: m/s, of the reference east and north. Returns the calibrator, times (N,) and true yaws (N,).
    """
    rng = np.random.default_rng(seed)
    exact_dvl = Parameters(gnss_aided_std=0.03, dvl_bias_std=0.0, **parameters)
    calibrator = Calibrator(exact_dvl, block_size=64, models=("full",))
    time = np.arange(0.0, LEG_S * legs, STEP_S)
    yaw = np.floor(time / LEG_S) * every + 0.2
    for at, heading in zip(time.tolist(), yaw.tolist(), strict=True):
        stamp = START_NS + round(at * 1e9)
        turned = rotation_from_rpy([0.0, 0.0, heading + off(heading, at)])
        velocity = rotation_from_rpy([0.0, 0.0, heading])[:, 0] + (*offset, 0.0) + rng.normal(0.0, 0.03, 3)
        dvl = rotation_from_rpy([0.0, 0.0, YAW])[:, 0] + rng.normal(0.0, 0.005, 3)
        calibrator.feed_imu(ImuSample(stamp, quaternion_from_rotation(turned), (0.0, 0.0, 0.0)))
        calibrator.feed_reference(ReferenceSample(stamp, tuple(velocity.tolist()), None, VelocityFrame.ENU))
        calibrator.feed_dvl(DvlSample(stamp, tuple(dvl.tolist())))
    calibrator.finish()
    return calibrator, time, yaw


def deviation(*args, **more):
    calibrator, _, yaw = recorded(*args, **more)
    return heading_deviation(yaw, calibrator.heading_deviation)


@pytest.mark.spread(1)
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, -0.009)])
def test_a_constant_error_of_the_heading_or_of_the_reference_is_no_deviation(offset):
    assert deviation(0, lambda *_: 0.02, offset) is None


@pytest.mark.spread(1)
@pytest.mark.parametrize("cycles", [1, 2])
def test_a_compass_that_deviates_is_found_with_its_size_and_headings(cycles):
    size = math.radians(2.0)
    found = deviation(1, lambda yaw, _: size * math.sin(cycles * yaw))
    assert found.rms == pytest.approx(size / math.sqrt(2.0), rel=0.25)
    if cycles == 1:  # most at the heading next to yaw 90 degrees, which is north
        assert min(found.most_at, 2.0 * math.pi - found.most_at) < 0.25
    said = heading_warning(found)
    assert said.code == "HEADING_DEVIATION" and "with the heading" in said.says and "compass first" not in said.remedy


@pytest.mark.slow
@pytest.mark.parametrize(
    ("every", "size"),
    [(math.pi / 4.0, 2.0), (math.pi, 2.0), (math.pi / 4.0, 0.0)],
    ids=["around", "to and fro", "none"],
)
def test_yaw_is_within_its_sigma(every, size):
    off = []
    for seed in range(4):
        deviates = lambda yaw, _, at=seed: math.radians(size) * math.sin(yaw + 1.6 * at)  # noqa: E731
        calibrator, *_ = recorded(seed, deviates, legs=16, every=every)
        estimate = calibrator.estimate("full")
        off.append((estimate.state[2] - YAW) / estimate.recording_std[2])
        assert estimate.recording_std[2] < math.radians(0.35 + 0.5 * size)
    assert np.abs(off).max() < 3.0, off


def test_on_one_heading_sigma_of_yaw_holds_what_the_heading_may_be_off_by():
    calibrator, *_ = recorded(0, lambda *_: math.radians(0.8), every=0.0, reference_offset_std=0.001)
    estimate = calibrator.estimate("full")
    assert math.radians(0.45) < estimate.recording_std[2] < math.radians(0.8)
    assert abs(estimate.state[2] - YAW) < 2.0 * estimate.recording_std[2]


def test_few_headings_or_nothing_at_all_say_nothing():
    assert deviation(3, lambda yaw, _: math.sin(yaw) * 0.05, legs=1) is None
    assert heading_deviation(np.zeros(0), GaussianState(np.zeros(4), np.eye(4))) is None


# ---------------------------------------------------------------------- how it is mounted


ANGLES = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)


def as_matrix(quaternion) -> np.ndarray:
    return Rotation.from_quat(quaternion).as_matrix()


@pytest.mark.parametrize("frame", ["enu", "ned"])
@given(mounting=ANGLES, attitude=ANGLES, rate=ANGLES)
def test_an_imu_that_is_mounted_turned_gives_the_bodys_attitude_and_rates(frame, mounting, attitude, rate):
    enu_from_body = Rotation.from_euler("xyz", attitude).as_matrix()
    body_from_imu = Rotation.from_euler("xyz", mounting).as_matrix()
    world_from_enu = ENU_FROM_NED.T if frame == "ned" else np.eye(3)
    measured = ImuSample(
        7,
        quaternion_from_rotation(world_from_enu @ enu_from_body @ body_from_imu),
        tuple((body_from_imu.T @ np.array(rate)).tolist()),
    )
    turned = ImuAlignment(Parameters(imu_rpy=mounting, imu_frame=frame)).sample(measured)
    assert turned.stamp_ns == 7
    np.testing.assert_allclose(as_matrix(turned.orientation), enu_from_body, atol=1e-12)
    np.testing.assert_allclose(turned.angular_velocity, rate, atol=1e-12)


def test_a_heading_offset_turns_the_attitude_about_the_vertical_and_leaves_the_rates():
    attitude, rate = Rotation.from_euler("ZYX", [0.7, -0.2, 0.1]), (0.1, 0.2, 0.3)
    measured = ImuSample(0, tuple(attitude.as_quat().tolist()), rate)
    turned = ImuAlignment(Parameters(heading_offset=0.4)).sample(measured)
    wanted = Rotation.from_euler("ZYX", [1.1, -0.2, 0.1])
    np.testing.assert_allclose(as_matrix(turned.orientation), wanted.as_matrix(), atol=1e-12)
    assert turned.angular_velocity == pytest.approx(rate)


def test_a_marine_imu_forward_right_down_in_north_east_down_is_imu_frame_ned_and_imu_rpy_pi():
    rpy_ned = (0.1, -0.2, 1.3)
    measured = ImuSample(0, quaternion_from_rotation(Rotation.from_euler("xyz", rpy_ned).as_matrix()), None)
    turned = ImuAlignment(Parameters(imu_rpy=(math.pi, 0.0, 0.0), imu_frame="ned")).sample(measured)
    np.testing.assert_allclose(as_matrix(turned.orientation), attitude_enu_flu_from_ned_frd(rpy_ned), atol=1e-12)
    assert turned.angular_velocity is None


def test_columns_are_turned_as_live_samples_are_and_what_is_not_given_stays_so():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(6, 7))
    values[:, :4] /= np.linalg.norm(values[:, :4], axis=1)[:, None]
    values[2, :4] = np.nan
    values[4, 4:] = np.nan
    alignment = ImuAlignment(Parameters(imu_rpy=(0.3, -0.1, 2.0), imu_frame="ned"))
    block = sample_block(Stream.IMU, np.arange(6), values)
    one_by_one = [alignment.sample(sample) for sample in block.samples()]
    assert list(alignment.block(block).samples()) == one_by_one
    assert one_by_one[2].orientation is None and one_by_one[4].angular_velocity is None


def test_without_its_parameters_samples_pass_as_the_same_objects():
    alignment = ImuAlignment(Parameters())
    sample = ImuSample(0, (0.0, 0.0, 0.0, 1.0), None)
    block = sample_block(Stream.IMU, np.arange(1), np.zeros((1, 7)))
    assert alignment.sample(sample) is sample and alignment.block(block) is block
