"""The trial that ends: each question is asked until it is decided, of one commit, and goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from validation.trial import sequential as sequential_trial
from validation.trial.figures import KNOWN
from validation.trial.plan import plan
from validation.trial.run import Trial
from validation.trial.sequential import MOST_CASES, NULLS, QUESTIONS, Sequential, decided, hits_of
from validation.trial.truth import Category, Truth

BY_NAME = {question.name: question for question in QUESTIONS}


def test_a_question_is_decided_by_as_many_cases_as_tell_good_from_bad():
    alarms = BY_NAME["no false alarm on nulls"]
    assert decided(alarms, [True] * 160) == "" and decided(alarms, [True] * 165) == "met"
    assert decided(alarms, [True] * 10 + [False] * 2) == "missed"
    exact = BY_NAME["exact, half_real"]
    assert decided(exact, [True] * 38) == "" and decided(exact, [True] * 39) == "met"
    assert decided(exact, [False, True] * 4) == "missed"
    assert all(decided(question, []) == "" for question in QUESTIONS)


def faked(case, seed, folder):
    """A case that nobody recorded: its bag is named by it, its truth as the plan has it."""
    names = [] if case.category in NULLS else [case.name or "lever_arm"]
    truth = Truth(
        case.id, case.category, case.kind, case.key, case.family.value, {name: {} for name in names}, q_wanted=case.q,
        distances={"sideslip": 10.0}, twin=case.twin.id if case.twin != case else None,
    )  # fmt: skip
    TRUTHS[case.id] = truth
    folder.mkdir(parents=True)
    return SimpleNamespace(bags=(folder,), truth=truth, mounting_rpy=(0.0, 0.0, 0.0), left_mps=lambda said: 0.0)


TRUTHS: dict[str, Truth] = {}


def right(paths, parameters):
    truth = TRUTHS[Path(paths[0]).name]
    if truth.category in NULLS:
        return {"verdict": "no_gap", "effects": []}
    verdict = "known" if truth.category in KNOWN else "unknown"
    return {"verdict": verdict, "effects": [{"name": name, "parameters": {}} for name in truth.faults]}


def wrong(paths, parameters):
    truth = TRUTHS[Path(paths[0]).name]
    is_null = truth.category in NULLS
    return {"verdict": "known" if is_null else "no_gap", "effects": [{"name": "sideslip"}] if is_null else []}


def run(folder, answerer, commit="abc", seconds=1e9):
    asked = []

    def noting(paths, parameters):
        asked.append(paths[0].name)
        return answerer(paths, parameters)

    trial = Trial(folder, seed=3, jobs=1, answerer=noting, recorder=faked)
    sequential = Sequential(trial, plan(), commit)
    return sequential, sequential.run(lambda _: None, seconds, lambda: 0.0), asked


def test_it_ends_when_all_is_decided_and_asks_nothing_again(tmp_path, monkeypatch):
    monkeypatch.setattr(sequential_trial, "BATCH", 40)
    sequential, scored, asked = run(tmp_path, right)
    assert {row[0]: row[5] for row in sequential.lines(scored) if row[5] != "told"} == dict.fromkeys(BY_NAME, "met")
    assert len(asked) == len(set(asked)) == len(scored) < 600 < MOST_CASES
    again, found, asked_again = run(tmp_path, right)
    assert asked_again == [] and again.lines(found) == sequential.lines(scored)


def test_what_is_far_from_its_goal_is_missed_after_few_cases(tmp_path):
    sequential, scored, _ = run(tmp_path, wrong)
    stands = {row[0]: row[5] for row in sequential.lines(scored)}
    assert stands["exact, displaced"] == stands["no false alarm on nulls"] == "missed"
    assert len(hits_of(BY_NAME["exact, displaced"], scored)) < 20
    assert len(scored) < 150


def test_the_first_cases_are_of_every_open_question(tmp_path):
    trial = Trial(tmp_path, seed=3, jobs=2, recorder=faked)
    sequential = Sequential(trial, plan(), "abc")
    first = sequential._next([], {})
    assert len(first) == 12
    assert all(any(question.asks(case) for case in first) for question in QUESTIONS)
    assert {case.category for case in first} >= {Category.UNKNOWN, Category.SINGLE}
    same = sequential.queues["same with and without the vertical"]
    assert [case.twin for case in same[::2]] == same[1::2]
