"""Without a reference a current tells the sign of the DVL's y; the sign of z is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from remedies import changes
from stacks import LEVER_ARM, TWIST, Told

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.streams.interpolation import ImuColumns
from dvl_calib_ros.discovery.axis_signs import sway_sign
from dvl_calib_ros.simulation.trajectories import make_motion

CURRENT_MPS = (0.2, 0.1, 0.0)
ASTERN = (0.0, 0.0, np.pi)


def recording(path, signs, current=CURRENT_MPS, mounting=(0.0, 0.0, 0.0), said=None, seed=3):
    """Write a DVL, with signs wrong, and an IMU of a vehicle that steers random courses through a current."""
    m = make_motion("free", 600.0, 100.0, np.random.default_rng(seed))
    drift = np.einsum("nji,j->ni", m.rotation_enu_from_body, np.array(current))
    told = Told(motion=replace(m, velocity_body=m.velocity_body + drift))
    told.dvl("/dvl/velocity", TWIST, "dvl_link", mounting)
    for _, _, _, message in told.rows:
        v = message.twist.twist.linear
        v.x, v.y, v.z = np.array([v.x, v.y, v.z]) * signs
    told.imu("/imu/data", "base_link")
    told.tf_static(told.transform("base_link", "dvl_link", said or mounting, LEVER_ARM))
    return told.write(path)


def codes(reasons):
    return [each.code for each in reasons]


def reasons_of(calibration):
    return calibration.replayed.result.verifications[calibration.model].reasons


@pytest.mark.spread(1)
@pytest.mark.parametrize(("signs", "mounting"), [((1.0, -1.0, 1.0), ASTERN), ((1.0, -1.0, -1.0), (0.0, 0.0, 0.0))])
def test_a_sway_that_a_current_contradicts_is_rejected_and_its_remedy_works(tmp_path, signs, mounting):
    wrong = recording(tmp_path / "wrong", signs, mounting=mounting)
    examined, calibration = dc.doctor(wrong), dc.replay(wrong, history=False)
    assert examined.verdict == "no" and calibration.verdict == "reject"
    assert codes(examined.reasons)[0] == codes(reasons_of(calibration))[0] == "DVL_SIDE_INVERTED"
    assert "set dvl_axes to frd" in reasons_of(calibration)[0].sentence
    if signs[2] < 0.0:
        typed = changes(
            reasons_of(calibration)[0].remedy, Parameters.from_mapping(calibration.replayed.result.parameters)
        )
        mended = dc.replay(wrong, history=False, **typed)
    else:
        mended = dc.replay(recording(tmp_path / "mended", (1.0, 1.0, 1.0), mounting=mounting), history=False)
    assert mended.verdict != "reject" and "DVL_SIDE_INVERTED" not in codes(reasons_of(mended))


def test_a_current_confirms_the_sign_of_y_and_that_of_z_is_asked(tmp_path):
    examined = dc.doctor(recording(tmp_path / "bag", (1.0, 1.0, 1.0)))
    (question,) = [each for each in examined.reasons if each.code.startswith("DVL_SI")]
    assert question.code == "DVL_SIGN_OPEN" and question.numbers["axis"] == "z"
    assert float(question.numbers["effect"].removeprefix("the pitch changes by ")[:-1]) == pytest.approx(2.0, abs=0.3)
    assert "positive when the vehicle moves up?" in question.sentence


def test_a_vehicle_that_only_goes_astern_is_a_mounting_turned_round_unless_it_is_confirmed(tmp_path):
    bag = recording(tmp_path / "bag", (-1.0, -1.0, 1.0))
    calibration = dc.replay(bag, history=False)
    assert calibration.verdict == "reject" and dc.doctor(bag).verdict == "no"
    first, *_ = reasons_of(calibration)
    assert first.code == "TRAVELS_ASTERN" and "try -p mounting_rpy:=[0deg,0deg,-180deg]" in first.sentence
    for yaw in (np.pi, 0.0):
        confirmed = dc.replay(bag, history=False, mounting_rpy=(0.0, 0.0, yaw))
        assert confirmed.verdict != "reject" and "TRAVELS_ASTERN" not in codes(reasons_of(confirmed))


def test_without_a_current_both_signs_are_asked_and_the_answer_is_marginal(tmp_path):
    bag = recording(tmp_path / "bag", (1.0, 1.0, -1.0), current=(0.0, 0.0, 0.0))
    calibration = dc.replay(bag, history=False)
    assert calibration.verdict == "marginal"
    assert codes(reasons_of(calibration)).count("DVL_SIGN_OPEN") == 2
    assert not any(each.code == "DOCTOR_FRAMES" for each in dc.doctor(bag).findings)
    question = next(each for each in reasons_of(calibration) if each.code == "DVL_SIGN_OPEN")
    answer = changes(question.remedy, Parameters.from_mapping(calibration.replayed.result.parameters))
    assert answer == {"dvl_axes": "flu"}
    assert "DVL_SIGN_OPEN" not in codes(reasons_of(dc.replay(bag, history=False, **answer)))


@pytest.mark.slow
def test_a_mirrored_y_with_the_yaw_of_the_other_sign_is_asked(tmp_path):
    """It was asked for z only; the sign of y and the yaw are wrong at once."""
    said, signs = (0.0, 0.0, -np.pi / 4.0), (1.0, -1.0, 1.0)
    bag = recording(tmp_path / "bag", signs, current=(0.0, 0.0, 0.0), mounting=(0.0, 0.0, np.pi / 4.0), said=said)
    reasons = reasons_of(dc.replay(bag, history=False))
    (question,) = [each for each in reasons if each.code == "DVL_SIGN_OPEN" and each.numbers["axis"] == "y"]
    assert "mounting_rpy [0deg,0deg,45deg] fits" in question.sentence
    assert "positive when the vehicle moves to port?" in question.sentence
    with_current = recording(tmp_path / "current", signs, mounting=(0.0, 0.0, np.pi / 4.0), said=said)
    assert codes(reasons_of(dc.replay(with_current, history=False)))[0] == "DVL_SIDE_INVERTED"


@pytest.mark.filterwarnings("error")
def test_without_an_attitude_at_any_velocity_nothing_is_said_of_the_sway():
    later = ImuColumns(np.arange(100, 110) * 1.0, np.tile([0.0, 0.0, 0.0, 1.0], (10, 1)), np.zeros((10, 3)))
    assert sway_sign(np.arange(10.0), np.ones((10, 3)), later) is None
