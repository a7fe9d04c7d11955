"""The diagnosis on simulated runs: what it finds, what it does not claim, and the loop from finding to compensation."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from command_line import fail, succeed
from scipy.signal import lfilter

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.calibration.numerics.tests import holm
from dvl_calib_ros.cli import common
from dvl_calib_ros.diagnosis.answer.compensation import compensated, verified_corrections
from dvl_calib_ros.diagnosis.answer.gap_closure import Gap, HeldOutResiduals
from dvl_calib_ros.diagnosis.answer.results import DiagnosisVerdict, FoundEffect, diagnosis_document
from dvl_calib_ros.diagnosis.diagnose import _reasons, _verdict, diagnose_recordings
from dvl_calib_ros.diagnosis.fit import gauss_newton
from dvl_calib_ros.diagnosis.fit.gauss_newton import Fit, Fitter, _with_time
from dvl_calib_ros.diagnosis.fit.selection_criteria import finer_steps
from dvl_calib_ros.diagnosis.model.forward_model import Problem, make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import Hypothesis, no_effect
from dvl_calib_ros.diagnosis.model.recorded_streams import RecordedStreams, load_recordings, make_recording
from dvl_calib_ros.diagnosis.model.stream_curve import Curve, segments_of
from dvl_calib_ros.diagnosis.model.time_grid import Grid, Offsets
from dvl_calib_ros.diagnosis.noise.noise_model import Arma, Noise, white_noise
from dvl_calib_ros.diagnosis.noise.whitened_least_squares import WhitenedLeastSquares
from dvl_calib_ros.diagnosis.search import candidates, observable_parameters
from dvl_calib_ros.diagnosis.search.arm_clock_ambiguity import CLOCKS, arm_change, lags_and_delays, with_changes
from dvl_calib_ros.diagnosis.search.candidates import by_other_clocks, intermittent_effects
from dvl_calib_ros.diagnosis.search.clock_jumps import (
    DELAYS,
    N_PARTS,
    Delays,
    gaps,
    time_by_stamps,
    with_jumps_in_gaps,
)
from dvl_calib_ros.diagnosis.search.clock_jumps import _best_delays as _delays
from dvl_calib_ros.diagnosis.search.effect_selection import (
    started,
    with_noise_reestimated,
)
from dvl_calib_ros.diagnosis.search.identifiability import _clock_or_arm, _selected
from dvl_calib_ros.diagnosis.search.observable_parameters import (
    observable_parts,
    with_observable,
    without_insignificant,
)
from dvl_calib_ros.diagnosis.search.unexplained import Unexplained
from dvl_calib_ros.effects.base import ActsOn, EffectNeeds
from dvl_calib_ros.effects.registry import EFFECTS
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.recordings.topics import Topics
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Run, Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.simulation.trajectories import Waves

pytestmark = pytest.mark.slow

CLAIMS = (DiagnosisVerdict.KNOWN, DiagnosisVerdict.AMBIGUOUS, DiagnosisVerdict.UNKNOWN)
LEVER = "lever_arm:x_m=-1.9,y_m=0.4,z_m=-0.3"


# Effects that one recording at the surface can show
OF_THE_SURFACE = {
    name: effect
    for name, effect in EFFECTS.items()
    if not effect.relative_to_first and EffectNeeds.DEPTH not in effect.needs
}


def scenario(trajectory="free", effects=(), **changes) -> Scenario:
    values = {"seconds": 400.0, "gnss_std": 0.05, "dvl_rate": 2.5, "gnss_rate": 2.5, "imu_rate": 10.0}
    values["errors"] = DvlErrors((0.02, -0.02, 0.03), (0.005,) * 3, beam_std=0.003)
    return Scenario(trajectory, effects=tuple(map(injection, effects)), **{**values, **changes})


def recording_of(run: Run, frame=VelocityFrame.ENU, name="run", axes="auto") -> RecordedStreams:
    first_ns = run.dvl[0].stamp_ns

    def stream(samples, field):
        time = np.array([1e-9 * (sample.stamp_ns - first_ns) for sample in samples])
        order = np.argsort(time)
        return time[order], np.array([getattr(sample, field) for sample in samples])[order]

    imu = {"attitude": stream(run.imu, "orientation"), "rates": stream(run.imu, "angular_velocity")} if run.imu else {}
    return make_recording(
        name,
        stream(run.dvl, "velocity"),
        stream(run.gnss, "velocity"),
        frame=frame,
        axes=axes,
        first_ns=first_ns,
        **imu,
    )


def diagnosed(*args, **changes):
    given = scenario(*args, **changes)
    return diagnose_recordings([recording_of(simulate(given), given.gnss_frame)], Parameters())


def found(diagnosis) -> dict[str, dict[str, float]]:
    return {e.name: {name: value for name, (value, _, _) in e.parameters.items()} for e in diagnosis.effects}


def assert_within(diagnosis, name, **values):
    parameters = next(effect.parameters for effect in diagnosis.effects if effect.name == name)
    for parameter, value in values.items():
        estimate, low, high = parameters[parameter]
        margin = high - estimate  # twice the interval: one of many would be outside the interval itself
        assert low - margin < value < high + margin, (name, parameter, parameters[parameter])


def fitted(given: Scenario, effects: dict[str, dict[str, float]]) -> tuple[Fitter, Fit, Hypothesis]:
    """Fitter, fit and its start of a simulated recording, by effects with the values they start from."""
    problem = make_problem(
        [recording_of(simulate(given), given.gnss_frame)], np.eye(3), np.zeros(3), [Offsets(0.0, 0.0)]
    )
    values = {name: (EFFECTS[name].defaults | its,) for name, its in effects.items()}
    start = no_effect().with_effects([EFFECTS[name] for name in effects], 1, values)
    fitter = Fitter(problem)
    noise = white_noise(fitter.evaluated(start)[1], problem.segments, None, problem.interval)
    return fitter, fitter.fit(start, noise), start


# ------------------------------------------------------------------ how it is fitted


def test_a_last_step_that_goes_astray_is_not_taken(monkeypatch):
    astray = SimpleNamespace(part=lambda free: SimpleNamespace(solution=lambda: np.full(len(free), 100.0)))
    monkeypatch.setattr(Fitter, "_without_own_noise", lambda *_: astray)
    _, fit, _ = fitted(scenario(effects=[LEVER]), {"lever_arm": {"x_m": -1.5, "y_m": 0.4, "z_m": -0.3}})
    assert [*fit.values["lever_arm"][0].values()] == pytest.approx([-1.9, 0.4, -0.3], abs=0.1)


def test_what_comes_and_goes_does_so_at_another_time_by_another_clock():
    """By an IMU that is late a current was where the DVL's late clock had it: the two clocks were named for it."""
    lock = {"east_mps": 0.2, "north_mps": -0.3, "from_s": 110.0, "to_s": np.inf}
    always = {"seconds": 0.2, "at_s": 0.0}
    values = {"dvl_time_offset": ({"seconds": 0.9},), "reference_time_offset": ({"seconds": 0.8},)}
    values |= {"water_lock": (lock,), "time_offset_jump": (always,)}
    effects = {name: EFFECTS[name].once for name in values} | {"attitude_time_offset": EFFECTS["attitude_time_offset"]}
    hypothesis = no_effect().with_effects([effects[name] for name in values], 1, values)
    fit = Mock(spec=Fit, hypothesis=hypothesis, values=values, effects=hypothesis.effects, n_recordings=1)
    found = [
        (each.values["water_lock"][0], each.values["time_offset_jump"][0], {*each.values} & {*CLOCKS})
        for each in by_other_clocks(fit, effects)
    ]
    assert [its for *_, its in found[:2]] == [{"attitude_time_offset"}, {"dvl_time_offset"}]
    assert [its["from_s"] for its, *_ in found] == pytest.approx([110.9, 110.8, 110.9, 110.0])
    assert all(its["to_s"] == np.inf and leap["at_s"] == 0.0 for its, leap, _ in found)


def test_a_current_that_was_taken_for_noise_is_proposed_when_it_came_and_went():
    """With a memory of 15 s, it was for as long as it takes in least: all after it began. 0.4 m/s were unknown."""
    given = scenario(effects=["water_lock:east_mps=0.2,north_mps=-0.34,from_s=120,to_s=241"], gnss_std=0.02)
    fitter, fit, _ = fitted(given, {})
    assert not intermittent_effects(fitter, fit, EFFECTS)
    fitter, fit = with_noise_reestimated(fitter, fit, {})
    assert max(arma.ratio for arma in fit.noise.axes) > 2.0
    effects = {name: EFFECTS[name].once for name in ("water_lock", "heading_error", "velocity_bias", "scale_drift")}
    (best, *_) = intermittent_effects(fitter, fit, effects)
    assert best.values["water_lock"][0]["to_s"] == pytest.approx(240.0, abs=1.0)
    assert best.values["water_lock"][0]["east_mps"] == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize(("seconds", "between_samples"), [(387.0, 1.0), (400.0, 0.4), (370.0, 0.2)])
def test_times_of_a_run_are_refined_to_less_than_the_time_between_samples(seconds, between_samples):
    """To 1.2 s of samples at 1 Hz, the end of a current was one sample late for good, and a leap of the clock there."""
    steps = finer_steps(Mock(spec=Problem, recordings=[Mock(seconds=seconds)], interval=2.0 * between_samples))
    assert 0.3 * between_samples < steps[-1] < between_samples
    np.testing.assert_allclose(np.array(steps[1:]) / steps[:-1], 0.5)


def test_a_clock_of_the_imu_is_told_beside_a_current_that_comes_and_goes():
    effects = ["lever_arm:x_m=2.4,y_m=-0.9", "attitude_time_offset:seconds=-0.87"]
    current = "water_lock:east_mps=0.2,north_mps=-0.34,from_s=111,to_s=248"
    diagnosis = diagnosed("free", effects=[*effects, current], seed=1, gnss_std=0.02)
    assert {*found(diagnosis)} == {"lever_arm", "attitude_time_offset", "water_lock"}
    assert_within(diagnosis, "attitude_time_offset", seconds=-0.87)
    times = found(diagnosis)["water_lock"]
    assert (times["from_s"], times["to_s"]) == pytest.approx((111.0, 248.0), abs=8.0)


def test_a_clock_that_only_stands_beside_an_arm_is_not_named_unless_it_is_shown():
    """With twelve others that could as well be meant, for none was."""
    late = {"reference_time_offset": {"seconds": -0.5}}
    fitter, fit, _ = fitted(
        scenario(effects=["reference_time_offset:seconds=-0.5"], seed=1),
        {"lever_arm": {"x_m": 0.0, "y_m": 0.0, "z_m": 0.0}, "dvl_time_offset": {"seconds": 0.0}, **late},
    )
    selected = [_selected(fitter, fit, effect, EFFECTS) for effect in fit.effects]
    kept = _clock_or_arm(fitter, fit, selected, len(EFFECTS), [EFFECTS["reference_time_offset"]], None)
    assert [each.effect.name for each in kept] == ["reference_time_offset"]


@pytest.mark.parametrize(("behind", "could_be"), [(8.0, True), (13.0, False)])
def test_what_chooses_no_time_could_be_the_cause_though_a_leap_at_the_best_of_times_fits_better(behind, could_be):
    """A drift of 6.8 s/h was a leap of 0.68 s, `known`: of nine times and either clock the best was 6.2 better."""
    once = {name: effect.once for name, effect in EFFECTS.items()}
    drift, leap, lasting = once["clock_drift"], once["time_offset_jump"], {"seconds": -0.6, "at_s": 200.0}
    given = scenario(effects=["clock_drift:seconds_per_hour=-6.8"], gnss_std=0.2)
    fitter, drifting, _ = fitted(given, {drift.name: {"seconds_per_hour": -6.8}})
    fit = fitter.fit(drifting.hypothesis.with_effects([leap], 1, {leap.name: (lasting,)}), drifting.noise)
    fit = replace(fit, deviance=drifting.deviance - behind)
    assert (drift.name in _selected(fitter, fit, leap, once).equivalent) is could_be


def test_a_fit_that_goes_astray_at_its_end_does_not_stand_for_the_best():
    """Its deviance was -3e12; what came after had noise of 43 m/s, and no effect was named."""
    told = ["attitude_time_offset:seconds=-0.26", "water_lock:east_mps=0.14,north_mps=0.26,from_s=61,to_s=140"]
    diagnosis = diagnosed(effects=told, seed=3, gnss_std=0.02)
    assert set(found(diagnosis)) == {"attitude_time_offset", "water_lock"}
    assert diagnosis.verdict is DiagnosisVerdict.KNOWN
    assert diagnosis.gap.not_explained < 0.3 * diagnosis.gap.noise_floor
    assert_within(diagnosis, "attitude_time_offset", seconds=-0.26)


# ------------------------------------------------------------------ what is found


def test_where_all_that_is_proposed_is_beyond_its_bounds_what_is_within_them_is_tried_as_well(monkeypatch):
    """A shear of 17° and more was in every proposal, no fit of them went anywhere, and a current was not found."""
    fitter, fit, _ = fitted(scenario(effects=["velocity_bias:x_mps=0.1"]), {})
    _, worth = candidates._combinations(fitter, fit, EFFECTS)
    assert worth and () not in worth
    monkeypatch.setattr(candidates, "_is_possible", lambda table, chosen: chosen in ((), worth[-1]))
    assert candidates._combinations(fitter, fit, EFFECTS)[1] == worth
    monkeypatch.setattr(candidates, "_is_possible", lambda table, chosen: chosen == ())
    assert candidates._combinations(fitter, fit, EFFECTS)[1] == [*worth, ()]


def test_linear_solutions_are_possible_within_the_bounds_of_all_their_parameters():
    shear, clock = EFFECTS["axis_nonorthogonality"], EFFECTS["clock_drift"]
    (high, *_), (drift,) = ([spec.high for spec in each.parameters] for each in (shear, clock))
    variants = [
        candidates.Variant(each, (each.defaults,), np.zeros((1, 3, p)), 1.0) for each, p in ((shear, 3), (clock, 1))
    ]
    blocks = [np.arange(6, 9), np.arange(9, 10)]
    for values, is_possible in (
        ([0.9 * high, 0.0, 0.0, 0.9 * drift], True),
        ([1.1 * high, 0.0, 0.0, 0.0], False),
        ([0.0, 0.0, -1.1 * high, 0.0], False),
        ([0.0, 0.0, 0.0, 1.1 * drift], False),
    ):
        part = Mock(solution=lambda values=values: np.array([9.0] * 6 + values))
        table = candidates.LinearisedModel(variants, blocks, Mock(part=lambda index, part=part: part))
        assert candidates._is_possible(table, (0, 1)) is is_possible


def test_a_run_without_a_gap_is_cleared_with_what_it_would_have_shown():
    diagnosis = diagnosed()
    assert diagnosis.verdict is DiagnosisVerdict.NO_GAP
    assert diagnosis.effects == () and diagnosis.where == ()
    assert {"mounting_moved", "sound_speed_moved", "sound_speed_layer"} == set(diagnosis.untestable)
    assert set(diagnosis.minimum_detectable) == set(EFFECTS) - set(diagnosis.untestable)
    assert 0.0 < diagnosis.minimum_detectable["lever_arm"]["x_m"] < 0.3
    assert diagnosis.gap.noise_floor == pytest.approx(np.sqrt(3.0) * 0.05, rel=0.1)
    assert diagnosis.gap.before == pytest.approx(diagnosis.gap.noise_floor, rel=0.05)
    assert diagnosis.gap.not_explained < 0.01


@pytest.mark.parametrize(("trajectory", "seed"), [("box", 1), ("lawnmower", 2), ("figure8", 3), ("free", 4)])
def test_noise_alone_is_not_taken_for_an_effect(trajectory, seed):
    assert diagnosed(trajectory, seed=seed).verdict not in CLAIMS


def test_slow_noise_of_the_reference_at_1_hz_is_no_water_that_comes_and_goes():
    """Each time that it was asked again, the noise was whiter and the current surer."""
    errors = DvlErrors((0.02, -0.02, 0.01), (0.003,) * 3, beam_std=0.005)
    given = scenario(seconds=370.0, gnss_std=1e-6, dvl_rate=1.0, gnss_rate=1.0, seed=7, errors=errors)
    recording = recording_of(simulate(given), given.gnss_frame, axes="xy")
    keep = np.exp(-1.0 / 6.0)
    white = np.random.default_rng(7).normal(size=(len(recording.reference.time) + 100, 3))
    noise = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)[100:]
    noisy = Curve(recording.reference.time, recording.reference.values + 0.006 * noise)
    assert diagnose_recordings([replace(recording, reference=noisy)], Parameters()).verdict not in CLAIMS


def test_a_pitch_of_the_mounting_that_is_not_shown_is_no_coupling_to_tilt():
    """It makes a velocity upwards, of which a vehicle that tilts by a degree shows a hundredth in surge and sway."""
    errors = DvlErrors((0.02, 0.1, 0.01), (0.005,) * 3, beam_std=0.002)
    given = scenario(gnss_std=0.004, waves=Waves(0.06, 6.0), seed=1, dvl_rate=5.0, gnss_rate=5.0, errors=errors)
    diagnosis = diagnose_recordings([recording_of(simulate(given), given.gnss_frame, axes="xy")], Parameters())
    assert diagnosis.selection is not None and np.trace(diagnosis.selection.fitter.problem.observable_turns) < 1.5
    assert diagnosis.verdict not in CLAIMS


def test_a_turn_that_is_not_shown_and_that_the_mounting_found_has_is_not_left_at_a_stroke():
    """Nobody told the mounting, so one of 12 degrees of pitch was found: without it all at once the fit ran away."""
    errors = DvlErrors((0.02, 0.2, 0.01), (0.005,) * 3, beam_std=0.002)
    given = scenario(gnss_std=0.004, waves=Waves(0.06, 6.0), seed=1, dvl_rate=5.0, gnss_rate=5.0, errors=errors)
    recording = recording_of(simulate(given), given.gnss_frame, axes="xy")
    problem, start, (guess,), _ = started([recording], np.eye(3), np.zeros(3), OF_THE_SURFACE)
    assert guess.phi[1] == pytest.approx(-0.2, abs=0.05) and np.trace(problem.observable_turns) < 1.5
    np.testing.assert_allclose(problem.observable_turns @ start.phi, start.phi, atol=1e-12)
    assert start.phi[2] == pytest.approx(-0.01, abs=0.02)


def test_what_is_not_shown_of_an_effect_is_its_where_it_is_named():
    """An error in surge by pitch, a sixth of that in sway by roll, was an unknown cause, and in place of both."""
    given = scenario("box", ["tilt_coupling:x_per_pitch=0.5,y_per_roll=-0.9"], gnss_std=0.01, waves=Waves(0.1, 6.0))
    recording = recording_of(simulate(given), given.gnss_frame, axes="xy")
    every = {name: effect.usual for name, effect in OF_THE_SURFACE.items()}
    problem, start, _, testable = started([recording], np.eye(3), np.zeros(3), every)
    tilt = every["tilt_coupling"]
    roll = tilt.without({spec.name for spec in tilt.parameters} - {"y_per_roll"})
    problem = replace(
        problem, unobservable=observable_parameters.unobservable_parts({tilt.name: tilt}, {tilt.name: roll})
    )
    seen = problem.all_seen(start)
    turns = problem.unobservable_columns(start, seen)[0].shape[2]
    named = start.with_effects([*start.effects, roll], 1, {roll.name: ({"y_per_roll": -0.9},)})
    columns, sizes = problem.unobservable_columns(named, seen)
    assert columns.shape[2] == len(sizes) == turns + 3
    of_pitch = problem.columns(named, seen, tilt, (tilt.defaults,))[:, :, 0]
    np.testing.assert_allclose(columns[:, :, turns], of_pitch, atol=1e-9)
    assert testable.keys() == every.keys()


@pytest.mark.parametrize("share", [0.2, 5.0])
def test_messages_that_claim_another_noise_than_they_have_make_no_effect(share):
    given = scenario(seconds=600.0, dvl_rate=5.0, gnss_rate=5.0, gnss_std=0.015, seed=11)
    honest = recording_of(simulate(given))
    dvl_std, reference_std = np.full(3, share * 0.004), np.full(3, share * 0.015)
    dvl, reference = replace(honest.dvl, reported=dvl_std), replace(honest.reference, reported=reference_std)
    claiming = replace(honest, dvl=dvl, reference=reference, dvl_std=dvl_std, reference_std=reference_std)
    assert diagnose_recordings([claiming], Parameters()).verdict not in CLAIMS


@pytest.mark.parametrize("seed", [1, 6])
def test_noise_of_the_dvl_in_what_the_error_is_held_against_is_no_finding(seed):
    given = Scenario("box", seconds=600.0, seed=seed, gnss_std=0.01, errors=DvlErrors((0.02, -0.03, 0.05)))
    assert diagnose_recordings([recording_of(simulate(given))], Parameters()).verdict not in CLAIMS


def test_an_effect_is_named_first_and_its_size_is_within_the_interval():
    diagnosis = diagnosed(effects=["clock_drift:seconds_per_hour=12"])
    assert [effect.name for effect in diagnosis.effects] == ["clock_drift"]
    assert diagnosis.effects[0].p < 0.01 and diagnosis.gap.closure > 0.8
    assert_within(diagnosis, "clock_drift", seconds_per_hour=12.0)


def test_only_a_correction_that_changes_a_parameter_and_lowers_the_held_out_error_is_applied():
    diagnosis = diagnosed(effects=[LEVER], gnss_std=0.02)
    (correction,) = verified_corrections(Parameters(), diagnosis, [None]).values()
    assert "lever_arm [-1.9" in correction.sentence and correction.errors[1] < correction.errors[0]
    (arm,) = diagnosis.effects
    for factor in (-1.0, 4.0):
        sizes = {name: tuple(factor * each for each in triple) for name, triple in arm.parameters.items()}
        wrong = replace(diagnosis, effects=(replace(arm, parameters=sizes),))
        with pytest.raises(InputError, match="the error does not fall: lever_arm"):
            verified_corrections(Parameters(), wrong, [None])
    late = {"name": "dvl_time_offset", "equivalent_to": ("attitude_time_offset",), "parameters": {"seconds": (2, 1, 3)}}
    for changes in ({"name": "velocity_bias"}, late):
        other = replace(diagnosis, effects=(replace(arm, **changes),))
        with pytest.raises(InputError, match="no parameter corrects what was found"):
            verified_corrections(Parameters(), other, [None])


def as_sent(run: Run) -> Run:
    """A driver drops what its clock, set back, stamps before what it has sent."""
    newest = np.maximum.accumulate([0, *(sample.stamp_ns for sample in run.dvl)])
    return replace(run, dvl=[each for each, before in zip(run.dvl, newest, strict=False) if each.stamp_ns > before])


def about(given: Scenario, run: Run, offsets: Offsets, effects: list, values: dict) -> tuple[Fitter, Fit]:
    """A fit of effects, with the noise that is about it."""
    problem = make_problem([recording_of(run, given.gnss_frame)], np.eye(3), np.zeros(3), [offsets])
    start, fitter = no_effect().with_effects(effects, 1, values), Fitter(problem)
    noise = white_noise(fitter.evaluated(start)[1], problem.segments, None, problem.interval)
    return with_noise_reestimated(fitter, fitter.fit(start, noise), EFFECTS)


LAGGING = "reference_lag:time_constant_s=1.3"
SET_BACK_TWICE = "time_offset_jump:seconds=-1.68,at_s=155,again_seconds=-1.99,again_at_s=277"


def test_leaps_of_seconds_are_found_beside_a_lag_and_a_clock_that_is_late_before_them():
    """It was refused, for a clock that drifts by 36 s an hour."""
    effects = ["dvl_time_offset:seconds=-1.71", SET_BACK_TWICE, LAGGING, "lever_arm:x_m=-0.7,y_m=-0.2"]
    given = scenario(effects=effects, gnss_std=0.02)
    diagnosis = diagnose_recordings([recording_of(as_sent(simulate(given)), given.gnss_frame)], Parameters())
    assert diagnosis.verdict is DiagnosisVerdict.KNOWN
    assert set(found(diagnosis)) == {text.split(":")[0] for text in effects}
    assert_within(diagnosis, "dvl_time_offset", seconds=-1.71)
    assert_within(diagnosis, "time_offset_jump", seconds=-1.68, again_seconds=-1.99)
    leaps = found(diagnosis)["time_offset_jump"]
    assert (leaps["at_s"], leaps["again_at_s"]) == pytest.approx((155.0, 277.0), abs=5.0)
    assert compensated(Parameters(), diagnosis).dvl_time_jump == 0.0  # no single one of two leaps


def test_how_a_run_begins_or_ends_is_no_leap():
    """A twin of a DVL that is early lacks its first half second: of T13 a leap at 1.9 s was named for the clock."""
    late, leapt = int(np.argmin(np.abs(DELAYS + 0.5))), int(np.argmin(np.abs(DELAYS - 1.0)))
    squares = np.full((len(DELAYS), N_PARTS), 100.0)
    squares[late] = 1.0
    for part in (0, N_PARTS - 1):
        odd = squares.copy()
        odd[late, part], odd[leapt, part] = 100.0, 1.0
        assert _delays(odd) == Delays((-0.5,), ())
    squares[late, 20:], squares[leapt, 20:] = 100.0, 1.0
    assert _delays(squares) == Delays((-0.5, 1.0), (20,))


def test_a_leap_ahead_leaves_a_gap_in_the_stamps_and_none_in_time():
    """Samples after a leap of 1.84 s were taken for as much as 0.9 s late, for the 1.7 s until they had caught up."""
    time = np.arange(0.0, 40.0, 0.1)
    leap = injection("time_offset_jump:seconds=1.84,at_s=20.05")
    grid = Grid(ActsOn.DVL_CLOCK, time + 1.84 * (time >= 20.05), 1)
    np.testing.assert_allclose(grid.true_time([leap]), time, atol=1e-9)
    tried = Grid(ActsOn.DVL_CLOCK, time, 1).true_time([leap])  # where there is none, time still goes on
    assert (np.diff(tried) > 0.0).all() and tried[-1] == pytest.approx(time[-1] - 1.84)


def test_leaps_ahead_are_put_where_the_stamps_have_a_gap_as_large():
    """The stamps show it to a sample; a lost second elsewhere is no leap, and a leap back leaves no gap."""
    given = scenario(
        effects=["dvl_time_offset:seconds=0.5", "time_offset_jump:seconds=1.8,at_s=201.3"], gnss_std=0.02, seconds=400.0
    )
    run = simulate(given)
    run = replace(run, dvl=[*run.dvl[:300], *run.dvl[305:]])
    problem = make_problem([recording_of(run, given.gnss_frame)], np.eye(3), np.zeros(3), [Offsets(0.5, 0.0)])
    effects = [EFFECTS["dvl_time_offset"], EFFECTS["time_offset_jump"].once]
    values = {"dvl_time_offset": ({"seconds": 0.5},), "time_offset_jump": ({"seconds": 1.7, "at_s": 199.0},)}
    start = no_effect().with_effects(effects, 1, values)
    fitter = Fitter(problem)
    fit = fitter.fit(start, white_noise(fitter.evaluated(start)[1], problem.segments, None, problem.interval))
    at = pytest.approx(201.3 - 0.5, abs=0.3)  # since the first stamp, which was late
    assert [gap for _, gap in gaps(fitter, fit)] == pytest.approx([2.0, 1.8]) and gaps(fitter, fit)[1][0] == at
    assert with_jumps_in_gaps(fitter, fit).values["time_offset_jump"][0]["at_s"] == at
    back = {**fit.values, "time_offset_jump": ({"seconds": -1.8, "at_s": 199.0},)}
    back = replace(fit, hypothesis=replace(fit.hypothesis, values=back))
    assert with_jumps_in_gaps(fitter, back) is back


def two_leaps(fit: Fit, values) -> Hypothesis:
    others = [effect for effect in fit.effects if effect.name != "time_offset_jump"]
    leap = EFFECTS["time_offset_jump"]
    return fit.hypothesis.with_effects([*others, leap], 1, {leap.name: (values,)})


def test_a_leap_back_is_put_where_the_stamps_go_back_and_its_time_is_known_to_a_sample():
    """A short step tells where: the time was open by 25 s, and with it the sizes of both leaps by half a second."""
    given = scenario(
        effects=["dvl_time_offset:seconds=0.5", "time_offset_jump:seconds=-1.3,at_s=201.3"],
        gnss_std=0.02,
        seconds=400.0,
    )
    recording = recording_of(as_sent(simulate(given)), given.gnss_frame)
    problem = make_problem([recording], np.eye(3), np.zeros(3), [Offsets(0.5, 0.0)])
    effects = [EFFECTS["dvl_time_offset"], EFFECTS["time_offset_jump"].once]
    values = {"dvl_time_offset": ({"seconds": 0.5},), "time_offset_jump": ({"seconds": -1.3, "at_s": 199.0},)}
    start = no_effect().with_effects(effects, 1, values)
    fitter = Fitter(problem)
    noise = white_noise(fitter.evaluated(start)[1], problem.segments, None, problem.interval)
    fit = with_jumps_in_gaps(fitter, fitter.fit(start, noise))
    time, low, high = time_by_stamps(fitter, fit, "at_s")
    assert low < 201.3 - 0.5 < high and high - low == pytest.approx(0.8, abs=0.01)  # since the first stamp
    assert time == pytest.approx(201.3 - 0.5, abs=0.3)
    twice = {"seconds": -0.5, "at_s": 120.0, "again_seconds": -0.8, "again_at_s": 200.0}  # one of two has left it
    (twice,) = with_jumps_in_gaps(fitter, replace(fit, hypothesis=two_leaps(fit, twice))).values["time_offset_jump"]
    assert twice["at_s"] == 120.0
    ahead = replace(fit.hypothesis, values={**fit.values, "time_offset_jump": ({"seconds": 1.3, "at_s": time},)})
    assert time_by_stamps(fitter, replace(fit, hypothesis=ahead), "at_s") is None


def test_of_two_leaps_back_the_second_is_put_behind_the_first():
    """It came out by the first, 1.3 s, too early: that was taken for the one that is looked for."""
    leap = "time_offset_jump:seconds=-1.3,at_s=101.3,again_seconds=-0.9,again_at_s=251.3"
    given = scenario(effects=["dvl_time_offset:seconds=0.5", leap], gnss_std=0.02, seconds=400.0)
    recording = recording_of(as_sent(simulate(given)), given.gnss_frame)
    problem = make_problem([recording], np.eye(3), np.zeros(3), [Offsets(0.5, 0.0)])
    names = ["dvl_time_offset", "time_offset_jump"]
    since_first_stamp = {name: value - 0.5 * name.endswith("at_s") for name, value in injection(leap).values.items()}
    values = {"dvl_time_offset": ({"seconds": 0.5},), "time_offset_jump": (since_first_stamp,)}
    hypothesis = no_effect().with_effects([EFFECTS[name] for name in names], 1, values)
    fit = Mock(spec=Fit, hypothesis=hypothesis, values=values, n_recordings=1)
    shown = [time_by_stamps(Fitter(problem), fit, name) for name in ("at_s", "again_at_s")]
    for (_, low, high), at in zip(shown, (101.3, 251.3), strict=True):
        assert low < at - 0.5 < high and high - low < 1.2


def test_times_of_a_leap_that_are_as_good_are_looked_for_beyond_such_as_are_not(monkeypatch):
    """On straight legs nothing shows when: 172.6 to 176.2 s were said of a leap at 248 s, which came out 5 worse."""
    leap = EFFECTS["time_offset_jump"]
    problem = SimpleNamespace(interval=2.0, recordings=[SimpleNamespace(seconds=400.0)])
    fit = Mock(spec=Fit, values={leap.name: ({"seconds": 2.0, "at_s": 174.0},)})

    def worse(_, moved, fit):
        at = moved - 174.0
        return 100.0 if at < -5.0 or at > 90.0 else 15.0 if abs(at) < 20.0 else 5.0

    monkeypatch.setattr(gauss_newton, "_with_time", lambda fit, effect, name, recording, at: at)
    monkeypatch.setattr(Fitter, "_worse_at", worse)
    at, low, high = Fitter(problem).time_interval(fit, leap, "at_s", 0)
    assert at == 174.0 and 174.0 - 5.0 < low < 174.0 and 248.0 < high < 350.0


def test_what_is_not_known_of_the_time_of_a_leap_is_in_the_intervals_of_all_sizes():
    fitter, fit, _ = fitted(
        scenario(effects=["time_offset_jump:seconds=0.8,at_s=200"], gnss_std=0.02),
        {"time_offset_jump": {"seconds": 0.8, "at_s": 200.0}},
    )
    (leap,) = fit.effects
    assert not fitter.moved_by_time(fit, leap, "at_s", 0, (200.0, 200.0)).any()
    moved = fitter.fit(_with_time(fit, leap, "at_s", 0, 170.0), fit.noise, 3).hypothesis.vector()[6:]
    added = fitter.moved_by_time(fit, leap, "at_s", 0, (170.0, 200.0))[6:, 6:]
    assert np.diag(added) == pytest.approx(((moved - fit.hypothesis.vector()[6:]) / 1.96) ** 2 / 2.0)


def test_noise_of_the_dvl_takes_nothing_off_a_lever_arm_however_long_the_run():
    """Sway that only a lever arm makes: its scale would explain the very noise that it holds, and bend the arm."""
    diagnosis = diagnosed(
        "free", [LEVER], seconds=900.0, seed=8, gnss_std=0.002, dvl_rate=10.0, gnss_rate=10.0, imu_rate=20.0,
        errors=DvlErrors(beam_std=0.005),
    )  # fmt: skip
    x, low, high = diagnosis.effects[0].parameters["x_m"]
    assert diagnosis.effects[0].name == "lever_arm" and low < -1.9 < high
    assert x == pytest.approx(-1.9, abs=0.06)  # -1.80 with those columns as they are


def test_a_drift_of_a_thousandth_of_what_a_delay_of_seconds_explains_is_named():
    """It was not proposed, for beside the delay all others explain more by themselves; and then taken for its ghost."""
    strong = [LEVER, "dvl_time_offset:seconds=2.5"]
    name, parameter, value = "misalignment_drift", "z_rad_per_hour", {"z_rad_per_hour": 0.05}
    diagnosis = diagnosed(effects=[*strong, f"{name}:{parameter}={value[parameter]}"], gnss_std=0.01, seconds=600.0)
    assert diagnosis.verdict is DiagnosisVerdict.KNOWN
    assert set(found(diagnosis)) == {each.split(":")[0] for each in strong} | {name}
    assert_within(diagnosis, name, **value)


def test_two_late_streams_are_told_by_the_two_differences_that_matter_and_the_third_clock_is_named():
    diagnosis = diagnosed(
        effects=["reference_time_offset:seconds=0.6", "attitude_time_offset:seconds=0.3"], gnss_std=0.03
    )
    assert_within(diagnosis, "dvl_time_offset", seconds=-0.3)
    assert_within(diagnosis, "reference_time_offset", seconds=0.3)
    assert all("attitude_time_offset" in effect.equivalent_to for effect in diagnosis.effects)
    assert diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS


def test_an_arm_and_a_delay_a_hundred_times_the_noise_are_exact_and_without_a_vertical_the_same():
    run = simulate(scenario(effects=[LEVER, "dvl_time_offset:seconds=-2.7"], gnss_std=0.02))
    flat = [replace_velocity(sample, (*sample.velocity[:2], 0.0)) for sample in run.gnss]
    whole, level = (
        diagnose_recordings([recording_of(each)], Parameters()) for each in (run, Run(run.dvl, flat, run.imu))
    )
    assert level.compared_axes == "xy of the body held level" and whole.compared_axes == "xyz"
    assert set(found(level)) == set(found(whole)) == {"lever_arm", "dvl_time_offset"}
    assert_within(whole, "lever_arm", x_m=-1.9, y_m=0.4, z_m=-0.3)
    assert_within(level, "lever_arm", x_m=-1.9, y_m=0.4)
    for each in (whole, level):
        assert_within(each, "dvl_time_offset", seconds=-2.7)
    assert whole.gap.not_explained < 0.3 * whole.gap.noise_floor
    assert level.gap.after == pytest.approx(np.sqrt(2.0) * 0.02, rel=0.15)
    # a height was claimed of a boat that does not tilt, as this vehicle does, and a mounting moved by 8° of roll
    assert {*found(whole)["lever_arm"]} == {*found(level)["lever_arm"]} == {"x_m", "y_m", "z_m"}
    still = [each._replace(orientation=turned(each), angular_velocity=(0.0, 0.0, 0.1)) for each in run.imu]
    boat = diagnose_recordings([recording_of(Run(run.dvl, flat, still))], Parameters())
    assert all({*values} <= {"x_m", "y_m"} for name, values in found(boat).items() if name == "lever_arm")
    assert {*boat.minimum_detectable["lever_arm"]} == {"x_m", "y_m"}
    assert {*level.minimum_detectable["mount_flexure"]} == {"z_rad_per_mps"}
    assert {*level.minimum_detectable["axis_nonorthogonality"]} == {"xy_rad"}  # heights were claimed of these two
    assert {*level.minimum_detectable["tilt_coupling"]} <= {"x_per_pitch", "y_per_roll"}


def turned(sample):
    """The orientation of a vehicle that only turns."""
    _, _, z, w = sample.orientation
    return (0.0, 0.0, z / np.hypot(z, w), w / np.hypot(z, w))


def replace_velocity(sample, velocity):
    return sample._replace(velocity=velocity)


def test_a_late_body_frame_reference_and_an_early_dvl_are_one_answer_with_two_names():
    diagnosis = diagnosed(effects=["reference_time_offset:seconds=0.5"], gnss_frame=VelocityFrame.BODY)
    (effect,) = diagnosis.effects
    assert {effect.name, *effect.equivalent_to} >= {"dvl_time_offset", "reference_time_offset"}
    assert diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS


def test_outliers_do_not_bend_a_large_effect_and_are_told_beside_it():
    diagnosis = diagnosed(effects=[LEVER, "outliers:share=0.02,std_mps=1"], gnss_std=0.02)
    assert set(found(diagnosis)) == {"lever_arm"}
    assert_within(diagnosis, "lever_arm", x_m=-1.9, y_m=0.4, z_m=-0.3)
    assert "outliers" in {finding.name for finding in diagnosis.noise}


def test_a_receiver_that_is_off_for_some_seconds_hides_no_effect_and_is_told_beside_it():
    """A real one drifted to 0.9 m/s and back in 8 s, once in ten minutes: 1 % of a gap was closed, for 97 % without."""
    given = scenario(effects=["lever_arm:x_m=0.3,y_m=0.2"])
    recording = recording_of(simulate(given))
    reference = recording.reference
    drift = 0.9 * np.clip(1.0 - np.abs(reference.time - 200.0) / 3.0, 0.0, None)
    off = replace(reference, values=reference.values + drift[:, None] * np.array([0.4, -1.0, 0.0]))
    diagnosis = diagnose_recordings([replace(recording, reference=off)], Parameters())
    assert set(found(diagnosis)) == {"lever_arm"} and diagnosis.verdict is DiagnosisVerdict.KNOWN
    assert diagnosis.gap.closure > 0.8
    assert "outliers" in {finding.name for finding in diagnosis.noise}


def test_a_fast_reference_is_compared_no_more_often_than_a_slow_dvl_can_tell():
    time = np.arange(0.0, 100.0, 0.1)
    slow = make_recording("slow", (time[::10], np.ones((100, 3))), (time, np.ones((1000, 3))))
    fast = make_recording("fast", (time[::2], np.ones((500, 3))), (time, np.ones((1000, 3))))
    assert (slow.reference.interval, fast.reference.interval) == (pytest.approx(0.4), pytest.approx(0.1))
    assert slow.dvl.interval == 1.0


def test_slow_noise_of_the_reference_is_a_finding_and_no_gap():
    diagnosis = diagnosed(effects=["coloured_reference_noise:std_mps=0.06,correlation_time_s=8"], gnss_std=0.03)
    assert "coloured_reference_noise" in {finding.name for finding in diagnosis.noise}
    assert diagnosis.gap.noise_floor == pytest.approx(np.sqrt(3.0) * np.hypot(0.03, 0.06), rel=0.2)
    assert diagnosis.gap.not_explained < 0.3 * diagnosis.gap.noise_floor


def test_what_comes_and_goes_with_a_period_of_its_own_is_unknown():
    given = scenario()
    run = simulate(given)
    bursts = [
        replace_velocity(s, tuple(np.array(s.velocity) + (0.06 if i % 55 < 22 else 0.0))) for i, s in enumerate(run.dvl)
    ]
    diagnosis = diagnose_recordings([recording_of(Run(bursts, run.gnss, run.imu))], Parameters())
    assert diagnosis.verdict is DiagnosisVerdict.UNKNOWN and diagnosis.reasons[0].code in (
        "GAP_UNKNOWN",
        "GAP_PARTLY_UNKNOWN",
    )


def with_added(run: Run, added) -> RecordedStreams:
    """A run whose DVL measures more than it does: added (N, 3) m/s of times (N,) s and turn rates (N,) rad/s."""
    first = run.dvl[0].stamp_ns
    time, imu_time = (np.array([1e-9 * (s.stamp_ns - first) for s in stream]) for stream in (run.dvl, run.imu))
    turning = np.interp(time, imu_time, [s.angular_velocity[2] for s in run.imu])
    measured = [
        replace_velocity(s, tuple(np.add(s.velocity, more)))
        for s, more in zip(run.dvl, added(time, turning), strict=True)
    ]
    return recording_of(Run(measured, run.gnss, run.imu))


def last_side(time, turning):
    """2 cm/s to the side of the last turn, until one to the other side."""
    side = np.where(np.abs(turning) > 0.05, np.sign(turning), 0.0)
    at = np.maximum.accumulate(np.where(side != 0.0, np.arange(len(side)), 0))
    return 0.02 * np.outer(side[at], [0.0, 1.0, 0.0])


def test_what_is_unknown_is_so_beside_a_lever_arm_and_a_delay_a_hundred_times_as_large():
    given = scenario(effects=[LEVER, "dvl_time_offset:seconds=1.2"], gnss_std=0.02, seconds=600.0)
    diagnosis = diagnose_recordings([with_added(simulate(given), last_side)], Parameters())
    assert diagnosis.verdict is DiagnosisVerdict.UNKNOWN and "follows turns before" in diagnosis.sentence
    assert {"lever_arm", "dvl_time_offset"} <= set(found(diagnosis))
    assert_within(diagnosis, "lever_arm", x_m=-1.9, y_m=0.4, z_m=-0.3)  # 7 sigma off, but for what is unknown
    assert_within(diagnosis, "dvl_time_offset", seconds=1.2)


def test_a_step_in_a_bias_is_unknown_and_no_drift():
    given = scenario(gnss_std=0.03, seconds=600.0)
    stepped = with_added(simulate(given), lambda time, _: 0.03 * np.outer(time > 400.0, [0.0, 1.0, 0.0]))
    diagnosis = diagnose_recordings([stepped], Parameters())
    assert diagnosis.verdict is DiagnosisVerdict.UNKNOWN and "follows a step in time" in diagnosis.sentence


def test_without_imu_what_needs_it_is_listed_as_untestable():
    diagnosis = diagnosed(imu_rate=0.0, gnss_frame=VelocityFrame.BODY)
    assert {name for name, effect in EFFECTS.items() if effect.needs} <= set(diagnosis.untestable)
    assert diagnosis.untestable["water_lock"] == "attitude"


# ------------------------------------------------------------------ several recordings


def several(*changes):
    return [
        recording_of(simulate(scenario(seed=seed, **{"seconds": 300.0, "gnss_std": 0.02, **each})), name=f"day{seed}")
        for seed, each in enumerate(changes)
    ]


def test_a_compass_that_is_wrong_by_another_amount_each_day_is_named_with_its_size_on_each():
    """It was asked to be the same on all: of three runs of a boat a current of each day was named instead."""
    sines = (-0.06, -0.035, 0.0)
    days = several(*({"effects": [f"heading_error:sin_rad={sine},cos_rad=0.02"]} for sine in sines))
    (effect,) = diagnose_recordings(days, Parameters()).effects
    assert effect.name == "heading_error"
    for name, sine in zip(("day0", "day1", "day2"), sines, strict=True):
        _, low, high = effect.by_recording[name]["sin_rad"]
        assert low <= sine <= high


def test_one_lever_arm_and_a_delay_for_each_day_are_fitted_together_and_whole_days_are_held_out():
    delays = (0.4, -1.1, 2.0)
    days = several(*({"effects": [LEVER, f"dvl_time_offset:seconds={delay}"]} for delay in delays))
    diagnosis = diagnose_recordings(days, Parameters())
    assert set(found(diagnosis)) == {"lever_arm", "dvl_time_offset"}
    assert_within(diagnosis, "lever_arm", x_m=-1.9, y_m=0.4, z_m=-0.3)
    offsets = next(effect for effect in diagnosis.effects if effect.name == "dvl_time_offset").by_recording
    assert [offsets[f"day{i}"]["seconds"][0] for i in range(3)] == pytest.approx(delays, abs=0.03)
    assert set(diagnosis.gap.by_recording) == {"day0", "day1", "day2"}
    assert diagnosis.gap.after < 1.1 * np.sqrt(3.0) * 0.02
    assert compensated(Parameters(), diagnosis).dvl_time_offset == 0.0
    written = verified_corrections(Parameters(), diagnosis, [0, 1, 2])
    assert written[1].parameters.dvl_time_offset == pytest.approx(-1.1, abs=0.03)
    for correction in written.values():
        assert correction.changed.keys() == {"lever_arm", "dvl_time_offset"}
        assert correction.errors[1] < 1.1 * np.sqrt(3.0) * 0.02 < 0.7 * correction.errors[0]


# ------------------------------------------------------------------ what cannot be said


def test_a_leap_that_came_once_is_one_of_an_effect_that_may_come_twice():
    """`diagnose --simulator` ended in a KeyError wherever it had found a leap."""
    leap = EFFECTS["time_offset_jump"]
    once = no_effect().with_effects([leap.once], 1, {leap.name: ({"seconds": 0.4, "at_s": 50.0},)})
    (injected,) = once.with_effects([leap], 1, {}).injections(0)
    assert leap.late(np.array([0.0, 60.0, 600.0]), injected.values) == pytest.approx([0.0, 0.4, 0.4])


@pytest.mark.parametrize("of_time", [lambda t: 1.0 + 0.3 * np.sin(0.1 * t), lambda t: np.where(t > 100.0, 1.0, 2.0)])
def test_streams_that_are_alike_to_rounding_have_an_answer(of_time):
    """As of two logs of one estimate. Noise of nothing made every column infinite: a LinAlgError."""
    time = np.arange(200.0)
    velocity = np.column_stack([of_time(time), 0.0 * time, 0.0 * time])
    alike = make_recording("alike", (time, velocity), (time + 0.3, velocity))
    assert diagnose_recordings([alike], Parameters()).verdict is not DiagnosisVerdict.NO_GAP  # a reference 0.3 s late


def test_a_straight_run_at_one_speed_makes_no_confident_claim_about_a_bias():
    diagnosis = diagnosed("straight", effects=["velocity_bias:x_mps=0.1"])
    assert diagnosis.verdict not in (DiagnosisVerdict.KNOWN, DiagnosisVerdict.NO_GAP)


def test_a_run_that_is_too_short_says_so():
    diagnosis = diagnosed(seconds=30.0)
    assert diagnosis.reasons[0].code == "GAP_TOO_SHORT"


def test_a_constant_reference_is_insufficient():
    run = simulate(scenario())
    still = [replace_velocity(sample, (1.0, 0.0, 0.0)) for sample in run.gnss]
    diagnosis = diagnose_recordings([recording_of(Run(run.dvl, still, run.imu))], Parameters())
    assert (
        diagnosis.verdict is DiagnosisVerdict.INSUFFICIENT_EXCITATION
        and diagnosis.reasons[0].code == "GAP_REFERENCE_CONSTANT"
    )


# ------------------------------------------------------------------ its parts


# Legs of a simulated run change their speed in small steps; waves do not
SMOOTH = {
    "trajectory": "lawnmower", "waves": Waves(1.0, 6.0), "gnss_std": 0.0, "errors": DvlErrors(), "seconds": 120.0,
    "imu_rate": 50.0, "dvl_rate": 10.0, "gnss_rate": 10.0,
}  # fmt: skip


def problem_of(run: Run):
    return make_problem([recording_of(run)], np.eye(3), np.zeros(3), [Offsets()])


@pytest.mark.parametrize("name", [name for name, effect in EFFECTS.items() if not effect.relative_to_first])
def test_what_the_simulator_does_the_composed_model_undoes(name):
    """One physics, forwards and backwards: with the true values of two effects at once nothing is left."""
    effect = EFFECTS[name]
    size = {p.name: p.typical for p in effect.parameters if p.unit != "s" or np.isfinite(p.high)}
    times = {"at_s": 60.0} if name == "time_offset_jump" else {}
    text = f"{name}:" + ",".join(f"{key}={value}" for key, value in (size | times).items())
    texts = [LEVER] if name == "lever_arm" else [LEVER, text]
    given = [injection(each) for each in texts]
    problem = problem_of(simulate(scenario(effects=texts, **SMOOTH)))
    values = {each.effect.name: (each.values,) for each in given}
    true = no_effect().with_effects([each.effect for each in given], 1, values)
    ends = slice(8, -8)
    left = problem.residual(problem.all_seen(true))[ends]
    if name == "time_offset_jump":  # whose samples stand out of order for a moment
        left = left[np.abs(problem.time[ends] - 60.0) > 2.0]
    without = problem.residual(problem.all_seen(no_effect()))[ends]
    assert np.sqrt(np.mean(left**2)) < 0.05 * np.sqrt(np.mean(without**2)), np.abs(left).max()


@pytest.mark.parametrize("name", [name for name, effect in EFFECTS.items() if not effect.relative_to_first])
def test_the_derivatives_are_those_of_the_model(name):
    problem = problem_of(simulate(scenario(**SMOOTH)))
    effect = EFFECTS[name]
    values = effect.defaults | ({"at_s": 50.0, "again_at_s": 70.0} if name == "time_offset_jump" else {})
    about = no_effect().with_effects([effect], 1, {name: (values,)})
    seen = problem.all_seen(about)
    columns = problem.columns(about, seen, effect, [values])
    specs = [parameter.spec for parameter in about.parameters()]
    for column, spec in zip(np.moveaxis(columns, 2, 0), specs, strict=True):
        step = 0.05 * spec.typical
        ends = [
            problem.residual(problem.all_seen(about.with_effects([effect], 1, {name: ({**values, spec.name: at},)})))
            for at in (max(values[spec.name] - step, spec.low), values[spec.name] + step)
        ]
        expected = (ends[1] - ends[0]) / (values[spec.name] + step - max(values[spec.name] - step, spec.low))
        error = np.sqrt(np.mean((column - expected)[8:-8] ** 2)) / np.sqrt(np.mean(expected[8:-8] ** 2))
        assert error < 0.1, (name, spec.name, error)


def test_whitened_least_squares_is_least_squares_with_a_prior(rng):
    columns, target, std = rng.normal(size=(40, 4)), rng.normal(size=40), np.array([0.5, 1.0, 2.0, 0.1])
    centre = rng.normal(size=4)
    system = WhitenedLeastSquares.of(columns, target, std, centre)
    stacked = np.concatenate([columns, np.diag(1.0 / std)])
    expected = np.linalg.lstsq(stacked, np.concatenate([target, centre / std]), rcond=None)[0]
    np.testing.assert_allclose(system.solution(), expected, rtol=1e-9)
    misfit = np.sum((target - columns @ expected) ** 2) + np.sum(((expected - centre) / std) ** 2)
    assert system.misfit(expected) == pytest.approx(misfit)
    np.testing.assert_allclose(system.covariance(), np.linalg.inv(stacked.T @ stacked), rtol=1e-9)
    alone = system.part(np.array([1, 3]))
    two = np.concatenate([columns[:, [1, 3]], np.diag(1.0 / std[[1, 3]])])
    right = np.concatenate([target, (centre / std)[[1, 3]]])
    np.testing.assert_allclose(alone.solution(), np.linalg.lstsq(two, right, rcond=None)[0], rtol=1e-9)


@pytest.mark.filterwarnings("error")
def test_a_system_from_which_more_noise_is_subtracted_than_it_holds_is_not_definite():
    gram = np.array([[-2.0, 1e300, 0.0], [1e300, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert not WhitenedLeastSquares(gram, np.ones(2), np.zeros(2)).is_definite
    assert WhitenedLeastSquares(np.eye(3), np.ones(2), np.zeros(2)).is_definite


def test_what_noise_makes_of_least_squares_is_taken_off_and_what_is_mostly_noise_is_left_alone(rng):
    """Scale for noise (errors in variables): of a column that is noise to a third, two thirds were found."""
    m, std = 100_000, np.full(2, 1e3)
    clean, noise = np.column_stack([rng.normal(size=m), 0.3 * rng.normal(size=m)]), rng.normal(size=(m, 3))
    noise[:, 0] *= np.sqrt(0.5)
    target = clean @ [2.0, 1.0] - noise[:, 1] + 0.1 * noise[:, 2]  # of the second the target has the noise as well
    seen = WhitenedLeastSquares.of(clean + noise[:, :2], target, std, np.zeros(2))
    again = np.column_stack([np.sqrt(0.5) * rng.normal(size=m), other := rng.normal(size=m), -other])
    assert seen.solution()[0] == pytest.approx(4.0 / 3.0, abs=0.02) and seen.solution()[1] < -0.5
    found = seen.solution_without(again.T @ again)
    assert found[0] == pytest.approx(2.0, abs=0.03) and found[1] == pytest.approx(0.0, abs=0.03)
    np.testing.assert_allclose(seen.solution_without(np.zeros((3, 3))), seen.solution())


def test_noise_is_no_slower_for_what_columns_explain_of_it_by_their_own():
    """A third of a DVL's noise was all that was left of it here; of a boat's, slow noise of three times as much, so an
    arm of 3 m was noise in the next round, and at the end nothing was found."""
    errors = DvlErrors((0.0, 0.0, 0.0), (0.0,) * 3, beam_std=0.012)
    given = scenario("box", gnss_std=0.004, seed=1, dvl_rate=2.0, gnss_rate=5.0, errors=errors, seconds=500.0)
    every = {name: effect.usual for name, effect in OF_THE_SURFACE.items()}
    recording = recording_of(simulate(given), given.gnss_frame, axes="xy")
    problem, start, _, _ = started([recording], np.eye(3), np.zeros(3), every)
    fitter = Fitter(problem)
    noise = white_noise(fitter.evaluated(start)[1], problem.segments, None, problem.interval)
    _, fit = with_noise_reestimated(fitter, fitter.fit(start, noise), every)
    left = np.sqrt(np.mean(fit.residual**2, axis=0))
    loud = [axis.std * axis.ratio for axis in fit.noise.axes]
    np.testing.assert_allclose(loud, left, rtol=0.1)
    assert max(axis.ratio for axis in fit.noise.axes) < 1.1


def test_holms_p_values_are_those_worked_out_by_hand():
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])


def test_the_rates_of_an_attitude_are_its_derivative_whatever_the_sign_of_its_quaternions(rng):
    motion = simulate(scenario(imu_rate=20.0, seconds=100.0))
    signs = rng.choice([-1.0, 1.0], len(motion.imu))
    turned = [
        s._replace(orientation=tuple(sign * np.array(s.orientation))) for s, sign in zip(motion.imu, signs, strict=True)
    ]
    recording = replace(recording_of(Run(motion.dvl, motion.gnss, turned)), rates=None)
    at = np.linspace(5.0, 95.0, 300)
    np.testing.assert_allclose(recording.angular_velocity(at), recording_of(motion).rates(at), atol=8e-3)


def test_a_quiet_curve_keeps_the_motion_and_loses_noise(rng):
    time = np.arange(0.0, 300.0, 0.2)
    true = np.column_stack([np.sin(0.3 * time), np.cos(0.2 * time), 0.0 * time])
    noisy = Curve(time, true + rng.normal(0.0, 0.05, true.shape))
    np.testing.assert_allclose(noisy.roughness, 0.05, rtol=0.1)
    assert np.std(noisy.denoised.values - true) < 0.5 * 0.05
    clean = Curve(time, true)
    np.testing.assert_allclose(clean.denoised.values, true, atol=1e-3)


def test_whitened_coloured_noise_is_white_and_comes_back(rng):
    arma = Arma(np.array([0.9]), -0.5, 0.1, 1.36)
    parts = segments_of([np.arange(2000.0), np.arange(1000.0)])
    noise = Noise(parts, None, np.ones((3000, 3)), (arma, arma, arma))
    series = noise.unwhiten(rng.standard_normal(9000))
    white = noise.whiten(series)
    assert noise.unwhiten(white) == pytest.approx(series)
    fitted = white_noise(series, parts, None).refitted(series)
    left = fitted.whiten(series).reshape(-1, 3)
    assert abs(np.corrcoef(left[1:, 0], left[:-1, 0])[0, 1]) < 0.06
    assert fitted.axes[0].std == pytest.approx(0.1, rel=0.05)


def test_the_document_is_json_with_the_agreed_keys():
    document = diagnosis_document(diagnosed())  # as above
    wanted = "verdict gap effects noise where untestable minimum_detectable next_manoeuvre"
    assert set(wanted.split()) <= set(document)
    gap = {"before_mps", "after_mps", "noise_floor_mps", "closure", "closure_ci95", "held_out", "not_explained_mps"}
    assert gap <= set(document["gap"])
    json.dumps(document)


def test_a_reference_in_an_earth_frame_without_attitude_is_refused(tmp_path, capsys):
    bag = tmp_path / "bag"
    succeed(capsys, "simulate", bag, "--duration", "60", "--imu-rate", "0")
    assert "no attitude" in fail(capsys, "diagnose", bag)
    with pytest.raises(InputError, match="fewer than two samples"):
        make_recording("none", (np.zeros(1), np.zeros((1, 3))), (np.zeros(1), np.zeros((1, 3))))


# ------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def bag_with_lever_arm(tmp_path_factory):
    from dvl_calib_ros.cli.main import main

    path = tmp_path_factory.mktemp("diagnosis") / "bag"
    options = (
        "--trajectory box --duration 300 --gnss-std 0.03 --misalignment 1 -1 2 --effect lever_arm:x_m=0.8,y_m=-0.3"
    )
    assert main(["simulate", str(path), *options.split()]) == 0
    return path


def test_what_was_found_can_be_applied_and_the_gap_is_gone(bag_with_lever_arm, tmp_path, capsys):
    applied, before, after = tmp_path / "applied.yaml", tmp_path / "before.json", tmp_path / "after.json"
    said, _ = succeed(
        capsys, "diagnose", bag_with_lever_arm, "--json", before, "--apply", applied, "-p", "gate_probability:=0.99"
    )
    first_line = said.splitlines()[0]
    assert "lever_arm" in first_line and first_line.endswith(".")  # the answer, in one sentence
    found = json.loads(before.read_text())
    assert found["effects"][0]["name"] == "lever_arm"
    assert "gate_probability: 0.99" in applied.read_text()
    succeed(capsys, "diagnose", bag_with_lever_arm, "--json", after, "--params", applied)
    left = json.loads(after.read_text())
    assert left["verdict"] == "no_gap"
    assert left["gap"]["before_mps"] == pytest.approx(left["gap"]["noise_floor_mps"], rel=0.03)
    assert found["gap"]["before_mps"] > 1.1 * found["gap"]["noise_floor_mps"]
    errors = []
    for options in ([], ["--params", applied]):
        succeed(capsys, "replay", bag_with_lever_arm, "--json", after, "--models", "M3", *options)
        errors.append(json.loads(after.read_text())["verification"]["M3"]["held_out"]["corrected_mps"])
    assert errors[1] < errors[0]


def test_the_twin_with_what_was_found_measures_what_was_recorded(bag_with_lever_arm, tmp_path, capsys):
    succeed(capsys, "diagnose", bag_with_lever_arm, "--twin", tmp_path / "twins")
    assert {path.name for path in (tmp_path / "twins").iterdir()} == {"bag_without", "bag_with"}
    recorded, without, with_it = (
        load_recordings([path], Parameters(), Topics()).recordings[0].dvl.values[10:-10]
        for path in (bag_with_lever_arm, tmp_path / "twins" / "bag_without", tmp_path / "twins" / "bag_with")
    )
    far, near = (np.sqrt(np.mean((twin - recorded) ** 2)) for twin in (without, with_it))
    assert near < 0.9 * far and near == pytest.approx(0.03, rel=0.2)  # the noise of the reference that it is made of


def test_the_first_screen_is_24_rows_of_80_and_ends_with_what_was_written(
    bag_with_lever_arm, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(common, "_width", lambda _: 80)
    output, errors = succeed(capsys, "diagnose", bag_with_lever_arm, "--apply", tmp_path / "applied.yaml")
    rows = (errors + output).splitlines()
    assert len(rows) <= 24 and "lever_arm" in output.splitlines()[0]
    assert rows[-1].startswith(f"wrote {tmp_path / 'applied.yaml'}: lever_arm [0.") and "held-out error" in rows[-1]
    assert (tmp_path / "applied.yaml").exists()
    assert all(any(row.startswith(word) for row in rows) for word in ("To do for lever_arm", "Cost: ", "Next: "))
    assert "Where the gap lies" not in output
    assert "Where the gap lies" in succeed(capsys, "diagnose", bag_with_lever_arm, "--verbose")[0]


def test_a_recording_is_not_held_out_from_its_own_copy_also_where_that_is_cut_off(bag_with_lever_arm, tmp_path):
    content = next(bag_with_lever_arm.glob("*.mcap")).read_bytes()
    (tmp_path / "copy.mcap").write_bytes(content[: 3 * len(content) // 4])
    with pytest.raises(InputError, match=r"copy\.mcap: hold the same samples"):
        load_recordings([bag_with_lever_arm, tmp_path / "copy.mcap"], Parameters(), Topics())


def test_a_bag_without_reference_is_refused(tmp_path, capsys):
    bag = tmp_path / "bag"
    succeed(capsys, "simulate", bag, "--duration", "60", "--gnss-rate", "0")
    assert "no reference velocity" in fail(capsys, "diagnose", bag)


def test_no_bag_is_refused(capsys):
    assert "required: BAG" in fail(capsys, "diagnose")


@pytest.mark.parametrize(
    ("not_explained", "closure", "verdict"),
    [
        (0.0139, 0.7, DiagnosisVerdict.KNOWN),
        (0.0141, 0.7, DiagnosisVerdict.UNKNOWN),
        (0.005, 0.07, DiagnosisVerdict.UNKNOWN),  # three runs of a boat: known, with 7 % closed
        (0.005, 0.01, DiagnosisVerdict.UNKNOWN),
        (0.005, -0.1, DiagnosisVerdict.UNKNOWN),
    ],
)
def test_effects_that_leave_more_than_the_noise_on_held_out_data_or_close_next_to_nothing_are_no_explanation(
    not_explained, closure, verdict
):
    """A step of a bias that a drift, a lag and an offset stood in for: 85 mm/s became 51, over noise of 14."""
    selection: Any = SimpleNamespace(selected=[SimpleNamespace(equivalent=())], fit=None, fitter=Mock())
    nothing_left = Unexplained(0.0, "", np.zeros((9, 3, 0)), np.zeros((9, 3, 0)))
    after = float(np.hypot(0.014, not_explained))
    gap = Gap(0.085, after, 0.014, closure, (closure - 0.1, closure + 0.1), not_explained)
    found = _verdict(selection, nothing_left, gap, 1.0)
    assert found is verdict
    effect = FoundEffect("scale_drift", (), {}, 0.7, 1e-9)
    reasons = _reasons(found, gap, [effect], nothing_left, [], 1)
    assert ("REST_FOLLOWS_NOTHING" in {each.code for each in reasons}) == (verdict is DiagnosisVerdict.UNKNOWN)
    assert f"is partly ({100 * closure:.0f} %) explained by scale_drift" in reasons[0].sentence
    explained = _reasons(found, replace(gap, closure=0.8), [effect], nothing_left, [], 1)
    assert "is explained by scale_drift" in explained[0].sentence


def test_an_error_of_a_third_of_the_noise_is_no_sound_bag():
    """94.4 mm/s were not explained beside `no_gap`."""
    selection: Any = SimpleNamespace(selected=[], fit=None, fitter=Mock())
    nothing_left = Unexplained(0.0, "", np.zeros((9, 3, 0)), np.zeros((9, 3, 0)))
    for not_explained, verdict in ((0.29, DiagnosisVerdict.NO_GAP), (0.31, DiagnosisVerdict.UNKNOWN)):
        after = float(np.hypot(1.0, not_explained))
        gap = Gap(after, after, 1.0, np.nan, (np.nan, np.nan), not_explained)
        assert _verdict(selection, nothing_left, gap, 1.0) is verdict


def test_what_the_very_stretch_that_is_held_out_tells_is_no_unknown_cause():
    """A current of 20 s, known exactly: elsewhere nothing tells of it, and what that leaves was called unknown."""
    current = "water_lock:east_mps=0.4,north_mps=0.1,from_s=101,to_s=119"
    diagnosis = diagnosed(effects=[LEVER, "dvl_time_offset:seconds=1.2", current], seconds=300.0, gnss_std=0.02)
    assert set(found(diagnosis)) == {"lever_arm", "dvl_time_offset", "water_lock"}
    assert diagnosis.gap.after > 2.0 * diagnosis.gap.noise_floor
    assert diagnosis.gap.not_expected < 0.3 * diagnosis.gap.noise_floor
    assert diagnosis.verdict is DiagnosisVerdict.KNOWN


def test_a_stretch_is_left_open_by_no_more_than_what_it_has_beyond_the_noise():
    after = np.sqrt([[5.0], [3.0], [2.0], [2.0], [1.0], [0.0]])
    residuals = HeldOutResiduals(
        after, after, np.ones((6, 1)), np.array([0, 0, 1, 1, 2, 2]), np.array([900.0, 1.0, 0.5, 0.5, 7.0, 0.0])
    )
    np.testing.assert_allclose(residuals.undetermined_of_blocks(), [6.0, 1.0, 0.0])


@pytest.mark.parametrize("name", ["lever_arm", "quadratic_scale", "mount_flexure", "attitude_time_offset"])
def test_the_derivatives_beside_a_lag_are_those_of_what_lags(name):
    """Those of a velocity that does not lag led a fit astray: a pitch of 6 degrees for one of -2."""
    problem = problem_of(simulate(scenario(effects=[LAGGING], **SMOOTH)))
    lag, effect = EFFECTS["reference_lag"], EFFECTS[name]
    values = {lag.name: ({"time_constant_s": 1.3},), name: (effect.defaults,)}
    about = no_effect().with_effects([lag, effect], 1, values)
    columns = problem.all_columns(about, problem.all_seen(about))
    for number in (0, 1, 2, 3, *range(7, columns.shape[2])):  # scales of sway and heave do next to nothing
        step = np.zeros(columns.shape[2])
        step[number] = 0.01
        ends = [problem.residual(problem.all_seen(about.moved(sign * step))) for sign in (-1.0, 1.0)]
        expected = (ends[1] - ends[0])[8:-8] / 0.02
        error = np.sqrt(np.mean((columns[8:-8, :, number] - expected) ** 2)) / np.sqrt(np.mean(expected**2))
        assert error < 0.1, (name, number, error)


def test_what_a_filter_remembers_of_before_the_recording_is_no_error_of_its_first_seconds():
    """A lag of 1.2 s was 1.06 s, and unknown: the filter was taken to begin with the recording."""
    given = scenario(effects=["reference_lag:time_constant_s=1.2"], gnss_std=0.002, errors=DvlErrors())
    run = simulate(given)
    from_ns = run.dvl[0].stamp_ns + 10**11
    later = Run(*([each for each in stream if each.stamp_ns >= from_ns] for stream in (run.dvl, run.gnss, run.imu)))
    problem = problem_of(later)
    lag = EFFECTS["reference_lag"]
    hypothesis = no_effect().with_effects([lag], 1, {lag.name: ({"time_constant_s": 1.2},)})
    left = np.linalg.norm(problem.residual(problem.all_seen(hypothesis)), axis=1)
    assert left[:4].max() < 0.01


def test_a_height_that_is_known_and_not_fitted_is_no_part_of_the_derivatives_of_the_rest():
    problem = problem_of(simulate(scenario(**SMOOTH)))
    arm = EFFECTS["lever_arm"]
    values = {"x_m": 1.0, "y_m": 0.0, "z_m": -1.4}
    about = no_effect().with_effects([arm], 1, {arm.name: (values,)})
    seen = problem.all_seen(about)
    of_all = problem.columns(about, seen, arm, [values])
    np.testing.assert_allclose(problem.columns(about, seen, arm.without({"z_m"}), [values]), of_all[:, :, :2])


@pytest.mark.parametrize(
    ("by_metre", "is_shown", "std"),
    [(0.005, False, 0.004 / 0.005), (0.0096, True, 0.004 / 0.0096), (0.02, True, 0.0)],
)
def test_a_height_is_looked_for_where_one_of_a_metre_shows_and_known_by_what_a_model_lacks(by_metre, is_shown, std):
    """Held at nothing at 9.6 mm/s a metre, one of 2.8 m turned the rest of the arm and was an unknown cause."""
    arm = EFFECTS["lever_arm"]
    columns = np.zeros((100, 2, 3))
    columns[:, 0, 0] = columns[:, 1, 1] = 0.07
    columns[:, 0, 2] = by_metre
    problem = Mock(spec=Problem, measured=(True, True, False), recordings=[], columns=lambda *_: columns)
    shown = observable_parts({arm.name: arm}, problem)[arm.name]
    assert [each.name for each in shown.parameters] == ["x_m", "y_m", "z_m"][: 2 + is_shown]
    hypothesis = no_effect().with_effects([arm], 1, {})
    fit = Mock(spec=Fit, hypothesis=hypothesis, values=hypothesis.values)
    fit.columns = np.concatenate([np.zeros((100, 2, 6)), columns], axis=2)
    added = np.diag(with_observable(problem, fit, np.zeros((9, 9))))
    assert np.sqrt(added) == pytest.approx([0.0] * 8 + [std])
    assert not with_observable(Mock(spec=Problem, measured=(True, True, True)), fit, np.zeros((9, 9))).any()
    for times, stands in ((1.9, not std), (-2.1, True)):
        fit.values = {arm.name: ({"x_m": 0.0, "y_m": 0.0, "z_m": times * std},)}
        fit.effects = (arm,)
        left = without_insignificant(problem, fit)
        assert left is None if stands else [each.name for each in left.parameters] == ["x_m", "y_m"]


def test_what_turns_show_best_of_an_arm_is_said_however_little_they_show():
    """Of a vehicle that hardly turns nothing of the arm would be left, and an effect without a parameter."""
    arm = EFFECTS["lever_arm"]
    hypothesis = no_effect().with_effects([arm], 1, {arm.name: ({"x_m": 0.1, "y_m": 0.1, "z_m": 0.1},)})
    fit = Mock(spec=Fit, hypothesis=hypothesis, values=hypothesis.values, effects=(arm,))
    fit.columns = np.concatenate([np.zeros((100, 2, 6)), np.full((100, 2, 3), [0.005, 0.005, 0.0005])], axis=2)
    left = without_insignificant(Mock(spec=Problem, measured=(True, True, False)), fit)
    assert left is not None and [each.name for each in left.parameters] == ["x_m", "y_m"]


def test_a_height_that_is_not_said_is_held_where_it_is(monkeypatch):
    """At nothing, half a metre of it was what is left, and right answers were unknown for it."""
    monkeypatch.setattr(observable_parameters, "MIN_SHARE", 0.8)
    monkeypatch.setattr(observable_parameters, "ARM_FROM_M", 10.0)
    given = scenario(effects=["lever_arm:x_m=-0.6,y_m=-1.6,z_m=-0.5"], gnss_std=0.01, waves=Waves(0.2, 6.0))
    diagnosis = diagnose_recordings([recording_of(simulate(given), given.gnss_frame, axes="xy")], Parameters())
    assert diagnosis.verdict is DiagnosisVerdict.KNOWN
    assert {*found(diagnosis)["lever_arm"]} == {"x_m", "y_m"}
    assert_within(diagnosis, "lever_arm", x_m=-0.6, y_m=-1.6)


def test_an_arm_that_may_be_another_is_so_after_an_effect_was_dropped():
    """By how much was a vector of the effects there had been: the diagnosis broke."""
    lag, arm = EFFECTS["reference_lag"], EFFECTS["lever_arm"]
    values = {lag.name: ({"time_constant_s": 1.0},), arm.name: ({"x_m": 0.5, "y_m": 0.1, "z_m": 0.0},)}
    there_were, there_are = (no_effect().with_effects(some, 1, values) for some in ([lag, arm], [arm.without({"z_m"})]))
    fit = Mock(spec=Fit, hypothesis=there_were, values=there_were.values)
    near, far = ({arm.name: ({"x_m": x, "y_m": 0.2},)} for x in (0.6, 0.9))
    moved = arm_change(fit, [Mock(spec=Hypothesis, values=each) for each in (near, far, {})])
    added = with_changes(Mock(spec=Fit, hypothesis=there_are), np.eye(8), moved) - np.eye(8)
    expected = np.zeros((8, 8))
    expected[6:, 6:] = np.outer([0.4, 0.1], [0.4, 0.1])
    np.testing.assert_allclose(added, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("late", "starts"),
    [
        ({"reference_time_offset": 1.5}, [("reference_lag", 1.5)]),
        ({"reference_lag": 1.5}, [("reference_time_offset", 1.5)]),
        (
            {"reference_lag": 1.0, "reference_time_offset": 0.5},
            [("reference_lag", 1.5), ("reference_time_offset", 1.5)],
        ),
        ({"reference_time_offset": -1.5}, []),
        ({}, []),
    ],
)
def test_what_makes_a_reference_late_is_tried_as_a_lag_and_as_a_delay(late, starts):
    values = {name: ({EFFECTS[name].parameters[0].name: seconds},) for name, seconds in late.items()}
    found = lags_and_delays(Mock(spec=Fit, values=values, n_recordings=1), EFFECTS)
    assert [(name, *per[0].values()) for one in found for name, per in one.items()] == starts
