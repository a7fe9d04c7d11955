"""Comparing calibrations: what is said to have moved has, what is within σ is not, and totals are compared."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dvl_calib_ros.calibration.comparison import mounting_change
from dvl_calib_ros.calibration.comparison.mounting_change import (
    Difference,
    compare,
    comparison_document,
    fused,
    reasons,
    remarks,
)
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy, rotation_of, turn_between
from dvl_calib_ros.calibration.numerics.kalman import GaussianState
from dvl_calib_ros.calibration.results.extrinsics import COMPONENTS, MOUNTING, Extrinsics, extrinsics_of, rejection
from dvl_calib_ros.calibration.results.results import corrected_rpy
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.verdict.reasons import finding

DAY_NS = 86_400_000_000_000
ALL = np.arange(8)
STD = np.array([*[math.radians(0.05)] * 3, *[0.02] * 3, 0.001, 0.01])


def extrinsics(day: int, turn=(0.0, 0.0, 0.0), arm=(0.0, 0.0, 0.0), scale=0.0, late=0.0, **fields) -> Extrinsics:
    first_ns = 1_750_000_000_000_000_000 + day * DAY_NS
    made = {
        "name": f"day{day}", "model": "full", "first_ns": first_ns, "last_ns": first_ns + DAY_NS // 24,
        "value": np.array([*np.radians(turn), *arm, scale, late]), "covariance": np.diag(STD**2),
        "shown": np.ones(8, dtype=bool), "used": 1000,
    }  # fmt: skip
    return Extrinsics(**(made | fields))


def noisy(day: int, rng: np.random.Generator, turn_deg=(0.0, 0.0, 0.0)) -> Extrinsics:
    e = rng.normal(0.0, STD)
    return extrinsics(day, np.add(turn_deg, np.degrees(e[:3])), e[3:6], e[6], e[7])


def test_a_rotation_vector_and_its_rotation_are_inverse_for_small_and_for_large_angles():
    rng = np.random.default_rng(1)
    for angle in (0.0, 1e-12, 1e-5, 0.1, 2.0, 3.1, math.pi):
        axis = rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        again = rotation_of(turn_between(np.eye(3), rotation_of(vector)))
        assert np.allclose(again, rotation_of(vector), atol=1e-9)
        if angle < 3.1:
            assert np.allclose(turn_between(np.eye(3), rotation_of(vector)), vector, atol=1e-9)


def test_a_mounting_that_moved_is_said_with_its_size_sigma_axis_and_dates():
    before, after = [extrinsics(day) for day in (0, 1)], [extrinsics(day, (0.0, 0.0, 0.7)) for day in (2, 3)]
    found = compare([*after, *before])  # in any order
    assert [each.name for each in found.calibrations] == ["day0", "day1", "day2", "day3"]
    assert not found.same_mounting
    (said,) = reasons(found)
    assert said.code == "MOUNTING_MOVED" and said.numbers["moved"] == "in yaw by +0.70° ± 0.05°"
    assert said.numbers["between"] == "between 2025-06-16 16:06 (day1) and 2025-06-17 15:06 (day2)"


def test_two_moves_are_both_found_and_a_clock_or_a_speed_of_sound_is_none():
    turns = [(0, 0, 0), (0, 0, 0), (1, 0, 0), (1, 0, 0), (0, 0, 0), (0, 0, 0)]
    series = [extrinsics(day, turn, late=0.5 * (day % 2), scale=0.01 * (day > 2)) for day, turn in enumerate(turns)]
    found = compare(series)
    assert [change.first_after.name for change in found.moved] == ["day2", "day4"]
    assert [change.first_after.name for change in found.scale_changed] == ["day3"]
    assert found.clock_changed
    only = compare([extrinsics(0), extrinsics(1, late=0.5, scale=0.02)])
    assert only.same_mounting and only.clock_changed and only.scale_changed
    said = reasons(only)
    assert [each.code for each in said] == ["MOUNTING_SAME", "SCALE_CHANGED", "DELAY_CHANGED"]
    assert said[1].numbers["percent"] == pytest.approx(2.0) and said[1].numbers["std"] == pytest.approx(
        0.1414, abs=1e-3
    )
    assert said[2].numbers["seconds"] == pytest.approx(0.5) and said[2].numbers["way"] == "later"


def test_a_dvl_that_was_put_elsewhere_is_said_by_its_lever_arm():
    found = compare([extrinsics(0), extrinsics(1, arm=(0.5, 0.0, 0.0))])
    assert reasons(found)[0].numbers["moved"] == ("in lever arm x by +0.50 m ± 0.03 m")


@pytest.mark.slow
def test_what_only_chance_makes_differ_is_the_same_in_95_of_100_and_has_never_moved():
    rng = np.random.default_rng(5)
    words = [compare([noisy(day, rng) for day in range(5)]).word for _ in range(200)]
    assert words.count("moved") == 0  # of 200 at 0.006 % or less
    assert words.count("suspicious") <= 18  # of 200 at 4.6 % or less: more by chance in one of a hundred


@pytest.mark.parametrize(
    ("sigmas", "word"), [(1.0, "same"), (2.5, "same"), (3.0, "suspicious"), (3.9, "suspicious"), (4.6, "moved")]
)
def test_one_angle_that_differs_by_some_sigma_is_no_chance_among_quantities_that_do_not(sigmas, word):
    std = Difference.between(extrinsics(0), extrinsics(1)).std[2]
    found = compare([extrinsics(0), extrinsics(1, (0.0, 0.0, math.degrees(sigmas * std)))])
    assert found.word == word
    assert [each.code for each in reasons(found)] == [f"MOUNTING_{word.upper()}"]  # nor do they scatter besides
    assert reasons(found)[0].severity is found.answer.severity
    assert comparison_document(found)["verdict"] == word


def test_chi_square_of_a_pair_and_of_one_against_several_is_that_of_the_covariances():
    rng = np.random.default_rng(3)
    draws = [[noisy(day, rng) for day in range(4)] for _ in range(100)]
    pairs = [Difference.between(*several[:2]) for several in draws]
    rest = [Difference.between(fused(several[:3]), several[3]).chi_square(ALL).value for several in draws]
    assert np.mean([pair.chi_square(ALL).value for pair in pairs]) == pytest.approx(8.0, abs=1.6)
    assert np.mean(rest) == pytest.approx(8.0, abs=1.6)
    assert 0.4 < np.mean([pair.chi_square(MOUNTING).p for pair in pairs]) < 0.6


def test_an_uncertain_lever_arm_does_not_hide_a_turn():
    """As of a recording of 12 minutes: a joint test of six has p 0.1."""
    std = np.array([*np.radians([0.24, 0.21, 0.25]), 0.05, 0.02, 0.02, 0.004, 0.04])
    first, second = (extrinsics(day, (0.0, 0.0, yaw), covariance=np.diag(std**2)) for day, yaw in enumerate((0.0, 1.1)))
    assert Difference.between(first, second).chi_square(MOUNTING).p > 0.1
    assert compare([first, second]).verdict == "suspicious"


@pytest.mark.slow
def test_of_movements_as_large_as_is_said_nine_of_ten_are_found():
    rng, found = np.random.default_rng(6), 0
    smallest = np.degrees(compare([extrinsics(0), extrinsics(1)]).smallest)
    for number in range(600):
        turn = np.where(np.arange(3) == number % 3, smallest, 0.0)
        found += compare([noisy(0, rng), noisy(1, rng, turn)]).verdict != "same"
    assert 0.87 < found / 600 < 0.94  # of chance in the other quantities slightly more than 0.9


def test_without_movement_the_size_that_could_not_be_seen_is_said_and_what_was_not_compared():
    blind = np.arange(8) != 0
    blank = extrinsics(1, shown=blind, covariance=np.diag(np.where(blind, STD**2, 0.0)))
    (said,) = reasons(compare([extrinsics(0), blank]))
    # (2.69 σ by Holm of seven + 1.28 σ) of √2 0.05°
    assert said.sentence == (
        "no movement found; smaller than 0.3° is not detectable (pitch 0.3°, yaw 0.3°; 90 of 100 such movements are "
        "found); roll cannot be compared"
    )


def test_angles_on_either_side_of_half_a_turn_are_compared_and_averaged_as_neighbours():
    up, down = extrinsics(0, (180.0, 0.0, 0.0)), extrinsics(1, (-179.98, 0.0, 0.0))
    found = compare([up, down])
    assert math.degrees(found.pairs[0].value[0]) == pytest.approx(0.02)
    assert [round(math.degrees(each.value[0]), 2) for each in found.calibrations] == [180.0, 180.02]
    assert math.degrees(fused([up, down]).value[0]) == pytest.approx(180.01)


def test_a_rejected_calibration_beside_accepted_ones_is_a_suspected_move_if_it_differs():
    accepted = [extrinsics(day) for day in (0, 1, 3)]
    moved = extrinsics(2, (0.0, 0.0, 5.7), rejected="the clock jumps")
    found = compare([*accepted, moved])
    assert found.verdict == "suspicious" and not found.moved
    (said,) = reasons(found)
    assert said.sentence == (
        "suspected move: day2 is rejected (the clock jumps), and differs from day1 in yaw by +5.70° ± 0.07°: "
        "inspect the mounting, and calibrate once more"
    )
    assert compare([*accepted, extrinsics(2, rejected="the clock jumps")]).verdict == "same"
    alone = [extrinsics(day, (0.0, 0.0, 5.7 * day), rejected="the clock jumps") for day in range(2)]
    assert compare(alone).verdict == "suspicious"  # σ of neither holds


def test_a_calibration_that_is_rejected_for_its_size_alone_is_believed():
    of_size = finding("MISALIGNMENT_LARGE", degrees=5.7, limit=5.0, roll=0.0, pitch=0.0, yaw=6.0)
    other = finding("NO_SAMPLE_USED")
    assert rejection([of_size.as_dict()]) == ""
    assert rejection([of_size.as_dict(), other.as_dict()]) == other.says


# What a bias of 10 mm/s makes at 1 m/s, and at three times that
SLOW = 0.01 * np.array([[0, 0, 0], [0, 0, 1], [0, -1, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]])
FAST = SLOW / 3.0


def biased(day, rng=None, bias=(0.0, 0.0, 0.0), by=SLOW, turn_deg=(0.0, 0.0, 0.0), dvl="dvl_link, flu") -> Extrinsics:
    """Of a DVL with a bias, in σ of its prior. rng: None without noise."""
    e = by @ bias + (rng.normal(0.0, STD) if rng else 0.0)
    turn = np.add(turn_deg, np.degrees(e[:3]))
    covariance = np.diag(STD**2) + by @ by.T
    return extrinsics(day, turn, e[3:6], e[6], e[7], covariance=covariance, by_bias=by, dvl=dvl)


def test_a_mounting_that_moved_is_not_hidden_by_the_bias_of_one_dvl():
    turned = (0.0, 0.0, 0.7)  # at 1 m/s 12 mm/s
    assert compare([biased(0), biased(1, turn_deg=turned)]).word == "moved"
    assert compare([biased(0), biased(1, turn_deg=turned, dvl="other, flu")]).word == "same"
    assert compare([biased(0, dvl=""), biased(1, turn_deg=turned, dvl="")]).word == "same"  # of which nothing is known
    assert compare([biased(0), biased(1, by=FAST, turn_deg=turned)]).word == "same"  # at another speed it is another
    (change,) = compare([biased(0), biased(1), biased(2, turn_deg=turned)]).moved
    assert change.first_after.name == "day2"


def test_differences_of_one_dvl_scatter_as_their_sigma_says_at_one_speed_and_at_several(monkeypatch):
    monkeypatch.setattr(mounting_change, "ARM_WANDERS_M", 0.0)  # no antenna is simulated
    rng = np.random.default_rng(4)
    chi_squares, speeds = [], (SLOW, FAST, SLOW, FAST)
    for _ in range(300):
        bias = rng.normal(size=3)
        found = compare([biased(day, rng, bias, by) for day, by in enumerate(speeds)])
        chi_squares.append([pair.chi_square(ALL).value for pair in found.pairs])
    assert np.mean(chi_squares, axis=0) == pytest.approx(8.0, abs=0.8)  # 3 σ of a mean of 300


def test_several_at_one_speed_leave_the_bias_as_it_is_and_at_two_speeds_show_it():
    alone, several = biased(0), [biased(day) for day in range(20)]
    np.testing.assert_allclose(fused(several).by_bias, SLOW, rtol=0.02)
    assert fused(several).std[2] == pytest.approx(0.01, rel=0.01)  # not a twentieth's root of it
    independent = fused([biased(day, dvl="") for day in range(20)])
    assert independent.std[2] == pytest.approx(alone.std[2] / math.sqrt(20.0))
    both = fused([*several, *(biased(day, by=FAST) for day in range(20, 40))])
    assert both.std[2] < 0.2 * alone.std[2]
    apart = both.covariance - both.by_bias @ both.by_bias.T
    assert np.linalg.eigvalsh(apart)[0] > 0.0


def test_sigma_of_the_angles_is_the_scatter_of_simulated_states():
    """Of a DVL mounted at an angle, for a model in the DVL's frame: against Monte Carlo through the error model."""
    parameters = Parameters(mounting_rpy=(0.1, -0.2, 0.8), day_std_heading=0.0)
    model, rng = MODELS["M3"], np.random.default_rng(5)
    x = np.array([0.03, -0.02, 0.05, 0.004])
    root = np.tril(rng.normal(size=(4, 4))) * 1e-3 + np.eye(4) * 1e-3
    made = extrinsics_of("a", model, GaussianState(x, root @ root.T), parameters, (0, 1), 100)
    draws = x + rng.normal(size=(3000, 4)) @ root.T
    turns = np.array([corrected_rpy(draw[:3], parameters) for draw in draws])
    assert np.allclose(np.cov(turns.T), made.covariance[:3, :3], rtol=0.1, atol=1e-7)


def test_what_is_the_days_own_is_in_the_sigma_that_calibrations_are_compared_with():
    """A heading reference's error about the body's z and the speed of sound, whatever the mounting; nothing beside."""
    model, state = MODELS["M3"], GaussianState(np.zeros(4), np.eye(4) * 1e-8)
    with_day, without = (
        extrinsics_of("a", model, state, parameters, (0, 1), 100)
        for parameters in (
            Parameters(mounting_rpy=(0.0, 0.0, 0.8), day_std_heading=0.002, day_std_scale=0.004),
            Parameters(mounting_rpy=(0.0, 0.0, 0.8), day_std_heading=0.0, day_std_scale=0.0),
        )
    )
    added = with_day.covariance - without.covariance
    assert np.allclose(added, np.diag([0.0, 0.0, 0.002**2, 0.0, 0.0, 0.0, 0.004**2, 0.0]), atol=1e-15)
    assert (with_day.shown == without.shown).all() and not with_day.shown[7]


def test_totals_are_compared_so_the_same_dvl_under_another_nominal_mounting_is_the_same():
    model, p = MODELS["M3"], 1e-6 * np.eye(4)
    flat, turned = Parameters(), Parameters(mounting_rpy=(0.0, 0.0, math.radians(3.0)))
    total = rotation_from_rpy((0.0, 0.0, math.radians(2.0)))
    states = []
    for parameters in (flat, turned):
        phi = -np.tan(turn_between(np.eye(3), parameters.rotation_dvl_from_body @ total))
        states.append(GaussianState(np.array([*phi, 0.0]), p))
    a, b = (
        extrinsics_of(name, model, state, parameters, (0, 1), 10)
        for name, state, parameters in zip("ab", states, (flat, turned), strict=True)
    )
    difference = Difference.between(a, b)
    assert np.allclose(difference.value[:3], 0.0, atol=1e-9) and compare([a, b]).same_mounting


def test_what_one_of_two_has_not_shown_is_not_compared():
    shown = np.array([False, True, True, False, False, False, False, False])
    other = extrinsics(1, (0.0, 0.0, 0.7), shown=shown, model="M7", covariance=np.diag(np.where(shown, STD**2, 0.0)))
    found = compare([extrinsics(0), other])
    assert [name for name, known in zip(COMPONENTS, found.pairs[0].compared, strict=True) if known] == ["pitch", "yaw"]
    assert not found.same_mounting and np.isnan(found.pairs[0].std[0])
    assert [each.numbers["models"] for each in remarks(found) if each.code == "MODELS_DIFFER"] == ["full, M7"]


def test_a_lever_arm_that_is_taken_as_known_and_is_another_is_remarked():
    assumed = np.array([True] * 3 + [False] * 3 + [True] * 2)
    found = compare([
        extrinsics(0, arm=(-1.9, 0.0, 0.0)),
        extrinsics(1, shown=assumed, covariance=np.diag(np.where(assumed, STD**2, 0.0))),
    ])  # fmt: skip
    assert "-p lever_arm:=[-1.90, 0.00, 0.00]" in " ".join(map(str, remarks(found)))


def test_nothing_shown_by_two_is_one_line():
    blank = {"shown": np.zeros(8, dtype=bool), "covariance": np.zeros((8, 8))}
    with pytest.raises(InputError, match="no angle is observable in two of them"):
        compare([extrinsics(0), extrinsics(1, **blank)])
    with pytest.raises(InputError, match="one alone"):
        compare([extrinsics(0)])


def test_several_together_are_their_weighted_mean():
    tight = extrinsics(1, (0.0, 0.0, 0.3), covariance=np.diag(STD**2) / 4.0)
    both = fused([extrinsics(0), tight])
    assert math.degrees(both.value[2]) == pytest.approx(0.8 * 0.3)
    assert both.std[2] == pytest.approx(STD[2] / math.sqrt(5.0))


def test_a_scatter_beyond_sigma_without_an_instant_is_said_to_be_a_sigma_too_small():
    found = compare([extrinsics(day, [0.1 * (-1) ** day] * 3) for day in range(12)])
    assert found.same_mounting
    first, *_, last = reasons(found)
    assert first.code == "MOUNTING_SCATTERS" and first.numbers["count"] == 12
    assert last.code == "SCATTER" and last.numbers["by"] == pytest.approx(1.5, abs=0.05)
