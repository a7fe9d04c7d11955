"""Bags of runs with positions whose noise lasts (validation/positions.py), for `positions`."""

from __future__ import annotations

import heapq
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bags.writer import BagWriter, Compression, Storage
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample
from dvl_calib_ros.messages.drivers import POSE_TYPES
from dvl_calib_ros.messages.encode import SampleWriter

USBL = "usbl/pose"


def write_positions(path: Path, driven_run, topic: str = USBL) -> Path:
    """A bag of it, with the fixes as poses."""
    stamps, velocity, quaternion, fixes = driven_run
    rotation = Rotation.from_quat(quaternion)
    rates = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / (1e-9 * np.diff(stamps))[:, None]
    with BagWriter(path, Storage.MCAP, Compression.NONE) as bag:
        writer, types = SampleWriter(bag), bag.typestore.types
        # a fix takes a second through the water and the deck unit
        rows = heapq.merge(
            ((int(stamp), 0, row) for row, stamp in enumerate(stamps)),
            ((int(stamp) + 1_000_000_000, 1, row) for row, stamp in enumerate(fixes.stamps_ns)),
        )
        for log_ns, is_fix, row in rows:
            if not is_fix:
                rate = rates[min(row, len(rates) - 1)].tolist()
                writer.imu("imu/data", ImuSample(log_ns, tuple(quaternion[row].tolist()), tuple(rate)))
                writer.dvl("dvl/twist", DvlSample(log_ns, tuple(velocity[row].tolist())))
                continue
            covariance = np.diag([*np.where(np.isnan(fixes.variance[row]), 1e7, fixes.variance[row]), 0.0, 0.0, 0.0])
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](*fixes.position[row].tolist()),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            )
            inner = types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance.ravel())
            message = types[POSE_TYPES[0]](writer._header(int(fixes.stamps_ns[row]), "map"), inner)
            bag.message(topic, POSE_TYPES[0], log_ns, message)
    return path
