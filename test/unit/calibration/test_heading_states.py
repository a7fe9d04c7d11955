"""States of the heading's deviation: as a fit with columns of their own, and σ of yaw holds what they leave."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.calibration import heading_states as module
from dvl_calib_ros.calibration.heading_states import (
    BlockTerms,
    HeadingEvidence,
    heading_states,
    heading_terms,
    with_terms,
)
from dvl_calib_ros.calibration.kalman import GaussianState
from dvl_calib_ros.calibration.time_blocks import TimeBlocks

N, ROWS, STD, PRIOR = 4, 30, math.radians(0.5), math.radians(5.0)
UP = np.array([0.0, 0.0, 1.0, 0.0])
DRIFT_S = 10.0


def earth_in_body(yaw):
    """(M, 3, 2) of headings (M,) rad from east to the left."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    return np.stack([np.stack([c, s], -1), np.stack([-s, c], -1), np.stack([zero, zero], -1)], axis=1)


def columns(yaw, seconds, span, centre):
    """What coefficients make of the heading's error (5,)."""
    return np.array(
        [math.sin(yaw), math.cos(yaw), math.sin(2 * yaw), math.cos(2 * yaw), (seconds - centre) / span if span else 0.0]
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
        terms = heading_terms(earth_in_body(np.full(ROWS, yaw)), np.ones(ROWS), DRIFT_S * b)
        blocks.add(*with_terms((h.T @ h)[None], (h.T @ z)[None], terms, UP), ROWS)
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
    found = heading_states([HeadingEvidence.of(blocks, without_deviation(h, z), np.zeros(1, dtype=int), 0)], STD)[0]
    span, informed = DRIFT_S * 6.0, np.bincount(number, (h @ UP) ** 2)
    centre = (informed @ (DRIFT_S * np.arange(7))) / informed.sum()
    own = np.array([columns(headings[b], DRIFT_S * b, span, centre) for b in number])
    wide = np.hstack([h, (h @ UP)[:, None] * own])
    std = np.concatenate([np.full(N, PRIOR), STD * module._SHARE])
    p = np.linalg.inv(wide.T @ wide + np.diag(std**-2.0))
    x = p @ (wide.T @ z)
    alone = without_deviation(h, z)
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
    found = heading_states([HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)], STD)[0]
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
        body.add(*with_terms(information[:, :N, :N], vector[:, :N], np.zeros(module.N_TERMS), UP), ROWS)
    found = heading_states([HeadingEvidence.of(body, without_deviation(h, z), np.zeros(1, dtype=int), 0)], STD)[0]
    assert not found.shift.any() and not found.more.any()


def test_terms_of_blocks_are_the_same_however_samples_come(rng):
    yaw, stamps_ns = rng.uniform(-3.0, 3.0, 40), np.arange(40) * 10**9
    earth = earth_in_body(yaw)
    at_once, one_by_one = BlockTerms(), BlockTerms()
    at_once.add(stamps_ns, earth)
    expected = at_once.upto(np.array([15, 30]))
    found = []
    for n in range(40):
        one_by_one.add(stamps_ns[n : n + 1], earth[n : n + 1])
        if n in (15, 30):
            found.append(one_by_one.upto(np.array([0]))[0])
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    np.testing.assert_allclose(at_once.rest(), one_by_one.rest(), rtol=1e-13)


def test_a_yaw_that_its_prior_does_not_expect_is_no_deviation(rng):
    blocks, h, z, _ = blocks_of(ONE, rng, np.zeros(5))
    z = z + h @ UP * math.radians(10.0)
    blocks = TimeBlocks()
    for b in range(len(ONE)):
        own = slice(b * ROWS, (b + 1) * ROWS)
        terms = heading_terms(earth_in_body(np.full(ROWS, ONE[b])), np.ones(ROWS), DRIFT_S * b)
        blocks.add(*with_terms((h[own].T @ h[own])[None], (h[own].T @ z[own])[None], terms, UP), ROWS)
    alone = without_deviation(h, z, math.radians(3.0))
    found = heading_states([HeadingEvidence.of(blocks, alone, np.zeros(1, dtype=int), 0)], STD)[0]
    assert abs(found.shift[0, 2]) < math.radians(0.7)
    assert math.sqrt(alone.p[0, 2, 2] + found.more[0, 2, 2]) < 2.0 * STD
