"""What is written is what rosbags writes of the same, byte for byte, though not by it."""

from __future__ import annotations

import numpy as np
import pytest
from io_fixtures import JAZZY, raw, storage_file
from rosbags.rosbag2 import Writer

from dvl_calib_ros.bags import writer as writing
from dvl_calib_ros.bags.writer import BagWriter, Compression
from dvl_calib_ros.calibration.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.messages.drivers import IMU_TYPE, TWIST_TYPE
from dvl_calib_ros.messages.encode import SampleWriter

NO_RATE = ImuSample(1_700_000_000_123_456_789, (0.0, 0.0, 0.6, 0.8), None)
NO_ATTITUDE = ImuSample(5_999_999_999, None, (0.1, -0.2, 0.3))


@pytest.mark.parametrize("frame_id", ["", "a", "map", "gnss", "base_link", "unterwassergefährt_1/dvl"])
def test_a_message_is_serialised_as_by_rosbags(frame_id, tmp_path):
    velocity, covariance = (1.5, -0.25, 0.125), np.arange(9.0).reshape(3, 3)
    with BagWriter(tmp_path / "bag") as bag:
        writer = SampleWriter(bag)
        writer.dvl("dvl", DvlSample(NO_RATE.stamp_ns, velocity, covariance), frame_id)
        writer.reference("gnss", ReferenceSample(7, velocity, None, VelocityFrame.ENU), frame_id)
        writer.imu("no_rate", NO_RATE, frame_id)
        writer.imu("no_attitude", NO_ATTITUDE, frame_id)
    found = {}
    for topic, log_ns, data in raw(tmp_path / "bag"):
        msgtype = TWIST_TYPE if topic in ("dvl", "gnss") else IMU_TYPE
        found[topic] = message = JAZZY.deserialize_cdr(data, msgtype)
        assert bytes(JAZZY.serialize_cdr(message, msgtype)) == data
        assert message.header.frame_id == frame_id
        assert message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec == log_ns
    for topic, claimed in (("dvl", covariance), ("gnss", np.zeros((3, 3)))):
        linear, angular = found[topic].twist.twist.linear, found[topic].twist.twist.angular
        assert (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z) == (*velocity, 0.0, 0.0, 0.0)
        whole = np.zeros((6, 6))
        whole[:3, :3] = claimed
        np.testing.assert_array_equal(found[topic].twist.covariance.reshape(6, 6), whole)
    for topic, sample in (("no_rate", NO_RATE), ("no_attitude", NO_ATTITUDE)):
        q, rate = found[topic].orientation, found[topic].angular_velocity
        assert (q.x, q.y, q.z, q.w) == (sample.orientation or (0.0, 0.0, 0.0, 1.0))
        assert (rate.x, rate.y, rate.z) == (sample.angular_velocity or (0.0, 0.0, 0.0))
        assert found[topic].orientation_covariance[0] == (0.0 if sample.orientation else -1.0)
        assert found[topic].angular_velocity_covariance[0] == (0.0 if sample.angular_velocity else -1.0)
        assert found[topic].linear_acceleration_covariance[0] == -1.0


@pytest.mark.parametrize("compression", [Compression.NONE, Compression.CHUNK, Compression.MESSAGE])
def test_a_file_of_several_chunks_is_that_of_rosbags(compression, tmp_path, monkeypatch):
    def written(name: str) -> bytes:
        (tmp_path / name).mkdir()
        with BagWriter(tmp_path / name / "bag", compression=compression) as bag:
            for number in range(3000):
                topic = "dvl" if number % 3 else "gnss"
                late = number % 7  # log times are not in order
                bag.serialised(topic, TWIST_TYPE, 10**15 + 1000 * (number - 9 * late), bytes([number % 251]) * 700)
        metadata = (tmp_path / name / "bag" / "metadata.yaml").read_bytes()
        return storage_file(tmp_path / name / "bag").read_bytes() + metadata

    ours = written("ours")
    monkeypatch.setattr(writing._Writer, "STORAGE_PLUGINS", Writer.STORAGE_PLUGINS)
    assert ours == written("theirs")
