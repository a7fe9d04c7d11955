"""References forward-right-down, in names that say so or do not, and recordings of two DVLs: taken as they are."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from stacks import DVL_STD, LEVER_ARM, ODOMETRY, TWIST, Sample, Told, motion

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NED, FLU_FROM_FRD
from dvl_calib_ros.calibration.numerics.samples import ReferenceSample, VelocityFrame
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.discovery.discovery import Given
from dvl_calib_ros.messages.decode import MessageDecoder, Refusal, frame_named
from dvl_calib_ros.messages.drivers import VELOCITY_TYPES
from dvl_calib_ros.recordings.recording import open_recording


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


@pytest.mark.spread(1)
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
    np.testing.assert_allclose(result.estimates["full"].lever_arm((0.0, 0.0, 0.0)), LEVER_ARM, atol=0.1)


PX4 = "px4_msgs/msg/VehicleOdometry"
PX4_DEFINITION = """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
uint64 timestamp_sample
uint8 POSE_FRAME_UNKNOWN = 0
uint8 POSE_FRAME_NED = 1
uint8 POSE_FRAME_FRD = 2
uint8 pose_frame
float32[3] position
float32[4] q
uint8 VELOCITY_FRAME_UNKNOWN = 0
uint8 VELOCITY_FRAME_NED = 1
uint8 VELOCITY_FRAME_FRD = 2
uint8 VELOCITY_FRAME_BODY_FRD = 3
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
float32[3] position_variance
float32[3] orientation_variance
float32[3] velocity_variance
uint8 reset_counter
int8 quality
"""


@pytest.mark.parametrize(("frame", "taken"), [(1, VelocityFrame.NED), (3, VelocityFrame.BODY)])
@pytest.mark.spread(1)
def test_a_px4_odometry_is_a_reference_in_the_frame_of_its_own_fields(tmp_path, frame, taken):
    told, m = Told(), motion()
    told.make.store.register(get_types_from_msg(PX4_DEFINITION, PX4))
    told.dvl("/dvl", TWIST, "dvl_link")
    for i, stamp in told.every(10.0, 0.04):
        velocity = FLU_FROM_FRD @ m.velocity_body[i]
        if frame == 1:
            velocity = ENU_FROM_NED.T @ m.rotation_enu_from_body[i] @ m.velocity_body[i]
        three = np.zeros(3, dtype=np.float32)
        message = told.types(
            PX4, 0, stamp // 1000, 1, three, np.zeros(4, dtype=np.float32), frame,
            (velocity + told.rng.normal(0.0, 0.02, 3)).astype(np.float32), three, three, three,
            np.full(3, 0.02**2, dtype=np.float32), 0, 100,
        )  # fmt: skip
        told.say(stamp, "/fmu/out/vehicle_odometry", PX4, message)
    told.imu("/imu", "base_link")
    bag = told.write(tmp_path / "bag")
    found = discover([bag], Parameters())
    assert found.topics.gnss == "/fmu/out/vehicle_odometry" and found.reference_frame is taken
    replayed = replay([bag], found.parameters, found.topics)
    assert replayed.result.counts["pairing"]["paired"] > 700
    np.testing.assert_allclose(replayed.result.estimates["full"].lever_arm((0.0, 0.0, 0.0)), LEVER_ARM, atol=0.1)


def test_a_px4_odometry_whose_stamp_is_beyond_64_bits_is_not_read(tmp_path):
    told, three = Told(), np.zeros(3, dtype=np.float32)
    told.make.store.register(get_types_from_msg(PX4_DEFINITION, PX4))
    for row, (_, stamp) in enumerate(told.every(10.0)):
        at_us = 2**63 if row == 7 else stamp // 1000
        message = told.types(
            PX4, 0, at_us, 1, three, np.zeros(4, dtype=np.float32), 1, three + 1.0, three, three, three, three, 0, 100
        )
        told.say(stamp, "/odometry", PX4, message)
    recording = open_recording([told.write(tmp_path / "bag")])
    recorded = recording.recorded("/odometry", Parameters())
    assert recorded.unreadable == 1 and len(recorded) == recording.counts["/odometry"] - 1 > 100


def test_a_px4_odometry_says_what_it_does_not_know_and_its_boot_time_is_no_stamp():
    message = SimpleNamespace(
        timestamp=81_000_000, timestamp_sample=80_000_000, velocity_frame=0, velocity=np.array([1.0, np.nan, 0.0]),
        angular_velocity=np.zeros(3), velocity_variance=np.full(3, np.nan),
    )  # fmt: skip
    kind = VELOCITY_TYPES[PX4]
    seen = kind.adapted(message)
    assert (seen.header.stamp.sec, seen.header.stamp.nanosec) == (0, 0) and kind.frame_id(seen) == ""
    decoder = MessageDecoder(Parameters(gnss_type=PX4))
    assert decoder.reference(seen, 1) == Refusal("wrong_frame")


def test_a_frame_below_a_namespace_or_with_a_suffix_says_what_it_is():
    names = {"world_ned": "ned", "map_enu": "enu", "base_link_frd": "frd", "ins_flu": "flu", "auv/base_link": "body"}
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
    (said,) = [note.sentence for note in discover([bag], Parameters()).notes if note.code == "SECOND_DVL"]
    assert "/starboard/dvl (starboard_dvl_link)" in said and "--dvl-topic /starboard/dvl" in said
    other = discover([bag], Parameters(), Given(dvl_topic="/starboard/dvl"))
    assert other.topics.dvl == "/starboard/dvl" and other.topics.gnss == "/gnss/vel"


ANTENNA = (-0.3, 0.0, 0.4)


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    ("frame", "position"), [("gps_link", LEVER_ARM), ("map", LEVER_ARM), ("base_link", LEVER_ARM), ("", None)]
)
def test_what_is_written_is_the_dvl_in_base_link_or_nothing(tmp_path, capsys, frame, position):
    """The lever arm is from the antenna; where that is nobody knows, the transform of the DVL stands, or nothing."""
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link")
    antenna = ANTENNA if frame in ("gps_link", "map") else (0.0, 0.0, 0.0)
    axes = "body" if frame == "base_link" else "enu"
    told.reference("/gps/vel", TWIST, frame or "map", axes, std=0.02, antenna=antenna)
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


def turned_over(told: Told) -> None:
    told.imu("/imu", "imu_link", FLU_FROM_FRD)


def inverted(told: Told) -> None:
    told.imu("/imu", "base_link")
    for message in told.said("/imu"):
        message.orientation.w *= -1.0


def w_first(told: Told) -> None:
    """Components as w, x, y, z: gravity turns with the heading, so its mean hardly leans."""
    told.imu("/imu", "base_link")
    for message in told.said("/imu"):
        q = message.orientation
        q.x, q.y, q.z, q.w = q.w, q.x, q.y, q.z


def down_labelled_up(told: Told) -> None:
    """Forward-right-down in NED, where the reference does not tell."""
    told.imu("/imu", "base_link", FLU_FROM_FRD, "ned")


def in_g(told: Told) -> None:
    told.imu("/imu", "base_link")
    for message in told.said("/imu"):
        message.linear_acceleration.z /= 9.81


def pulls(told: Told) -> None:
    """Gravity, and not what holds against it, as some simulators have it."""
    told.imu("/imu", "base_link")
    for message in told.said("/imu"):
        message.linear_acceleration.z *= -1.0


@pytest.mark.spread(2)
@pytest.mark.parametrize(
    ("tell", "code"),
    [
        (turned_over, "turned over"),
        (inverted, "GRAVITY_FITS_INVERTED"),
        (w_first, "GRAVITY_LEANS"),
        (down_labelled_up, "imu_frame ned"),
        (in_g, "GRAVITY_IN_G"),
        (pulls, "GRAVITY_SIGN"),
        (lambda told: told.imu("/imu", "base_link"), ""),
    ],
)
def test_gravity_turned_by_the_orientation_points_up_or_what_is_wrong_is_said(tmp_path, tell, code):
    told = Told()
    told.dvl("/dvl", TWIST, "dvl_link")
    tell(told)
    told.reference("/gps/vel", TWIST, "map", "enu", std=0.03)
    bag = told.write(tmp_path / "bag")
    found = discover([bag], Parameters())
    if code.isupper():
        assert code in {each.code for each in found.contradictions}
    else:
        assert code in " ".join(found.found) and not found.contradictions
