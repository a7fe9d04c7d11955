"""Waves are named where the vehicle heaves in them by more than is assumed, and nothing else is taken for waves."""

from __future__ import annotations

import heapq
from functools import cache

import numpy as np
import pytest
from runs import feed

from dvl_calib_ros.calibration.advice import heave_advice
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.heave_waves import HeaveWaves
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.waves import Waves


@cache
def calibrated(height: float, motion_std: float = 0.03) -> Calibrator:
    waves = Waves(height, 8.0) if height else None
    run = simulate(Scenario("box", 150.0, seed=4, dvl_rate=2.0, gnss_rate=1.0, imu_rate=5.0, waves=waves))
    samples = heapq.merge(run.imu, run.gnss, run.dvl, key=lambda sample: sample.stamp_ns)
    return feed(Calibrator(Parameters(motion_std=motion_std), block_size=64), samples)


def test_waves_are_named_with_their_size_and_what_to_set():
    (found,) = heave_advice(calibrated(1.0).result().heave)
    heave = calibrated(1.0).heave
    assert heave is not None and 0.1 < heave.std < 0.3 and 4.0 < heave.period < 9.0
    assert f"{heave.std:.2f} m/s every {heave.period:.0f} s" in found.says
    assert f"motion_std to {heave.std:.2f}" in found.remedy


@pytest.mark.parametrize(("height", "motion_std"), [(0.0, 0.03), (1.0, 0.2)], ids=["calm", "as assumed"])
def test_a_calm_sea_or_one_that_is_assumed_is_not(height, motion_std):
    assert calibrated(height, motion_std).heave is None


def test_a_dive_is_no_wave():
    waves, rng = HeaveWaves(np.eye(3)), np.random.default_rng(1)
    for start in range(0, 200, 10):
        times = start + np.arange(0.0, 24.0, 0.5)
        dive = 0.4 * np.sin(2.0 * np.pi * times / 120.0)
        velocity = np.column_stack([np.full(48, 1.5), np.zeros(48), dive + rng.normal(0.0, 0.005, 48)])
        waves.add(times, velocity, np.eye(3) * 0.005**2)
    assert waves.found(0.03) is None


def test_noise_of_a_slow_dvl_that_it_reports_is_no_wave():
    waves, rng = HeaveWaves(np.eye(3)), np.random.default_rng(1)
    for start in range(0, 300, 10):
        velocity = rng.normal(0.0, 0.15, (24, 3))
        waves.add(start + np.arange(24.0), velocity, np.eye(3) * 0.15**2)
    assert waves.found(0.03) is None
