"""`positions` against a simulation of its own: positions with metres of noise tell yaw and scale, and σ covers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.calibration.estimators.displacement_least_squares import DeadReckoning
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import skew
from validation.positions import NOISES, Driven, Noise, Truth, drawn, driven, errors_of, fitted


def assert_found(fit, truth: Truth, yaw_deg: float) -> None:
    """Yaw and scale within three σ, of which that of yaw is at most so much."""
    error, std = errors_of(fit, truth)
    assert (np.abs(error) < 3.0 * std).all() and math.degrees(std[0]) < yaw_deg


@pytest.mark.parametrize("kind", NOISES)
def test_half_an_hour_of_positions_with_2_m_of_noise_tells_yaw_and_scale(kind):
    rng = np.random.default_rng(5)
    truth = drawn(rng)
    fit = fitted(driven(rng, 1800.0, truth=truth, noise=NOISES[kind]))
    assert_found(fit, truth, 0.3 if kind in ("white", "outliers") else 0.45)
    assert errors_of(fit, truth)[1][1] < 0.005
    assert np.count_nonzero(~fit.used) > 60 if kind == "outliers" else np.count_nonzero(~fit.used) < 20


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lasts_2_min", "outliers"])
def test_sigma_covers(kind):
    """Of thirty runs each."""
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = drawn(rng)
        error, std = errors_of(fitted(driven(rng, 1800.0, truth=truth, noise=NOISES[kind])), truth)
        inside.append(np.abs(error) < 2.0 * std)
    share = np.mean(inside, axis=0)
    assert (share >= 0.9).all(), share


def test_of_horizontal_positions_no_level_angle_is_claimed_and_with_heights_pitch_is_found():
    truth = Truth((0.01, 0.02, -0.02), 0.004)
    prior_std = Parameters().initial_std_misalignment
    x, p = fitted(driven(np.random.default_rng(2), 1200.0, truth=truth)).errors
    np.testing.assert_allclose(x[:2], 0.0, atol=1e-9)
    assert (np.sqrt(np.diag(p)[:2]) > 0.95 * prior_std).all()
    x, p = fitted(driven(np.random.default_rng(2), 1200.0, truth=truth, depths=True)).errors
    assert abs(x[1] - 0.02) < 3.0 * math.sqrt(p[1, 1]) < 0.005


def test_across_a_gap_of_the_dvl_nothing_is_concluded():
    """The way in it is not known: were it taken as none, yaw would be off by degrees."""
    rng = np.random.default_rng(8)
    truth = Truth((0.0, 0.0, 0.02), 0.003)
    stamps, velocity, quaternion, fixes = driven(rng, 1800.0, truth=truth)
    seconds = 1e-9 * (stamps - stamps[0])
    kept = ((seconds < 500.0) | (seconds > 560.0)) & ((seconds < 1100.0) | (seconds > 1130.0))
    assert_found(fitted(Driven(stamps[kept], velocity[kept], quaternion[kept], fixes)), truth, 0.4)


def test_fixes_come_seldom_with_dropouts_and_a_slow_dvl():
    rng = np.random.default_rng(9)
    truth = Truth((0.0, 0.0, -0.03), 0.004, (1.0, 0.0, 0.0), 1.0)
    stamps, velocity, quaternion, fixes = driven(rng, 1800.0, fix_s=10.0, dvl_hz=1.0, truth=truth)
    heard = rng.random(len(fixes.stamps_ns)) < 0.6
    assert_found(fitted(Driven(stamps, velocity, quaternion, fixes.part(np.flatnonzero(heard)))), truth, 0.5)


def test_noise_for_minutes_far_from_the_rest_is_left_out():
    """As a receiver's under a bridge: 14 m off for a minute, all fixes alike."""
    rng = np.random.default_rng(10)
    truth = Truth((0.0, 0.0, 0.01), 0.003)
    stamps, velocity, quaternion, fixes = driven(rng, 900.0, truth=truth, noise=Noise(0.3))
    bad = slice(400, 450)
    fixes.position[bad] += [-14.0, 6.0, 0.0]
    fit = fitted(Driven(stamps, velocity, quaternion, fixes))
    assert not fit.used[bad].any()
    assert_found(fit, truth, 0.3)


def test_rows_one_by_one_give_what_columns_give_whenever_fixes_come():
    parameters = Parameters()
    stamps, velocity, quaternion, fixes = driven(np.random.default_rng(4), 300.0)
    whole = DeadReckoning(parameters.rotation_dvl_from_body)
    whole.add_fixes(fixes)
    whole.add_rows(stamps, velocity, quaternion)
    single = DeadReckoning(parameters.rotation_dvl_from_body)
    given = 0
    for row, stamp in enumerate(stamps.tolist()):
        single.add_rows(stamps[row : row + 1], velocity[row : row + 1], quaternion[row : row + 1])
        if row % 97 == 0:
            single.legs()
        while given < len(fixes.stamps_ns) and fixes.stamps_ns[given] + 4_000_000_000 < stamp:  # late
            single.add_fixes(fixes.part(slice(given, given + 1)))
            given += 1
    one, other = whole.legs(), single.legs()
    n = len(other.seconds)
    assert n > 0.9 * len(one.seconds)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a[:n], b, rtol=1e-12, atol=1e-9)


def test_a_dvl_with_hundreds_of_gaps_and_fixes_of_garbage_are_no_matter():
    rng = np.random.default_rng(12)
    truth = Truth((0.0, 0.0, 0.02), 0.003)
    stamps, velocity, quaternion, fixes = driven(rng, 3600.0, truth=truth)
    seconds = 1e-9 * (stamps - stamps[0])
    kept = (seconds % 9.0 > 4.0) | (seconds < 1500.0)
    fixes.position[40], fixes.position[900] = [1e300, 0.0, 0.0], [np.nan, 1.0, 0.0]
    assert_found(fitted(Driven(stamps[kept], velocity[kept], quaternion[kept], fixes)), truth, 0.4)


def test_nothing_is_found_of_too_few_fixes_or_of_fixes_all_alike():
    stamps, velocity, quaternion, fixes = driven(np.random.default_rng(1), 60.0)
    assert fitted(Driven(stamps, velocity, quaternion, fixes.part(slice(5)))) is None
    stuck = fixes._replace(position=np.zeros_like(fixes.position))
    fit = fitted(Driven(stamps, velocity, quaternion, stuck))
    assert fit is None or np.isfinite(fit.errors.p).all()


@pytest.mark.parametrize("rpy", [(0.0, 0.0, math.pi / 4), (math.pi, 0.0, 0.0), (0.1, -0.2, -2.0)])
def test_a_dvl_in_any_mounting_is_found_however_far_it_is_turned(rpy):
    """5° is no small angle: the way is linear in the matrix, not in the angle."""
    parameters, phi = Parameters(mounting_rpy=rpy), np.array([0.0, 0.0, 0.09])
    t = parameters.rotation_dvl_from_body
    stamps, in_body, quaternion, fixes = driven(np.random.default_rng(1), 900.0, truth=Truth((0.0, 0.0, 0.0), 0.006))
    velocity = in_body @ ((np.eye(3) + skew(phi)) @ t).T
    x, p = fitted(Driven(stamps, velocity, quaternion, fixes), parameters).errors
    about = t[:, 2]
    assert abs(about @ (x[:3] - phi)) < 3.0 * math.sqrt(about @ p[:3, :3] @ about) < math.radians(1.0)
    assert abs(x[3] - 0.006) < 3.0 * math.sqrt(p[3, 3])
