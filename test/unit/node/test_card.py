"""What /diagnostics says for an operator: rates, ages, headings, the mounting, its worth and what to drive next."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from runs import MatchedRun, calibrate, make_samples, without

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.filters.observability import PredictedDrift, predicted_drift
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import ReferenceSample, VelocityFrame
from dvl_calib_ros.node import operator_card
from dvl_calib_ros.node.operator_card import (
    LEAST_LOOKS,
    REPLANNED_EVERY_S,
    SECTORS,
    SPREAD,
    STANDS_S,
    Card,
    RecentWorth,
    RemainingTime,
)

RUN = MatchedRun("box", 120.0, (0.0, 0.0, 0.05), dvl_std=0.01, gnss_std=0.03, frame=VelocityFrame.ENU)


def counts(dvl, gnss=0, imu=0):
    return {"dvl": {"received": dvl}, "reference": {"received": gnss}, "imu": {"received": imu}}


class Going:
    """A calibrator whose DVL has stamps up to so many seconds."""

    def __init__(self, calibrator: Calibrator, newest_s: float) -> None:
        self._calibrator, self.last_ns = calibrator, int(newest_s * 1e9)

    def __getattr__(self, name: str) -> object:
        return getattr(self._calibrator, name)


def values(card, calibrator, received, now_s):
    return card.values(calibrator, calibrator.estimate(), received, now_s)


def test_before_the_first_sample_nothing_is_known_and_all_is_said_so():
    said = values(Card(100.0), Calibrator(Parameters()), counts(0), 101.0)
    assert said["elapsed [s]"] == "1" and said["dvl rate [Hz]"] == said["dvl age [s]"] == said["seconds"] == "-"
    assert said["worth ahead"] == "-" and "goal ahead [%]" not in said  # no model without a reference knows the scale
    assert said["next code"] == "NEXT_WAIT" and float(said["goal worth [%]"]) == pytest.approx(0.0, abs=1.0)


def test_in_a_dive_the_card_asks_for_the_reference():
    dive = without(make_samples(RUN), ReferenceSample, lambda at: at >= 90.0)
    said = values(Card(0.0), calibrate(dive, Parameters(target_drift=0.5)), counts(600), 1.0)
    assert said["next"] == "surface: full learns only with the reference"


def test_rates_are_those_of_the_last_seconds_and_ages_since_something_came():
    card, calibrator = Card(0.0), Calibrator(Parameters())
    for second in range(20):
        said = values(card, calibrator, counts(5 * second, min(second, 12), 50 * second), float(second))
    assert (said["dvl rate [Hz]"], said["imu rate [Hz]"]) == ("5.0", "50.0")
    assert said["gnss age [s]"] == "7" and float(said["gnss rate [Hz]"]) < 0.5


def test_the_card_has_the_estimate_its_worth_and_the_heading():
    calibrator = calibrate(make_samples(RUN), Parameters(model="full"))
    card = Card(0.0)
    values(card, Going(calibrator, 1.0), counts(1), 1.0)
    said = values(card, Going(calibrator, 2.0), counts(6), 2.0)
    estimate = calibrator.estimate()
    drift = predicted_drift_of(calibrator, estimate)
    assert float(said["worth"]) == pytest.approx(drift.both, abs=0.01) and said["target"] == "2"
    assert float(said["mounting yaw [deg]"]) == pytest.approx(-math.degrees(0.05), abs=0.5)
    assert 0.0 < float(said["sigma mounting arm x [m]"]) < 0.2 and float(said["sigma mounting yaw [deg]"]) < 1.0
    motion = calibrator.latest_motion()
    sector = SECTORS[round((90.0 - math.degrees(motion.heading)) / 45.0) % 8]
    assert motion.in_earth and 0.8 < motion.speed < 1.8
    assert {name: said[f"driven {name} [s]"] for name in SECTORS} == dict.fromkeys(SECTORS, "0") | {sector: "1"}


def predicted_drift_of(calibrator, estimate):
    return predicted_drift(MODELS[estimate.model], estimate.velocity_covariance, calibrator.parameters)


def test_what_to_drive_next_is_thought_of_now_and_then(monkeypatch):
    calls, real = [], operator_card.outlook
    monkeypatch.setattr(operator_card, "outlook", lambda *given: calls.append(1) or real(*given))
    card, calibrator = Card(0.0), calibrate(make_samples(RUN), Parameters(model="full"))
    for second in range(11):
        values(card, calibrator, counts(second), float(second))
    assert len(calls) == 1 + 10 // REPLANNED_EVERY_S


def looks(card, calibrator, factors, rate=1.0, since_s=0.0):
    """What the card says each second of the estimate with its σ so many times larger. rate: of play."""
    estimate = calibrator.estimate()
    for second, factor in enumerate(factors):
        each = replace(estimate, recording_covariance=factor**2 * estimate.recording_covariance)
        yield card.values(Going(calibrator, since_s + rate * second), each, counts(second), float(second))


@pytest.fixture(scope="module")
def at_the_goal() -> Calibrator:
    """A calibration whose predicted drift is 0.9 of its target."""
    samples = make_samples(RUN)
    known = calibrate(samples, Parameters(model="full"))
    target = predicted_drift_of(known, known.estimate()).both / 0.9
    return calibrate(samples, Parameters(model="full", target_drift=target))


def test_bars_that_are_full_and_what_to_drive_next_say_the_same_at_once(at_the_goal):
    for said in looks(Card(0.0), at_the_goal, [100.0] * 5 + [0.1] * 90):
        assert (said["goal worth [%]"] == "100") == (said["next code"] == "NEXT_IS_GOOD")
    assert said["next code"] == "NEXT_IS_GOOD"


def test_good_enough_is_said_when_it_has_stood_and_until_then_how_long_that_takes(at_the_goal):
    said = list(looks(Card(0.0), at_the_goal, [1.0] * 60))
    codes = [each["next code"] for each in said]
    first = codes.index("NEXT_IS_GOOD")
    assert first == STANDS_S and set(codes[:first]) == {"NEXT_STANDS"} and set(codes[first:]) == {"NEXT_IS_GOOD"}
    assert [each["seconds"] for each in said[:2]] == ["30", "29"] and said[first]["seconds"] == "-"


@pytest.mark.parametrize("rate", [0.5, 10.0])
def test_good_enough_takes_as_much_data_however_fast_it_is_played(at_the_goal, rate):
    codes = [each["next code"] for each in looks(Card(0.0), at_the_goal, [1.0] * 70, rate)]
    assert codes.index("NEXT_IS_GOOD") == max(STANDS_S / rate, LEAST_LOOKS)


def test_a_dvl_that_is_silent_or_far_ahead_by_one_stamp_makes_nothing_good_enough(at_the_goal):
    card = Card(0.0)
    assert {each["next code"] for each in looks(card, at_the_goal, [1.0] * 10)} == {"NEXT_STANDS"}
    silent = list(looks(card, at_the_goal, [1.0] * 300, rate=0.0, since_s=9.0))
    assert {each["next code"] for each in silent} == {"NEXT_STANDS"} and silent[-1]["seconds"] == "21"
    assert len(card._worth._drifts) <= STANDS_S  # what is kept stays bounded
    ahead = next(looks(card, at_the_goal, [1.0], since_s=1e6))
    assert ahead["next code"] == "NEXT_STANDS"


def test_a_sigma_that_differs_from_look_to_look_does_not_take_good_enough_back(at_the_goal):
    flickering = [1.0] * 40 + [1.0, 1.0, 2.5] * 60  # as that of the shipped bag does
    codes = [each["next code"] for each in looks(Card(0.0), at_the_goal, flickering)]
    assert set(codes[codes.index("NEXT_IS_GOOD") :]) == {"NEXT_IS_GOOD"}
    assert all(each["taken back"] == "" for each in looks(Card(0.0), at_the_goal, flickering))


def test_good_enough_is_not_said_of_looks_that_are_only_mostly_within_the_goal(at_the_goal):
    codes = {each["next code"] for each in looks(Card(0.0), at_the_goal, [1.0] * 25 + [2.5] * 20 + [1.0] * 20)}
    assert "NEXT_IS_GOOD" not in codes and "NEXT_STANDS" in codes
    codes = [each["next code"] for each in looks(Card(0.0), at_the_goal, [1.0, 2.5] * 40)]
    assert set(codes[::2]) == {"NEXT_STANDS"} and not {"NEXT_STANDS", "NEXT_IS_GOOD"} & set(codes[1::2])


def test_a_sigma_that_has_grown_for_good_takes_good_enough_back_and_says_so_until_it_is_good_again(at_the_goal):
    said = list(looks(Card(0.0), at_the_goal, [1.0] * 60 + [2.5] * 60 + [1.0] * 90))
    codes = [each["next code"] for each in said]
    back = next(at for at in range(60, 120) if codes[at] != "NEXT_IS_GOOD")
    assert back >= 60 + STANDS_S / 2 and "m per km" in said[back]["taken back"]
    assert said[back]["next code"] not in ("NEXT_STANDS", "NEXT_IS_GOOD")
    assert said[119]["taken back"] and codes[-1] == "NEXT_IS_GOOD" and said[-1]["taken back"] == ""


def test_another_model_takes_good_enough_back_at_once_and_is_named():
    worth, drift = RecentWorth(), PredictedDrift(1.0, 1.0, 1.4)
    for second in range(40):
        worth.add("full", drift, 2.0, float(second), rejected=False)
    assert worth.is_good and worth.taken_back is None
    worth.add("unaided", drift, 2.0, 40.0, rejected=False)
    assert not worth.is_good and "unaided" in worth.taken_back.sentence and worth.seconds_left(41.0) == STANDS_S - 1.0


def test_a_standing_vehicle_drives_no_heading():
    card, calibrator = Card(0.0), calibrate(make_samples(RUN), Parameters(model="full"))
    for second in range(5):
        said = values(card, calibrator, counts(7), float(second))
    assert sum(float(said[f"driven {name} [s]"]) for name in SECTORS) == 0.0


def test_of_a_calibration_that_would_be_rejected_nothing_is_good_enough(at_the_goal):
    card, estimate = Card(0.0), at_the_goal.estimate()
    assert list(looks(card, at_the_goal, [1.0] * 40))[-1]["next code"] == "NEXT_IS_GOOD"
    said = card.values(at_the_goal, estimate, counts(1), 40.0, rejected=True)
    assert said["next code"] == "NEXT_REJECTED" and said["goal worth [%]"] == "99"
    assert card.values(at_the_goal, estimate, counts(1), 41.0)["next code"] == "NEXT_STANDS"


def told_of(predictions, drifts):
    """What is told each 5 s: (time, left, latest promised so far with its spread, code)."""
    remaining, latest, told = RemainingTime(), math.inf, []
    for number, (seconds, drift) in enumerate(zip(predictions, drifts, strict=True)):
        now_s = 5.0 * number
        left = remaining.add(seconds, drift, now_s)
        code = "" if remaining.longer is None else remaining.longer.code
        told.append((now_s, left, latest, code))
        end_s = math.inf if left is None else now_s + left
        latest = end_s + SPREAD * left if end_s > latest else min(latest, end_s + SPREAD * (left or math.inf))
    return told


@pytest.mark.parametrize("seed", range(2))
def test_the_remaining_time_is_never_longer_than_promised_by_more_than_its_spread_or_says_why(seed):
    """It went from 9 to 26, 10 and 12 minutes without a word."""
    rng = np.random.default_rng(seed)
    predictions = np.maximum(600.0 - 5.0 * np.arange(100), 30.0) * rng.lognormal(0.0, 0.7, 100)
    drifts = np.linspace(8.0, 3.0, 100)
    told = told_of(predictions, drifts)
    beyond = [code for now_s, left, latest, code in told if now_s + left > latest]
    assert all(beyond)
    assert set(beyond) <= {"LONGER_AS_LITTLE_SHOWN", "LONGER_AS_DRIFT_GREW"}


def test_a_time_that_runs_out_as_promised_is_without_a_word_and_a_vehicle_that_learns_nothing_is_told_why():
    told = told_of([600.0 - 5.0 * each for each in range(110)], [5.0] * 110)
    assert not any(code for *_, code in told) and told[-1][1] == pytest.approx(55.0, abs=15.0)
    told = told_of([300.0] * 100, [5.0] * 100)  # it is to take as long as ever
    first = next(now_s for now_s, *_, code in told if code)
    assert first == pytest.approx(300.0 * SPREAD, abs=STANDS_S)
    assert {code for *_, code in told} == {"", "LONGER_AS_LITTLE_SHOWN"}
    grown = told_of([300.0] * 3 + [900.0] * 20, [5.0] * 3 + [7.0] * 20)
    assert "LONGER_AS_DRIFT_GREW" in {code for *_, code in grown}


def test_the_time_that_is_told_includes_that_for_which_the_goal_has_to_stand_and_counts_down():
    calibrator = calibrate(make_samples(RUN), Parameters(model="full", target_drift=8.0))
    said = list(looks(Card(0.0), calibrator, [1.2] * 8))
    seconds = [float(each["seconds"]) for each in said]
    assert seconds[0] > STANDS_S and float(said[0]["seconds spread"]) == pytest.approx(SPREAD * seconds[0], abs=1.0)
    assert all(after <= before for before, after in pairwise(seconds)) and seconds[4] == seconds[0] - 4
