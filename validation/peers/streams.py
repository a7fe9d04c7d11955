"""What peers read of bags: the three streams of each recording, without what is far off.

Rows are the samples of the slower of DVL and reference, so that only the faster one is interpolated: what a curve
through few samples makes of waves looks like a clock, a lag or a scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import FRAMES, SampleBlock, VelocityFrame
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics

Floats = NDArray[np.float64]

# Of a recording with more rows every second or third is taken
MAX_ROWS = 2000
# The IMU's samples are no nearer to each other, s: attitude between them is a curve
NEAREST_S = 0.1
# A reference so many times as fast as the DVL is smoothed, by a cubic fitted to what lies between two of the DVL's
FASTER = 3
# Columns are of a velocity that is smoothed over so long on both sides, s
QUIET_S = 1.0
# Shifts at which the speeds of both are compared, s
SHIFTS_S = np.arange(-4.0, 4.01, 0.05)
# A variance of a reference above this says that the axis is not measured, (m/s)²
UNMEASURED = 100.0
# Where attitudes are further apart than this, s, angular velocities are taken from them
SLOW_S = 0.3


@dataclass(frozen=True)
class Streams:
    """One recording: times in s since its first DVL sample, velocities in m/s, attitude (A, 4), rates (A, 3) rad/s.

    quiet: the DVL's velocity without most of its noise, for columns. Made of `dvl` itself they would explain its noise.
    """

    dvl_s: Floats
    dvl: Floats
    quiet: Floats
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
    """What the bags hold, as rows are made of. Raises InputError where one lacks what the model needs."""
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
    dvl_s, values = _cleaned(dvl, dvl.values, first)
    reference_s, velocity = _cleaned(reference, reference.values, first)
    of_z = reference.covariances.distinct[:, 2, 2]
    told = not len(of_z) or 0.0 <= float(np.median(of_z)) < UNMEASURED
    vertical = bool(velocity[:, 2].any()) and told
    dvl_s, values, reference_s, velocity = _at_the_slower(dvl_s, values, reference_s, velocity, vertical)
    quaternions = imu.orientation.copy()
    quaternions[1:] *= np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))[:, None]
    imu_s, inertial = _cleaned(imu, np.column_stack([quaternions, imu.angular_velocity]), first)
    every = max(int(NEAREST_S / _step(imu_s)), 1)
    imu_s, attitude, rates = imu_s[::every], inertial[::every, :4], _smoothed(inertial[:, 4:], every)[::every]
    if _step(imu_s) > SLOW_S or not np.isfinite(rates).all():
        rates = _turning(imu_s, attitude)
    frame = FRAMES[int(reference.frames[0])]
    if frame is VelocityFrame.NED:
        velocity = velocity[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    return Streams(
        dvl_s,
        values,
        _quiet(dvl_s, values),
        reference_s,
        velocity,
        imu_s,
        attitude,
        rates,
        frame is not VelocityFrame.BODY,
        vertical,
    )


def _cleaned(block: SampleBlock, of: NDArray[Any], first_ns: int) -> tuple[Floats, Floats]:
    """Stamps and values, in order of time, without what is far off."""
    order = np.argsort(block.stamps_ns, kind="stable")
    time = np.asarray(1e-9 * (block.stamps_ns[order] - first_ns), dtype=np.float64)
    values = np.asarray(of[order], dtype=np.float64)
    known = np.isfinite(values).any(axis=1)
    time, values = time[known], values[known]
    later = np.concatenate([[True], np.diff(time) > 1e-6]) & ~_far_off(values)
    return time[later], values[later]


def _at_the_slower(
    dvl_s: Floats, dvl: Floats, reference_s: Floats, reference: Floats, vertical: bool
) -> tuple[Floats, Floats, Floats, Floats]:
    """Both, the reference at the DVL's samples (moved by how late it is) if it is the faster; and not too many."""
    faster = _step(dvl_s) / _step(reference_s)
    if faster > 1.3:
        axes = 3 if vertical else 2
        curve = _smoothed(reference, int(faster) if faster >= FASTER else 1)
        at = dvl_s + _shift(dvl_s, dvl[:, :axes], reference_s, reference[:, :axes])
        gap = 4.0 * _step(reference_s)
        after = np.clip(np.searchsorted(reference_s, at), 1, len(reference_s) - 1)
        inside = (at >= reference_s[0]) & (at <= reference_s[-1]) & (reference_s[after] - reference_s[after - 1] < gap)
        reference_s, reference = at[inside], np.asarray(CubicSpline(reference_s, curve)(at[inside]))
    every = -(-len(reference_s) // MAX_ROWS)
    return dvl_s, dvl, reference_s[::every], reference[::every]


def _step(time: Floats) -> float:
    return float(np.median(np.diff(time)))


def _smoothed(values: Floats, every: int) -> Floats:
    """By a cubic fitted to so many on both sides: it does not delay, and does not flatten what bends."""
    if every < FASTER:
        return values
    return np.asarray(savgol_filter(values, 2 * max(every // 2, 2) + 1, 3, axis=0))


def _quiet(time: Floats, values: Floats) -> Floats:
    """Smoothed over some seconds, on both sides."""
    return np.asarray(savgol_filter(values, 2 * max(int(QUIET_S / _step(time)), 3) + 1, 3, axis=0))


def _shift(dvl_s: Floats, dvl: Floats, reference_s: Floats, reference: Floats) -> float:
    """s by which the reference is late, by the speeds alone, of which no frame has to be known."""
    speed, other = np.linalg.norm(dvl, axis=1), np.linalg.norm(reference, axis=1)
    apart = [float(np.std(np.interp(dvl_s + shift, reference_s, other) - speed)) for shift in SHIFTS_S.tolist()]
    return float(SHIFTS_S[int(np.argmin(apart))])


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
