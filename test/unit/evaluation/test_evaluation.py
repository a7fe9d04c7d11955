"""The evaluation: the same estimator as in replay, whatever runs it, and what it says of bad folders."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvl_calib_ros import parallel
from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NED, FLU_FROM_FRD, rpy_from_rotation
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.evaluation import protocol, results, validation_study
from dvl_calib_ros.evaluation.estimation import SensorData, estimate
from dvl_calib_ros.evaluation.protocol import Trajectory, load_folder, own_trajectories
from dvl_calib_ros.evaluation.results import UNCALIBRATED, Improvement
from dvl_calib_ros.evaluation.validation_study import (
    DEFAULTS,
    EVALUATED,
    Procedure,
    dvl_velocities,
    evaluate,
    references,
    sensor_data,
    true_state,
)
from dvl_calib_ros.logs.dvl_log import angular_velocities
from dvl_calib_ros.logs.trajectories import ImportOptions, import_recording
from dvl_calib_ros.parallel import Workers, run_all

pytestmark = pytest.mark.slow

COMBINATION = 7


@pytest.fixture(scope="module")
def runs() -> dict[str, Trajectory]:
    return own_trajectories()


@pytest.fixture(scope="module")
def evaluation():
    return evaluate(None, Parameters(**DEFAULTS), n_seeds=2)


def first(run: Trajectory, samples: int) -> Trajectory:
    """The run as it would be if it ended there, its angular velocity too."""
    cut = run.part(0, samples)
    return replace(cut, angular_velocity=angular_velocities(cut.time, cut.rotation_enu_from_body))


def write_csv(path: Path, columns: str, time, values) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns.split(","))
        writer.writerows([repr(float(t)), *map(repr, row)] for t, row in zip(time, values.tolist(), strict=True))
    return path


def write_velocity(path: Path, time, velocity_flu) -> Path:
    return write_csv(path, "Time [s],DVL X [m/s],DVL Y [m/s],DVL Z [m/s]", time, velocity_flu @ FLU_FROM_FRD)


def write_attitude(path: Path, run: Trajectory) -> Path:
    rotations = ENU_FROM_NED.T @ run.rotation_enu_from_body @ FLU_FROM_FRD
    rpy = np.array([rpy_from_rotation(rotation) for rotation in rotations])
    return write_csv(path, "Time [s],Roll [rad],Pitch [rad],Yaw [rad]", run.time, rpy)


# ------------------------------------------------------------------ the estimator


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"gate_probability": 0.9},
        {"min_speed": 1.2, "max_turn_rate": 0.1},
        {"prior_source": "initial_window", "prior_window": 5.0},
        {"prior_source": "fixed", "prior_sway_heave": (0.1, -0.02)},
        {"gnss_aided_std": 0.1, "gnss_free_std": 0.05, "initial_std_scale": 0.02, "motion_correlation_time": 0.0},
    ],
    ids=str,
)
def test_every_state_is_that_of_replaying_a_bag_of_the_same_data(options, runs, tmp_path):
    parameters = Parameters(**{**DEFAULTS, **options})
    data = sensor_data(first(runs["T03"], 150), seed=3)
    dvl = write_velocity(tmp_path / "dvl.csv", data.run.time, data.velocity_dvl[COMBINATION])
    gnss = write_velocity(tmp_path / "gnss.csv", data.run.time, data.reference[COMBINATION])
    import_recording(dvl, gnss, write_attitude(tmp_path / "rpy.csv", data.run), tmp_path / "bag", ImportOptions())
    if parameters.prior_source == "reference":  # replay's is that of the noisy GNSS, the evaluation's that of the truth
        _, sway, heave = data.run.velocity[:2].mean(axis=0).tolist()
        replayed = replay([tmp_path / "bag"], parameters.replace(prior_source="fixed", prior_sway_heave=(sway, heave)))
    else:
        replayed = replay([tmp_path / "bag"], parameters)
    states = estimate(EVALUATED, data, parameters, [50, 150], [])
    assert set(states) == set(EVALUATED)
    for name in EVALUATED:
        expected = replayed.result.estimates[name]
        assert expected.used > 20
        np.testing.assert_allclose(states[name].x[-1, COMBINATION], expected.state, rtol=0, atol=1e-10)
        np.testing.assert_allclose(states[name].p[-1, COMBINATION], expected.filter_covariance, rtol=0, atol=1e-10)


def test_the_truth_to_find_is_in_the_frame_of_the_estimates(runs):
    """With a reference without noise, what is left is the beams' biases: 5 mm/s at 1.5 m/s are 0.2 degrees."""
    run = runs["T02"]
    data = SensorData(run, dvl_velocities(run, seed=0), references(run, seed=0, gnss_std=0.0))
    parameters = Parameters(**DEFAULTS, gnss_aided_std=0.005, initial_std_misalignment=0.5, initial_std_scale=0.1)
    found = estimate(("M3",), data, parameters, [len(data.run.time)], [])["M3"].x[0]
    truth = true_state(MODELS["M3"])
    error = found[:, : truth.shape[1]] - truth
    assert np.degrees(np.abs(error[:, 1:3]).max()) < 0.4
    assert np.abs(error[:, 3]).max() < 0.015  # one scale for all axes


def test_vrmse_from_moments_is_that_of_the_samples(rng):
    truth = rng.normal([1.5, 0.1, 0.0], 0.3, (200, 3))
    measured = truth @ rng.normal(np.eye(3), 0.1).T + rng.normal(0.0, 0.02, (4, 200, 3))
    correction = rng.normal(np.eye(3), 0.05, (4, 3, 3))
    corrected = np.einsum("bij,bnj->bni", correction, measured)
    direct = np.sqrt(np.mean(np.sum((truth - corrected) ** 2, axis=-1), axis=-1))
    np.testing.assert_allclose(results.vrmse(results.RunMoments.of(measured, truth), correction), direct, rtol=1e-12)


def test_coverage_of_errors_as_large_as_claimed_is_68_and_95_per_cent(rng):
    std = rng.uniform(0.5, 2.0, (20_000, 2))
    errors = rng.normal(0.0, std) * [1.0, 2.0]
    found = results.coverage("M1", ("honest", "overconfident"), errors, std)
    assert found.within_68 == pytest.approx([0.680, 0.381], abs=0.012)
    assert found.within_95 == pytest.approx([0.950, 0.673], abs=0.012)
    assert found.normalised_rms == pytest.approx(np.sqrt(2.5), rel=0.02)
    assert found.n_errors == 20_000


# ------------------------------------------------------------------ results


def test_averages_are_those_of_every_combination_and_trajectory(evaluation, runs):
    """One cell, from the samples."""
    column = evaluation.columns.index("M4")
    data = {name: sensor_data(run, seed=1) for name, run in runs.items()}
    state = estimate(("M4",), data["T13"], Parameters(**DEFAULTS), [len(runs["T13"].time)], [])["M4"].x[-1]
    scores = []
    for index in range(len(protocol.COMBINATIONS)):
        phi, k = state[index, :3], np.array([state[index, 3], 0.0, 0.0])
        matrix = np.diag(1 + k) @ (np.eye(3) + np.cross(np.eye(3), phi))
        for name, each in data.items():
            if name != "T13":
                error = each.run.velocity - each.velocity_dvl[index] @ np.linalg.inv(matrix).T
                scores.append(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    assert evaluation.avg_vrmse[1, column, 1] == pytest.approx(np.mean(scores), rel=1e-9)


def test_a_set_is_calibrated_on_its_own_window(evaluation):
    assert evaluation.sets[0].window_s == 200.0
    at_200_s = evaluation.windows_s.index(200.0)
    np.testing.assert_array_equal(evaluation.avg_vrmse[0], evaluation.avg_vrmse_by_time[0, at_200_s])
    np.testing.assert_array_equal(evaluation.avg_vrmse[1:], evaluation.avg_vrmse_by_time[1:, -1])


def test_calibrations_are_judged_on_samples_that_they_had_not_seen(evaluation):
    found = {(each.set_name, each.model): each for each in evaluation.held_out}
    assert set(found) == {(each.name, model) for each in evaluation.sets for model in EVALUATED}
    for each in found.values():
        assert sum(each.verdicts.values()) == len(protocol.MISALIGNMENTS_DEG)
    m3 = found["E4", "M3"]
    gnss_noise = 0.2 * np.sqrt(3)
    assert gnss_noise * 0.95 < m3.corrected < gnss_noise * 1.05
    assert m3.corrected < m3.uncorrected - 0.005
    assert m3.corrected == pytest.approx(m3.predicted, rel=0.03)


def test_a_verdict_is_worked_out_with_the_models_that_are_evaluated_alone(runs, monkeypatch):
    """The one that finds arm and delay, which nobody asked for, took nine tenths of the time."""
    made = []
    monkeypatch.setattr(
        validation_study, "Calibrator", lambda *given, **named: made.append(Calibrator(*given, **named)) or made[-1]
    )
    procedure = Procedure(runs, ("M4", "M3"), protocol.SETS[:1], Parameters(**DEFAULTS), studies=False)
    held_out, failures = validation_study.verify_set(procedure, 0, procedure.sets[0])
    assert [each.model for each in held_out] == ["M4", "M3"] and not failures
    assert {name for each in made for name in each.result().estimates} == {"M4", "M3"}


def test_a_run_of_one_heading_is_told_from_one_of_many(evaluation):
    spread = {run.trajectory: run.heading_spread for run in evaluation.each.runs}
    assert spread["T12"] < np.deg2rad(2) < np.deg2rad(60) < spread["T03"]
    for leg in evaluation.single_heading.runs:
        assert leg.heading_spread < np.deg2rad(15) and leg.to_s - leg.from_s >= 59
    yaw_seen = dict(zip(evaluation.models, evaluation.each.yaw_observed.T, strict=True))["unaided"]
    assert yaw_seen[list(spread).index("T03")] == 1.0 and yaw_seen[list(spread).index("T12")] == 0.0


def test_noise_depends_on_seed_trajectory_and_combination_alone(runs):
    alone = sensor_data(runs["T05"], seed=4)
    [sensor_data(run, seed=4) for run in reversed(runs.values())]
    np.testing.assert_array_equal(sensor_data(runs["T05"], seed=4).velocity_dvl, alone.velocity_dvl)
    for other in (sensor_data(runs["T05"], seed=5), sensor_data(runs["T08"], seed=4)):
        assert np.abs(np.corrcoef(*(noise(each)[:200] for each in (alone, other)))[0, 1]) < 0.3
    assert np.abs(np.corrcoef(noise(alone, 0), noise(alone, 1))[0, 1]) < 0.3


def noise(data: SensorData, combination: int = 0):
    return (data.reference[combination] - data.run.velocity)[:, 0]


# ------------------------------------------------------------------ scale


def test_workers_change_nothing(evaluation):
    """Of two sets, which one model shows as well as all: to rounding, as with another number of threads older linear
    algebra adds in another order."""
    options = {"n_seeds": 2, "models": ("M4",), "sets": ("E1", "E3")}
    found = evaluate(None, Parameters(**DEFAULTS), **options, workers=Workers(jobs=2))
    of_sets = [[each.name for each in evaluation.sets].index(each.name) for each in found.sets]
    of_columns = [0, evaluation.columns.index("M4")]
    for one, other in (
        (found.avg_vrmse, evaluation.avg_vrmse[of_sets][:, of_columns]),
        (found.avg_vrmse_by_time, evaluation.avg_vrmse_by_time[of_sets][:, :, of_columns]),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-13)
    held_out = {(each.set_name, each.model): each for each in evaluation.held_out}
    assert len(found.held_out) == 2
    for each in found.held_out:
        assert each.corrected == pytest.approx(held_out[each.set_name, "M4"].corrected, rel=1e-10)


def test_a_worker_process_that_is_killed_is_said():
    with pytest.raises(InputError, match="a worker process was killed"):
        run_all(os._exit, [1, 1], Workers(jobs=2))


def test_a_scheduler_that_does_not_answer_is_said_in_seconds(capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(parallel, "CONNECT_TIMEOUT_S", 0.5)
    assert main(["evaluate", "--seeds", "2", "--dask", "tcp://127.0.0.1:9"]) == 2
    error = capsys.readouterr().err
    assert "--dask tcp://127.0.0.1:9: no scheduler answers there" in error and error.count("\n") == 1


def test_a_scheduler_without_workers_is_said(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(parallel, "WORKERS_TIMEOUT_S", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None, processes=False) as cluster,
        pytest.raises(InputError, match="has no workers"),
    ):
        run_all(abs, [1, 2], Workers(dask=cluster.scheduler_address))


# ------------------------------------------------------------------ the command


@pytest.fixture
def folder(tmp_path, runs) -> Path:
    """A folder of trajectories, as short as they may be; T01 has attitude."""
    path = tmp_path / "trajectories"
    path.mkdir()
    for name, run in runs.items():
        short = run.part(0, 200 if name in ("T12", "T13", "T14", "T15") else 60)
        write_velocity(path / f"{name}_dvl.csv", short.time, short.velocity)
        if name == "T01":
            write_attitude(path / f"{name}_attitude.csv", short)
    return path


def edit(path: Path, row: int, line: str) -> None:
    lines = path.read_text().splitlines()
    lines[row] = line
    path.write_text("\n".join(lines) + "\n")


def keep_rows(path: Path, rows: int) -> None:
    path.write_text("".join(path.read_text().splitlines(keepends=True)[: rows + 1]))


def in_cm_per_s(path: Path) -> None:
    header, *rows = path.read_text().splitlines()
    scaled = [[row.split(",")[0], *(repr(100 * float(v)) for v in row.split(",")[1:])] for row in rows]
    path.write_text("\n".join([header, *map(",".join, scaled)]) + "\n")


BAD = {
    "a missing trajectory": (lambda f: (f / "T07_dvl.csv").unlink(), "T07_dvl.csv missing", "--partial"),
    "no trajectory at all": (
        lambda f: [each.unlink() for each in f.glob("*_dvl.csv")], "T03_dvl.csv and more missing", "or two bags",
    ),
    "a missing calibration run": (lambda f: (f / "T14_dvl.csv").unlink(), "T14_dvl.csv missing", "needs T12"),
    "a calibration run shorter than its window": (
        lambda f: keep_rows(f / "T12_dvl.csv", 150), "T12_dvl.csv: ends at row 150 after 150 s", "needs 200 s",
    ),
    "a short trajectory": (lambda f: keep_rows(f / "T03_dvl.csv", 20), "T03_dvl.csv: ends at row 20", "needs 60 s"),
    "other units by size": (lambda f: in_cm_per_s(f / "T09_dvl.csv"), "T09_dvl.csv: row 1: ", "convert"),
    "attitude at other times": (
        lambda f: edit(f / "T01_attitude.csv", 30, "29.4,0.0,0.0,1.0"), "T01_attitude.csv: row 30", "resample",
    ),
    "attitude that ends early": (lambda f: keep_rows(f / "T01_attitude.csv", 40), "T01_attitude.csv: row 41", "time"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_folder_is_refused_with_file_and_remedy_and_nothing_is_written(case, folder, tmp_path, capsys):
    spoil, where, remedy = BAD[case]
    spoil(folder)
    outputs = [tmp_path / "e.json", tmp_path / "e.csv"]
    assert main(["evaluate", str(folder), "--json", str(outputs[0]), "--csv", str(outputs[1])]) == 2
    output = capsys.readouterr()
    assert where in output.err and remedy in output.err
    assert output.err.count("\n") == 1 and output.out == ""
    assert not any(path.exists() for path in outputs)


def test_a_partial_folder_is_evaluated_if_asked_for(folder):
    (folder / "T07_dvl.csv").unlink()
    found, notes = load_folder(folder, partial=True)
    assert len(found) == 14 and "T07 missing" in notes[0]


def test_the_command_writes_json_and_csv_and_says_what_it_ran_on(folder, tmp_path, capsys):
    target = tmp_path / "e.json", tmp_path / "e.csv"
    options = "--models M3,M7 --sets E1,E3 --seeds 2 --jobs 1 -p mounting_rpy:=[0.0,0.0,1.0]"
    assert main(["evaluate", str(folder), *options.split(), "--json", str(target[0]), "--csv", str(target[1])]) == 0
    output = capsys.readouterr()
    assert f"folder {folder}" in output.out and "mounting_rpy is not used by the procedure" in output.err
    document = json.loads(target[0].read_text())
    assert set(document["avg_vrmse"]) == {"E1", "E3"}
    assert set(document["avg_vrmse"]["E1"]) == set(document["mean"]) == {UNCALIBRATED, "M3", "M7"}
    assert document["published"]["E3"]["M6"] == 0.0625
    assert document["seeds"] == [0, 1]
    assert document["parameters"]["gate_probability"] == 0.0
    rows = list(csv.DictReader(target[1].open()))
    of_set = [float(r["avg_vrmse_mps"]) for r in rows if (r["study"], r["set"], r["model"]) == ("sets", "E1", "M3")]
    assert np.mean(of_set) == pytest.approx(document["avg_vrmse"]["E1"]["M3"])


def test_without_a_folder_the_command_says_that_the_trajectories_are_its_own(capsys):
    assert main(["evaluate", "--models", "M7", "--sets", "E1"]) == 0
    output = capsys.readouterr()
    assert output.out.startswith("better: On the other runs") and "\nown generator" in output.out
    assert "no ratio" in output.err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--models", "M9"], "--models: 'M9' is none of"),
        (["--sets", "E5"], "--sets: 'E5' is none of"),
        (["--seeds", "0"], "--seeds: 0 is outside"),
        (["--jobs", "-2"], "jobs: -2 is no number of processes"),
        (["--json", "no/such/e.json"], "no/such"),
        (["--json", "same", "--csv", "same"], "--json and --csv: both write same"),
        (["nowhere"], "nowhere: no such file or folder"),
        (["-p", "gnss_aided_std:=-1.0"], "gnss_aided_std"),
    ],
    ids=str,
)
def test_bad_usage_is_refused_in_one_line(options, said, capsys):
    assert main(["evaluate", *options]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


# ------------------------------------------------------------------ bags


@pytest.fixture(scope="module")
def two_bags(tmp_path_factory) -> list[str]:
    folder = tmp_path_factory.mktemp("bags")
    bags = [str(folder / name) for name in ("morning", "evening")]
    for seed, bag in enumerate(bags):
        simulate = ["simulate", bag, "--duration", "200", "--misalignment", "1", "-2", "3", "--seed", str(seed)]
        assert main([*simulate, "--gnss-std", "0.02"]) == 0
    return bags


def test_bags_are_checked_against_each_other(two_bags, tmp_path, capsys):
    assert main(["evaluate", *two_bags, "--models", "M3,M7", "--json", str(tmp_path / "e.json")]) == 0
    document = json.loads((tmp_path / "e.json").read_text())
    for calibrated, verified in (two_bags, two_bags[::-1]):
        corrected = document["corrected"][calibrated]["M3"]
        assert set(corrected) == {verified}
        assert corrected[verified] < 0.05 < 0.08 < document["uncorrected"][verified]


@pytest.mark.parametrize(
    ("others", "said"),
    [((), "one bag cannot be checked"), (("morning",), "named twice"), (("link",), "are one bag by two names")],
)
def test_one_bag_is_not_enough_by_any_name(others, said, two_bags, tmp_path, capsys):
    (tmp_path / "link").symlink_to(Path(two_bags[0]).resolve())
    names = {"morning": two_bags[0], "link": str(tmp_path / "link")}
    assert main(["evaluate", two_bags[0], *(names[each] for each in others), "--models", "M3"]) == 2
    assert said in capsys.readouterr().err


def test_the_verdict_of_an_evaluation_is_that_of_the_model_that_improves_most():
    uncorrected = np.array([0.2, np.nan, 0.4])
    corrected = np.array([[0.3, 0.1, np.nan], [0.1, 0.1, 0.3]])
    found = Improvement.of(("M1", "M2"), corrected, uncorrected)
    assert found == ("M2", pytest.approx(0.3), pytest.approx(0.2)) and found.verdict == "better"
    assert Improvement.of(("M1",), corrected[:1], uncorrected).verdict == "not_better"
    assert Improvement.of(("M1",), np.full((1, 3), np.nan), uncorrected).verdict == "not_known"
