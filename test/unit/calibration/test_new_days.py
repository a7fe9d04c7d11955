"""What belongs to the day is found anew on another: recordings taken together have one lever arm and a delay each."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from runs import START_NS, altered, calibrate, feed_columns, pushed, shifted
from test_full import LEVER_ARM, NOISE, PHI, late

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.filters.cross_validation import with_states_of
from dvl_calib_ros.calibration.models.own import DELAY, FULL
from dvl_calib_ros.calibration.models.own import LEVER_ARM as LEVER_ARM_STATES
from dvl_calib_ros.calibration.numerics.block_covariance import TimeBlocks
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ReferenceSample
from dvl_calib_ros.calibration.streams.stream_order import NewDays

SECOND_NS = 1_000_000_000
NIGHT_NS = 86_400 * SECOND_NS
DELAYS = (-1.4, 0.6)


def off(samples, east_north):
    """The same with a reference that is off by so much all along, m/s."""
    return pushed(samples, ReferenceSample, lambda _: [*east_north, 0.0])


@cache
def two_days(pause_ns: int = NIGHT_NS):
    """Two runs of one vehicle, each with its own delay of the DVL and its own error of the reference."""
    first = off(late(DELAYS[0]), (0.012, -0.008))
    second = off(late(DELAYS[1], seed=1), (-0.01, 0.01))
    return [*first, *shifted(second, pause_ns)]


@cache
def found() -> Calibrator:
    """What is made of them; not to be fed any more."""
    return calibrate(two_days(), NOISE, verified=True)


def test_two_days_have_one_lever_arm_and_a_delay_and_a_reference_offset_each():
    calibrator = found()
    estimate, days = calibrator.estimate("full"), calibrator.days
    error = estimate.state[LEVER_ARM_STATES] - LEVER_ARM
    assert np.all(np.abs(error) < 3.5 * estimate.recording_std[LEVER_ARM_STATES])
    assert np.all(np.abs(error[:2]) < 0.04)
    assert np.all(np.abs(estimate.state[:3] - PHI) < 4.0 * estimate.std[:3])
    assert [day.first_ns for day in days] == [START_NS + round(DELAYS[0] * 1e9), START_NS + NIGHT_NS + 600_000_000]
    for day, delay, offset in zip(days, DELAYS, ((0.012, -0.008), (-0.01, 0.01)), strict=True):
        assert day.shown
        assert abs(day.dvl_time_offset - delay) < min(0.03, 3.5 * day.dvl_time_offset_std)
        assert np.all(np.abs(np.subtract(day.reference_offset, offset)) < 4.0 * np.array(day.reference_offset_std))
    assert estimate.state[DELAY] == days[-1].dvl_time_offset


def test_both_days_are_worth_more_than_either():
    std = found().estimate("full").filter_std[LEVER_ARM_STATES]
    for seed, delay in enumerate(DELAYS):
        alone = calibrate(late(delay, seed=seed), NOISE).estimate("full").filter_std[LEVER_ARM_STATES]
        assert np.all(std[:2] < 0.85 * alone[:2])


def test_held_out_samples_are_judged_with_the_delay_of_their_own_day():
    verification = found().verification("full")
    assert verification.verdict.value == "accept"
    assert verification.held_out.corrected < 0.05 < verification.held_out.uncorrected


@pytest.mark.slow
def test_how_samples_are_gathered_changes_nothing_about_days():
    one, other = found(), calibrate(two_days(), NOISE, block_size=40, verified=True)
    for name in ("full", "unaided"):
        a, b = one.estimate(name), other.estimate(name)
        np.testing.assert_allclose(a.state, b.state, rtol=0, atol=1e-12)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-12)
    for a, b in zip(one.days, other.days, strict=True):
        assert a.first_ns == b.first_ns
        assert a.dvl_time_offset == pytest.approx(b.dvl_time_offset, abs=1e-12)
    assert [each.model for each in one.selection.segments] == [each.model for each in other.selection.segments]


def test_a_dive_that_is_interrupted_for_minutes_is_one_day():
    calibrator = calibrate(two_days(600 * SECOND_NS), NOISE)
    assert calibrator.days == ()


def test_recordings_that_are_named_are_days_however_short_the_time_between_them():
    pause_ns = 300 * SECOND_NS
    between_ns = START_NS + 225 * SECOND_NS
    calibrator = Calibrator(NOISE, recordings_ns=[between_ns])
    feed_columns(calibrator, two_days(pause_ns))
    assert [round(day.dvl_time_offset, 1) for day in calibrator.days] == list(DELAYS)


def test_a_day_that_shows_no_delay_claims_none_and_the_lever_arm_stays():
    calibrator = Calibrator(NOISE)
    feed_columns(calibrator, late(DELAYS[0]))
    before = calibrator.estimate("full")
    slow = altered(late(0.0), (DvlSample, ReferenceSample), velocity=(0.1, 0.0, 0.0))
    feed_columns(calibrator, shifted(slow, NIGHT_NS))
    after = calibrator.estimate("full")
    # the last blocks of the first day were still waiting for what may belong to them
    assert np.all(np.abs(after.state - before.state)[LEVER_ARM_STATES] < before.std[LEVER_ARM_STATES])
    assert abs(after.state[DELAY]) < 0.1 and after.std[DELAY] > 0.9
    assert [day.shown for day in calibrator.days] == [True, False]


# ---------------------------------------------------------------------- parts


def test_days_begin_with_a_pause_or_a_recording_by_stamps_alone():
    days = NewDays(3600 * SECOND_NS, [1000 * SECOND_NS])
    assert days.begins(5000 * SECOND_NS, 3601 * SECOND_NS)
    assert not days.begins(5000 * SECOND_NS, 3599 * SECOND_NS)
    assert days.begins(1001 * SECOND_NS, 16 * SECOND_NS)
    assert not days.begins(1001 * SECOND_NS, 14 * SECOND_NS)  # the next file of the same recording
    assert not days.begins(1101 * SECOND_NS, 100 * SECOND_NS)


def test_blocks_of_a_day_that_is_over_say_of_what_goes_on_what_they_said_with_the_day_solved():
    """The sum of what is left of blocks is the Schur complement, and scores sum to zero where they did."""
    rng = np.random.default_rng(0)
    n, of_day = 4, np.array([2, 3])
    blocks, information, vector = TimeBlocks(), np.zeros((1, n, n)), np.zeros((1, n))
    for _ in range(10):
        h = rng.normal(size=(20, n))
        z = h @ [1.0, -2.0, 0.5, 3.0] + rng.normal(size=20)
        blocks.add((h.T @ h)[None], (h.T @ z)[None], 20.0)
        information, vector = information + h.T @ h, vector + h.T @ z
    p = np.linalg.inv(information[0])
    x = p @ vector[0]
    blocks.end_day(of_day, information, vector, np.array([0]))
    left, rest = (each.sum(axis=0)[0] for each in blocks.kept)
    np.testing.assert_allclose(np.linalg.inv(left[:2, :2]), p[:2, :2], rtol=1e-9)
    np.testing.assert_allclose(rest[:2], left[:2, :2] @ x[:2], rtol=1e-9)
    assert not left[2:].any() and not rest[2:].any()


def test_another_day_leaves_what_belongs_to_the_vehicle_as_it_is():
    rng = np.random.default_rng(1)
    n, of_day = FULL.n_state, FULL.of_day
    root = rng.normal(size=(n, n))
    state = GaussianState(rng.normal(size=n), root @ root.T)
    start = GaussianState(np.zeros(n), np.eye(n))
    x, p = with_states_of(state, start, of_day)
    on = np.setdiff1d(np.arange(n), of_day)
    np.testing.assert_array_equal(x[on], state.x[on])
    np.testing.assert_array_equal(p[np.ix_(on, on)], state.p[np.ix_(on, on)])
    assert not x[of_day].any() and not p[np.ix_(on, of_day)].any()
    np.testing.assert_array_equal(p[np.ix_(of_day, of_day)], np.eye(len(of_day)))
