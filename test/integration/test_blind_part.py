"""A fixed part of the blind trial, small enough for every run of the tests, with bounds that a regression breaks.

The figures of the whole trial are in docs/diagnosis.md; these bounds are what the part must keep, with some room for
the chance that a change of the noise estimate moves a single case.
"""

from __future__ import annotations

import numpy as np
import pytest

from validation.trial.motion import RECORDED
from validation.trial.plan import KINDS, Case, Family, plan
from validation.trial.run import Trial
from validation.trial.scored import join
from validation.trial.truth import Category, unseal
from validation.trial.vehicle import of_one_recording

pytestmark = pytest.mark.trial

SINGLES = sorted(of_one_recording(in_body=False))[::4]
KINDS_HERE = tuple(kind for kind in KINDS if kind != RECORDED)  # the same part with and without the recordings


def fixed_part() -> list[Case]:
    """Nulls, every fourth effect at q = 20, a pair, an unknown fault, and a run that cannot tell."""
    cases = plan(KINDS_HERE)
    strong = [case for case in cases if case.q == 20.0]
    return [
        *[case for case in cases if case.category is Category.NULL][:3],
        *[case for case in cases if case.category is Category.HARD_NULL][:1],
        *[next(c for c in strong if c.category is Category.SINGLE and c.name == name) for name in SINGLES],
        *[case for case in strong if case.category is Category.PAIR][:1],
        *[case for case in strong if case.category is Category.UNKNOWN][:1],
        *[case for case in cases if case.category is Category.UNIDENTIFIABLE][:1],
    ]


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """Category -> cases with their answers."""
    trial = Trial(tmp_path_factory.mktemp("trial"), seed=0, jobs=1)
    answers = trial.run(fixed_part())
    cases = join(unseal(trial.sealed), answers)
    return {category: [case for case in cases if case.truth.category is category] for category in Category}


def test_no_case_breaks_the_diagnosis(scored):
    assert not [case.truth for cases in scored.values() for case in cases if case.verdict == "failed"]


def test_nulls_raise_no_false_alarm(scored):
    nulls = scored[Category.NULL] + scored[Category.HARD_NULL]
    assert len(nulls) == 4
    assert not any(case.claimed for case in nulls)


def test_strong_effects_are_found_and_named(scored):
    single = scored[Category.SINGLE]
    assert len(single) == len(SINGLES)
    assert all(case.claimed for case in single)
    assert all(case.named_set & case.truth.faults.keys() for case in single)
    assert sum(case.is_right_first for case in single if case.separable) >= 3


def test_strong_effects_are_closed_and_their_sizes_within_their_intervals(scored):
    single = scored[Category.SINGLE]
    assert np.median([case.closure for case in single if case.closure is not None]) >= 0.9
    inside = [interval.holds for case in single for interval in case.intervals]
    assert len(inside) >= 4
    assert np.mean(inside) >= 0.8


def test_pairs_and_unknown_effects_are_seen(scored):
    assert any(case.are_all_named for case in scored[Category.PAIR])
    assert any(case.verdict == "unknown" for case in scored[Category.UNKNOWN])


def test_nothing_is_guessed_where_the_data_cannot_tell(scored):
    assert all(case.no_guess for case in scored[Category.UNIDENTIFIABLE])


def test_the_scale_of_a_sway_that_is_noise_explains_no_noise(tmp_path):
    """Of a DVL of 2 Hz that has lost some samples: with the heading it did, and the rest followed a period of 85 s."""
    trial = Trial(tmp_path / "trial", seed=25401, jobs=1)
    answers = trial.run([Case(Category.HARD_NULL, "box", hardness="gaps", number=21)])
    [case] = join(unseal(trial.sealed), answers)
    assert case.verdict == "no_gap"


# ------------------------------------------------------------------ real motion


@pytest.fixture(scope="module")
def at_sea(tmp_path_factory, snapir_ins):
    """Of every family with real motion, a null and lever arm with delay."""
    cases = [Case(Category.NULL, RECORDED, family=family) for family in (Family.HALF_REAL, Family.HORIZONTAL)]
    cases += [Case(Category.PAIR, RECORDED, family=family) for family in (Family.HALF_REAL, Family.HORIZONTAL)]
    cases += [Case(Category.PAIR, RECORDED, "dvl_time_offset", family=Family.SEVERAL)]
    trial = Trial(tmp_path_factory.mktemp("at_sea"), seed=0, jobs=1)
    answers = trial.run(cases)
    return {(case.truth.family, case.truth.category): case for case in join(unseal(trial.sealed), answers)}


def test_on_real_motion_exactly_the_true_effects_are_named_with_and_without_a_vertical(at_sea):
    pairs = [case for (_, category), case in at_sea.items() if category is Category.PAIR]
    assert len(pairs) == 3
    assert all(case.is_exact for case in pairs)
    inside = [interval.holds for case in pairs for interval in case.intervals]
    assert np.mean(inside) >= 0.8


def test_on_real_motion_what_was_named_leaves_little_more_than_the_noise(at_sea):
    assert all(case.error_over_possible < 1.2 for case in at_sea.values())


def test_real_motion_alone_raises_no_alarm(at_sea):
    assert not [family for (family, category), case in at_sea.items() if category is Category.NULL and case.claimed]
