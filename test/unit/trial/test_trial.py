"""The blind trial: its generator, how strong its faults are, what it keeps sealed, how it goes on, how it scores."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.numerics.frames import attitude_enu_flu_from_ned_frd, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.effects.base import EffectInput, EffectNeeds
from dvl_calib_ros.effects.registry import EFFECTS
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.logs.trajectories import read_columns
from validation.trial import generator
from validation.trial.cases import draw
from validation.trial.generator import Noise, record
from validation.trial.motion import MARGIN_S, TUNING_KINDS, manoeuvre
from validation.trial.plan import Case, Family, plan
from validation.trial.recorded import recorded
from validation.trial.run import Trial, read_answers
from validation.trial.scored import join
from validation.trial.strength import Scene, Yardstick
from validation.trial.tables import score
from validation.trial.truth import Category, unseal
from validation.trial.vehicle import FAULTS, NEED_ATTITUDE, Vehicle, dvl_stamps

pytestmark = pytest.mark.slow

TOPICS = ("dvl/twist", "gnss/twist", "imu/data")


def short_scene(kind="free", seconds=240.0, in_body=False, **rest) -> Scene:
    """A scene with everything in it, seen by slow sensors."""
    vehicle = Vehicle((0.0, 0.0, np.pi / 4), (0.02, -0.01, 0.03), 0.005, beam_angle_error=0.002)
    motion = manoeuvre(kind, seconds, np.random.default_rng(7))
    settings = {"dvl_rate": 5.0, "gnss_rate": 5.0, "beam_std": 0.005, "gnss_std": 0.1, "gnss_phase_s": 0.05}
    return Scene((motion,), vehicle, in_body=in_body, **(settings | rest))


def short_cases(n: int) -> list[Case]:
    """The cheapest cases to record: nulls of recorded length, which need no strength to be solved for."""
    return [Case(Category.NULL, kind, number=number) for number in range(n) for kind in TUNING_KINDS][:n]


def messages(bag: Path) -> list:
    with BagReader([bag]) as reader:
        return list(reader.raw_messages(TOPICS))


# ------------------------------------------------------------------ plan and generator


def test_no_two_cases_share_an_id_and_a_part_of_the_plan_is_a_part_of_the_longer_one():
    cases = plan()
    assert len({case.id for case in cases}) == len(cases) > 1500
    tuning = plan(TUNING_KINDS)
    assert {case.kind for case in tuning} == {*TUNING_KINDS, "straight", "one_speed_box"}
    assert {case.family for case in tuning} == {Family.SIMULATED}
    assert [case for case in cases if case in set(tuning)] == tuning


@pytest.mark.parametrize("family", Family)
def test_any_beginning_of_the_plan_is_a_fair_part_of_each_family(family):
    cases = [case for case in plan() if case.family is family]
    beginning = [case for case in plan()[:500] if case.family is family]
    assert len(beginning) == 100  # families take turns
    for category in Category:
        whole = sum(case.category is category for case in cases) / len(cases)
        assert sum(case.category is category for case in beginning) / 100 == pytest.approx(whole, abs=0.03)


def test_a_case_is_the_same_whenever_it_is_recorded_and_another_with_another_seed(tmp_path):
    first, second = short_cases(2)
    alone = record(second, 5, tmp_path / "alone")
    record(first, 5, tmp_path / "first")
    after = record(second, 5, tmp_path / "after")
    other = record(second, 6, tmp_path / "other")
    assert alone.drawn.truth == after.drawn.truth
    assert messages(alone.bags[0]) == messages(after.bags[0])
    assert messages(alone.bags[0]) != messages(other.bags[0])


PEERS = "answers, bic, correlation, evidence, forward, residual, search, sparse"


@pytest.mark.parametrize(
    "imports", ["from validation.trial import generator, run, tables", f"from validation.peers import {PEERS}"]
)
def test_generator_and_peers_share_no_code_with_the_diagnosis(imports):
    code = (
        f"import sys\n{imports}\n"
        "names = ('effects', 'simulation', 'diagnosis')\n"
        "print([m for m in sys.modules if m.startswith(tuple(f'dvl_calib_ros.{n}' for n in names))])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert shown.stdout.strip() == "[]"


def test_only_the_question_itself_reaches_the_diagnosis():
    """Also not by an import within a function."""
    found = []
    for path in Path(generator.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            module = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
            if re.match(r"dvl_calib_ros\.(effects|simulation|diagnosis)\b", module):
                found.append((path.name, module))
    assert found == [("run.py", "dvl_calib_ros.diagnosis.diagnose")]


# Effect -> parameters at which its trace is large
SIZES = {
    name: {
        each: 2.0 * size * sign for (each, size), sign in zip(fault.typical.items(), (1, -0.6, 0.8, 0.5), strict=False)
    }
    for name, fault in FAULTS.items()
}
SIZES["water_lock"] |= {"from_s": 60.0, "to_s": 150.0}
SIZES["time_offset_jump"] |= {"at_s": 90.0}


def test_the_trial_has_every_effect_that_shows_at_the_surface():
    own = {name: each for name, each in EFFECTS.items() if type(each).__module__.startswith("dvl_calib_ros")}
    assert {name for name, each in own.items() if EffectNeeds.DEPTH not in each.needs} == set(FAULTS)


@pytest.mark.parametrize("in_body", [False, True], ids=["enu", "body"])
@pytest.mark.parametrize("name", [name for name in FAULTS if name in EFFECTS])
def test_the_library_means_by_its_names_what_the_generator_means(name, in_body):
    """Two pieces of code, written apart, agree on sign, size and frame of every effect."""
    if in_body and name in NEED_ATTITUDE:
        pytest.skip("a reference in the body's frame is not turned by the attitude")
    scene = short_scene(in_body=in_body)
    yardstick = Yardstick(scene)
    (motion,) = scene.motions
    dvl, gnss = scene.dvl_times(motion), scene.gnss_stamps(motion)
    times = dvl[(dvl >= gnss[0]) & (dvl <= gnss[-1])]
    # the generator compares what the DVL measured at a time, the library what it has stamped with that
    times = dvl_stamps(dvl, {name: SIZES[name]})[(dvl >= gnss[0]) & (dvl <= gnss[-1])]
    state = motion.at(times)
    effect = EFFECTS[name]
    seen = EffectInput(
        times,
        state.velocity_body,
        rotation_from_rpy(scene.vehicle.mounting_rpy).T,
        state.attitude.as_matrix(),
        state.rates,
        VelocityFrame.BODY if in_body else VelocityFrame.ENU,
    )
    by_library = effect.trace(seen, effect.defaults | SIZES[name]) @ seen.rotation_dvl_from_body.T
    by_generator = yardstick._difference({name: SIZES[name]}) - yardstick._sound
    middle = slice(50, -50)  # what was before the first sample is known to the generator only
    apart = np.sqrt(np.mean((by_library - by_generator)[middle] ** 2) / np.mean(by_generator[middle] ** 2))
    # misalignment of 2 degrees, by which the library's trace is not turned; interpolation; a sample at a window's end
    assert apart < 0.1


def test_recorded_motion_is_the_recording_turned_into_forward_left_up(snapir):
    motion = recorded("T05")
    time, velocity_frd, _ = read_columns(snapir / "T05_dvl.csv", "m/s")
    _, rpy, _ = read_columns(snapir / "T05_attitude.csv", "rad")
    inside = (time > time[0] + MARGIN_S) & (time < time[-1] - MARGIN_S)
    state = motion.at(time[inside] - time[0] - MARGIN_S)
    off = np.linalg.norm(state.velocity_body - velocity_frd[inside] * [1.0, -1.0, -1.0], axis=1)
    assert np.median(off) < 0.05  # smoothed
    recorded_attitude = attitude_enu_flu_from_ned_frd(rpy[inside])
    turned = np.einsum("nji,njk->nik", recorded_attitude, state.attitude.as_matrix())
    assert np.median(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))) < np.deg2rad(2.0)


# ------------------------------------------------------------------ strength


@pytest.mark.parametrize(("name", "rates"), [("lever_arm", (4.0, 4.0)), ("heading_error", (2.0, 8.0))])
def test_q_is_the_norm_of_the_trace_outside_of_the_calibration_over_the_noise(name, rates, monkeypatch):
    """Computed again from the samples of two bags without noise, one with the fault and one without."""
    case = Case(Category.SINGLE, "box", name, 12.0)
    drawn = draw(case, 1)
    scene = replace(drawn.scene, dvl_rate=rates[0], gnss_rate=rates[1])
    q = Yardstick(scene).q(drawn.faults)
    monkeypatch.setattr(generator, "IMU_ATTITUDE_STD", 0.0)
    clean = replace(drawn, scene=replace(scene, beam_std=0.0, gnss_std=0.0))
    sound = replace(clean, faults={})
    trace = residual_of(clean) - residual_of(sound)
    velocity = reference_of(sound)
    # the same six columns, another way: what skew and diagonal matrices make of the velocity
    columns = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        skew = np.zeros((3, 3))
        skew[j, i], skew[i, j] = 1.0, -1.0
        columns.append(velocity @ skew.T)
    columns += [velocity * np.eye(3)[axis] for axis in range(3)]
    beams = scene.vehicle.beams()
    dvl_variance = scene.beam_std**2 * np.diag(np.linalg.inv(beams.T @ beams))
    shares = {(4.0, 4.0): 1.0, (2.0, 8.0): None}[rates]
    part = (-scene.gnss_phase_s * rates[1]) % 1.0
    sharing = shares if shares is not None else part**2 + (1 - part) ** 2
    weights = 1.0 / np.sqrt(dvl_variance + sharing * scene.gnss_std**2)
    design = np.column_stack([(column * weights).ravel() for column in columns])
    white = (trace * weights).ravel()
    left = white - design @ np.linalg.lstsq(design, white, rcond=None)[0]
    assert np.linalg.norm(left) == pytest.approx(q, rel=0.02)


def samples_of(drawn):
    return generator._samples(drawn, 0, Noise(np.random.default_rng(0)), 0)


def arrays_of(samples):
    return np.array([s.stamp_ns for s in samples]) * 1e-9, np.array([s.velocity for s in samples])


def reference_of(drawn):
    """The reference at the DVL's stamps in the DVL's nominal frame."""
    dvl, gnss, imu = samples_of(drawn)
    times, _ = arrays_of(dvl)
    stamps, velocity = arrays_of(gnss)
    keep = times[(times >= stamps[0]) & (times <= stamps[-1])]
    paired = np.column_stack([np.interp(keep, stamps, column) for column in velocity.T])
    if not drawn.scene.in_body:
        from scipy.spatial.transform import Rotation, Slerp

        attitude = Slerp([s.stamp_ns * 1e-9 for s in imu], Rotation.from_quat([s.orientation for s in imu]))
        last = imu[-1].stamp_ns * 1e-9
        paired = attitude(np.minimum(keep, last)).apply(paired, inverse=True)
    return paired @ rotation_from_rpy(drawn.scene.vehicle.mounting_rpy)


def residual_of(drawn):
    dvl, gnss, _ = samples_of(drawn)
    times, measured = arrays_of(dvl)
    stamps, _ = arrays_of(gnss)
    return measured[(times >= stamps[0]) & (times <= stamps[-1])] - reference_of(drawn)


@pytest.mark.parametrize("q", [5.0, 40.0])
def test_a_fault_has_the_strength_that_the_case_wants(q):
    drawn = draw(Case(Category.SINGLE, "figure8", "sideslip", q), 3)
    assert drawn.truth.q["sideslip"] == pytest.approx(q, rel=0.01)
    assert set(drawn.truth.distances) >= {"lever_arm", "reference_lag"} and "sideslip" not in drawn.truth.distances
    assert all(0.0 <= left <= q * 1.01 for left in drawn.truth.distances.values())


def test_the_two_of_a_pair_can_be_told_apart_and_what_is_unknown_is_not_in_the_library():
    pair = draw(Case(Category.PAIR, "zigzag", q=12.0), 3).truth
    assert len(pair.faults) == 2 and pair.correlation < 0.8
    assert list(pair.q.values()) == pytest.approx([12.0, 12.0], rel=0.01)
    unknown = draw(Case(Category.UNKNOWN, "zigzag", "slow_heave", 20.0), 3).truth
    assert unknown.outside_share >= 0.35 and unknown.q["slow_heave"] == pytest.approx(20.0, rel=0.01)
    assert "slow_heave" not in EFFECTS


def test_what_cannot_be_identified_leaves_nothing_beyond_the_calibration():
    truth = draw(Case(Category.UNIDENTIFIABLE, "straight", "velocity_bias"), 3).truth
    assert truth.q["velocity_bias"] < 0.5
    alike = draw(Case(Category.UNIDENTIFIABLE, "one_speed_box", "sideslip", 20.0), 3).truth
    assert alike.distances["lever_arm"] < 4.0


# ------------------------------------------------------------------ hard nulls


def test_hard_nulls_are_as_hard_as_they_say(rng):
    scene = short_scene()
    coloured = Noise(rng, correlation_s=2.0).of_reference(20000, 5.0)
    assert np.std(coloured) == pytest.approx(1.0, rel=0.1)
    assert np.corrcoef(coloured[:-1, 0], coloured[1:, 0])[0, 1] == pytest.approx(np.exp(-0.1), abs=0.02)
    heavy = Noise.of("heavy_tails", scene, rng).white((100000,))
    assert np.mean(np.abs(heavy) > 5.0) > 1e-3  # of a normal distribution 6e-7
    stamps = np.arange(0.0, 300.0, 0.2)
    assert np.diff(Noise.of("gaps", scene, rng).sampled(stamps, 5.0)).max() > 4.0
    assert np.std(np.diff(Noise.of("jitter", scene, rng).sampled(stamps, 5.0))) > 0.02
    assert np.allclose(Noise.of(None, scene, rng).sampled(stamps, 5.0), stamps)


def test_wrong_covariances_are_wrong_only_in_what_they_claim():
    drawn = draw(Case(Category.NULL, "box"), 1)
    claims = Noise(np.random.default_rng(1), reported_gnss=0.2, reported_dvl=0.0)
    dvl, gnss, _ = generator._samples(drawn, 0, claims, 0)
    _, honest, _ = generator._samples(drawn, 0, Noise(np.random.default_rng(1)), 0)
    assert dvl[0].covariance is None
    assert np.allclose(gnss[0].covariance, 0.04 * honest[0].covariance)
    assert [s.velocity for s in gnss] == [s.velocity for s in honest]


# ------------------------------------------------------------------ running


def count_messages(paths, parameters):
    """An answer that depends on the bags."""
    return {"verdict": "no_gap", "effects": [], "gap": {"closure": None}, "n": sum(len(messages(p)) for p in paths)}


class Killed(BaseException):
    """As a signal ends a process."""


def killed_at_third(paths, parameters):
    killed_at_third.calls += 1
    if killed_at_third.calls == 3:
        raise Killed
    return count_messages(paths, parameters)


def documents(answers):
    return {name: answer["document"] for name, answer in answers.items()}


def test_a_trial_that_was_killed_goes_on_and_ends_as_if_it_had_not_been(tmp_path):
    cases = short_cases(4)
    whole = Trial(tmp_path / "whole", jobs=1, answerer=count_messages).run(cases)
    killed_at_third.calls = 0
    with pytest.raises(Killed):
        Trial(tmp_path / "killed", jobs=1, answerer=killed_at_third).run(cases)
    answers = tmp_path / "killed" / "answers.jsonl"
    assert len(answers.read_text().splitlines()) == 2
    with answers.open("a") as file:
        file.write('{"id": "cut o')
    again = Trial(tmp_path / "killed", jobs=1, answerer=killed_at_third).run(cases)
    assert killed_at_third.calls == 3 + 2  # the two that are answered were not asked again
    assert documents(again) == documents(whole)
    assert documents(read_answers(answers)) == documents(whole)


def test_the_diagnosis_gets_bags_and_no_truth(tmp_path):
    seen = []

    def look(paths, parameters):
        for path in paths:
            content = b"".join(file.read_bytes() for file in path.rglob("*") if file.is_file())
            seen.append((path, parameters.mounting_rpy, content))
        return count_messages(paths, parameters)

    case = Case(Category.SINGLE, "box", "velocity_bias", 20.0)
    trial = Trial(tmp_path, jobs=1, answerer=look)
    trial.run([case])
    ((bag, mounting_rpy, content),) = seen
    truth = unseal(trial.sealed)[case.id]
    assert truth.faults.keys() == {"velocity_bias"} and tuple(truth.scene["vehicle"]["mounting_rpy"]) == mounting_rpy
    assert trial.sealed not in bag.parents and bag.parents[0] not in trial.sealed.parents
    for word in ("velocity_bias", "single", "box"):
        assert word not in str(bag.relative_to(tmp_path)) and word.encode() not in content
    assert not bag.exists()


def test_a_diagnosis_that_breaks_is_scored_as_failed_and_one_that_refuses_as_seeing_nothing(tmp_path):
    def broken(paths, parameters):
        raise ZeroDivisionError("by zero")

    def refusing(paths, parameters):
        raise InputError("no overlap")

    (case,) = short_cases(1)
    for name, answerer, verdict in (("a", broken, "failed"), ("b", refusing, "insufficient_excitation")):
        trial = Trial(tmp_path / name, jobs=1, answerer=answerer)
        answers = trial.run([case])
        assert answers[case.id]["document"]["verdict"] == verdict
        assert score(join(unseal(trial.sealed), answers)).n_failed == (name == "a")


def test_what_was_said_is_computed_again_by_the_generator(tmp_path):
    """The error that is left: none with the truth said, all of it with nothing said, whatever the diagnosis claims."""
    case = Case(Category.SINGLE, "box", "velocity_bias", 20.0)
    true = draw(case, 0).truth

    def answer_of(faults):
        effects = [{"name": n, "parameters": {k: {"value": v} for k, v in p.items()}} for n, p in faults.items()]
        return lambda paths, parameters: {"verdict": "known", "effects": effects, "gap": {"closure": 1.0}}

    left = {}
    for name, faults in {
        "truth": true.faults,
        "nothing": {},
        "nonsense": {"water_lock": {"east_mps": None}, "a_plug_in": {"x": 1.0}},
    }.items():
        (answered,) = Trial(tmp_path / name, jobs=1, answerer=answer_of(faults)).run([case]).values()
        left[name] = answered["left_mps"]
    assert left["truth"] < 1e-9
    assert left["nothing"] == pytest.approx(true.before_mps) and true.before_mps > 1e-3
    assert left["nonsense"] == pytest.approx(true.before_mps)
