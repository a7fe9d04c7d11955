"""Rows of heave: honest in waves, whoever feeds them, and nothing bridged over a pause."""

from __future__ import annotations

import numpy as np
import pytest
from runs import feed

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.filters.vertical_motion import HeaveRows, with_heave
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.evaluation import protocol
from dvl_calib_ros.evaluation.estimation import SensorData, estimate
from dvl_calib_ros.evaluation.protocol import Trajectory
from dvl_calib_ros.simulation.scenario import Scenario, motion_of, simulate
from dvl_calib_ros.simulation.trajectories import Waves

SECOND_NS = 1_000_000_000
PARAMETERS = Parameters()


def rolls_over_sigma(waves: Waves | None) -> np.ndarray:
    """Error of G1's roll over its own σ in 40 runs of 200 s, each with other waves, noise and errors of the DVL."""
    found = []
    for seed in range(10):
        for trajectory in ("box", "lawnmower", "figure8", "free"):
            motion, _ = motion_of(Scenario(trajectory, 200.0, seed=seed, waves=waves))
            at = slice(0, None, 50)
            run = Trajectory(trajectory, motion.time[at], motion.velocity_body[at])
            rng = np.random.default_rng([seed, len(trajectory)])
            dvl = protocol.unit_under_test(run.velocity, protocol.COMBINATIONS[seed], rng)[None]
            data = SensorData(run, dvl, protocol.reference(run.velocity, rng)[None])
            state = estimate(["G1"], data, PARAMETERS.replace(prior_source="fixed"), [len(run.time)], [])["G1"]
            error = state.x[0, 0, 0] - protocol.truth()[seed, 0]
            found.append(error / np.sqrt(state.p[0, 0, 0, 0]))
    return np.array(found)


def test_in_waves_of_a_metre_the_roll_is_as_certain_as_it_says_with_nothing_set():
    z = rolls_over_sigma(Waves(1.0, 8.0))
    assert np.mean(np.abs(z) < 1.96) >= 0.9  # of 40, were it 95 per cent, 35 or fewer are one in a hundred
    assert np.sqrt(np.mean(z**2)) < 1.15


def rows_of(heave: np.ndarray, sway: np.ndarray) -> np.ndarray:
    """(H, z) (N, 1, 3) of a roll (rad), which shows by sway (m/s), and of a constant, for a heave (m/s)."""
    return np.stack([sway, -np.ones(len(heave)), heave], axis=-1)[:, None]


def taken(stamps_ns, rows, cuts=()) -> HeaveRows:
    found = HeaveRows(1, 2, PARAMETERS)
    for start, end in zip([0, *cuts], [*cuts, len(stamps_ns)], strict=True):
        found.add(stamps_ns[start:end], rows[start:end], np.ones(end - start, dtype=bool))
    return found


def test_what_is_fed_one_by_one_or_in_blocks_is_the_same(rng):
    stamps_ns = np.cumsum(rng.integers(1, 3, 300)) * SECOND_NS // 2
    rows = rows_of(rng.normal(size=300), rng.normal(size=300))
    for one, other in zip(taken(stamps_ns, rows).sums(), taken(stamps_ns, rows, range(1, 300)).sums(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_a_pause_ends_a_block_and_is_no_time_of_measurement(rng):
    before = np.arange(0, 8) * SECOND_NS
    after = np.arange(15, 20) * SECOND_NS  # within the same 20 s
    rows = rows_of(rng.normal(size=13), rng.normal(size=13))
    sums = taken(np.concatenate([before, after]), rows).sums()
    assert sums.weight == pytest.approx((7.0 + 4.0) / 20.0)
    means = [rows[:8, 0].mean(axis=0), rows[8:, 0].mean(axis=0)]
    told = sum(w / 20.0 * np.outer(m, m) for w, m in zip((7.0, 4.0), means, strict=True))
    np.testing.assert_allclose(sums.told[0], told)


def test_a_sample_that_the_filter_did_not_use_is_not_in_the_mean(rng):
    stamps_ns, rows = np.arange(20) * SECOND_NS, rows_of(rng.normal(0.0, 0.01, 20), np.zeros(20))
    rows[7] = 1e6
    found = HeaveRows(1, 2, PARAMETERS)
    found.add(stamps_ns, rows, np.arange(20) != 7)
    assert abs(found.sums().told[0, -1, -1]) < 1e-3


@pytest.mark.parametrize(("std", "expected"), [(0.01, 0.03), (0.1, 0.1)], ids=["calm", "rough"])
def test_the_variance_is_as_set_until_the_run_shows_a_larger_one(rng, std, expected):
    stamps_ns = np.arange(1, 2000) * SECOND_NS
    block = np.repeat(rng.normal(0.0, std, 100), 20)[1:2000]
    found = taken(stamps_ns, rows_of(block, np.repeat(rng.normal(0.0, 0.2, 100), 20)[1:2000]))
    start = GaussianState(np.zeros((1, 2)), np.diag([0.05**2, 0.02**2])[None])
    _, learnt = with_heave(start, found.sums(), 0.03)
    assert np.sqrt(learnt[0]) == pytest.approx(expected, rel=0.25)
    _, before = with_heave(start, HeaveRows(1, 2, PARAMETERS).sums(), 0.03)
    assert np.sqrt(before[0]) == pytest.approx(0.03)


@pytest.mark.parametrize("random_walk", [0.0, 1e-4], ids=["constant", "random walk"])
def test_live_and_in_blocks_say_the_same_of_heave_under_a_random_walk_too(random_walk):
    run = simulate(Scenario("box", 70.0, seed=4, dvl_rate=2.0, gnss_rate=1.0, imu_rate=4.0, waves=Waves(0.5, 7.0)))
    samples = sorted([*run.imu, *run.gnss, *run.dvl], key=lambda sample: sample.stamp_ns)
    parameters = Parameters(process_std_misalignment=random_walk)
    live, blocks = (feed(Calibrator(parameters, block_size=size), samples) for size in (1, 97))
    for name in ("G1", "full"):
        one, other = live.estimate(name), blocks.estimate(name)
        np.testing.assert_allclose(one.state, other.state, rtol=0, atol=1e-12)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=0, atol=1e-12)
