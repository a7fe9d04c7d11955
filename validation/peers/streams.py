"""What peers read of bags: the three streams of each recording, without what is far off, thinned to the same rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import FRAMES, SampleBlock, VelocityFrame
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics

Floats = NDArray[np.float64]

# Streams are averaged until about so many samples of a recording are left
MAX_ROWS = 1000
# A variance of a reference above this says that the axis is not measured, (m/s)²
UNMEASURED = 100.0
# Where attitudes are further apart than this, s, angular velocities are taken from them
SLOW_S = 0.3


@dataclass(frozen=True)
class Streams:
    """One recording: times in s since its first DVL sample, velocities in m/s, attitude (A, 4), rates (A, 3) rad/s."""

    dvl_s: Floats
    dvl: Floats
    reference_s: Floats
    reference: Floats
    imu_s: Floats
    attitude: Floats
    rates: Floats
    in_earth: bool
    vertical: bool

    @property
    def seconds(self) -> float:
        """Of the DVL."""
        return float(self.dvl_s[-1])


def read_streams(paths: Sequence[Path], parameters: Parameters) -> list[Streams]:
    """What the bags hold, averaged to the same rate. Raises InputError where one lacks what the model needs."""
    opened = open_recording(paths, Topics(), parameters)
    found = []
    for path, one in zip(paths, opened.each, strict=True):
        topics = Topics().found_in(one.types)
        streams = one.streams(topics, MessageDecoder(one.of_types(topics, parameters)))
        dvl, reference, imu = (
            each.part(np.flatnonzero(each.refused == 0)) for each in (streams.dvl, streams.reference, streams.imu)
        )
        if min(len(dvl), len(reference), len(imu)) < 10:
            raise InputError(f"{path}: a peer needs ten samples of DVL, reference and IMU; record all three")
        found.append(_streams(dvl, reference, imu))
    return found


def _streams(dvl: SampleBlock, reference: SampleBlock, imu: SampleBlock) -> Streams:
    first = int(dvl.stamps_ns.min())
    bin_s = 1e-9 * float(dvl.stamps_ns.max() - first) / MAX_ROWS
    dvl_s, values = _thinned(dvl, dvl.values, first, bin_s)
    reference_s, velocity = _thinned(reference, reference.values, first, bin_s)
    quaternions = imu.orientation.copy()
    quaternions[1:] *= np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))[:, None]
    imu_s, inertial = _thinned(imu, np.column_stack([quaternions, imu.angular_velocity]), first, min(bin_s, 0.3))
    attitude, rates = inertial[:, :4], inertial[:, 4:]
    if float(np.median(np.diff(imu_s))) > SLOW_S or not np.isfinite(rates).all():
        rates = _turning(imu_s, attitude)
    of_z = reference.covariances.distinct[:, 2, 2]
    told = not len(of_z) or 0.0 <= float(np.median(of_z)) < UNMEASURED
    frame = FRAMES[int(reference.frames[0])]
    if frame is VelocityFrame.NED:
        velocity = velocity[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    return Streams(
        dvl_s, values, reference_s, velocity, imu_s, attitude, rates, frame is not VelocityFrame.BODY,
        bool(velocity[:, 2].any()) and told,
    )  # fmt: skip


def _thinned(block: SampleBlock, of: NDArray[Any], first_ns: int, bin_s: float) -> tuple[Floats, Floats]:
    """Stamps and values, in order of time, without what is far off; smoothed and thinned where there are too many.

    What smooths is a cubic fitted to neighbours: it does not delay, and does not flatten what bends.
    """
    order = np.argsort(block.stamps_ns, kind="stable")
    time = np.asarray(1e-9 * (block.stamps_ns[order] - first_ns), dtype=np.float64)
    values = np.asarray(of[order], dtype=np.float64)
    known = np.isfinite(values).any(axis=1)
    time, values = time[known], values[known]
    later = np.concatenate([[True], np.diff(time) > 1e-6]) & ~_far_off(values)
    time, values = time[later], values[later]
    every = int(bin_s / float(np.median(np.diff(time))))
    if every > 1:
        values = savgol_filter(values, 2 * max(every, 2) + 1, 3, axis=0)
        time, values = time[::every], values[::every]
    return time, values


def _turning(time: Floats, attitude: Floats) -> Floats:
    """(A, 3) rad/s in the body from the attitudes about each."""
    turned = Rotation.from_quat(attitude)
    steps = np.diff(time)[:, None]
    between = (turned[:-1].inv() * turned[1:]).as_rotvec() / steps
    return np.asarray(np.vstack([between[:1], 0.5 * (between[:-1] + between[1:]), between[-1:]]))


def _far_off(values: Floats) -> NDArray[np.bool_]:
    """Samples that stand out of their neighbours: off from the median of five by eight times the usual."""
    padded = np.pad(values, ((2, 2), (0, 0)), mode="edge")
    middle = np.median(np.stack([padded[k : k + len(values)] for k in range(5)]), axis=0)
    off = np.abs(values - middle)
    return np.asarray((off > 8.0 * (1.4826 * np.median(off, axis=0) + 1e-3)).any(axis=1))
