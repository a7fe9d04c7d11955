"""A reference that lags is followed between the samples of slow streams, where a vehicle goes on moving."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.diagnosis.answer.gap_closure import high_frequency_variance, noise_floor
from dvl_calib_ros.diagnosis.fit.gauss_newton import Fitter
from dvl_calib_ros.diagnosis.fit.parametric_bootstrap import _reference
from dvl_calib_ros.diagnosis.model.forward_model import Problem, make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import no_effect
from dvl_calib_ros.diagnosis.model.recorded_streams import make_recording
from dvl_calib_ros.diagnosis.model.time_grid import Offsets
from dvl_calib_ros.diagnosis.noise.noise_model import white_noise
from dvl_calib_ros.diagnosis.search.effect_selection import EffectSelection
from dvl_calib_ros.diagnosis.search.unexplained import Unexplained
from dvl_calib_ros.effects.registry import EFFECTS

LAG, LAGS_S = EFFECTS["reference_lag"], 1.2
LAGGING = no_effect().with_effects([LAG], 1, {LAG.name: ({"time_constant_s": LAGS_S},)})
# Rad/s and complex amplitudes, m/s, of east, north and up: a vehicle under way in waves of 5 s
MOVES = ((0.05, (1.2, -1.0j, 0.0)), (0.31, (0.3j, 0.2, 0.05)), (2.0 * np.pi / 5.0, (0.1, 0.08j, 0.1)))


def _velocity(at: np.ndarray, lags_s: float = 0.0) -> np.ndarray:
    """(N, 3) m/s, east, north, up; through a low-pass that has been there for ever."""
    found = np.zeros((len(at), 3))
    for rate, amplitudes in MOVES:
        turning = np.exp(1j * rate * at) / (1.0 + 1j * rate * lags_s)
        found += np.real(np.outer(turning, amplitudes))
    return found


def _problem(dvl_hz: float, lost: slice = slice(0, 0), noise_mps: float = 0.0) -> Problem:
    seconds, at = np.arange(0.0, 200.0, 1.0 / dvl_hz), np.arange(0.4, 199.0)
    at = np.delete(at, lost)

    def attitude(time: np.ndarray) -> Rotation:
        euler = [0.05 * time + 0.3 * np.sin(0.2 * time), 0.05 * np.sin(0.9 * time), 0.05 * np.cos(0.8 * time)]
        return Rotation.from_euler("ZYX", np.column_stack(euler))

    often = np.arange(0.0, 200.0, 0.2)
    noise = noise_mps * np.random.default_rng(0).standard_normal((len(seconds), 3))
    return make_problem(
        [
            make_recording(
                "run",
                (seconds, attitude(seconds).apply(_velocity(seconds), inverse=True) + noise),
                (at, _velocity(at, LAGS_S)),
                attitude=(often, attitude(often).as_quat()),
            )
        ],
        np.eye(3),
        np.zeros(3),
        [Offsets()],
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values[10:-5] ** 2)))  # the filter begins with the first sample


@pytest.mark.parametrize(("dvl_hz", "share"), [(1.0, 0.05), (5.0, 0.01)])
def test_what_a_lag_takes_off_is_told_between_slow_samples(dvl_hz, share):
    """By slopes at 1 Hz it was a quarter too small in waves of 5 s: a delay explained more, and stood for the lag."""
    problem = _problem(dvl_hz)
    added = _rms(problem.residual(problem.all_seen(no_effect())))
    assert added > 0.05
    assert _rms(problem.residual(problem.all_seen(LAGGING))) < share * added


@pytest.mark.parametrize("name", ["reference_lag", "dvl_time_offset", "quadratic_scale"])
@pytest.mark.parametrize("dvl_hz", [1.0, 5.0])
def test_derivatives_are_those_of_what_is_followed_between_samples(dvl_hz, name):
    problem, effect = _problem(dvl_hz), EFFECTS[name]
    about = LAGGING.with_effects(list({LAG.name: LAG, name: effect}.values()), 1, {})
    columns = np.concatenate(
        [
            problem.calibration_columns(about, problem.all_seen(about)),
            *(problem.columns(about, problem.all_seen(about), each, about.values[each.name]) for each in about.effects),
        ],
        axis=2,
    )
    for number in range(columns.shape[2]):
        step = np.zeros(columns.shape[2])
        step[number] = 0.01
        ends = [problem.residual(problem.all_seen(about.moved(sign * step))) for sign in (-1.0, 1.0)]
        expected = (ends[1] - ends[0]) / 0.02
        # those of a slow DVL are of its smoothed velocity, which takes a little off its heave
        assert _rms(columns[:, :, number] - expected) < 0.12 * _rms(expected), number


def test_derivatives_beside_a_lag_hold_no_more_of_the_noise_of_a_slow_dvl():
    """A lag of 7 ms, by itself nothing, made scales of sway and heave of 3 and 6 that fitted the DVL's noise."""
    problem = _problem(1.0, noise_mps=0.02)
    brief = LAGGING.with_effects([LAG], 1, {LAG.name: ({"time_constant_s": 1e-6},)})
    with_it, without = (problem.calibration_columns(each, problem.all_seen(each)) for each in (brief, no_effect()))
    np.testing.assert_allclose(with_it[1:], without[1:], atol=1e-5)


def test_over_a_gap_nothing_is_told_of_what_was_between():
    problem = _problem(5.0, lost=slice(80, 100))
    time = problem.grids[0].true_time([])
    between, own = problem.grids[0].between(time)
    np.testing.assert_allclose(between[own], time)
    gap = int(np.argmax(np.diff(time)))
    assert own[gap + 1] == own[gap] + 1
    assert np.sort(np.diff(between))[-2] == pytest.approx(0.1)


def test_made_up_recordings_lag_as_the_fit_does():
    problem = _problem(5.0)
    (recording,) = problem.recordings
    made = _reference(problem, LAGGING, 0)
    assert _rms(made - recording.reference.values) < 0.01 * _rms(recording.reference.values)


@pytest.mark.parametrize("noise_mps", [0.005, 0.02])
def test_noise_that_a_lag_has_made_slow_is_noise(noise_mps):
    """High frequencies show a fifth of it: what was found was right, and unknown for four times the noise left."""
    problem = _problem(1.0, noise_mps=noise_mps)
    fitter = Fitter(problem)
    noise = white_noise(fitter.evaluated(LAGGING)[1], problem.segments, None, problem.interval)
    fit = fitter.fit(LAGGING, noise)
    left = problem.errors(fit.seen)
    high, _ = high_frequency_variance(problem.sample_time, left)
    selection = Mock(spec=EffectSelection, fitter=fitter, fit=fit)
    squares = (left**2).sum(axis=1).mean()
    assert high.sum() < 0.5 * squares
    nothing = Unexplained(0.0, "", fit.columns[:, :, :0], fit.columns[:, :, :0])
    assert noise_floor(selection, nothing).sum(axis=1).mean() == pytest.approx(squares, rel=0.2)
