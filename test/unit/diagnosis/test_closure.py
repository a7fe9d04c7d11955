"""The closure's interval holds the closure that a correction has on the motion without noise."""

from __future__ import annotations

import math
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.diagnosis.answer.gap_closure import _drift, held_out, measure_gap, with_closure
from dvl_calib_ros.diagnosis.fit.gauss_newton import Fitter
from dvl_calib_ros.diagnosis.fit.selection_criteria import blocks_of
from dvl_calib_ros.diagnosis.model.forward_model import Problem, make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import no_effect
from dvl_calib_ros.diagnosis.model.recorded_streams import make_recording
from dvl_calib_ros.diagnosis.model.time_grid import Offsets
from dvl_calib_ros.diagnosis.noise.noise_model import white_noise
from dvl_calib_ros.diagnosis.search.effect_selection import EffectSelection, with_noise_reestimated
from dvl_calib_ros.diagnosis.search.identifiability import Selected
from dvl_calib_ros.diagnosis.search.unexplained import Unexplained
from dvl_calib_ros.effects.registry import EFFECTS

DRAWS = 40
BIAS = np.array([0.036, -0.027, 0.018])


def _problem(noise: np.ndarray, bias: np.ndarray) -> Problem:
    """A boat on waves of heading and speed, 300 s at 1 Hz, its DVL with a bias, and a noisy reference in ENU."""
    time = np.arange(300.0)
    yaw = 2.0 * np.sin(2 * np.pi * time / 70.0)
    attitude = Rotation.from_euler("zyx", np.column_stack([yaw, 0.0 * yaw, 0.0 * yaw]))
    body = np.column_stack([1.2 + 0.5 * np.sin(2 * np.pi * time / 43.0), 0.0 * time, 0.1 * np.sin(time / 9.0)])
    quaternion = attitude.as_quat()
    recording = make_recording(
        "run", (time, body + bias), (time, attitude.apply(body) + noise), attitude=(time, quaternion)
    )
    return make_problem([recording], np.eye(3), np.zeros(3), [Offsets()])


def _noise(rng: np.random.Generator, memory_s: float) -> np.ndarray:
    """White noise of 3 cm/s, and slow noise of 2 cm/s with a memory."""
    white, slow = rng.normal(0.0, 0.03, (300, 3)), np.zeros((300, 3))
    if memory_s:
        decay = math.exp(-1.0 / memory_s)
        slow[0] = rng.normal(0.0, 0.02, 3)
        for n in range(1, 300):
            slow[n] = decay * slow[n - 1] + rng.normal(0.0, 0.02 * math.sqrt(1 - decay**2), 3)
    return white + slow


@pytest.mark.slow
@pytest.mark.parametrize(("memory_s", "times"), [(0.0, 1.0), (40.0, 3.0)])
def test_nine_of_ten_true_closures_are_inside_the_interval(memory_s, times):
    """Slow noise was part of the gap, and parameters were exact: half of the intervals held it."""
    rng, effect = np.random.default_rng(5), EFFECTS["velocity_bias"]
    clean = Fitter(_problem(np.zeros((300, 3)), times * BIAS))
    start = no_effect().with_effects([effect], 1, {effect.name: (effect.defaults,)})
    nothing = Unexplained(0.0, "", np.zeros((1, 3, 0)), np.zeros((1, 3, 0)))
    inside, widths = 0, []
    for _ in range(DRAWS):
        problem = _problem(_noise(rng, memory_s), times * BIAS)
        fitter = Fitter(problem)
        _, residual = fitter.evaluated(start)
        fitter, fit = with_noise_reestimated(
            fitter, fitter.fit(start, white_noise(residual, problem.segments, None)), EFFECTS
        )
        base = fitter.fit(no_effect(), fit.noise)
        selection = EffectSelection((Selected(effect, -50.0, ()),), base, fit, fitter, EFFECTS)
        residuals = held_out(selection, nothing)
        gap = with_closure(measure_gap(selection, residuals), selection, fit.covariance(blocks_of(problem)), residuals)
        low, high = gap.interval
        assert gap.not_explained == pytest.approx(gap.beyond_noise * math.sqrt(1.0 - gap.closure))
        true = _true_closure(clean, no_effect().with_effects([effect], 1, fit.values))
        inside += low - 0.005 <= true <= high + 0.005
        widths.append(high - low)
    assert inside >= 0.88 * DRAWS, inside
    assert np.median(widths) < 0.5


def _true_closure(clean: Fitter, found) -> float:
    """Return the share of the noise-free squares that a correction closes, each after its best calibration."""
    left = []
    for hypothesis in (no_effect(), found):
        seen, residual = clean.evaluated(hypothesis)
        columns = clean.problem.all_columns(hypothesis, seen)[:, :, :6].reshape(-1, 6)
        series = residual.ravel()
        left.append(np.sum((series - columns @ np.linalg.lstsq(columns, series)[0]) ** 2))
    return float(1.0 - left[1] / left[0])


def test_a_constant_bias_drifts_by_its_share_of_the_speed_and_not_after_its_correction():
    """Dead reckoning on one course: 3.6 cm/s ahead and 2.7 to port, at 1.2 m/s."""
    selection, residuals = Mock(), Mock()
    n = 2000
    problem = Mock(sample_time=np.arange(float(n)), bin_of=np.arange(n), sampled=lambda *_: np.full(n, 1.2))
    selection.fitter.problem = problem
    residuals.before, residuals.after = np.tile([0.036, -0.027, 0.5], (n, 1)), np.zeros((n, 3))
    before, after = _drift(selection, residuals)
    assert before.per_km == pytest.approx(1000.0 * 0.045 / 1.2, rel=1e-3) and after.per_km == 0.0
    problem.sampled = lambda *_: np.zeros(n)
    assert _drift(selection, residuals) is None
