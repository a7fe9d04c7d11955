"""Poses of a motion capture give attitude and turn rates where no IMU does."""

from __future__ import annotations

import numpy as np
import pytest
from io_fixtures import run, write_bag

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import Stream
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.messages.drivers import IMU_TYPE, POSE_TYPES, TWIST_TYPE
from dvl_calib_ros.recordings.recording import open_recording

POSES = "/mocap/rov/pose"


def write_poses(path, kind: str, imu: str = "none", *, turns: bool = True):
    """A bag of DVL and poses of a vehicle that is turned as an IMU was. imu: none, raw (no orientation), whole."""
    with BagReader([write_bag(path / "source", run(60.0))]) as bag:
        messages = [(topic, log_ns, message) for topic, log_ns, message, _ in bag.messages(["dvl/twist", "imu/data"])]
    with BagWriter(path / "bag") as bag:
        types = bag.typestore.types
        for topic, log_ns, message in messages:
            if topic == "dvl/twist":
                bag.message(topic, TWIST_TYPE, log_ns, message)
                continue
            q = message.orientation
            still = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            point = types["geometry_msgs/msg/Point"](1e-9 * (log_ns - messages[0][1]), 0.0, 0.0)
            pose = types["geometry_msgs/msg/Pose"](point, q if turns else still)
            if kind.endswith("PoseWithCovarianceStamped"):
                pose = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
            header = types["std_msgs/msg/Header"](message.header.stamp, "mocap")
            bag.message(POSES, kind, log_ns, types[kind](header, pose))
            if imu == "raw":
                message.orientation_covariance = np.array([-1.0, *[0.0] * 8])
            if imu != "none":
                bag.message("imu/data", IMU_TYPE, log_ns, message)
    rates = [m.angular_velocity for topic, _, m in messages if topic == "imu/data"]
    return path / "bag", np.array([(w.x, w.y, w.z) for w in rates])


@pytest.mark.parametrize(("kind", "imu"), [*zip(POSE_TYPES, ("none", "raw"), strict=True)])
def test_without_an_orientation_of_an_imu_that_of_the_poses_is_taken(tmp_path, kind, imu):
    bag, expected = write_poses(tmp_path, kind, imu)
    recording = open_recording([bag])
    found = discover(recording, Parameters())
    assert found.topics.imu == f"{POSES}/orientation" and recording.counts[found.topics.imu] == len(expected)
    assert any(f"no IMU gives an attitude; it is the orientation of {POSES}," in each for each in found.found)
    [stretch] = recording.stretches({found.topics.imu: Stream.IMU}, MessageDecoder(Parameters()))
    np.testing.assert_allclose(np.linalg.norm(stretch.streams.imu.values[:, :4], axis=1), 1.0, atol=1e-9)
    off = stretch.streams.imu.values[:, 4:] - expected
    assert np.sqrt(np.mean(off**2)) < 0.2 * np.sqrt(np.mean(expected**2))


@pytest.mark.parametrize(("imu", "turns"), [("whole", True), ("none", False)])
def test_an_imu_goes_first_and_an_orientation_that_was_filled_in_is_none(tmp_path, imu, turns):
    bag, _ = write_poses(tmp_path, POSE_TYPES[1], imu, turns=turns)
    assert f"{POSES}/orientation" not in open_recording([bag]).types
