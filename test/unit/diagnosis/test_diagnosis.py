"""The diagnosis on simulated runs: what it finds, what it does not claim, and the loop from finding to compensation."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import fail, succeed

from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import VelocityFrame
from dvl_calib_ros.diagnosis.diagnose import diagnose_recordings
from dvl_calib_ros.diagnosis.dictionary import Dictionary
from dvl_calib_ros.diagnosis.noise import Arma, Noise, segments_of, white_noise
from dvl_calib_ros.diagnosis.problem import PRIOR_STD, calibrated, lowpassed
from dvl_calib_ros.diagnosis.recordings import make_recording
from dvl_calib_ros.diagnosis.results import Verdict, diagnosis_document
from dvl_calib_ros.diagnosis.unexplained import lines
from dvl_calib_ros.effects.base import EffectInput
from dvl_calib_ros.effects.registry import EFFECTS
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.simulation.sensors import DvlErrors, measure_dvl
from dvl_calib_ros.simulation.trajectories import make_motion

pytestmark = pytest.mark.slow

CLAIMS = (Verdict.KNOWN, Verdict.AMBIGUOUS, Verdict.UNKNOWN)


def recording(
    trajectory="box",
    seconds=600.0,
    seed=0,
    effects=None,
    gnss_std=0.05,
    unknown=None,
    imu=True,
    misalignment=0.02,
    beam_std=0.003,
    **more,
):
    """A run with effects by name, as it comes out of pairing; 2 Hz, so that the tests are quick."""
    rng = np.random.default_rng(seed)
    motion = make_motion(trajectory, seconds, 100.0)
    at = slice(0, None, 50)
    time, velocity = motion.time[at], motion.velocity_body[at]
    rotation, rate = motion.rotation_enu_from_body[at], motion.angular_velocity[at]
    seen = EffectInput(time, velocity, np.eye(3), rotation, rate)
    trace = np.zeros_like(velocity)
    for name, values in (effects or {}).items():
        trace = trace + EFFECTS[name].trace(seen, EFFECTS[name].defaults | values)
    if unknown is not None:
        trace = trace + unknown(seen)
    errors = DvlErrors((misalignment, -misalignment, 1.5 * misalignment), (0.006, 0.006, 0.006), beam_std=beam_std)
    measured = measure_dvl(velocity + trace, errors, np.eye(3), rng)
    reference = velocity + rng.normal(0.0, gnss_std, velocity.shape)
    attitude = {"rotation_enu_from_body": rotation, "angular_velocity": rate} if imu else {}
    frame = VelocityFrame.ENU if imu else VelocityFrame.BODY
    return make_recording(
        "run", time, measured, reference, reference_frame=frame, reference_rate=2.0, **attitude, **more
    )


def diagnosed(*args, **changes):
    return diagnose_recordings([recording(*args, **changes)], Parameters())


# ------------------------------------------------------------------ what is found


def test_a_run_without_a_gap_is_cleared_with_what_it_would_have_shown():
    diagnosis = diagnosed()
    assert diagnosis.verdict is Verdict.NO_GAP
    assert diagnosis.effects == () and diagnosis.where == ()
    assert set(diagnosis.minimum_detectable) == set(EFFECTS)
    assert 0.0 < diagnosis.minimum_detectable["lever_arm"]["x_m"] < 0.3
    assert diagnosis.gap.noise_floor == pytest.approx(np.sqrt(3.0) * 0.05, rel=0.1)


@pytest.mark.parametrize("seed", range(1, 3))
def test_noise_alone_is_not_taken_for_an_effect(seed):
    trajectory = ("box", "lawnmower", "figure8")[seed % 3]
    assert diagnosed(trajectory, seed=seed, seconds=400.0).verdict not in CLAIMS


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("lever_arm", {"x_m": 0.4, "y_m": -0.2}),
        ("velocity_bias", {"x_mps": 0.1}),
        ("heading_error", {"sin_rad": 0.02, "cos_rad": 0.02}),
        ("tilt_coupling", {"x_per_pitch": 1.5}),
    ],
)
def test_an_effect_is_named_first_and_its_size_is_within_the_interval(name, values):
    diagnosis = diagnosed(effects={name: values})
    first = diagnosis.effects[0]
    assert first.name == name
    assert first.p < 0.01 and diagnosis.gap.closure > 0.8
    for parameter, value in values.items():
        estimate, low, high = first.parameters[parameter]
        margin = high - estimate  # twice the interval: one of many would be outside the interval itself
        assert low - margin < value < high + margin


def test_two_effects_are_both_found():
    diagnosis = diagnosed(effects={"lever_arm": {"x_m": 0.5}, "heading_error": {"cos_rad": 0.04}})
    assert {effect.name for effect in diagnosis.effects} == {"lever_arm", "heading_error"}
    assert diagnosis.gap.closure > 0.9


def test_a_late_dvl_beside_a_lever_arm_is_told_apart_from_a_late_reference():
    effects = {"lever_arm": {"x_m": 0.8, "y_m": -0.3}, "dvl_time_offset": {"seconds": 0.25}}
    diagnosis = diagnosed("free", effects=effects, seed=4)
    assert [effect.name for effect in diagnosis.effects] == ["lever_arm", "dvl_time_offset"]
    seconds, low, high = diagnosis.effects[1].parameters["seconds"]
    assert low - (high - seconds) < 0.25 < high + (high - seconds)


def test_the_noise_of_a_dvl_at_constant_speed_is_not_taken_for_a_delay():
    diagnosis = diagnosed("straight", beam_std=0.02, gnss_std=0.05)
    assert diagnosis.verdict not in CLAIMS


def test_what_comes_and_goes_with_a_period_of_its_own_is_unknown():
    def bursts(seen):
        return np.outer(seen.time % 22.0 < 9.0, [0.03, 0.03, 0.0])

    assert diagnosed(unknown=bursts).verdict is Verdict.UNKNOWN


def test_a_line_in_the_spectrum_is_found_at_its_period_and_noise_has_none(rng):
    problem = calibrated([recording()], np.eye(3))
    innovations = rng.standard_normal((len(problem.time), 3))
    (chance,) = lines(problem, innovations)
    innovations[:, 1] += 0.4 * np.sin(2.0 * np.pi * problem.time / 34.0)
    (line,) = lines(problem, innovations)
    assert line.period_s == pytest.approx(34.0, rel=0.03)
    assert line.log_p < np.log(1e-6) < chance.log_p


def test_a_gap_that_the_library_lacks_is_unknown():
    def doubled_heading(seen):
        yaw = np.arctan2(seen.attitude[:, 1, 0], seen.attitude[:, 0, 0])
        return np.outer(np.cos(2.0 * yaw), [0.0, 0.0, 0.05])

    assert diagnosed(unknown=doubled_heading).verdict is Verdict.UNKNOWN


def test_an_effect_in_part_of_the_run_is_found_with_its_times():
    diagnosis = diagnosed(effects={"water_lock": {"east_mps": 0.15, "from_s": 150.0, "to_s": 400.0}})
    first = diagnosis.effects[0]
    assert first.name == "water_lock"
    assert first.parameters["from_s"][0] == pytest.approx(150.0, abs=25.0)
    assert first.parameters["to_s"][0] == pytest.approx(400.0, abs=25.0)


def test_without_imu_what_needs_it_is_listed_as_untestable():
    diagnosis = diagnosed(imu=False)
    assert set(diagnosis.untestable) == {name for name, effect in EFFECTS.items() if effect.needs}
    assert diagnosis.untestable["water_lock"] == "attitude"


# ------------------------------------------------------------------ what cannot be said


def test_a_straight_run_at_one_speed_makes_no_confident_claim_about_a_bias():
    diagnosis = diagnosed("straight", effects={"velocity_bias": {"x_mps": 0.1}})
    assert diagnosis.verdict not in (Verdict.KNOWN, Verdict.NO_GAP)


def test_a_run_that_is_too_short_says_so():
    diagnosis = diagnosed(seconds=30.0)
    assert diagnosis.verdict is Verdict.INSUFFICIENT_EXCITATION and "too few" in diagnosis.sentence


def test_a_constant_reference_is_insufficient():
    run = recording()
    still = make_recording("still", run.time, run.velocity_dvl, np.ones_like(run.reference_body))
    diagnosis = diagnose_recordings([still], Parameters())
    assert diagnosis.verdict is Verdict.INSUFFICIENT_EXCITATION and "constant" in diagnosis.sentence


def test_recordings_of_different_mountings_are_refused():
    with pytest.raises(InputError, match="mounted differently"):
        diagnose_recordings([recording(misalignment=0.0), recording(misalignment=0.15)], Parameters())


# ------------------------------------------------------------------ its parts


def test_the_calibration_is_recovered_from_a_run_without_noise():
    errors = DvlErrors((0.03, -0.02, 0.05), (0.01, 0.01, 0.01))
    motion = make_motion("figure8", 300.0, 5.0)
    measured = measure_dvl(motion.velocity_body, errors, np.eye(3), np.random.default_rng(0))
    problem = calibrated([make_recording("run", motion.time, measured, motion.velocity_body)], np.eye(3))
    assert np.abs(problem.residual).max() < 1e-4
    assert problem.calibration.scale[0] == pytest.approx(0.01, abs=1e-4)


def test_the_calibration_beside_an_effect_is_as_good_as_its_standard_deviation_says():
    scores = []
    for seed in range(6):
        run = recording("free", seed=seed, misalignment=0.0, effects={"lever_arm": {"x_m": 0.5}})
        series = diagnose_recordings([run], Parameters(), with_series=True).series
        assert "lever_arm" in series.traces
        truth = np.array([0.0, 0.0, 0.0, 0.006, 0.006, 0.006])
        scores.append((np.concatenate([series.phi, series.scale]) - truth) / series.calibration_std)
    assert np.abs(scores).max() < 4.0
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.5


@pytest.fixture
def seen():
    """A dictionary of all effects through white noise, a residual of noise and a lever arm, and what it is made of."""
    run = recording(seconds=200.0, effects={"lever_arm": {"x_m": 0.3}})
    problem = calibrated([run], np.eye(3))
    noise = white_noise(problem.residual, problem.segments, None)
    dictionary = Dictionary(problem, EFFECTS)
    return dictionary.seen(noise, problem.residual), problem, noise


def least_squares_misfit(problem, noise, variants):
    """Sum of squares that calibration and variants leave of a residual, with their priors; and the steps."""
    target, columns, priors = problem.residual - problem.base @ problem.prior_change, [problem.base], [PRIOR_STD]
    for variant in variants:
        target = target if variant.offset is None else target - variant.offset
        columns.append(variant.columns)
        priors.append(variant.std)
    white = noise.whiten(np.concatenate(columns, axis=2))
    prior = np.diag(1.0 / np.concatenate(priors))
    right = np.concatenate([noise.whiten(target), np.zeros(len(prior))])
    steps, *_ = np.linalg.lstsq(np.concatenate([white, prior]), right, rcond=None)
    return float(np.sum((np.concatenate([white, prior]) @ steps - right) ** 2)), steps


def test_a_hypothesis_solved_in_the_gram_matrix_is_the_least_squares_fit(seen):
    seen, problem, noise = seen
    without, _ = least_squares_misfit(problem, noise, [])
    for name, candidate in seen.candidates([]).items():
        variant = seen.dictionary.variants[candidate.index]
        left, steps = least_squares_misfit(problem, noise, [variant])
        assert candidate.drop == pytest.approx(without - left, rel=1e-6, abs=1e-4), name
        np.testing.assert_allclose(seen.solved([candidate.index]), steps, rtol=1e-5, atol=1e-7)


def test_an_effect_in_the_place_of_another_is_judged_as_if_that_one_were_not_there(seen):
    seen = seen[0]
    first = seen.candidates([])["lever_arm"]
    instead = seen.candidates([first.index], instead_of=first.index)
    assert instead["sideslip"].drop == pytest.approx(seen.candidates([])["sideslip"].drop)
    assert instead["lever_arm"].drop == pytest.approx(first.drop)


def test_samples_held_out_do_not_count(seen):
    seen, problem, noise = seen
    held = np.arange(len(problem.time)) % 3 == 0
    kept = np.repeat(~held, 3)
    white = noise.whiten(problem.base)[kept]
    right = noise.whiten(problem.residual - problem.base @ problem.prior_change)[kept]
    expected = np.linalg.solve(white.T @ white + np.diag(PRIOR_STD**-2.0), white.T @ right)
    np.testing.assert_allclose(seen.without(held).solved([]), expected, rtol=1e-6)


def test_a_low_pass_changes_nothing_when_applied_again(rng):
    time = np.arange(0.0, 300.0, 0.5)
    velocity = np.column_stack([1.0 + 0.2 * np.sin(0.3 * time), 0.1 * np.cos(0.2 * time), 0.0 * time])
    noisy = velocity + rng.normal(0.0, 0.01, velocity.shape)
    once = lowpassed(time, noisy, noisy)
    np.testing.assert_allclose(lowpassed(time, once, noisy), once, atol=1e-12)
    assert np.std(once - velocity) < 0.5 * np.std(noisy - velocity)


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
    document = diagnosis_document(diagnosed(seconds=200.0))
    wanted = "verdict gap effects noise where untestable minimum_detectable next_manoeuvre"
    assert set(document) == set(wanted.split())
    json.dumps(document)


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
    succeed(
        capsys, "diagnose", bag_with_lever_arm, "--json", before, "--apply", applied, "-p", "gate_probability:=0.99"
    )
    found = json.loads(before.read_text())
    assert found["effects"][0]["name"] == "lever_arm"
    assert "gate_probability: 0.99" in applied.read_text()
    succeed(capsys, "diagnose", bag_with_lever_arm, "--json", after, "--params", applied)
    left = json.loads(after.read_text())
    assert left["verdict"] == "no_gap"
    assert left["gap"]["before_mps"] < 0.25 * found["gap"]["before_mps"]
    errors = []
    for options in ([], ["--params", applied]):
        succeed(capsys, "replay", bag_with_lever_arm, "--json", after, "--models", "G1", *options)
        errors.append(json.loads(after.read_text())["verification"]["G1"]["held_out"]["corrected_mps"])
    assert errors[1] < errors[0]


def test_the_answer_comes_first_in_one_sentence(bag_with_lever_arm, capsys):
    output, _ = succeed(capsys, "diagnose", bag_with_lever_arm)
    assert "lever_arm" in output.splitlines()[0] and output.splitlines()[0].endswith(".")


def test_a_bag_without_reference_is_refused(tmp_path, capsys):
    bag = tmp_path / "bag"
    succeed(capsys, "simulate", bag, "--duration", "60", "--gnss-rate", "0")
    assert "no reference velocity" in fail(capsys, "diagnose", bag)


def test_no_bag_is_refused(capsys):
    assert "name a bag" in fail(capsys, "diagnose")
