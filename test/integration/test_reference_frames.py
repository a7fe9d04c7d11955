"""References forward-right-down, in names that say so or do not, and recordings of two DVLs: taken as they are."""

from __future__ import annotations

import re

import numpy as np
import pytest
from stacks import DVL_STD, LEVER_ARM, ODOMETRY, TWIST, Sample, Told, motion

from dvl_calib_ros.calibration.frames import FLU_FROM_FRD
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import ReferenceSample, VelocityFrame
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.discovery.discover import Given, discover
from dvl_calib_ros.messages.decode import MessageDecoder, frame_named
from dvl_calib_ros.replay.replay import replay


def odometry_down(told: Told, frame: str, child: str, rates: bool) -> None:
    """Odometry of a body forward-right-down, as PX4, Stonefish and survey INS publish it."""
    m = motion()
    for i, stamp in told.every(20.0):
        velocity = FLU_FROM_FRD @ (m.velocity_body[i] + told.rng.normal(0.0, 0.005, 3))
        message = told.make.velocity(ODOMETRY, Sample(stamp, velocity, 0.005**2 * np.eye(3)), child)
        message.header.frame_id = frame
        if rates:
            message.twist.twist.angular = told.make.vector(FLU_FROM_FRD @ m.angular_velocity[i])
        told.say(stamp, "/ins/odometry", ODOMETRY, message)


@pytest.mark.parametrize(
    ("frame", "child", "rates"),
    [
        ("odom", "base_link_frd", False),  # the child's name says so
        ("world_ned", "girona/odometry", False),  # the pose's frame does
        ("world", "girona/odometry", True),  # it turns the other way than the IMU
    ],
)
def test_an_odometry_forward_right_down_gives_the_lever_arm_with_its_sign(tmp_path, frame, child, rates):
    told = Told()
    told.dvl("/dvl", TWIST, "sensor/dvl", frd=True)
    odometry_down(told, frame, child, rates)
    told.imu("/imu", "imu_frd", FLU_FROM_FRD, "ned")
    bag = told.write(tmp_path / "bag")
    found = discover([bag], Parameters())
    assert found.parameters.gnss_frame == "frd" or child.endswith("_frd")
    result = replay([bag], found.parameters, found.topics).result
    np.testing.assert_allclose(result.estimates["G2"].lever_arm((0.0, 0.0, 0.0)), LEVER_ARM, atol=0.1)


def test_a_frame_below_a_namespace_or_with_a_suffix_says_what_it_is():
    names = {"world_ned": "ned", "map_enu": "enu", "base_link_frd": "frd", "ins_flu": "body", "auv/base_link": "body"}
    assert {name: frame_named(name, ["base_link"]).name for name in names} == names
    assert frame_named("gps", ["base_link"]) is frame_named("frd", ["base_link"]) is None


@pytest.mark.parametrize("by_parameter", [True, False])
def test_a_reference_forward_right_down_is_the_bodys_forward_left_up_with_its_covariance(by_parameter):
    covariance = np.array([[4.0, 1.0, 2.0], [1.0, 5.0, 3.0], [2.0, 3.0, 6.0]])
    message = Told().make.velocity(TWIST, Sample(1, np.array([1.0, 2.0, 3.0]), covariance), "base_link_frd")
    decoder = MessageDecoder(Parameters(gnss_frame="frd") if by_parameter else Parameters())
    decoded = decoder.reference(message, 0)
    assert isinstance(decoded, ReferenceSample) and decoded.frame is VelocityFrame.BODY
    assert decoded.velocity == (1.0, -2.0, -3.0)
    np.testing.assert_array_equal(decoded.covariance, FLU_FROM_FRD @ covariance @ FLU_FROM_FRD)


def test_gnss_frame_frd_is_an_option_and_stands_against_what_the_name_says(tmp_path):
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_flu")
    odometry_down(told, "odom", "base_link", False)
    told.imu("/imu", "base_link")
    given = Given(parameters=frozenset({"gnss_frame"}))
    found = discover([told.write(tmp_path / "bag")], Parameters(gnss_frame="frd"), given)
    assert found.parameters.gnss_frame == "frd" and found.reference_frame is VelocityFrame.BODY
    assert not found.contradictions


def test_two_dvls_are_two_and_each_is_calibrated_by_itself(tmp_path):
    told = Told()
    told.dvl("/port/dvl", TWIST, "port_dvl_link")
    told.dvl("/starboard/dvl", TWIST, "starboard_dvl_link")
    m = motion()
    for i, stamp in told.every(5.0):  # what a driver makes of the first is no second one
        copy = m.velocity_body[i] + DVL_STD * np.array([np.sin(i), np.cos(i), 0.0])
        told.say(
            stamp, "/port/dvl/odom", ODOMETRY, told.make.velocity(ODOMETRY, Sample(stamp, copy, None), "port_dvl_link")
        )
    told.reference("/gnss/vel", TWIST, "map", "enu")
    told.imu("/imu", "base_link")
    bag = told.write(tmp_path / "bag")
    (said,) = [note for note in discover([bag], Parameters()).notes if note.startswith("two DVLs")]
    assert "/starboard/dvl (starboard_dvl_link)" in said and "--dvl-topic /starboard/dvl" in said
    other = discover([bag], Parameters(), Given(dvl_topic="/starboard/dvl"))
    assert other.topics.dvl == "/starboard/dvl" and other.topics.gnss == "/gnss/vel"


ANTENNA = (-0.3, 0.0, 0.4)


@pytest.mark.parametrize(
    ("frame", "position"), [("gps_link", LEVER_ARM), ("map", LEVER_ARM), ("base_link", LEVER_ARM), ("", None)]
)
def test_what_is_written_is_the_dvl_in_base_link_or_nothing(tmp_path, capsys, frame, position):
    """The lever arm is from the antenna; where that is nobody knows, the transform of the DVL stands, or nothing."""
    told, m = Told(), motion()
    told.dvl("/dvl", TWIST, "dvl_link")
    antenna = np.array(ANTENNA if frame in ("gps_link", "map") else (0.0, 0.0, 0.0))
    for i, stamp in told.every(5.0, 0.04):
        velocity = m.velocity_body[i] + np.cross(m.angular_velocity[i], antenna) + told.rng.normal(0.0, 0.02, 3)
        if frame != "base_link":
            velocity = m.rotation_enu_from_body[i] @ velocity
        sample = Sample(stamp, velocity, 4e-4 * np.eye(3))
        told.say(stamp, "/gps/vel", TWIST, told.make.velocity(TWIST, sample, frame or "map"))
    told.imu("/imu", "base_link")
    if frame:
        antennas = [told.transform("base_link", "gps_link", (0.0, 0.0, 0.0), ANTENNA)] if frame == "gps_link" else []
        told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM), *antennas)
    bag, saved, launch = told.write(tmp_path / "bag"), tmp_path / "saved.yaml", tmp_path / "dvl.launch.xml"
    assert main(["replay", str(bag), "--save", str(saved)]) == 0
    written = re.search(r"URDF  <origin (?:xyz=\"([^\"]*)\" )?rpy", capsys.readouterr().out)[1]
    if position is None:
        assert written is None
        assert main(["apply", str(saved), "--launch", str(launch)]) == 2
        assert "reference_position" in capsys.readouterr().err and not launch.exists()
        return
    np.testing.assert_allclose([float(word) for word in written.split()], position, atol=0.05)
    assert main(["apply", str(saved), "--launch", str(launch)]) == 0
    at = [float(re.search(rf"--{axis} (\S+)", launch.read_text())[1]) for axis in "xyz"]
    np.testing.assert_allclose(at, position, atol=0.05)
