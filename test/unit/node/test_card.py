"""What /diagnostics says for an operator: rates, ages, headings, the mounting, its worth and what to drive next."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import VelocityFrame
from dvl_calib_ros.calibration.worth import predicted_drift
from dvl_calib_ros.node.card import SECTORS, THOUGHT_OF_EVERY_S, Card

RUN = MatchedRun("box", 120.0, (0.0, 0.0, 0.05), dvl_std=0.01, gnss_std=0.03, frame=VelocityFrame.ENU)


def counts(dvl, gnss=0, imu=0):
    return {"dvl": {"received": dvl}, "reference": {"received": gnss}, "imu": {"received": imu}}


def values(card, calibrator, received, now_s):
    return card.values(calibrator, calibrator.estimate(), received, now_s)


def test_before_the_first_sample_nothing_is_known_and_all_is_said_so():
    said = values(Card(100.0), Calibrator(Parameters()), counts(0), 101.0)
    assert said["elapsed [s]"] == "1" and said["dvl rate [Hz]"] == said["dvl age [s]"] == said["seconds"] == "-"
    assert said["worth ahead"] == "-" and "goal ahead [%]" not in said  # no model without a reference knows the scale
    assert said["next code"] == "NEXT_WAIT" and float(said["goal worth [%]"]) == pytest.approx(0.0, abs=1.0)


def test_rates_are_those_of_the_last_seconds_and_ages_since_something_came():
    card, calibrator = Card(0.0), Calibrator(Parameters())
    for second in range(20):
        said = values(card, calibrator, counts(5 * second, min(second, 12), 50 * second), float(second))
    assert (said["dvl rate [Hz]"], said["imu rate [Hz]"]) == ("5.0", "50.0")
    assert said["gnss age [s]"] == "7" and float(said["gnss rate [Hz]"]) < 0.5


def test_the_card_has_the_estimate_its_worth_and_the_heading():
    calibrator = calibrate(make_samples(RUN), Parameters(model="G1"))
    card = Card(0.0)
    values(card, calibrator, counts(1), 1.0)
    said = values(card, calibrator, counts(6), 2.0)
    estimate = calibrator.estimate()
    drift = predicted_drift_of(calibrator, estimate)
    assert float(said["worth"]) == pytest.approx(drift.both, abs=0.01) and said["target"] == "2"
    assert float(said["mounting yaw [deg]"]) == pytest.approx(-math.degrees(0.05), abs=0.5)
    assert said["sigma mounting arm x [m]"] == "not estimated" and float(said["sigma mounting yaw [deg]"]) < 1.0
    motion = calibrator.latest_motion()
    sector = SECTORS[round((90.0 - math.degrees(motion.heading)) / 45.0) % 8]
    assert motion.in_earth and 0.8 < motion.speed < 1.8
    assert {name: said[f"driven {name} [s]"] for name in SECTORS} == dict.fromkeys(SECTORS, "0") | {sector: "1"}


def predicted_drift_of(calibrator, estimate):
    from dvl_calib_ros.calibration.models import MODELS

    return predicted_drift(MODELS[estimate.model], estimate.recording_covariance, calibrator.parameters)


def test_what_to_drive_next_is_thought_of_now_and_then(monkeypatch):
    calls = []
    from dvl_calib_ros.node import card as module

    real = module.outlook
    monkeypatch.setattr(module, "outlook", lambda *given: calls.append(1) or real(*given))
    card, calibrator = Card(0.0), calibrate(make_samples(RUN), Parameters(model="G1"))
    for second in range(11):
        values(card, calibrator, counts(second), float(second))
    assert len(calls) == 1 + 10 // THOUGHT_OF_EVERY_S


def test_bars_that_are_full_and_what_to_drive_next_say_the_same_at_once():
    card, calibrator = Card(0.0), calibrate(make_samples(RUN), Parameters(model="G1"))
    estimate = calibrator.estimate()
    coarse = replace(estimate, recording_covariance=1e4 * estimate.recording_covariance)
    assert "GOOD" not in card.values(calibrator, coarse, counts(9), 1.0)["next code"]
    fine = replace(estimate, recording_covariance=1e-4 * estimate.recording_covariance)
    said = card.values(calibrator, fine, counts(9), 2.0)
    assert said["goal worth [%]"] == "100" and said["next code"] == "NEXT_IS_GOOD"


def test_a_standing_vehicle_drives_no_heading():
    card, calibrator = Card(0.0), calibrate(make_samples(RUN), Parameters(model="G1"))
    for second in range(5):
        said = values(card, calibrator, counts(7), float(second))
    assert sum(float(said[f"driven {name} [s]"]) for name in SECTORS) == 0.0


def test_of_a_calibration_that_would_be_rejected_nothing_is_good_enough():
    calibrator = calibrate(make_samples(RUN), Parameters(model="G1", target_drift=1000.0))
    card, estimate = Card(0.0), calibrator.estimate()
    assert card.values(calibrator, estimate, counts(1), 1.0)["next code"] == "NEXT_IS_GOOD"
    assert card.values(calibrator, estimate, counts(1), 2.0, rejected=True)["next code"] == "NEXT_REJECTED"
