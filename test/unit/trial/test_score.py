"""The score of a trial: the figures, their bounds, what theory allows, and the page of the documentation."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from validation.trial.scored import join
from validation.trial.tables import score
from validation.trial.truth import Category, Truth, seal, unseal


def truth(number: int, category: Category, faults=(), q=0.0, **rest) -> Truth:
    values = {"lever_arm": {"x_m": 1.0, "y_m": 2.0, "z_m": 3.0}, "sideslip": {"coefficient_s": 0.5}}
    named = {name: values.get(name, {"size": 1.0}) for name in faults}
    return Truth(f"case{number:03d}", category, "box", faults=named, q=dict.fromkeys(faults, q), q_wanted=q, **rest)


def answer(verdict, *effects, closure=None):
    """effects: (name, equals, parameter -> (low, high))."""
    return {
        "document": {
            "verdict": verdict,
            "gap": {"closure": closure},
            "noise": [{"name": "outliers"}] if verdict == "no_gap" else [],
            "effects": [
                {
                    "name": name,
                    "equivalent_to": list(equals),
                    "parameters": {each: {"value": 0.0, "ci95": list(ends)} for each, ends in parameters.items()},
                }
                for name, equals, parameters in effects
            ],
        },
        "cpu_s": 1.0,
    }


ARM = {"x_m": (0.9, 1.1), "y_m": (1.9, 2.1), "z_m": (3.1, 3.2)}  # the third is off
HAND_MADE = [
    (truth(0, Category.NULL), answer("no_gap")),
    (truth(1, Category.NULL), answer("no_gap")),
    (truth(2, Category.NULL), answer("unknown")),
    (truth(3, Category.NULL), answer("insufficient_excitation")),
    (truth(4, Category.HARD_NULL, hardness="ar1"), answer("known", ("sideslip", (), {}))),
    (truth(5, Category.SINGLE, ["lever_arm"], 5.0, distances={"sideslip": 5.0}), answer("no_gap")),
    (
        truth(6, Category.SINGLE, ["lever_arm"], 8.0, distances={"sideslip": 8.0}),
        answer("known", ("lever_arm", (), ARM), closure=0.9),
    ),
    (
        truth(7, Category.SINGLE, ["lever_arm"], 20.0, distances={"sideslip": 1.0}),
        answer("ambiguous", ("sideslip", ["lever_arm"], {"coefficient_s": (0, 1)}), closure=0.98),
    ),
    (
        truth(8, Category.SINGLE, ["sideslip"], 20.0, distances={"lever_arm": 10.0}),
        answer("known", ("sideslip", (), {"coefficient_s": (0.4, 0.6)}), closure=0.96),
    ),
    (
        truth(9, Category.PAIR, ["lever_arm", "sideslip"], 12.0, correlation=0.1),
        answer("known", ("heading_error", ["sideslip"], {}), ("lever_arm", (), {})),
    ),
    (
        truth(10, Category.PAIR, ["lever_arm", "sideslip"], 12.0, correlation=0.1),
        answer("ambiguous", ("lever_arm", ["sideslip"], {})),
    ),
    (truth(11, Category.UNKNOWN, ["slow_heave"], 12.0, outside_share=0.9), answer("unknown")),
    (truth(12, Category.UNKNOWN, ["slow_heave"], 12.0, outside_share=0.9), answer("known", ("lever_arm", (), {}))),
    (truth(13, Category.UNIDENTIFIABLE, ["sideslip"], 20.0), answer("ambiguous", ("lever_arm", ["sideslip"], {}))),
    (truth(14, Category.UNIDENTIFIABLE, ["sideslip"], 20.0), answer("ambiguous", ("lever_arm", (), {}))),
    (truth(15, Category.UNIDENTIFIABLE, ["sideslip"]), answer("insufficient_excitation")),
]


@pytest.fixture
def hand_made(tmp_path):
    for each, _ in HAND_MADE:
        seal(each, tmp_path)
    return score(join(unseal(tmp_path), {each.id: given for each, given in HAND_MADE}))


def test_figures_of_hand_made_answers_are_those_computed_by_hand(hand_made):
    values = {figure.name: (figure.value, figure.n) for figure in hand_made.figures["simulated"]}
    assert values["false alarms, nulls"] == (0.25, 4)
    assert values["false alarms, hard nulls"] == (1.0, 1)
    assert values["detected, q = 5"] == (0.0, 1)
    assert values["detected, q >= 8"] == (1.0, 3)
    assert values["right effect first, q = 8"] == (1.0, 1)
    assert values["right effect first, q >= 12"] == (0.5, 2)
    assert values["right effect first, q >= 12, where theory can tell"] == (1.0, 1)
    assert values["truth in the named set, q >= 8"] == (1.0, 3)
    assert values["size of the named set, q >= 8"] == (1.0, 3)
    assert values["unknown called unknown, q = 12"] == (0.5, 2)
    assert values["closure, q >= 8"] == (0.96, 3)
    assert values["closure, q >= 20"] == (pytest.approx(0.97), 2)
    assert values["true value in the 95 % interval"] == (0.75, 4)
    assert values["both of a pair, q >= 12"] == (0.5, 2)
    assert values["no guess where data cannot tell"] == (pytest.approx(2 / 3), 3)


def test_bounds_are_clopper_and_pearsons(hand_made):
    figure = next(figure for figure in hand_made.figures["simulated"] if figure.name == "false alarms, nulls")
    # the beta quantiles of 1 of 4
    assert (figure.low, figure.high) == (pytest.approx(0.00631, abs=1e-4), pytest.approx(0.80588, abs=1e-4))
    assert figure.met is False
    never = next(figure for figure in hand_made.figures["simulated"] if figure.name == "detected, q >= 8")
    assert (never.low, never.high) == (pytest.approx(0.025 ** (1 / 3)), 1.0)


def test_theory_is_the_power_of_the_test_and_the_likelihood_of_telling_apart(hand_made):
    bounds = {figure.name: figure.bound for figure in hand_made.figures["simulated"]}
    # chi-square test with 3 degrees of freedom at 0.01 / 19, by simulation
    draws = np.random.default_rng(0).normal([5.0, 0.0, 0.0], 1.0, (400000, 3))
    null = 17.62  # the quantile 1 - 0.01 / 19 of the central distribution
    assert bounds["detected, q = 5"] == pytest.approx(np.mean((draws**2).sum(axis=1) > null), abs=0.003)
    # 1 σ apart: right in Φ(1/2) of the cases; 10 σ apart: always
    assert bounds["right effect first, q >= 12"] == pytest.approx((0.6915 + 1.0) / 2, abs=1e-3)


def test_confusion_and_verdicts_count_every_case_once(hand_made):
    assert hand_made.confusion == {
        "lever_arm": {"lever_arm": 1, "no_gap": 1, "sideslip": 1},
        "sideslip": {"sideslip": 1},
    }
    assert sum(sum(row.values()) for row in hand_made.verdicts.values()) == len(HAND_MADE) == hand_made.n_cases


def test_what_is_said_of_the_noise_is_counted_by_the_noise_there_is(hand_made):
    (table,) = (table for table in hand_made.tables if table.title.startswith("Findings"))
    assert table.columns == ("noise", "runs", "outliers")
    assert table.rows == (("ar1", "1", ""), ("ordinary", "4", "2"))


def test_score_is_written_as_json_and_markdown(hand_made):
    document = json.loads(json.dumps(hand_made.document()))
    assert document["figures"]["simulated"][0] | {"low": 0, "high": 0} == {
        "name": "false alarms, nulls", "target": "<= 1%", "value": 0.25, "low": 0, "high": 0, "n": 4, "met": False,
        "bound": None,
    }  # fmt: skip
    assert "| false alarms, nulls | <= 1% | 25.0% | 0.6% .. 80.6% | - | 4 | no |" in hand_made.markdown()


# ------------------------------------------------------------------ real motion

ARM_X = {"lever_arm": {"x_m": 1.0}}
BOTH = ARM_X | {"dvl_time_offset": {"seconds@0": 1.0, "seconds@1": 2.0}}


def at_sea(number: int, category: Category, faults=(), family="half_real", **rest) -> Truth:
    return Truth(
        f"case{number:03d}",
        category,
        "snapir",
        family=family,
        faults=dict(faults),
        noise_mps=0.03,
        scene={"sources": []},
        **rest,
    )


def says(verdict, left_mps, **parameters):
    """parameters: name of an effect -> of its parameters low and high."""
    given = answer(verdict, *((name, (), ends) for name, ends in parameters.items()))
    for effect in given["document"]["effects"]:
        of_each = {name: value for name, value in effect["parameters"].items() if "@" in name}
        for name, value in of_each.items():
            parameter, number = name.split("@")
            effect.setdefault("by_recording", {}).setdefault(f"recording{number}", {})[parameter] = value
            del effect["parameters"][name]
    given["document"]["gap"] = {"closure": None, "after_mps": 0.03}
    return given | {"left_mps": left_mps}


AT_SEA = [
    (at_sea(0, Category.SINGLE, ARM_X), says("known", 0.0, lever_arm={"x_m": (0.9, 1.1)})),
    (at_sea(1, Category.SINGLE, ARM_X), says("known", 0.04, lever_arm={"x_m": (1.1, 1.3)}, sideslip={})),
    (at_sea(2, Category.NULL), says("no_gap", 0.0)),
    (
        at_sea(3, Category.SINGLE, ARM_X, "horizontal", twin="case000"),
        says("known", 0.0, lever_arm={"x_m": (1.0, 1.2)}),
    ),
    (
        at_sea(4, Category.SINGLE, ARM_X, "horizontal", twin="case001"),
        says("known", 0.0, lever_arm={"x_m": (0.8, 1.2)}),
    ),
    (at_sea(5, Category.NULL, (), "horizontal", twin="case002"), says("known", 0.01, lever_arm={})),
    (
        at_sea(6, Category.PAIR, BOTH, "several"),
        says(
            "known", 0.0, lever_arm={"x_m": (0.9, 1.1)}, dvl_time_offset={"seconds@0": (0.9, 1.1), "seconds@1": (0, 1)}
        ),
    ),
    (at_sea(7, Category.PAIR, BOTH, "several"), says("unknown", 0.0, lever_arm={}, dvl_time_offset={})),
]


def test_a_mounting_that_moved_is_held_against_what_each_recording_has_of_it():
    moved = {"mounting_moved": {"x_rad": 0.1, "from_recording": 2.0}}
    truth = replace(at_sea(0, Category.SINGLE, moved, "several"), scene={"seconds": [400.0] * 3, "sources": []})
    given = says("known", 0.0, mounting_moved={"x_rad@1": (-0.1, 0.05), "x_rad@2": (0.2, 0.3)})
    (case,) = join({truth.id: truth}, {truth.id: given})
    assert [(each.parameter, each.true, each.holds) for each in case.intervals] == [
        ("x_rad@1", 0.0, True),
        ("x_rad@2", 0.1, False),
    ]


@pytest.fixture
def by_family():
    truths, answers = {each.id: each for each, _ in AT_SEA}, {each.id: given for each, given in AT_SEA}
    result = score(join(truths, answers))
    return {family: {each.name: (each.value, each.n) for each in result.figures[family]} for family in result.figures}


def test_exact_are_the_true_effects_and_no_other_as_all_that_there_is(by_family):
    assert by_family["half_real"]["exactly the true effects"] == (0.5, 2)
    assert by_family["half_real"]["all true effects in the named sets"] == (1.0, 2)
    assert by_family["several"]["exactly the true effects"] == (0.5, 2)
    assert by_family["several"]["exactly the true effects, pairs"] == (0.5, 2)


def test_a_delay_a_day_is_held_against_the_interval_of_that_day(by_family):
    assert by_family["several"]["true value in the 95 % interval"] == (pytest.approx(2 / 3), 3)


def test_the_error_that_is_left_stands_over_that_of_the_noise_alone(by_family):
    assert by_family["half_real"]["error after over the possible"] == (pytest.approx((1.0 + 5.0 / 3.0) / 2), 2)
    assert by_family["half_real"]["error after within 1.1 of the possible"] == (0.5, 2)
    assert by_family["half_real"]["error after said within 20% of the true"] == (0.5, 2)  # 0.03 where it is 0.05


def test_a_horizontal_reference_is_compared_with_its_twin_of_all_axes(by_family):
    assert by_family["horizontal"]["same as with all axes"] == (pytest.approx(1 / 3), 3)
    assert by_family["horizontal"]["false alarms, nulls"] == (1.0, 1)
    assert by_family["all families"]["false alarms, all nulls"] == (0.5, 2)
