"""The trial of pairs: what is drawn, and how answers are counted."""

from __future__ import annotations

import numpy as np
import pytest

from validation.trial.pairs import ROWS, WHAT, make_pair
from validation.trial.pairs_run import figures, run_pairs, score_pair


def truth(vehicle=(), simulator=(), **noise):
    level = {f"level_{axis}": 0.01 for axis in "xyz"}
    none = {"outliers": 0.0, "repeats": 0.0, "jitter": 0.0, "dropouts": 0.0}
    return {
        "vehicle": {name: {"seconds": 0.3} for name in vehicle},
        "simulator": {name: {"seconds": 0.3} for name in simulator},
        "noise": {"vehicle": level | none | noise, "simulator": level | none | {"growth": 0.0, "colour": 0.0}},
    }


def effect(name, status, equivalent=(), low=0.2, high=0.4):
    value = {"seconds": {"value": 0.3, "ci95": [low, high]}}
    return {"name": name, "status": status, "equivalent_to": list(equivalent), "vehicle": value, "simulator": value}


def answer(effects=(), noise=()):
    claims = [{"name": name, "status": "other_size"} for name in noise]
    return {"document": {"verdict": "different", "effects": list(effects), "noise": claims}}


def test_the_right_name_first_counts_and_another_is_a_false_claim():
    right = score_pair(truth(["lever_arm"]), answer([effect("lever_arm", "missing_in_simulator")]))
    assert right.first and not right.wrong and (right.held, right.intervals) == (1, 1)
    wrong = score_pair(truth(["lever_arm"]), answer([effect("sideslip", "missing_in_simulator", ["lever_arm"])]))
    assert not wrong.first and wrong.first_in_set and not wrong.wrong
    false = score_pair(truth(["lever_arm"], ["lever_arm"]), answer([effect("lever_arm", "other_size", low=0.4)]))
    assert false.first is None and false.wrong == ("lever_arm",) and false.held == 0


def test_noise_that_is_alike_and_claimed_to_differ_is_counted():
    assert score_pair(truth(), answer(noise=["level_x", "repeats"])).noise_wrong == ("level_x", "repeats")
    assert score_pair(truth(repeats=0.03), answer(noise=["repeats"])).noise_wrong == ()


def test_shares_have_exact_bounds():
    found = figures([score_pair(truth(["lever_arm"]), answer([effect("lever_arm", "missing_in_simulator")]))] * 3)
    assert str(found[0]).startswith("missing effect named first: 100.0 % (3 of 3; 95 %: 29.2 .. 100.0)")


def test_a_pair_is_the_same_whenever_it_is_drawn(tmp_path):
    first, again = (make_pair(14, 5, tmp_path / name) for name in ("a", "b"))
    assert first.truth == again.truth and first.truth.what == "none"
    sizes = [[p.stat().st_size for p in sorted(pair.vehicle.rglob("*.mcap"))] for pair in (first, again)]
    assert sizes[0] == sizes[1]


def test_sixty_pairs_hold_every_row_of_the_table_and_every_kind_of_truth():
    assert {WHAT[n % len(WHAT)] for n in range(60)} == set(WHAT)
    together = {(WHAT[n % len(WHAT)], list(ROWS)[n % len(ROWS)]) for n in range(60)}
    assert {row for _, row in together} == set(ROWS) and len(together) > 30


@pytest.mark.slow
def test_a_short_part_of_the_trial_names_what_is_missing_and_claims_nothing_else(tmp_path):
    found = run_pairs(tmp_path, seed=1, numbers=(3, 8, 14))
    scores = [score_pair(*each) for each in found]
    assert [score.first for score in scores] == [True, None, None]
    assert not any(score.wrong or score.noise_wrong or score.failed for score in scores)
    assert np.mean([score.held / max(score.intervals, 1) for score in scores[:2]]) > 0.8
    again = run_pairs(tmp_path, seed=1, numbers=(3,))
    assert again[0][1]["cpu_s"] == found[0][1]["cpu_s"]  # what is there is not done again
