"""Orientations of poses as IMU data, for recordings without an IMU that has an orientation.

A motion capture measures orientation and position of a vehicle; the turn rates are the orientation's derivative.
"""

from __future__ import annotations

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Mask, Stamps
from ..messages.drivers import IMU_TYPE, POSE_TYPES
from .columns import Laid, TopicColumns
from .topics import ORIENTATION

# Turn rates are means over this time (s), so that noise of 0.1° per pose gives less than 1 °/s.
RATE_WINDOW_S = 0.2
# orientations whose components differ by no more than this are a constant filled in by the driver
LEAST_CHANGE = 1e-4


def orientations_of(poses: TopicColumns) -> TopicColumns | None:
    """Return the orientations of a topic of poses as an IMU's; None for another type or without orientations."""
    if poses.msgtype not in POSE_TYPES or len(poses) < 3:
        return None
    values = np.full((len(poses), 7), np.nan)
    for row, (_, _, message, _) in enumerate(poses.singles.messages()):
        if message is not None:
            q = getattr(message.pose, "pose", message.pose).orientation
            values[row, :4] = q.x, q.y, q.z, q.w
    values[~_are_unit(values)] = np.nan
    if not hold_orientations(values):
        return None
    good = np.flatnonzero(np.isfinite(values[:, 0]))
    (arrival, log_ns), stamps_ns = poses.arrivals, poses.stamps_ns
    values[good, 4:] = _turn_rates(stamps_ns[good], values[good, :4])
    n = len(poses)
    laid = Laid(
        arrival, log_ns, stamps_ns, values, np.zeros(n, dtype=np.int32), np.full(n, -1, dtype=np.int32),
        np.zeros(n, dtype=np.uint8), np.full((n, 3), np.nan), frames=("",),
    )  # fmt: skip
    nothing = poses.singles.part(np.zeros(0, dtype=np.intp))
    return TopicColumns(poses.topic + ORIENTATION, IMU_TYPE, laid, nothing)


def hold_orientations(values: Array) -> bool:
    """Return whether quaternions (N, 4 or more) are orientations that change; nan is ignored."""
    given = values[_are_unit(values), :4]
    return len(given) > 2 and float(np.ptp(given, axis=0).max()) > LEAST_CHANGE


def _are_unit(values: Array) -> Mask:
    return np.asarray(np.abs(np.einsum("ni,ni->n", values[:, :4], values[:, :4]) - 1.0) < 0.02)


def _turn_rates(stamps_ns: Stamps, quaternions: Array) -> Array:
    """Return angular velocities (N, 3), rad/s, in the body, of orientations (N, 4); nan if stamps do not advance."""
    from scipy.spatial.transform import Rotation

    order = np.argsort(stamps_ns, kind="stable")
    time = 1e-9 * (stamps_ns[order] - stamps_ns.min())
    first = np.searchsorted(time, time - 0.5 * RATE_WINDOW_S)
    last = np.searchsorted(time, time + 0.5 * RATE_WINDOW_S, side="right") - 1
    alone = first == last  # in slow streams, difference to the neighbours
    first, last = np.where(alone, first - 1, first).clip(0), np.where(alone, last + 1, last).clip(max=len(time) - 1)
    turns = Rotation.from_quat(quaternions[order])
    seconds = (time[last] - time[first])[:, None]
    rates = np.empty((len(time), 3))
    rates[order] = (turns[first].inv() * turns[last]).as_rotvec() / np.where(seconds > 0.0, seconds, np.nan)
    return rates
