"""States of the heading's deviation and of the DVL's bias: as a fit with columns of their own, and σ holds what they
leave."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.calibration.filters import heading_bias as module
from dvl_calib_ros.calibration.filters.heading_bias import (
    N_BEFORE,
    N_BIAS,
    BlockTerms,
    HeadingEvidence,
    TermsOfBlock,
    block_terms,
    heading_states,
    prior_std,
    with_terms,
)
from dvl_calib_ros.calibration.filters.vertical_motion import HeaveSums
from dvl_calib_ros.calibration.numerics.block_covariance import TimeBlocks
from dvl_calib_ros.calibration.numerics.frames import skew
from dvl_calib_ros.calibration.numerics.kalman import GaussianState

N, ROWS, STD, PRIOR = 4, 30, math.radians(0.5), math.radians(5.0)
TURNS = np.eye(N, 3)  # of a DVL along the vehicle's axes
UP = TURNS[:, 2]
DRIFT_S = 10.0
EXACT = prior_std(STD, 0.0)  # of a DVL without a bias
BIAS = 0.01


def earth_in_body(yaw):
    """(M, 3, 2) of headings (M,) rad from east to the left."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    return np.stack([np.stack([c, s], -1), np.stack([-s, c], -1), np.stack([zero, zero], -1)], axis=1)


def columns(yaw, seconds, span, centre):
    """What coefficients make of the heading's error (5,)."""
    return np.array(
        [math.sin(yaw), math.cos(yaw), math.sin(2 * yaw), math.cos(2 * yaw), (seconds - centre) / span if span else 0.0]
    )


def heading_only(yaw, seconds):
    """TermsOfBlock of a block on one heading, of which no bias is told."""
    return block_terms(
        earth_in_body(np.full(ROWS, yaw)), np.zeros((ROWS, 3)), np.zeros((ROWS, 3)), np.ones(ROWS), seconds, TURNS, N
    )


def blocks_of(headings, rng, truth, noise=1.0, speed=100.0, lasting=0.0):
    """Blocks of rows z = H x + noise, and the same rows with columns of their own: H (R, N), z (R,), (R,) of which.

    truth: (5,) rad, coefficients. lasting: σ of an error that is the same for all of a block.
    """
    blocks, all_h, all_z, number = TimeBlocks(), [], [], []
    span, centre = DRIFT_S * (len(headings) - 1), DRIFT_S * (len(headings) - 1) / 2.0
    for b, yaw in enumerate(headings):
        h = rng.normal(0.0, 0.1, (ROWS, N))
        h[:, 2] = speed  # so that all blocks tell as much of yaw
        turned = columns(yaw, DRIFT_S * b, span, centre) @ truth
        z = h @ UP * turned + rng.normal(0.0, noise, ROWS) + rng.normal(0.0, lasting)
        terms = heading_only(yaw, DRIFT_S * b)
        blocks.add(*with_terms((h.T @ h)[None], (h.T @ z)[None], terms), ROWS)
        all_h.append(h)
        all_z.append(z)
        number += [b] * ROWS
    return blocks, np.concatenate(all_h), np.concatenate(all_z), np.array(number)


def without_deviation(h, z, prior=PRIOR):
    information = h.T @ h + np.eye(N) / prior**2
    p = np.linalg.inv(information)
    return GaussianState((p @ (h.T @ z))[None], p[None])


def test_it_equals_least_squares_with_columns_of_its_own(rng, monkeypatch):
    monkeypatch.setattr(module, "_FACTORS", np.ones(1))
    monkeypatch.setattr(module, "_LOG_LIKELY", np.zeros(1))
    headings = rng.uniform(-math.pi, math.pi, 7)  # too few for σ to be raised
    blocks, h, z, number = blocks_of(headings, rng, np.radians([1.0, -0.5, 0.2, 0.1, 0.3]))
    alone = without_deviation(h, z)
    found = heading_states([HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)], EXACT, UP)[0]
    span, informed = DRIFT_S * 6.0, np.bincount(number, (h @ UP) ** 2)
    centre = (informed @ (DRIFT_S * np.arange(7))) / informed.sum()
    own = np.array([columns(headings[b], DRIFT_S * b, span, centre) for b in number])
    wide = np.hstack([h, (h @ UP)[:, None] * own])
    std = np.concatenate([np.full(N, PRIOR), EXACT[N_BEFORE:]])
    p = np.linalg.inv(wide.T @ wide + np.diag(std**-2.0))
    x = p @ (wide.T @ z)
    np.testing.assert_allclose(alone.x[0] + found.shift[0], x[:N], rtol=1e-8, atol=1e-12)
    assert found.drifted == pytest.approx((x[-1] ** 2 + p[-1, -1]) / 12.0)  # when it was right is not known
    np.testing.assert_allclose(alone.p[0] + found.more[0], p[:N, :N], rtol=1e-8, atol=1e-14)
    scale = np.array([1.0, 1.0, 1.0, 1.0, 1.0 / span])  # a drift is told in rad/s
    np.testing.assert_allclose(found.coefficients.x, scale * x[N:], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.coefficients.p, np.outer(scale, scale) * p[N:, N:], rtol=1e-7, atol=1e-16)


BOX = np.tile(np.radians([10.0, 100.0, 190.0, 280.0]), 6)
LAWN = np.tile(np.radians([10.0, 190.0]), 12)
ONE = np.full(24, math.radians(10.0))


def yaw_of(headings, rng, truth, **more):
    blocks, h, z, _ = blocks_of(headings, rng, truth, **more)
    alone = without_deviation(h, z)
    found = heading_states([HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)], EXACT, UP)[0]
    x, p = alone.x[0] + found.shift[0], alone.p[0] + found.more[0]
    return x[2], math.hypot(math.sqrt(p[2, 2]) * found.inflation[2], math.sqrt(found.drifted)), found


def test_on_one_heading_sigma_of_yaw_holds_the_deviation_and_several_show_that_there_is_none(rng):
    sigma = {name: yaw_of(each, rng, np.zeros(5))[1] for name, each in {"one": ONE, "lawn": LAWN, "box": BOX}.items()}
    assert sigma["one"] > STD
    assert sigma["lawn"] < 0.3 * STD and sigma["box"] < 0.2 * STD


@pytest.mark.parametrize("headings", [BOX, LAWN], ids=["box", "lawnmower"])
def test_yaw_is_within_its_sigma_whatever_the_compass_does(headings):
    off = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        size = math.radians(float(np.exp(rng.uniform(math.log(0.1), math.log(2.0)))))
        truth = size * rng.normal(0.0, [1.0, 1.0, 0.5, 0.5, 1.0])
        yaw, std, _ = yaw_of(headings, rng, truth, lasting=10.0 * math.radians(0.2))
        off.append(yaw / std)
    off = np.abs(off)
    assert (off < 2.0).mean() > 0.9 and (off < 3.0).mean() > 0.97


def test_a_deviation_is_found_with_its_size(rng):
    truth = np.radians([2.0, -1.0, 0.0, 0.0, 0.0])
    _, _, found = yaw_of(BOX, rng, truth)
    np.testing.assert_allclose(found.coefficients.x[:2], truth[:2], atol=math.radians(0.1))
    assert np.sqrt(np.diag(found.coefficients.p))[:2].max() < math.radians(0.1)


def test_a_reference_in_the_body_says_nothing_of_the_heading_and_changes_nothing(rng):
    blocks, h, z, _ = blocks_of(BOX, rng, np.zeros(5))
    body = TimeBlocks()
    for information, vector in zip(*blocks.kept, strict=True):
        body.add(*with_terms(information[:, :N, :N], vector[:, :N], TermsOfBlock.none(UP)), ROWS)
    found = heading_states([HeadingEvidence.of(body, without_deviation(h, z), np.zeros(1, dtype=int), 0)], EXACT, UP)[0]
    assert not found.shift.any() and not found.more.any()


def test_terms_of_blocks_are_the_same_however_samples_come(rng):
    yaw, stamps_ns = rng.uniform(-3.0, 3.0, 40), np.arange(40) * 10**9
    earth, velocity = earth_in_body(yaw), rng.normal(0.0, 1.0, (40, 3))
    at_once, one_by_one = BlockTerms(TURNS, N), BlockTerms(TURNS, N)
    at_once.add(stamps_ns, earth, velocity, -velocity)
    expected = at_once.upto(np.array([15, 30]))
    found = []
    for n in range(40):
        one_by_one.add(stamps_ns[n : n + 1], earth[n : n + 1], velocity[n : n + 1], -velocity[n : n + 1])
        if n in (15, 30):
            found.append(one_by_one.upto(np.array([0]))[0])
    for one, other in [*zip(found, expected, strict=True), (at_once.rest(), one_by_one.rest())]:
        np.testing.assert_allclose(one.of_states, other.of_states, rtol=1e-13)
        np.testing.assert_allclose(one.pull, other.pull, rtol=1e-13)


def test_a_yaw_that_its_prior_does_not_expect_is_no_deviation(rng):
    blocks, h, z, _ = blocks_of(ONE, rng, np.zeros(5))
    z = z + h @ UP * math.radians(10.0)
    blocks = TimeBlocks()
    for b in range(len(ONE)):
        own = slice(b * ROWS, (b + 1) * ROWS)
        terms = heading_only(ONE[b], DRIFT_S * b)
        blocks.add(*with_terms((h[own].T @ h[own])[None], (h[own].T @ z[own])[None], terms), ROWS)
    alone = without_deviation(h, z, math.radians(3.0))
    found = heading_states([HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)], EXACT, UP)[0]
    assert abs(found.shift[0, 2]) < math.radians(0.7)
    assert math.sqrt(alone.p[0, 2, 2] + found.more[0, 2, 2]) < 2.0 * STD


@pytest.mark.parametrize(("constant", "by_heading"), [(3.0, 0.0), (-3.0, 0.0), (0.0, 1.5), (0.0, 0.0)])
def test_a_heading_that_is_wrong_is_no_roll_of_a_vehicle_that_leans_into_its_turns(constant, by_heading):
    """It turns about the vertical of the earth. A declination of 4 degrees was 1.7 of roll at sigma 0.17."""
    off = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        blocks, all_h, all_z = TimeBlocks(), [], []
        for b in range(24):
            yaw = b * 1.7 + np.linspace(0.0, 0.8, ROWS)
            turning = (np.arange(ROWS) > rng.integers(5, 25)) * (1.0 if b % 3 else -1.0)
            roll, velocity = math.radians(3.0) * turning, np.zeros((ROWS, 3))
            velocity[:, 0], velocity[:, 1] = 1.5, -0.06 * turning + rng.normal(0.0, 0.01, ROWS)
            lean = np.array([[[1, 0, 0], [0, math.cos(r), math.sin(r)], [0, -math.sin(r), math.cos(r)]] for r in roll])
            earth = lean @ earth_in_body(yaw)
            vertical = np.cross(earth[:, :, 0], earth[:, :, 1])
            delta = np.radians(constant + by_heading * np.sin(yaw))
            h = np.concatenate([rows_at(each) for each in velocity]) / 0.01
            z = (np.cross(velocity, vertical) * delta[:, None]).ravel() / 0.01 + rng.normal(0.0, 1.0, 3 * ROWS)
            terms = block_terms(earth, velocity, np.zeros((ROWS, 3)), np.ones(ROWS), DRIFT_S * b, TURNS, N)
            blocks.add(*with_terms((h.T @ h)[None], (h.T @ z)[None], terms), ROWS)
            all_h.append(h)
            all_z.append(z)
        alone = without_deviation(np.concatenate(all_h), np.concatenate(all_z))
        found = heading_states([HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)], EXACT, UP)[0]
        of = GaussianState(alone.x[0] + found.shift[0], alone.p[0] + found.more[0]).raised(found.inflation)
        off.append(of.x[0] / math.sqrt(of.p[0, 0]))
        assert of.x[2] == pytest.approx(math.radians(constant), abs=math.radians(0.5))  # it is in the yaw
    assert math.sqrt(np.mean(np.square(off))) < 1.7 and np.abs(off).max() < 3.0


def rows_at(velocity):
    """What misalignment and scale of all axes make of a reference less the DVL's velocity (3,): (3, 4)."""
    return np.column_stack([skew(velocity), -velocity])


def bias_terms(velocity):
    return block_terms(
        np.zeros((ROWS, 3, 2)), np.tile(velocity, (ROWS, 1)), np.zeros((ROWS, 3)), np.ones(ROWS), 0.0, TURNS, N
    )


def test_a_bias_is_to_one_velocity_the_same_as_a_misalignment_and_a_scale(rng):
    velocity = rng.normal(0.0, 1.0, 3)
    np.testing.assert_allclose(rows_at(velocity) @ bias_terms(velocity).of_states[:, :N_BIAS], -np.eye(3), atol=1e-12)


def biased(speeds, bias, rng, noise=0.03):
    """x (4,) and σ (4,) of blocks at these speeds ahead (B,) m/s, with a bias (3,) m/s; and the fit without one."""
    blocks, all_h, all_z = TimeBlocks(), [], []
    ahead = np.array([1.0, 0.0, 0.0])
    for speed in speeds:
        h = np.tile(rows_at(speed * ahead), (ROWS, 1)) / noise
        z = -np.tile(bias, ROWS) / noise + rng.normal(0.0, 1.0, 3 * ROWS)
        blocks.add(*with_terms((h.T @ h)[None], (h.T @ z)[None], bias_terms(speed * ahead)), ROWS)
        all_h.append(h)
        all_z.append(z)
    alone = without_deviation(np.concatenate(all_h), np.concatenate(all_z))
    seen = HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)
    found = heading_states([seen], prior_std(STD, BIAS), UP)[0]
    of = GaussianState(alone.x[0] + found.shift[0], alone.p[0] + found.more[0]).raised(found.inflation)
    return found.of_bias.at(0).added_to(of), found, alone


def test_at_one_speed_sigma_holds_the_bias_and_two_speeds_show_it(rng):
    bias = np.array([0.02, -0.02, 0.02])
    one, of_one, alone = biased(np.full(24, 1.5), bias, rng)
    assert abs(alone.x[0, 2]) > 10.0 * math.sqrt(alone.p[0, 2, 2])  # what was claimed before
    assert abs(one.x[2]) < 3.0 * math.sqrt(one.p[2, 2]) < 3.5 * BIAS / 1.5
    assert not of_one.shift.any() and not of_one.more.any()  # the best at the speeds driven, whatever the bias is
    no_bias, _, _ = biased(np.tile([0.5, 2.0], 12), np.zeros(3), rng)
    assert math.sqrt(no_bias.p[2, 2]) < 0.5 * BIAS / 1.5
    two, _, _ = biased(np.tile([0.5, 2.0], 12), bias, rng)
    assert abs(two.x[2]) < 3.0 * math.sqrt(two.p[2, 2])


def test_the_columns_of_a_bias_are_by_how_much_it_takes_the_states_off_as_far_as_speeds_do_not_show_it():
    def taken_off(speeds):
        free, of_bias = (biased(speeds, BIAS * np.eye(3)[0] * k, np.random.default_rng(3)) for k in (0.0, 1.0))
        return of_bias[0].x - free[0].x, free[1].of_bias.columns[0]

    off, columns = taken_off(np.full(6, 1.5))
    np.testing.assert_allclose(columns[:, 0], off, rtol=5e-3, atol=1e-6)
    off, columns = taken_off(np.tile([0.5, 2.0], 3))
    assert abs(columns[3, 0]) < 0.5 * abs(off[3])


def test_a_bias_is_in_sigma_as_it_is_likely_whatever_the_speeds():
    """Its size drawn from its prior: what the states are off by has the size that σ says."""
    off = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        found, _, _ = biased(rng.uniform(0.7, rng.uniform(0.7, 2.5), 12), rng.normal(0.0, BIAS, 3), rng)
        off.append(found.x[1:] / np.sqrt(np.diag(found.p)[1:]))
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(off), axis=0)), 1.0, atol=0.15)


def test_what_says_that_a_vehicle_does_not_heave_makes_no_bias_of_trim(rng):
    speed, trim = 1.5 * np.array([1.0, 0.0, 0.0]), math.radians(4.0)
    told, h, terms = TimeBlocks(), rows_at(speed) / 0.03, bias_terms(speed)
    for _ in range(7):
        told.add(*with_terms((h.T @ h)[None], np.zeros((1, N)), terms), 1.0)
    # the vertical as of the vehicle, which moves by its trim: as another pitch
    row, off = h[2], h[2, 1] * trim
    heave, of_heave = np.outer(row, row)[None], (row * off)[None]
    total = 7.0 * h.T @ h + heave[0] + np.eye(N) / PRIOR**2
    p = np.linalg.inv(total)
    state = GaussianState((p @ of_heave[0])[None], p[None])
    one_row = np.concatenate([0.03 * row, [0.03 * off]])[None]
    outer = one_row[:, :, None] * one_row[:, None]
    rows = HeaveSums(outer, outer, np.append(one_row, [[1.0]], axis=1), np.ones(1))
    where = np.zeros(1, dtype=int), 0
    wider = [
        heading_states([HeadingEvidence.of(told, state, *where, beside)], prior_std(STD, BIAS), UP)[0].of_bias
        for beside in (None, rows.with_terms(0.03**2, np.array([0.0, 0.0, 1.0])))
    ]
    a_bias = BIAS / 1.5  # of pitch
    std = [math.sqrt(each.covariance[0, 1, 1]) for each in wider]
    assert std[0] > 1.1 * a_bias and std[1] == pytest.approx(a_bias, rel=0.01)
