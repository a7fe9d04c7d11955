"""A run with positions whose noise lasts, and outliers: simulated by itself, for D1."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bags.writer import BagWriter, Compression, Storage
from dvl_calib_ros.calibration.displacement.legs import Fixes
from dvl_calib_ros.calibration.samples import DvlSample, ImuSample
from dvl_calib_ros.messages.drivers import POSE_TYPE
from dvl_calib_ros.messages.encode import SampleWriter

USBL = "usbl/pose"


@dataclass(frozen=True)
class Truth:
    """phi: misalignment, rad. scale. arm: DVL from reference point, m. late_s: of the fixes. deviation: of the
    heading, of its sine and cosine, rad."""

    phi: tuple[float, float, float]
    scale: float = 0.0
    arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late_s: float = 0.0
    deviation: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Noise:
    """m: white, and lasting with a time of lasts_s; share of outliers of 30 m. dvl: m/s."""

    white: float = 2.0
    lasting: float = 0.0
    lasts_s: float = 60.0
    outliers: float = 0.0
    dvl: float = 0.01


def driven(rng, seconds, dvl_hz=5.0, fix_s=1.0, speed=1.5, truth=None, noise=None, depths=False):
    """Stamps, DVL velocities and attitudes of a lawnmower's lines, and fixes."""
    truth, noise = truth or Truth((0.0, 0.0, 0.0), 0.0), noise or Noise()
    dt = 0.05
    time = np.arange(0.0, seconds + 5.0, dt)
    # lines of two minutes to and fro, and a short one across between them
    yaw_at = np.cumsum([0.0, 120.0, 15.0, 120.0, 15.0] * (1 + int(seconds / 270.0)))
    legs = np.array([0.0, 90.0, 180.0, 90.0] * (1 + int(seconds / 270.0)))
    index = np.clip(np.searchsorted(yaw_at[1::1], time, side="right"), 0, len(legs) - 1)
    wanted = np.radians(legs[index] + 25.0)
    yaw = lfilter([dt / 3.0], [1.0, dt / 3.0 - 1.0], wanted - wanted[0]) + wanted[0]
    pitch = 0.02 * np.sin(time / 7.0) + (0.15 * np.sin(time / 90.0) if depths else 0.0)
    roll = 0.03 * np.sin(time / 5.0)
    rotation = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    # moves where it points, with some sway in turns
    body = np.column_stack([np.full(len(time), speed), 0.1 * np.gradient(yaw, dt), np.zeros(len(time))])
    position = np.cumsum(rotation.apply(body), axis=0) * dt
    arm = rotation.apply(truth.arm)
    at_dvl = np.gradient(position + arm, dt, axis=0)
    measured = rotation.inv().apply(at_dvl)
    phi = np.asarray(truth.phi)
    matrix = (1.0 + truth.scale) * (np.eye(3) + np.cross(np.eye(3), phi))
    every = round(1.0 / (dvl_hz * dt))
    at = np.arange(0, len(time), every)
    velocity = measured[at] @ matrix.T + rng.normal(0.0, noise.dvl, (len(at), 3))
    fix_at = np.arange(40, len(time) - 40, round(fix_s / dt))
    fixes = position[fix_at]
    fixes = fixes + rng.normal(0.0, noise.white, fixes.shape)
    if noise.lasting:
        a = math.exp(-fix_s / noise.lasts_s)
        driving = rng.normal(0.0, noise.lasting, fixes.shape)
        driving[1:] *= math.sqrt(1.0 - a * a)
        fixes = fixes + lfilter([1.0], [1.0, -a], driving, axis=0)
    bad = rng.random(len(fixes)) < noise.outliers
    fixes[bad] += rng.normal(0.0, 30.0, (int(bad.sum()), 3))
    stamps = (time * 1e9).astype(np.int64) + 1_760_000_000_000_000_000
    sine, cosine = truth.deviation
    told = rotation.as_euler("ZYX") + np.outer(sine * np.sin(yaw) + cosine * np.cos(yaw), [1.0, 0.0, 0.0])
    variance = np.full(fixes.shape, float(noise.white) ** 2)
    if not depths:
        variance[:, 2] = np.nan
    return (
        stamps[at],
        velocity,
        Rotation.from_euler("ZYX", told[at]).as_quat(),
        Fixes(stamps[fix_at] + round(truth.late_s * 1e9), fixes, variance),
    )


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
            message = types[POSE_TYPE](writer._header(int(fixes.stamps_ns[row]), "map"), inner)
            bag.message(topic, POSE_TYPE, log_ns, message)
    return path
