"""What is left is what it is also elsewhere; what is not looked at twice, or not at all, changes no answer."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_diagnosis import LEVER, fitted, recording_of, scenario, with_added

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.diagnosis.answer.gap_location import places
from dvl_calib_ros.diagnosis.answer.results import DiagnosisVerdict
from dvl_calib_ros.diagnosis.diagnose import diagnose_recordings
from dvl_calib_ros.diagnosis.fit.cross_validation import held_out_deviance
from dvl_calib_ros.diagnosis.fit.gauss_newton import EQUAL_DEVIANCE, Fitter
from dvl_calib_ros.diagnosis.fit.selection_criteria import NuisanceFit
from dvl_calib_ros.diagnosis.model.forward_model import make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import no_effect
from dvl_calib_ros.diagnosis.model.seen import columns_by_turn
from dvl_calib_ros.diagnosis.model.time_grid import Offsets
from dvl_calib_ros.diagnosis.noise.noise_model import Noise, white_noise
from dvl_calib_ros.diagnosis.search import unexplained as looking
from dvl_calib_ros.diagnosis.search.effect_selection import EffectSelection
from dvl_calib_ros.diagnosis.search.identifiability import Selected
from dvl_calib_ros.diagnosis.search.unexplained import (
    find_unexplained,
    is_of_group,
    without_replaceable,
)
from dvl_calib_ros.effects.registry import EFFECTS
from dvl_calib_ros.simulation.scenario import simulate
from dvl_calib_ros.simulation.sensors import DvlErrors


@pytest.fixture(scope="module")
def stepped():
    """Fitter and fit, without any effect, of a run in which a bias steps by 3 cm/s."""
    run = simulate(scenario("lawnmower", seconds=300.0, gnss_std=0.03))
    return without_effects(with_added(run, lambda time, _: 0.03 * np.outer(time > 200.0, [0.0, 1.0, 0.0])))


def without_effects(recording):
    """Fitter and fit without any effect, under white noise."""
    problem = make_problem([recording], np.eye(3), np.zeros(3), [Offsets()])
    fitter = Fitter(problem)
    noise = white_noise(fitter.evaluated(no_effect())[1], problem.segments, None, problem.interval)
    return fitter, fitter.fit(no_effect(), noise)


def test_a_fit_from_what_was_looked_at_already_is_the_same():
    fitter, fit, start = fitted(scenario("lawnmower", seconds=120.0), {"lever_arm": {}, "dvl_time_offset": {}})
    again = fitter.fit(start, fit.noise, linearised=fitter._linearised(start, fit.noise))
    whole = fitter.fit(start, fit.noise)
    assert again.deviance == whole.deviance
    np.testing.assert_array_equal(again.hypothesis.vector(), whole.hypothesis.vector())


def test_columns_of_the_calibration_are_the_means_of_those_of_the_samples():
    fitter, fit, _ = fitted(scenario("lawnmower", seconds=120.0), {"lever_arm": {}})
    (seen,), (grid,) = fit.seen, fitter.problem.grids
    by_turn = grid.averaged(columns_by_turn(fit.hypothesis, seen, seen.measured))
    by_scale = -(seen.measured / (1.0 + fit.hypothesis.scale))[:, None, :] * seen.body_from_measured
    columns = fitter.problem.calibration_columns(fit.hypothesis, fit.seen)
    np.testing.assert_allclose(columns, np.concatenate([by_turn, grid.averaged(by_scale)], axis=2), atol=1e-13)


def test_a_fit_that_is_kept_sees_again_what_it_saw():
    fitter, fit, start = fitted(scenario("lawnmower", seconds=120.0), {"lever_arm": {}, "dvl_time_offset": {}})
    kept = fitter.fit_kept(start, fit.noise)
    assert len(kept.seen) == 1 and kept.seen[0] is kept.seen[0]
    np.testing.assert_array_equal(fitter.problem.residual(kept.seen), kept.residual)


def test_what_a_step_from_a_fit_at_rest_promises_is_promised_of_no_hypothesis_nearby():
    """A noisy DVL at 1 Hz promised 65 of deviance at any time of a water lock, and 74 fits were made for that."""
    errors = DvlErrors(beam_std=0.1)
    given = scenario("lawnmower", seconds=300.0, errors=errors, dvl_rate=1.0, gnss_rate=5.0, gnss_std=0.02)
    effects = {"lever_arm": {}, "dvl_time_offset": {}, "reference_time_offset": {}}
    fitter, fit, _ = fitted(given, effects)
    promised, looked = fitter._predicted_gain(fit), fitter._linearised(fit.hypothesis, fit.noise)

    def is_surely_worse(by: float, promised: float) -> bool:
        return fitter._is_surely_worse(fit.hypothesis, looked, fit.noise, fit.deviance - by, promised)

    assert promised > 3.0 and not is_surely_worse(0.0, promised)
    beyond = 2.0 * EQUAL_DEVIANCE + 0.1
    assert is_surely_worse(beyond, promised) and not is_surely_worse(beyond, 0.0)


def test_lines_are_looked_for_in_what_a_fit_leaves(stepped, monkeypatch):
    """At right angles to noisy columns it followed the vehicle's speed: a period of 82 s was an unknown cause."""
    fitter, fit = stepped
    off = replace(fit, residual=fit.residual - 0.003 * fit.columns[:, :, 3])  # as what noise in the columns makes of it
    seen = []
    monkeypatch.setattr(looking, "lines", lambda _, innovations: seen.append(innovations) or [])
    find_unexplained(fitter, off)
    white = fit.noise.whiten(off.residual).reshape(off.residual.shape)
    np.testing.assert_allclose(seen[0] / np.sqrt(np.mean(seen[0] ** 2)), white / np.sqrt(np.mean(white**2)))


def with_a_wave(seconds, velocity):
    """Ten minutes at the surface in which a wave (3,) m/s of so many seconds is on the DVL alone."""
    run = simulate(scenario("lawnmower", seconds=600.0, gnss_std=0.03, errors=DvlErrors(beam_std=0.02)))
    added = with_added(run, lambda time, _: np.outer(np.sin(2.0 * np.pi * time / seconds), velocity))
    return without_effects(added)


def test_what_is_left_of_a_heave_that_is_hardly_there_is_there_elsewhere_as_well():
    """A scale of the heave, free to be anything, took it in wherever it was fitted to: -19 were told, and no gap."""
    fitter, fit = with_a_wave(118.0, (0.0, 0.0, 0.01))
    rest = find_unexplained(fitter, fit)
    assert rest.about == pytest.approx(118.0, rel=0.05)
    assert rest.found


def test_a_period_that_no_function_of_time_follows_matters():
    """Of no group it counted for nothing: with 56 in units of the noise it was too little to matter."""
    fitter, fit = with_a_wave(18.0, (0.0, 0.008, 0.0))
    rest = find_unexplained(fitter, fit)
    assert rest.about == pytest.approx(18.0, rel=0.05)
    assert rest.found


def test_what_is_not_shown_is_no_finding_under_noise_that_is_estimated_anew_either(monkeypatch):
    """The height of a DVL a metre up, which a horizontal reference hardly shows, was what is left of right answers."""
    monkeypatch.setattr(Noise, "is_coloured", True)
    arm = EFFECTS["lever_arm"].without({"x_m", "y_m"})
    fitter, fit = without_effects(recording_of(simulate(scenario("lawnmower", gnss_std=0.03))))
    height = fitter.problem.columns(fit.hypothesis, fit.seen, arm, [arm.defaults])
    off = replace(fit, residual=fit.residual + 0.015 / np.sqrt(np.mean(height**2)) * height[:, :, 0])
    assert find_unexplained(fitter, off).about == "roll and pitch rate"
    unobservable = replace(fitter.problem, unobservable=(arm,))
    assert not find_unexplained(replace(fitter, problem=unobservable), off).found


def test_one_harmonic_of_the_heading_is_looked_for_by_itself():
    """Among ten functions of the heading a third harmonic was half as clear, and a current of minutes stood for it."""
    run = simulate(scenario("free", gnss_std=0.03, seed=3))

    def third(time, turning):
        heading = np.cumsum(turning * np.diff(time, prepend=time[0]))
        return 0.01 * np.outer(np.sin(3.0 * heading), [0.0, 1.0, 0.0])

    fitter, fit = without_effects(with_added(run, third))
    rest = find_unexplained(fitter, fit)
    assert rest.about == "heading" and rest.clearest.shape[2] == 6
    assert rest.found


@pytest.mark.slow
def test_what_is_off_in_turns_is_unknown_and_no_heading_error():
    """Which on a lawnmower explains as much for its price; elsewhere it tells 21 less. It was known."""
    run = simulate(scenario("lawnmower", seconds=360.0, gnss_std=0.03, seed=16))
    recording = with_added(run, lambda _, turning: 0.02 * np.outer(np.abs(turning) > 0.05, [0.6, 0.8, 0.3]))
    diagnosis = diagnose_recordings([recording], Parameters())
    assert diagnosis.verdict is DiagnosisVerdict.UNKNOWN and not diagnosis.effects


@pytest.mark.slow
def test_effects_that_an_unknown_cause_may_be_a_part_of_are_not_named_beside_it():
    """A step in a bias was named a current and two drifts beside what is unknown, by another reference other ones."""
    run = simulate(scenario("free", seconds=300.0, gnss_std=0.03, effects=[LEVER]))
    recording = with_added(run, lambda time, _: 0.05 * np.outer(time > 200.0, [0.7, 0.7, 0.0]))
    problem = make_problem([recording], np.eye(3), np.zeros(3), [Offsets()])
    fitter, effects = Fitter(problem), [EFFECTS[name] for name in ("lever_arm", "misalignment_drift", "scale_drift")]
    start = no_effect().with_effects(effects, 1, {effect.name: (effect.defaults,) for effect in effects})
    noise = white_noise(fitter.evaluated(start)[1], problem.segments, None, problem.interval)
    noise = white_noise(fitter.fit(start, noise).residual, problem.segments, None, problem.interval)
    base, fit = fitter.fit(no_effect(), noise), fitter.fit(start, noise)
    assert find_unexplained(fitter, fit).found
    selected = tuple(Selected(effect, -50.0, ()) for effect in effects)
    left, rest = without_replaceable(EffectSelection(selected, base, fit, fitter, EFFECTS))
    assert rest.about == "a step in time"
    assert [each.effect.name for each in left.selected] == ["lever_arm"] == [each.name for each in left.fit.effects]


def test_what_one_stretch_alone_tells_of_an_effect_is_not_held_against_it_where_that_is_held_out():
    """Of the only dive of a run no other stretch tells: a coupling to tilt told -86 there, and was an unknown cause."""
    rng, time = np.random.default_rng(1), np.arange(0.0, 400.0, 0.5)
    dives = (time >= 100.0) & (time < 120.0)
    column = np.where(dives, 1.0, 0.01) * rng.standard_normal(len(time))
    residual = (3.0 * column + rng.standard_normal(len(time)))[:, None]
    noise = white_noise(rng.standard_normal((len(time), 1)), (slice(0, len(time)),), None, 0.5)
    known = NuisanceFit(np.ones((len(time), 1, 1)), np.ones(1), np.zeros(1))
    problem, raw = SimpleNamespace(time=time), column[:, None, None]
    left = noise.whiten(residual - 3.0 * column[:, None])
    explained = float(np.sum(noise.whiten(residual) ** 2) - np.sum(left**2))
    with_it = held_out_deviance(problem, noise, known.and_nuisance(raw, residual), residual)
    predicted = held_out_deviance(problem, noise, known, residual) - with_it
    assert predicted == pytest.approx(explained, abs=20.0)


@pytest.mark.parametrize(("better", "kept"), [(-20.0, True), (20.0, False)])
def test_an_unknown_cause_takes_the_place_of_effects_only_where_it_predicts_better(stepped, monkeypatch, better, kept):
    fitter, fit = stepped
    drift = EFFECTS["misalignment_drift"]
    fitted_with = fitter.fit(no_effect().with_effects([drift], 1, {drift.name: (drift.defaults,)}), fit.noise)
    nothing = fit.columns[:, :, :0]
    cause = looking.Unexplained(-50.0, "speed", nothing, nothing)
    monkeypatch.setattr(looking, "find_unexplained", lambda *_: cause)
    monkeypatch.setattr(looking, "_held_out_gain", lambda *_: better)
    selected = (Selected(drift, -50.0, ()),)
    left, _ = without_replaceable(EffectSelection(selected, fit, fitted_with, fitter, EFFECTS))
    assert bool(left.selected) == kept


def test_how_sure_the_places_of_a_gap_are_does_not_go_by_how_columns_of_nothing_are_rounded():
    """Of the mounting of a boat that does not tilt only yaw is shown: two columns were rounding, and each took a part
    of the gap with it that nobody could have told before."""
    fitter, _ = without_effects(recording_of(simulate(scenario(effects=[LEVER], seconds=300.0, gnss_std=0.02))))
    fitter = Fitter(replace(fitter.problem, observable_turns=np.diag([0.0, 0.0, 1.0]), of_axes=(True, True, False)))
    problem = fitter.problem
    residual = fitter.evaluated(no_effect())[1]
    base = fitter.fit(no_effect(), white_noise(residual, problem.segments, None, problem.interval))
    arm = problem.columns(base.hypothesis, base.seen, EFFECTS["lever_arm"], [EFFECTS["lever_arm"].defaults])
    mixed = base.columns @ np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))[0]
    assert np.linalg.matrix_rank(mixed.reshape(-1, 6)) == 4
    other = replace(base)
    other.__dict__["columns"] = mixed
    once, again = (places(fitter, each, base, arm) for each in (base, other))
    assert len(once) > 3
    np.testing.assert_allclose([np.log(each.p) for each in again], [np.log(each.p) for each in once], rtol=1e-6)


@pytest.mark.parametrize(("about", "is_some"), [("sway and heave", True), ("turn rate", False), (40.0, False)])
def test_a_group_of_which_an_effect_is_some_is_not_in_its_place_for_what_it_predicts_elsewhere(
    monkeypatch, about, is_some
):
    """A shear of two degrees, errors along one axis per speed along another, was functions of sway and heave."""
    shear = EFFECTS["axis_nonorthogonality"]
    given = scenario(effects=["axis_nonorthogonality:xy_rad=0.15"], gnss_std=0.01)
    fitter, fit, _ = fitted(given, {shear.name: {}})
    assert is_of_group(fitter.problem, fit, [shear], about) is is_some
    none = fitter.fit(fit.hypothesis.with_effects([], 1, {}), fit.noise)
    nothing = fit.columns[:, :, :0]
    cause = looking.Unexplained(-50.0, about, nothing, nothing)
    monkeypatch.setattr(looking, "find_unexplained", lambda *_: cause)
    monkeypatch.setattr(looking, "_held_out_gain", lambda *_: 1000.0)
    left, _ = without_replaceable(EffectSelection((Selected(shear, -50.0, ()),), none, fit, fitter, EFFECTS))
    assert bool(left.selected) == is_some


@pytest.mark.parametrize(
    ("about", "third"),
    [
        ("a step in time", lambda time, _: 0.04 * np.outer(time > 83.0, [0.0, 0.0, 1.0])),
        ("a stretch of time", lambda time, _: 0.06 * np.outer(np.abs(time - 150.0) < 12.0, [0.0, 0.0, 1.0])),
    ],
)
def test_one_event_is_found_whenever_it_happens(about, third):
    fitter, fit = without_effects(with_added(simulate(scenario("lawnmower", seconds=300.0, gnss_std=0.03)), third))
    rest = find_unexplained(fitter, fit)
    assert rest.about == about
    assert rest.found


def test_a_magnetic_anomaly_is_a_passage_that_turns_the_heading():
    """A wreck turns the compass for 25 s: the reference, in earth axes, is right, and the DVL's velocity is turned."""
    run = simulate(scenario("lawnmower", seconds=300.0, gnss_std=0.02))
    x, y, _ = np.transpose([sample.velocity for sample in run.dvl])

    def turned(time, _):
        off = 0.15 * np.maximum(1.0 - np.abs(time - 140.0) / 24.0, 0.0)
        return off[:, None] * np.column_stack([-y, x, np.zeros_like(x)])

    fitter, fit = without_effects(with_added(run, turned))
    rest = find_unexplained(fitter, fit)
    assert rest.about == "a passage that turns the heading"
    assert rest.found
