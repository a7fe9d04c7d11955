"""The truth of the second generator of recordings, and the judge of its trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from validation.second_recordings import (
    START_S,
    TYPES,
    Case,
    Noise,
    dvl_velocity,
    motion_of,
    residual,
    rotation,
    streams_of,
    write,
)
from validation.second_trial import KINDS, TABLE, TIMES, draw, is_right, sizes_of, true_closure, visibility

pytestmark = pytest.mark.slow
LATE_S = 0.3


@pytest.fixture
def boat() -> Case:
    return Case((4, 0), "boat", "zigzag", 160.0, (5.0, 5.0, 50.0), (0.0, 0.0, np.pi / 4), (0.4, 0.1, -0.2),
                (0.01, -0.02, 0.03), 0.006, Noise("white", 0.01, 0.02, (0.7, 1.5)))  # fmt: skip


def test_the_residual_of_a_null_is_its_noise(boat):
    dvl, reference, imu = streams_of(boat, motion_of(boat))
    times = dvl.stamps[5:-5]
    seen = np.stack([np.interp(times, imu.stamps, each) for each in (imu.clean + imu.noise).T], -1)
    earth = np.stack([np.interp(times, reference.stamps, each) for each in reference.clean.T], -1)
    body = rotation(seen[:, :3]).inv().apply(earth) + np.cross(seen[:, 3:6], boat.arm_m)
    difference = (dvl.clean + dvl.noise)[5:-5] - body @ boat.calibration.T
    # all but the noise: attitude of 0.02 degrees at 2 m/s, rates, interpolation between samples in waves
    assert np.std(difference - dvl.noise[5:-5]) < 0.005
    assert np.std(difference, axis=0) == pytest.approx([0.01, 0.01, 0.007], rel=0.15)


@pytest.mark.parametrize(("name", "sign"), [("dvl_time_offset", 1), ("reference_time_offset", -1)])
def test_a_delay_is_found_by_correlation(boat, name, sign):
    dvl, reference, imu = streams_of(replace(boat, effects={name: {"seconds": LATE_S}}), motion_of(boat))
    grid = np.arange(10.0, 150.0, 0.02)
    ahead = (dvl.clean + dvl.noise) @ np.linalg.inv(boat.calibration).T
    seen = np.stack([np.interp(grid, imu.stamps, each) for each in imu.clean[:, :3].T], -1)
    earth = np.stack([np.interp(grid, reference.stamps, each) for each in (reference.clean + reference.noise).T], -1)
    fast = rotation(seen).inv().apply(earth)[:, 0]
    lags = np.arange(-0.6, 0.61, 0.02)
    agreement = [np.corrcoef(np.interp(grid + lag, dvl.stamps, ahead[:, 0]), fast)[0, 1] for lag in lags]
    assert lags[np.argmax(agreement)] == pytest.approx(sign * LATE_S, abs=0.061)


def test_a_seed_is_one_case_and_kinds_of_noise_take_turns():
    assert draw(31, 3) == draw(31, 3)
    first, again = (streams_of(case, motion_of(case)) for case, _ in (draw(31, 1), draw(31, 1)))
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.clean + one.noise, other.clean + other.noise)
    assert {draw(31, number, only="null")[0].noise.kind for number in range(len(KINDS))} == set(KINDS)


def test_effects_are_as_large_as_their_q_and_leave_nothing_when_they_are_found(boat):
    motion = motion_of(boat)
    for name, given in TABLE.items():
        one = replace(boat, effects={name: given(np.random.default_rng(3), boat.seconds)})
        half = {name: {key: each if key in TIMES else each / 2 for key, each in one.effects[name].items()}}
        alone, left = visibility(one, motion)[name]
        assert alone == left > 0.0, name
        smaller = visibility(replace(one, effects=half), motion)[name][0]
        assert smaller == pytest.approx(alone / 2, rel=0.25), name
        assert true_closure(one, motion, one.effects) == pytest.approx(1.0), name
        assert true_closure(one, motion, half) == pytest.approx(0.75, abs=0.12), name
        assert true_closure(one, motion, {}) == pytest.approx(0.0), name


def test_what_falls_into_a_drop_out_is_not_visible(boat):
    gaps = replace(boat, noise=replace(boat.noise, kind="gaps", gaps=(0, 1)))
    times = streams_of(gaps, motion_of(gaps))[1].measured
    begin = int(np.argmax(np.diff(times)))
    passage = {"rad": 0.5, "at_s": float(times[begin : begin + 2].mean()), "width_s": 0.5}
    cases = (replace(each, effects={"magnetic_passage": passage}) for each in (boat, gaps))
    seen, lost = (visibility(each, motion_of(each))["magnetic_passage"][0] for each in cases)
    assert seen > 20.0 and lost < 0.1 * seen


def test_a_lever_arm_ahead_is_omega_cross_arm(boat):
    motion, stamps = motion_of(boat), np.arange(0.0, 150.0, 0.2)
    straight = replace(boat, mounting_rpy=(0.0, 0.0, 0.0), misalignment_rad=(0.0, 0.0, 0.0), scale=0.0)
    difference = residual(straight, motion, {"lever_arm": {"x_m": 0.5}}, stamps)
    np.testing.assert_allclose(difference[:, 1], 0.5 * motion.at(stamps).rate[:, 2], atol=1e-12)


@pytest.mark.parametrize("name", ["mount_flexure", "misalignment_drift"])
def test_a_mounting_that_turns_measures_the_same_speed(boat, name):
    motion, per = motion_of(boat), {"mount_flexure": "rad_per_mps", "misalignment_drift": "rad_per_hour"}[name]
    effects = {name: {f"y_{per}": 0.07, f"z_{per}": -0.1}}
    without, turned = (dvl_velocity(boat, motion, each) for each in ({}, effects))
    speeds = (np.linalg.norm(each, axis=1) for each in (without, turned))
    np.testing.assert_allclose(*speeds, rtol=1e-12)


def test_the_bag_holds_the_streams_with_stamps_that_are_late(boat, tmp_path):
    late = replace(boat, effects={"dvl_time_offset": {"seconds": LATE_S}})
    write(late, tmp_path / "bag")
    dvl = streams_of(late, motion_of(late))[0]
    with AnyReader([tmp_path / "bag"], default_typestore=TYPES) as reader:
        chosen = [each for each in reader.connections if each.topic == "dvl/twist"]
        sent = [reader.deserialize(raw, each.msgtype) for each, _, raw in reader.messages(chosen)]
    stamps = [each.header.stamp.sec - START_S + each.header.stamp.nanosec * 1e-9 for each in sent]
    linear = [[each.twist.twist.linear.x, each.twist.twist.linear.y, each.twist.twist.linear.z] for each in sent]
    np.testing.assert_allclose(stamps, dvl.measured + LATE_S, atol=1e-6)
    np.testing.assert_array_equal(linear, dvl.clean + dvl.noise)
    assert sent[0].twist.covariance[0] == pytest.approx(0.01**2)


def test_answers_are_judged_by_the_sets_they_name():
    truth = ["lever_arm", "clock_drift"]
    assert is_right("several", truth, "known", [["clock_drift", "lever_arm"]])
    assert is_right("several", truth, "ambiguous", [["clock_drift", "sideslip"], ["clock_drift", "lever_arm"]])
    assert not is_right("several", truth, "known", [["lever_arm"]])
    assert not is_right("several", truth, "known", [["lever_arm", "clock_drift", "sideslip"]])
    assert not is_right("several", truth, "unknown", [truth])
    assert is_right("null", [], "no_gap", []) and not is_right("null", [], "unknown", [])
    assert is_right("outside", ["thrust_bias"], "unknown", []) and not is_right("outside", ["x"], "no_gap", [])


@pytest.mark.parametrize("name", ["lever_arm", "reference_time_offset"])
def test_an_arm_that_is_known_together_with_a_clock_brings_that_clock(name):
    value = {"lever_arm": {"x_m": {"value": -0.05}}, "reference_time_offset": {"seconds": {"value": -0.15}}}[name]
    both = {"parameter": "x_m", "clock": "reference_time_offset", "speed_mps": -1.2,
            "arm_less_speed_times_delay_m": {"value": -0.23}}  # fmt: skip
    assert sizes_of([{"name": name, "parameters": value, "combination": both}]) == {
        "lever_arm": {"x_m": pytest.approx(-0.05)}, "reference_time_offset": {"seconds": pytest.approx(-0.15)}
    }  # fmt: skip
