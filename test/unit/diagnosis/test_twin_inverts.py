"""The forward model of twins and of comparisons is the inverse of the one that the diagnosis fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.diagnosis.answer.simulated_twin import simulated
from dvl_calib_ros.diagnosis.model.forward_model import make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import is_time_of_run, no_effect
from dvl_calib_ros.diagnosis.model.recorded_streams import make_recording
from dvl_calib_ros.diagnosis.model.stream_curve import Curve
from dvl_calib_ros.diagnosis.model.time_grid import Offsets
from dvl_calib_ros.effects.registry import EFFECTS


@pytest.fixture(scope="module")
def recording():
    """Two minutes of turns, tilts and changes of speed, without noise; the DVL's values are not used."""
    t = np.arange(0.0, 120.0, 0.1)
    euler = np.column_stack([0.8 * np.sin(0.11 * t) + 0.02 * t, 0.1 * np.sin(0.3 * t), 0.08 * np.cos(0.23 * t)])
    attitude = Rotation.from_euler("ZYX", euler)
    body = np.column_stack([1.4 + 0.5 * np.sin(0.17 * t), 0.15 * np.sin(0.21 * t), 0.1 * np.cos(0.19 * t)])
    return make_recording("run", (t, body), (t, attitude.apply(body)), attitude=(t, attitude.as_quat()))


@pytest.mark.parametrize("name", list(EFFECTS))
def test_what_an_effect_adds_at_four_times_its_typical_size_is_taken_off_again(recording, name):
    effect = EFFECTS[name]
    values = {
        spec.name: (60.0 if spec.name == "at_s" else effect.defaults[spec.name])
        if is_time_of_run(spec)
        else 4.0 * spec.typical
        for spec in effect.parameters
    }
    calibration = no_effect(np.array([0.02, -0.01, 0.03]), np.full(3, 0.005))
    hypothesis = calibration.with_effects([effect], 1, {name: (values,)})
    plain = make_problem([recording], np.eye(3), np.zeros(3), [Offsets()])
    dvl = Curve(recording.dvl.time, simulated(plain, hypothesis, 0))
    problem = make_problem([replace(recording, dvl=dvl)], np.eye(3), np.zeros(3), [Offsets()])
    inside = slice(10, -10)  # a delay reaches beyond the ends
    added = np.abs(problem.residual(problem.all_seen(calibration))[inside]).max()
    left = np.abs(problem.residual(problem.all_seen(hypothesis))[inside]).max()
    assert added > 1e-3
    assert left < 0.02 * added


def test_a_spike_that_an_effect_would_more_than_double_is_not_undone_further_with_every_pass(recording):
    """0.15 s/m at 8 m/s is 120 per cent: passes of an effect that is to be small led to 1e4 m/s, and a traceback."""
    effect = EFFECTS["quadratic_scale"]
    hypothesis = no_effect().with_effects([effect], 1, {effect.name: ({"coefficient_s_per_m": -0.15},)})
    values = recording.dvl.values.copy()
    values[600:700, 0] = 8.0
    far = replace(recording, dvl=Curve(recording.dvl.time, values))
    problem = make_problem([far], np.eye(3), np.zeros(3), [Offsets()])
    assert np.abs(problem.residual(problem.all_seen(hypothesis))).max() < 20.0


def test_times_stay_in_order_for_a_leap_that_was_not_there(recording):
    """What filters and differentiates goes by steps of time: backwards it overflowed."""
    rng = np.random.default_rng(1)
    dvl = Curve(recording.dvl.time, recording.dvl.values + 0.01 * rng.standard_normal(recording.dvl.values.shape))
    problem = make_problem([replace(recording, dvl=dvl)], np.eye(3), np.zeros(3), [Offsets()])
    jump, lag = EFFECTS["time_offset_jump"], EFFECTS["reference_lag"]
    assert problem.grids[0].clock is jump.acts_on
    start = {jump.name: (jump.defaults | {"seconds": 3.0, "at_s": 60.0},), lag.name: ({"time_constant_s": 0.003},)}
    (seen,) = problem.all_seen(no_effect().with_effects([jump, lag], 1, start))
    assert np.diff(seen.motion.time).min() > 0.04
    assert np.isclose(np.diff(seen.motion.time), 0.1).sum() > 1000  # but for the time of the leap, as measured
    assert np.abs(seen.error).max() < 10.0
