"""Evaluation and calibration of the same data use the same samples, whatever the parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import searched
from hypothesis import given
from hypothesis import strategies as st
from runs import feed

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import MODELS, Needs
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import SampleUse
from dvl_calib_ros.evaluation.estimation import SensorData, aligned, estimate, streams_of, true_prior
from dvl_calib_ros.evaluation.protocol import own_trajectories
from dvl_calib_ros.evaluation.validation_study import EVALUATED, sensor_data

N_SAMPLES, N_VARIANTS = 80, 3
HELD = slice(30, 35)  # five equal samples


@pytest.fixture(scope="module")
def data() -> SensorData:
    whole = sensor_data(own_trajectories()["T03"].part(0, N_SAMPLES), seed=1)
    velocity, reference = whole.velocity_dvl[:N_VARIANTS].copy(), whole.reference[:N_VARIANTS].copy()
    velocity[:, HELD] = velocity[:, HELD.start : HELD.start + 1]
    velocity[1, 50] *= 3.0
    reference[2, 60:63] += 4.0
    return SensorData(whole.run, velocity, reference)


def calibrated(data: SensorData, variant: int, parameters: Parameters):
    """Fed one by one, as live, and what became of its rows."""
    blocks = []
    prior = true_prior(data, parameters)
    calibrator = Calibrator(parameters, prior_sway_heave=prior, on_rows=blocks.append)
    feed(calibrator, [row for _, row in streams_of(data, variant).in_order()])
    calibrator.finish()
    return calibrator, [np.concatenate([getattr(b, name) for b in blocks]) for name in ("row", "verdict", "pairing")]


def check(data: SensorData, parameters: Parameters):
    variants = aligned(data, parameters)
    states = estimate(EVALUATED, data, parameters, [N_SAMPLES], [])
    for variant in range(N_VARIANTS):
        calibrator, (row, verdict, pairing) = calibrated(data, variant, parameters)
        own = slice(variant * N_SAMPLES, (variant + 1) * N_SAMPLES)
        np.testing.assert_array_equal(variants.rows.verdict[own][row], verdict)
        np.testing.assert_array_equal(variants.rows.pairing[own][row], pairing)
        refused = np.setdiff1d(np.arange(N_SAMPLES), row)
        assert len(refused) == calibrator.counts["dvl"]["invalid"]
        assert not any(has[variant, refused].any() for has in variants.has.values())
        for name, model in ((name, MODELS[name]) for name in EVALUATED):
            expected = calibrator.estimate(name)
            if not model.needs_prior:
                assert variants.has[model.needs][variant].sum() == expected.used + expected.gated
            np.testing.assert_allclose(states[name].x[-1, variant], expected.state, rtol=0, atol=1e-9)
            np.testing.assert_allclose(states[name].p[-1, variant], expected.filter_covariance, rtol=0, atol=1e-9)
    return variants


@pytest.mark.slow
@searched(15)
@given(
    options=st.fixed_dictionaries(
        {
            "gate_probability": st.sampled_from([0.0, 0.5, 0.9, 0.999]),
            "min_speed": st.floats(0.0, 2.5),
            "max_turn_rate": st.sampled_from([0.0, 0.02, 0.3]),
            "max_repeats": st.integers(0, 5).map(float),
            "max_speed": st.floats(1.0, 10.0),
            "prior_source": st.sampled_from(["fixed", "initial_window", "reference"]),
            "gnss_aided_std": st.floats(0.05, 1.0),
            "gnss_timeout": st.floats(0.5, 5.0),
            "imu_timeout": st.floats(0.5, 5.0),
            "max_latency": st.floats(0.0, 2.0),
            "gnss_axes": st.sampled_from(["auto", "xyz", "xy"]),
            "motion_correlation_time": st.floats(0.0, 20.0),
        }
    )
)
def test_evaluation_and_calibration_use_gate_and_refuse_the_same_samples(data, options):
    check(data, Parameters(**options))


def test_of_five_equal_samples_max_repeats_1_uses_2_everywhere(data):
    variants = check(data, Parameters(max_repeats=1.0, gate_probability=0.0))
    verdict = variants.rows.verdict[:N_SAMPLES][HELD]
    assert verdict.tolist() == [SampleUse.USED, SampleUse.USED, *[SampleUse.FROZEN] * 3]
    assert variants.has[Needs.NOTHING][0, HELD].sum() == 2
    assert math.isclose(variants.rows.weight[HELD].min(), 1.0)
