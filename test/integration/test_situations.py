"""Situations that users have reported: a right answer, or a rejection that names the cause and whose remedy works."""

from __future__ import annotations

import math

import numpy as np
import pytest
import stacks
from remedies import changes
from scipy.spatial.transform import Rotation
from situations import DVL, SITUATIONS, ask_once, contradicts, long_motion, sound
from stacks import ODOMETRY, TWIST, Told, true_mounting

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.filters.observability import body_angle_std
from dvl_calib_ros.calibration.models.parameters import Parameters

# An answer is wrong if it is off by more than three of its σ and by this, degrees.
RIGHT_DEG = 0.5
# The prior of a mounting is 2.9 degrees: with more than this the data said nothing of the yaw.
YAW_STD_DEG = 2.5
UNDER_2_S = (
    "wrong transform without reference", "text of a DVL", "negated axis at 45 degrees without reference",
    "swapped axes without reference", "earth axes without reference", "large misalignment", "wrong transform",
)  # fmt: skip


SLOW = set(SITUATIONS).difference(UNDER_2_S)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in SITUATIONS])
def test_a_situation_is_answered_right_or_rejected_with_its_cause_and_a_remedy_that_works(name, tmp_path, monkeypatch):
    situation = SITUATIONS[name]
    bag = situation.write(tmp_path / "bag", True)
    ask_once(monkeypatch)
    calibration = dc.replay(bag, history=False)
    assert not contradicts(dc.doctor(bag).verdict, calibration.verdict)
    if situation.cause:
        assert calibration.verdict == "reject"
        first, *_ = calibration.replayed.result.verifications[calibration.model].reasons
        cause = first.causes[0] if first.causes else first
        assert cause.code == situation.cause and situation.remedy in cause.sentence
        typed = {}
        if "-p " in situation.remedy or "--" in situation.remedy:
            said = cause.sentence[cause.sentence.index(situation.remedy) :]
            typed = changes(said, Parameters.from_mapping(calibration.replayed.result.parameters))
        else:
            bag = situation.write(tmp_path / "mended", False)
        ask_once(monkeypatch)  # anew: of another recording
        calibration = dc.replay(bag, history=False, **typed)
    assert calibration.verdict in situation.verdicts, calibration.reasons
    errors_deg, std_deg = errors_of(calibration, situation.yaw_deg)
    assert (errors_deg < np.maximum(3.0 * std_deg, RIGHT_DEG)).all(), (errors_deg, std_deg)
    assert std_deg[2] < YAW_STD_DEG


@pytest.mark.slow
def test_doctor_replay_and_diagnose_begin_with_one_cause(tmp_path):
    """`diagnose` said no_gap, as it fits a mounting of any size."""
    told = Told()
    sound(told, yaw=math.radians(-135.0), said_yaw=math.radians(135.0))
    bag = told.write(tmp_path / "bag")
    calibration = dc.replay(bag, history=False)
    first, *_ = calibration.replayed.result.verifications[calibration.model].reasons
    assert first.code == "MOUNTING_CONTRADICTED" and dc.doctor(bag).reasons[0] == first
    diagnosis = dc.diagnose(bag)
    assert diagnosis.verdict.value == "no_gap" and diagnosis.reasons[0].code == "CALIBRATION_REJECTS"
    assert diagnosis.reasons[0].causes == (first,)
    assert diagnosis.sentence.startswith("The calibration rejects this recording: DVL and reference do not agree")


def test_a_reference_that_is_to_be_ignored_is_not_missed(tmp_path):
    told = Told()
    sound(told)
    calibration = dc.replay(told.write(tmp_path / "bag"), history=False, gnss_topic="none")
    assert "BAG_NO_GNSS" not in {each.code for each in calibration.findings}


@pytest.mark.spread(1)
@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.3, 0.0, -0.5), (1.0, 0.0, 0.0)])
def test_without_turn_rates_sigma_includes_what_a_lever_arm_makes(tmp_path, monkeypatch, arm):
    """Of an INS's body velocity alone roll was 7.2° ± 1.6 for 0.7, and yaw 3.9° ± 0.3 for 1.5."""
    monkeypatch.setattr(stacks, "LEVER_ARM", arm)
    told = Told(motion=long_motion())
    told.dvl(DVL, TWIST, "dvl_link")
    told.reference("/ins/odometry", ODOMETRY, "base_link", "body", std=0.02)
    calibration = dc.replay(told.write(tmp_path / "bag"), history=False)
    errors_deg, std_deg = errors_of(calibration, 0.0)
    assert (errors_deg < 3.0 * std_deg).all(), (errors_deg, std_deg)
    roll, pitch, *_ = calibration.replayed.result.estimate.observability
    assert "turn rate" in roll.missing and pitch.observed
    assert (calibration.verdict == "accept") == (not any(arm)), calibration.reasons


def errors_of(calibration, yaw_deg):
    """Errors of roll, pitch, yaw about the body's axes and their σ, degrees."""
    result = calibration.replayed.result
    parameters = Parameters.from_mapping(result.parameters)
    found = result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    truth = true_mounting((0.0, 0.0, math.radians(yaw_deg)))
    error = Rotation.from_matrix(found @ truth.T).as_rotvec()
    return np.abs(np.degrees(error)), np.degrees(body_angle_std(result.estimate.covariance, parameters))
