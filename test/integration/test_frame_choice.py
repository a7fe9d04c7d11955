"""Recordings whose axes are other than they say, or of which two readings fit: what is taken, and what is said."""

from __future__ import annotations

import numpy as np
import pytest
from remedies import changes
from scipy.spatial.transform import Rotation
from situations import DVL, five_minutes, sound
from stacks import LEVER_ARM, ODOMETRY, TWIST, Sample, Told, motion, positions, true_mounting

from dvl_calib_ros import doctor, replay
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NWU, FLU_FROM_FRD, rpy_from_rotation
from dvl_calib_ros.calibration.registration.frame_hypotheses import NOT_REGISTERED, Readings
from dvl_calib_ros.discovery.discover import discover

ODOMETRY_FRAMES = {"as its child frame says": np.eye(3), "forward-right-down": FLU_FROM_FRD}


def truth_deg(mounting_rpy=(0.0, 0.0, 0.0)):
    """Roll, pitch, yaw (degrees) of the DVL in a forward-left-up body."""
    return np.degrees(rpy_from_rotation(true_mounting(mounting_rpy)))


def found_deg(calibration):
    parameters = Parameters.from_mapping(calibration.replayed.result.parameters)
    estimate = calibration.replayed.result.estimate
    return np.degrees(rpy_from_rotation(estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)))


def is_right(calibration, truth, atol=(2.0, 0.5, 0.5)):
    """Whether roll, pitch, yaw (degrees) are; 150 s hardly show the roll."""
    return bool((np.abs(found_deg(calibration) - truth) < atol).all())


def codes(reasons):
    return [reason.code for reason in reasons]


def vehicle(z_down: bool, position=LEVER_ARM, dvl_rpy=(0.0, 0.0, 0.0), axes="enu", std=0.05) -> Told:
    """A vehicle of which all is z up, or all z down: base_link, DVL, IMU and reference."""
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link", frd=z_down)
    told.imu("/imu", "base_link", FLU_FROM_FRD if z_down else None, "ned" if z_down else "enu")
    told.reference("/gps/velocity", TWIST, "ned" if z_down else "map", "ned" if z_down else axes, std=std)
    place = FLU_FROM_FRD @ np.array(position) if z_down else position
    told.tf_static(told.transform("base_link", "dvl_link", dvl_rpy, place))
    return told


def odometry(told: Told, axes, pose: bool) -> None:
    """An INS whose pose is that of a forward-left-up base_link in ENU, with its twist turned by axes (3, 3)."""
    m = motion()
    quaternions, places = Rotation.from_matrix(m.rotation_enu_from_body).as_quat(), positions()
    for i, stamp in told.every(10.0, 0.02):
        velocity = axes @ (m.velocity_body[i] + told.rng.normal(0.0, 0.01, 3))
        message = told.make.velocity(ODOMETRY, Sample(stamp, velocity, 1e-4 * np.eye(3)), "base_link")
        message.header.frame_id = "odom"
        if pose:
            p, q = message.pose.pose.position, message.pose.pose.orientation
            (p.x, p.y, p.z), (q.x, q.y, q.z, q.w) = places[i].tolist(), quaternions[i].tolist()
        told.say(stamp, "/ins/odometry", ODOMETRY, message)


@pytest.mark.spread(1)
def test_a_vehicle_that_is_z_down_gets_its_mounting_in_its_own_axes(tmp_path, capsys):
    up, down = (replay(vehicle(z_down, std=0.002).write(tmp_path / str(z_down))) for z_down in (False, True))
    assert up.replayed.result.parameters["base_axes"] == "flu" and down.replayed.result.parameters["base_axes"] == "frd"
    assert is_right(up, truth_deg())
    np.testing.assert_allclose(found_deg(down), found_deg(up) * [1.0, -1.0, -1.0], atol=0.15)
    arms = [each.replayed.result.parameters["lever_arm"] for each in (up, down)]
    np.testing.assert_allclose(arms[1], FLU_FROM_FRD @ arms[0])
    assert "base_axes frd" in " ".join(down.discovery.found)
    assert "lever arm, to starboard" in str(down) or "to port" not in str(down)


@pytest.mark.spread(1)
@pytest.mark.parametrize("twist", ODOMETRY_FRAMES)
def test_a_twist_is_in_the_axes_in_which_it_moves_its_own_pose(tmp_path, twist):
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link")
    told.imu("/imu", "base_link")
    odometry(told, ODOMETRY_FRAMES[twist], pose=True)
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))
    calibration = replay(told.write(tmp_path / "bag"))
    assert is_right(calibration, truth_deg())
    said = "REFERENCE_FRAME_OTHER" in codes(calibration.discovery.contradictions)
    assert said == (twist != "as its child frame says")


def z_down_with_a_twist_forward_left_up(folder, lever_arm, pose):
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link", frd=True)
    told.imu("/imu", "base_link", FLU_FROM_FRD, "ned")
    odometry(told, np.eye(3), pose=pose)
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), lever_arm))
    return told.write(folder / "bag")


@pytest.mark.spread(1)
def test_a_forward_left_up_twist_of_a_vehicle_that_is_z_down_is_turned(tmp_path):
    """It was no hypothesis: accepted with pitch and yaw of the opposite signs."""
    arm = FLU_FROM_FRD @ np.array(LEVER_ARM)
    calibration = replay(z_down_with_a_twist_forward_left_up(tmp_path, arm, pose=True))
    parameters = calibration.replayed.result.parameters
    assert parameters["base_axes"] == "frd" and parameters["gnss_frame"] == "flu"
    assert is_right(calibration, truth_deg() * [1.0, -1.0, -1.0])


@pytest.mark.spread(1)
def test_a_twist_without_a_pose_leaves_open_whether_the_vehicle_is_z_down(tmp_path):
    """It was accepted with pitch and yaw of the opposite signs."""
    bag = z_down_with_a_twist_forward_left_up(tmp_path, (0.0, 0.0, 0.0), pose=False)
    found = replay(bag)
    assert found.verdict == "marginal" and doctor(bag).verdict == "partly"
    (open_,) = [each for each in found.discovery.contradictions if each.code == "FRAMES_AMBIGUOUS"]
    typed = changes(open_.remedy, Parameters.from_mapping(found.replayed.result.parameters))
    assert typed == {"base_axes": "flu"} and open_.numbers["first"] == "frd"
    told_axes = replay(bag, base_axes="frd")
    assert told_axes.verdict == "accept" and is_right(told_axes, truth_deg() * [1.0, -1.0, -1.0])


@pytest.mark.spread(1)
def test_two_readings_that_fit_as_well_are_both_said_and_the_answer_is_marginal(tmp_path):
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link", frd=True)
    told.imu("/imu", "base_link")
    odometry(told, np.eye(3), pose=False)
    bag = told.write(tmp_path / "bag")
    as_found = replay(bag)
    assert as_found.verdict == "marginal" and doctor(bag).verdict == "partly"
    assert "dvl_axes frd and dvl_axes flu equally well" in as_found.reasons[0]
    assert "is the DVL forward-left-up? If so, set dvl_axes to flu; if not, set it to frd" in as_found.reasons[0]
    told_axes = replay(bag, dvl_axes="frd", gnss_frame="body")
    assert "FRAMES_AMBIGUOUS" not in codes(told_axes.discovery.contradictions)
    assert is_right(told_axes, truth_deg())


@pytest.mark.spread(1)
def test_a_reference_in_north_west_up_is_turned_not_the_dvl(tmp_path):
    told, m = Told(), motion()
    told.dvl("/dvl", TWIST, "dvl_link")
    told.imu("/imu", "base_link")
    for i, stamp in told.every(5.0, 0.04):
        velocity = ENU_FROM_NWU.T @ (m.rotation_enu_from_body[i] @ m.velocity_body[i] + told.rng.normal(0.0, 0.03, 3))
        message = told.make.velocity(TWIST, Sample(stamp, velocity, 9e-4 * np.eye(3)), "world")
        told.say(stamp, "/gps/vel", TWIST, message)
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))
    bag = told.write(tmp_path / "bag")
    found = discover([bag], Parameters())
    assert found.parameters.gnss_frame == "nwu" and codes(found.contradictions) == ["REFERENCE_FRAME_OTHER"]
    assert is_right(replay(bag), truth_deg())


@pytest.mark.slow
def test_two_negated_axes_are_a_mounting_or_the_drivers(tmp_path):
    """Of a vehicle that heaves."""
    told = Told(motion=five_minutes())
    sound(told)
    for message in told.said(DVL):
        v = message.twist.twist.linear
        v.x, v.z = -v.x, -v.z
    assert "negate x and z in the DVL's driver" in doctor(told.write(tmp_path / "bag")).reasons[0].sentence


def test_a_reading_that_cannot_be_registered_is_judged_by_its_agreement(tmp_path, monkeypatch):
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link")
    told.imu("/imu", "base_link")
    told.reference("/gps/velocity", TWIST, "map", "enu", std=0.2)
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))
    bag, registered = told.write(tmp_path / "bag"), Readings.registered

    def fails_as_declared(self, reading, rotation):
        return registered(self, reading, rotation) if reading.turned else NOT_REGISTERED

    monkeypatch.setattr(Readings, "registered", fails_as_declared)
    found = discover([bag], Parameters())
    assert "dvl_axes" not in found.values and not found.contradictions
