"""What a calibration is worth to dead reckoning is predicted as draws show it, and a manoeuvre as filters take it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from runs import ONE_HERTZ, MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.assessment.manoeuvre_planner import (
    RecentMotion,
    _information,
    _manoeuvres,
    noise_of_a_second,
    outlook,
)
from dvl_calib_ros.calibration.filters.observability import KM, predicted_drift
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy, skew
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame

RUN = MatchedRun(dvl_std=0.01, gnss_std=0.05, frame=VelocityFrame.ENU, **ONE_HERTZ)
EASTWARD = RecentMotion(1.5, 0.0, True, 0.05**2)


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0, 180.0])
def test_the_predicted_drift_is_that_of_calibrations_drawn_from_the_covariance(yaw):
    parameters = Parameters(mounting_rpy=(math.radians(20.0), 0.0, math.radians(yaw)))
    rng = np.random.default_rng(1)
    model = MODELS["full"]
    root = 1e-3 * rng.normal(size=(model.n_state, model.n_state))
    drift = predicted_drift(model, root @ root.T, parameters)
    t = rotation_from_rpy(parameters.mounting_rpy).T
    errors = rng.normal(size=(20_000, model.n_state)) @ root.T @ model.error_terms_from_state.T
    off = np.array([t.T @ (skew(each[:3]) + np.diag(each[3:])) @ t[:, 0] for each in errors])
    ahead, side, _ = KM * np.sqrt((off**2).mean(axis=0))
    assert (drift.side, drift.ahead) == pytest.approx((side, ahead), rel=0.03)
    assert drift.both == pytest.approx(math.hypot(side, ahead), rel=0.03)


def test_a_leg_is_predicted_to_bring_what_the_filter_learns_on_it():
    parameters = Parameters(gnss_aided_std=0.05, model="full")
    before = calibrate([], parameters).estimate("full")
    after = calibrate(make_samples(replace(RUN, trajectory="straight", seconds=60.0)), parameters).estimate("full")
    course = _manoeuvres(EASTWARD)["east"][1]
    gain = _information(MODELS["full"], parameters, EASTWARD, *course)
    predicted = np.linalg.inv(np.linalg.inv(before.filter_covariance) + gain)
    expected = predicted_drift(MODELS["full"], after.filter_covariance, parameters)
    assert predicted_drift(MODELS["full"], predicted, parameters) == pytest.approx(expected, rel=0.1)


def test_the_noise_of_a_second_is_what_the_information_was_gathered_with():
    parameters = Parameters(gnss_aided_std=0.05, model="M3")
    estimate = calibrate(make_samples(replace(RUN, trajectory="straight", seconds=120.0)), parameters).estimate("M3")
    assert noise_of_a_second(estimate, parameters, 120.0, 1.5**2) == pytest.approx(0.05**2, rel=0.1)
    assert noise_of_a_second(calibrate([], parameters).estimate("M3"), parameters, 0.0, 0.0) == 0.05**2


def said(seconds, motion=EASTWARD, before=None, trajectory="straight", **changes):
    parameters = Parameters(gnss_aided_std=0.05, model="full", **changes)
    samples = make_samples(replace(RUN, trajectory=trajectory, seconds=seconds)) if seconds else []
    return outlook(calibrate(samples, parameters).estimate("full"), parameters, motion, before)


def test_after_one_leg_another_heading_or_a_turn_is_asked_for_with_the_time_it_takes():
    first = said(60.0, target_drift=10.0)
    assert first.next.code in ("NEXT_LEG", "NEXT_CIRCLE", "NEXT_EIGHT") and first.next.numbers.get("name") != "east"
    assert 0.0 < first.seconds < 1800.0
    assert said(60.0, target_drift=5.0).seconds > first.seconds


def test_what_is_good_enough_is_said_and_what_stands_or_has_learnt_nothing_is_to_go_on():
    assert said(300.0, trajectory="box", target_drift=1000.0).next.code == "NEXT_IS_GOOD"
    assert said(0.0).next.code == "NEXT_WAIT"
    assert said(60.0, EASTWARD._replace(speed=0.0)).next.code == "NEXT_WAIT"


def test_what_was_named_stays_while_nothing_is_clearly_better():
    first = said(60.0)
    side = {"port": "starboard", "starboard": "port"}.get(first.next.numbers.get("side", ""))
    if side is not None:
        other = next(r for r, _ in _manoeuvres(EASTWARD).values() if r.numbers.get("side") == side)
        assert said(60.0, before=other).next == other
    assert said(60.0, before=first.next).next == first.next


def test_without_a_heading_no_course_is_named():
    assert said(60.0, EASTWARD._replace(heading=None)).next.code != "NEXT_LEG"


def test_without_a_scale_it_is_said_that_it_stays_unknown():
    parameters = Parameters(target_drift=1000.0)
    estimate = calibrate(make_samples(replace(RUN, gnss_every=0)), parameters).estimate("unaided")
    assert math.isnan(predicted_drift(MODELS["unaided"], estimate.recording_covariance, parameters).ahead)
    assert outlook(estimate, parameters, EASTWARD).next.code == "NEXT_IS_GOOD_BUT_SCALE"
