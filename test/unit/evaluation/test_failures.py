"""What raises among the estimates of an evaluation costs that estimate, is counted and said, and never the run."""

from __future__ import annotations

import json

import numpy as np
import pytest
from report_fixtures import drawn

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.evaluation import estimation, validation_study
from dvl_calib_ros.evaluation.estimation import SensorData, estimate
from dvl_calib_ros.evaluation.protocol import own_trajectories
from dvl_calib_ros.evaluation.results import Failure
from dvl_calib_ros.evaluation.validation_study import DEFAULTS, evaluate, sensor_data

N_SAMPLES, ENDS = 60, (20, 60)
MODELS = ("M4", "M3", "unaided")
COMMAND = ("evaluate", "--models", "M4,M3", "--sets", "E4", "--jobs", "1")


@pytest.fixture
def data() -> SensorData:
    whole = sensor_data(own_trajectories()["T03"].part(0, N_SAMPLES), seed=1)
    return SensorData(whole.run, whole.velocity_dvl[:3], whole.reference[:3])


def refuse(monkeypatch, model: str, velocity=None) -> None:
    """Estimates of a model raise: all of them, or those that are shown this velocity of the DVL."""
    real = estimation._estimate_one

    def refusing(asked, seen, *others):
        if asked.name == model and (velocity is None or (seen.velocity_dvl == velocity).all(axis=1).any()):
            raise np.linalg.LinAlgError("Singular\nmatrix")
        return real(asked, seen, *others)

    monkeypatch.setattr(estimation, "_estimate_one", refusing)


def test_one_variant_of_one_model_that_raises_is_named_and_costs_no_other(data, monkeypatch):
    parameters = Parameters(**DEFAULTS)
    whole = estimate(MODELS, data, parameters, ENDS, [])
    failures: list[Failure] = []
    refuse(monkeypatch, "M3", data.velocity_dvl[1, 5])
    found = estimate(MODELS, data, parameters, ENDS, failures)
    assert [str(each) for each in failures] == ["M3, T03, combination 1: LinAlgError: Singular matrix"]
    assert np.isnan(found["M3"].x[:, 1]).all() and np.isnan(found["M3"].p[:, 1]).all()
    for name in MODELS:
        left = [0, 2] if name == "M3" else [0, 1, 2]
        np.testing.assert_allclose(found[name].x[:, left], whole[name].x[:, left], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[name].p[:, left], whole[name].p[:, left], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_command_counts_what_raised_says_which_and_why_and_goes_on(monkeypatch, tmp_path, capsys):
    told = sensor_data(own_trajectories()["T15"], seed=0).velocity_dvl[7, 5]
    assert main([*COMMAND, "--json", str(tmp_path / "whole.json")]) == 0
    refuse(monkeypatch, "M3", told)
    drawn(monkeypatch)  # the pictures are looked at elsewhere
    outputs = {f"--{name}": str(tmp_path / f"e.{end}") for name, end in (("json", "json"), ("report", "html"))}
    assert main([*COMMAND, *(word for pair in outputs.items() for word in pair)]) == 0
    why = "M3, T15, seed 0, combination 7: LinAlgError: Singular matrix"
    assert f"1 failed and is in none of the figures: {why}" in " ".join(capsys.readouterr().err.split())
    assert "combination 7: LinAlgError" in (tmp_path / "e.html").read_text()
    whole, found = (json.loads((tmp_path / name).read_text()) for name in ("whole.json", "e.json"))
    assert whole["failures"] == []
    assert [(each["what"], each["run"], each["combination"], each["seed"]) for each in found["failures"]] == [
        ("M3", "T15", 7, 0)
    ]
    assert found["avg_vrmse"]["E4"]["M4"] == pytest.approx(whole["avg_vrmse"]["E4"]["M4"], rel=1e-12)
    one, other = (each["avg_vrmse"]["E4"]["M3"] for each in (found, whole))
    assert one != other and one == pytest.approx(other, rel=0.2)
    assert found["coverage"]["M3"]["errors"] == whole["coverage"]["M3"]["errors"] - 1


@pytest.mark.slow
def test_a_seed_and_a_combination_that_raise_are_left_out(monkeypatch):
    real = validation_study.run_seed

    def refusing(asked, seed):
        if seed == 1:
            raise ValueError("no such seed")
        return real(asked, seed)

    def none(*_, **__):
        raise FloatingPointError

    monkeypatch.setattr(validation_study, "run_seed", refusing)
    monkeypatch.setattr(validation_study, "Calibrator", none)
    found = evaluate(None, Parameters(**DEFAULTS), models=("M4",), sets=("E4",), n_seeds=2)
    assert found.seeds == (0,) and found.avg_vrmse.shape == (1, 2, 1) and np.isfinite(found.avg_vrmse).all()
    assert found.held_out == ()
    assert str(found.failures[0]) == "everything, seed 1: ValueError: no such seed"
    assert str(found.failures[1]) == "hold-out verification, T15, seed 0, combination 0: FloatingPointError"
    assert found.notes[-1].startswith(
        f"{len(found.failures)} failed and are in none of the figures: everything, seed 1"
    )


def test_where_nothing_comes_out_the_command_says_why_in_one_line(monkeypatch, capsys):
    def none(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(validation_study, "run_seed", none)
    assert main([*COMMAND]) == 2
    error = capsys.readouterr().err
    assert "no model has an estimate" in error and "everything, seed 0: LinAlgError: Singular matrix" in error
    assert error.count("\n") == 1
