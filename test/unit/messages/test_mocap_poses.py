"""Poses of a motion capture are a reference's positions, with or without covariance, whatever their orientation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dvl_calib_ros
from dvl_calib_ros.bags.writer import BagWriter, Compression, Storage
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample
from dvl_calib_ros.messages.drivers import POSE_TYPES
from dvl_calib_ros.messages.encode import SampleWriter

MOUNTED_DEG, SECONDS, STEP_S, START_NS = (0.0, 1.0, 3.0), 240.0, 0.02, 1_700_000_000_000_000_000
DVL_EVERY, POSE_NOISE_M, DVL_NOISE_MPS = 6, 0.001, 0.006


def write_tank(path: Path, kind: str, topic: str, frame_id: str = "mocap") -> Path:
    """A slow vehicle that turns and goes in all directions, seen by cameras at 50 Hz."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, SECONDS, STEP_S)
    rates = np.column_stack([0 * t, 0 * t, 0.15 * np.sin(t / 9.0)])
    attitude = Rotation.from_euler("z", np.cumsum(rates[:, 2:], axis=0) * STEP_S)
    body = np.column_stack([0.3 * np.cos(t / 8.0), 0.3 * np.sin(t / 8.0), 0.08 * np.sin(t / 4.0)])
    position = np.cumsum(attitude.apply(body), axis=0) * STEP_S + rng.normal(0.0, POSE_NOISE_M, body.shape)
    mounted = Rotation.from_euler("ZYX", MOUNTED_DEG[::-1], degrees=True)
    measured = mounted.inv().apply(body) + rng.normal(0.0, DVL_NOISE_MPS, body.shape)
    quaternions = attitude.as_quat()
    with BagWriter(path, Storage.MCAP, Compression.NONE) as bag:
        writer, types = SampleWriter(bag), bag.typestore.types
        for row, stamp_ns in enumerate((START_NS + t * 1e9).astype(np.int64).tolist()):
            writer.imu("imu/data", ImuSample(stamp_ns, tuple(quaternions[row]), tuple(rates[row])))
            if row % DVL_EVERY == 0:
                noise = np.eye(3) * DVL_NOISE_MPS**2
                writer.dvl("dvl/twist", DvlSample(stamp_ns, tuple(measured[row]), noise))
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](*position[row]),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.6, 0.0, 0.8),
            )
            if kind == POSE_TYPES[0]:
                pose = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
            bag.message(topic, kind, stamp_ns, types[kind](writer._header(stamp_ns, frame_id), pose))
    return path


@pytest.mark.spread(1)
@pytest.mark.parametrize(("kind", "topic"), [(POSE_TYPES[0], "/mocap/rov/pose"), (POSE_TYPES[1], "/vrpn/rov/pose")])
def test_the_mounting_is_found_with_the_noise_that_the_data_show(tmp_path, kind, topic):
    found = dvl_calib_ros.replay(write_tank(tmp_path / "bag", kind, topic))
    assert found.discovery.topics.gnss == topic and found.verdict == "accept"
    assert found.discovery.values["gnss_aided_std"] < 0.03
    mounting = found.mounting
    assert np.all(np.abs(np.subtract(mounting.rpy_deg, MOUNTED_DEG)) < 3.0 * np.array(mounting.std_deg) + 0.05)
    assert mounting.std_deg[2] < 0.5
