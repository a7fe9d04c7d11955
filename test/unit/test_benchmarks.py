"""What `python -m benchmarks` makes of what its parts measure, which is measured on a quiet machine."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import DifferentWorkError, Measurement, batch, check_same, evaluate
from benchmarks.__main__ import main
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.evaluation import protocol
from dvl_calib_ros.evaluation.protocol import own_trajectories
from dvl_calib_ros.evaluation.validation_study import DEFAULTS, Procedure, run_seed


def measured(ratio: float, what: str = "speed", higher_is_better: bool = False):
    return Measurement(what, "1 s", "2 s", f"{ratio:g}", "<= 1", True, ratio, higher_is_better)


def broken(_):
    raise ValueError("operands could not be\nbroadcast together")


def save_baseline(path, ratio: float, higher_is_better: bool = False):
    assert main(["--json", str(path)], {"fine": lambda _: [measured(ratio, "speed", higher_is_better)]}) == 0


def test_a_part_that_fails_leaves_the_others_and_is_said_in_one_line(tmp_path, capsys):
    saved = tmp_path / "measured.json"
    parts = {"broken": broken, "fine": lambda _: [measured(0.5)]}
    assert main(["--markdown", "--json", str(saved)], parts) == 1
    out, err = capsys.readouterr()
    assert "| speed | 1 s | 2 s | 0.5 | <= 1 |" in out
    assert "broken: failed: ValueError: operands could not be broadcast together" in err.splitlines()
    assert "1 of 2 parts failed" in err.splitlines()
    assert "Traceback" not in err


def test_what_was_measured_is_saved_after_every_part_with_load_commit_and_versions(tmp_path):
    saved = tmp_path / "measured.json"

    def ended(_):
        assert json.loads(saved.read_text())["parts"]["fine"]["measurements"][0]["ratio_value"] == 0.5
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        main(["--json", str(saved)], {"fine": lambda _: [measured(0.5)], "ended": ended})
    document = json.loads(saved.read_text())
    assert document["parts"] == {"fine": {"measurements": [measured(0.5)._asdict()], "failed": None}}
    assert len(document["load"]) == 2 and {"commit", "versions"} <= document.keys()
    assert document["versions"]["numpy"] == np.__version__


@pytest.mark.parametrize(
    ("higher_is_better", "now", "code"),
    [
        (False, 1.9, 0),
        (False, 2.1, 1),
        (False, 0.1, 0),
        (True, 0.52, 0),
        (True, 0.48, 1),
        (True, 9.0, 0),
        (False, np.nan, 1),
    ],
)
def test_a_ratio_worse_than_its_baseline_by_twice_or_no_number_fails(tmp_path, capsys, higher_is_better, now, code):
    baseline = tmp_path / "baseline.json"
    save_baseline(baseline, 1.0, higher_is_better)
    parts = {"fine": lambda _: [measured(now, "speed", higher_is_better)]}
    assert main(["--against", str(baseline)], parts) == code
    assert (f"fine: speed: baseline 1.00, now {now:.2f}" in capsys.readouterr().err.splitlines()) == bool(code)


@pytest.mark.parametrize("difference", [1e-8, float("nan"), float("inf")])
def test_two_sides_with_different_states_are_no_comparison(difference):
    with pytest.raises(DifferentWorkError, match="differ by"):
        check_same(difference, "batch and filterpy")


def test_batch_and_filterpy_come_to_the_same_states(monkeypatch):
    pytest.importorskip("filterpy", reason="a peer of the benchmarks: pip install '.[test]'")
    monkeypatch.setattr(batch, "N_SAMPLES", 2100)  # a block and a part of one
    monkeypatch.setattr(batch, "ROUNDS", 1)
    (measurement,) = batch.measure()  # raises where they do not
    assert measurement.ratio_value > 1.0


def test_the_published_procedure_and_its_loop_with_filterpy_come_to_the_same_scores():
    """Also of models whose noise has fewer rows than three, and of those that want a height."""
    pytest.importorskip("filterpy", reason="a peer of the benchmarks: pip install '.[test]'")
    procedure = Procedure(own_trajectories(), ("unaided",), protocol.SETS[:1], Parameters(**DEFAULTS), studies=False)
    ours = np.array([each.by_time for each in run_seed(procedure, 0).by_set])
    peers = evaluate._with_filterpy(procedure, 0)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(peers))
    np.testing.assert_allclose(ours, peers, rtol=0.0, atol=1e-9, equal_nan=True)
    assert np.isfinite(ours).all()
