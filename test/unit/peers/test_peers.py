"""The peers of the diagnosis: a model of their own, one form of answer, asked beside the diagnosis of the same bags."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.errors import InputError
from validation.peers.asked import PEERS, ask
from validation.peers.command import asked_anew
from validation.peers.foreign import foreign_cases, has_physics, record_foreign
from validation.peers.forward import CLOCKS, LINEAR, Clock, Forward
from validation.peers.scores import is_right, sides, tables
from validation.peers.search import Fitted, Member, Search, Whitening, residual_of_all, sizes_of
from validation.peers.streams import read_streams
from validation.trial.generator import record
from validation.trial.plan import Case
from validation.trial.run import Trial, read_answers
from validation.trial.truth import Category, unseal
from validation.trial.vehicle import FAULTS

pytestmark = pytest.mark.slow
SEED = 9100


@pytest.fixture(scope="module")
def null(tmp_path_factory):
    return record(Case(Category.NULL, "free"), 9101, tmp_path_factory.mktemp("null") / "case")


@pytest.fixture(scope="module")
def drift(tmp_path_factory):
    """A scale that drifts, twenty times as strong as the noise."""
    case = Case(Category.SINGLE, "free", "scale_drift", 20.0)
    return record(case, 9102, tmp_path_factory.mktemp("drift") / "case")


def asked(name, recorded):
    pytest.importorskip(PEERS[name][0], reason="validation/peers/requirements.txt is not installed")
    return ask(name, recorded.bags, Parameters(mounting_rpy=recorded.mounting_rpy))


@pytest.mark.parametrize("name", PEERS)
def test_each_peer_says_that_a_null_has_no_gap(name, null):
    assert asked(name, null)["verdict"] == "no_gap"


@pytest.mark.parametrize("name", PEERS)
def test_each_peer_finds_a_strong_effect_and_its_size(name, drift):
    document = asked(name, drift)
    assert [each["name"] for each in document["effects"]] == ["scale_drift"]
    assert document["verdict"] == "known"
    low, high = document["effects"][0]["parameters"]["rate_per_hour"]["ci95"]
    true = drift.truth.faults["scale_drift"]["rate_per_hour"]
    assert high - low < abs(true)
    assert low - 0.05 * abs(true) <= true <= high + 0.05 * abs(true)


def fitted(recorded, name):
    model = Forward(read_streams(recorded.bags, Parameters(mounting_rpy=recorded.mounting_rpy)), recorded.mounting_rpy)
    search = Search(model)
    true = recorded.truth.faults[name]
    leap_at = true.get("at_s", 0.0) / model.seconds
    clock = Clock({name: 0.7 * true[CLOCKS[name]]} if name in CLOCKS else {}, leap_at)
    found = search.refined(Fitted((Member(name),), clock, math.inf, search.n))
    model.calibrated(found.values[:6])
    search = Search(model, Whitening(residual_of_all(model, found.clock)))
    found = search.refined(replace(found, n=search.n))
    return sizes_of(found), true


ALWAYS_THERE = [name for name in (*LINEAR, *CLOCKS) if name != "water_lock"]


@pytest.mark.parametrize("name", ALWAYS_THERE[::3])
def test_the_forward_model_means_by_an_effect_what_the_generator_means(name, tmp_path):
    """Written apart, the two agree on sign, size and frame of every effect."""
    kind = "free" if name != "sideslip" else "figure8"
    recorded = record(Case(Category.SINGLE, kind, name, 20.0), SEED, tmp_path / "case")
    sizes, true = fitted(recorded, name)
    typical = FAULTS[name].typical
    for parameter in typical:
        value, std = sizes[f"{name}.{parameter}"]
        assert abs(value - true[parameter]) < 4.0 * std + 0.05 * abs(true[parameter]), parameter
    assert max(abs(sizes[f"{name}.{each}"][0]) / sizes[f"{name}.{each}"][1] for each in typical) > 2.5


# ------------------------------------------------------------------ side by side


def says(name, paths, parameters):
    return {"verdict": "known" if name else "no_gap", "effects": [{"name": name, "parameters": {}}] if name else []}


def test_who_is_asked_beside_is_asked_of_the_same_bags_and_scored_with_the_same_truth(tmp_path):
    cases = [Case(Category.NULL, "free", number=1), Case(Category.SINGLE, "free", "velocity_bias", 20.0)]
    seen: dict[str, list[tuple[Path, ...]]] = {"ours": [], "other": []}

    def noting(name, which, paths, parameters):
        seen[which].append(tuple(paths))
        return says(name, paths, parameters)

    ours = partial(noting, "velocity_bias", "ours")
    trial = Trial(tmp_path, SEED, jobs=1, answerer=ours, beside={"other": partial(noting, "", "other")})
    answers = trial.run(cases)
    assert seen["ours"] == seen["other"] and len(seen["ours"]) == 2
    assert trial.run(cases) == answers and len(seen["ours"]) == 2  # gone on with: nothing is left
    changed = replace(trial, answerer=partial(noting, "lever_arm", "ours"))
    half = asked_anew(changed, cases, lambda _: None, 0.0)
    assert not half and read_answers(trial.answers) == answers  # as they were until all are there
    anew = asked_anew(changed, [*cases, Case(Category.NULL, "free", number=2)], lambda _: None, np.inf)
    assert [each["document"]["effects"][0]["name"] for each in anew.values()] == ["lever_arm"] * 2
    assert [each["beside"] for each in anew.values()] == [each["beside"] for each in answers.values()]
    assert len(seen["other"]) == 2 and read_answers(trial.answers) == anew and not (tmp_path / "anew").exists()
    with pytest.raises(InputError, match=r"not .*'seed': 9101"):  # the peers' answers are to other bags
        asked_anew(replace(changed, seed=SEED + 1), cases, lambda _: None, np.inf)
    assert read_answers(trial.answers) == anew
    both = sides(unseal(trial.sealed), answers)
    assert [side.name for side in both] == ["diagnose", "other"]
    right = [{case.truth.category: is_right(case) for case in side.cases.values()} for side in both]
    assert right == [{Category.NULL: False, Category.SINGLE: True}, {Category.NULL: True, Category.SINGLE: False}]
    # what the effect leaves if it is not said is an error; if it is, at a wrong size, it is another
    single = [next(c for c in side.cases.values() if not c.is_null) for side in both]
    assert single[1].left_mps > 0.0
    pytest.importorskip("scoringrules")
    everything = tables(both)[-1]
    assert everything[0] == "all"
    assert [row[:2] for row in everything[2]] == [("diagnose", "2"), ("other", "2")]
    assert everything[2][1][-1] == "1 / 1 (1)"


@pytest.mark.skipif(not has_physics(), reason="the traps' physics is not there (DVL_CALIB_SHARED)")
def test_a_foreign_recording_has_its_truth_and_is_the_same_again(tmp_path):
    case = foreign_cases(12)[9]
    assert case.category is Category.SINGLE
    first, again = (record_foreign(case, SEED, tmp_path / name) for name in ("a", "b"))
    assert first.truth == again.truth or str(first.truth) == str(again.truth)
    (name,) = first.truth.faults
    assert name == case.name
    a, b = (read_streams(each.bags, Parameters(mounting_rpy=each.mounting_rpy))[0] for each in (first, again))
    np.testing.assert_array_equal(a.dvl, b.dvl)
