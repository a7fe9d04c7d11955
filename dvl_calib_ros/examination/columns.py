"""All messages of a recording's chosen topics as columns, as they come: nothing left out, nothing turned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bags.columns import Part, windows
from ..bags.reader import BagReader
from ..calibration.frames import Array
from ..calibration.parameters import Parameters
from ..discovery.survey import FASTEST
from ..messages.drivers import IMU_TYPE, VELOCITY_TYPES
from ..messages.fixes import FixDifference

Stamps = NDArray[np.int64]
# What reading a message, or columns, of another layout than its type's raises.
_UNREADABLE = (AttributeError, TypeError, ValueError, IndexError, OverflowError)


@dataclass(frozen=True)
class Recorded:
    """A topic's messages, N of them, in order of log time.

    stamps_ns: (N,) of the header, 0 where it has none. log_ns: (N,). values: (N, 3) m/s; of an IMU (N, 4) its
    quaternion. variances: (N, 3) (m/s)², nan where not given. refused: by counter of the driver's rules, of how many.
    unreadable: messages that could not be read.
    """

    topic: str
    msgtype: str
    stamps_ns: Stamps
    log_ns: Stamps
    values: Array
    variances: Array
    refused: Mapping[str, int]
    unreadable: int

    def __len__(self) -> int:
        return len(self.stamps_ns)


def recorded(bag: BagReader, topics: list[str], parameters: Parameters) -> dict[str, Recorded]:
    """Read these topics (velocities and IMUs) to the end."""
    types = bag.topics
    parts: dict[str, list[_Rows]] = {topic: [] for topic in topics}
    fixes = {topic: FixDifference(parameters.position_window) for topic in topics}
    unreadable: Counter[str] = Counter()
    for window in windows(bag, topics):
        for part in window.parts:
            topic = part.channel.topic
            kind = VELOCITY_TYPES.get(types[topic])
            if kind is not None and kind.is_position:
                parts[topic] += _differences(part, fixes[topic])
                continue
            for rows in _rows(part, types[topic], parameters):
                if rows is None:
                    unreadable[topic] += 1
                else:
                    parts[topic].append(rows)
    return {topic: _joined(topic, types[topic], parts[topic], unreadable[topic]) for topic in topics}


@dataclass(frozen=True)
class _Rows:
    arrival: Stamps
    log_ns: Stamps
    stamps_ns: Stamps
    values: Array
    variances: Array
    refused: Mapping[str, int]


def _rows(part: Part, msgtype: str, parameters: Parameters) -> Iterator[_Rows | None]:
    read = _imu if msgtype == IMU_TYPE else _velocity
    if part.columns is not None:
        try:
            yield read(part.columns, len(part), part.arrival, part.log_ns, msgtype, parameters)
            return
        except _UNREADABLE:  # a type with lists: one by one
            pass
    for row, (message, _) in enumerate(part.messages()):
        try:
            yield read(message, 1, part.arrival[row : row + 1], part.log_ns[row : row + 1], msgtype, parameters)
        except _UNREADABLE:
            yield None


def _differences(part: Part, difference: FixDifference) -> Iterator[_Rows]:
    """Satellite positions as the velocities between them."""
    for row, (message, _) in enumerate(part.messages()):
        at, log_ns = part.arrival[row : row + 1], part.log_ns[row : row + 1]
        if message is None or message.status.status < 0:
            continue
        given = message.position_covariance if message.position_covariance_type else None
        stamp = int(_stamps(message, 1)[0]) or int(log_ns[0])
        found = difference(stamp, message.latitude, message.longitude, message.altitude, given)
        if found is not None:
            variances = np.full(3, np.nan) if found.covariance is None else np.diag(found.covariance)
            # by the log time of the middle of its window, as if it had been measured then
            middle = log_ns - (stamp - found.stamp_ns)
            yield _Rows(at, middle, np.array([found.stamp_ns]), np.array([found.velocity]), variances[None], {})


def _stamps(message: Any, n: int) -> Stamps:
    stamp = message.header.stamp
    return np.broadcast_to(np.asarray(stamp.sec, dtype=np.int64) * 1_000_000_000 + stamp.nanosec, n).astype(np.int64)


def _velocity(message: Any, n: int, arrival: Stamps, log_ns: Stamps, msgtype: str, parameters: Parameters) -> _Rows:
    """Of columns of n messages, or of one."""
    kind = VELOCITY_TYPES[msgtype]
    v = kind.velocity(message)
    values = np.column_stack([np.broadcast_to(np.asarray(each, dtype=float), n) for each in (v.x, v.y, v.z)])
    given = kind.covariance(message)
    variances = np.full((n, 3), np.nan)
    if given is not None:
        covariance = np.asarray(given, dtype=float).reshape(n, -1)
        step = 4 if covariance.shape[1] == 9 else 7
        variances = covariance[:, [0, step, 2 * step]].copy()
        variances[np.broadcast_to(np.asarray(kind.lacks_covariance(message)), n)] = np.nan
        variances[(variances <= 0.0).any(axis=1)] = np.nan
    refused: dict[str, int] = {}
    left = np.ones(n, dtype=bool)
    for rule in kind.rules:
        broken = np.broadcast_to(np.asarray(rule.broken(message, parameters)), n) & left
        if broken.any():
            refused[rule.counter] = int(broken.sum())
        left = left & ~broken
    return _Rows(arrival, log_ns, _stamps(message, n), values, variances, refused)


def _imu(message: Any, n: int, arrival: Stamps, log_ns: Stamps, msgtype: str, parameters: Parameters) -> _Rows:
    q = message.orientation
    values = np.column_stack([np.broadcast_to(np.asarray(each, dtype=float), n) for each in (q.x, q.y, q.z, q.w)])
    first = np.asarray(message.orientation_covariance, dtype=float).reshape(n, -1)[:, 0]
    values[first == -1.0] = np.nan
    return _Rows(arrival, log_ns, _stamps(message, n), values, np.full((n, 3), np.nan), {})


def _joined(topic: str, msgtype: str, parts: list[_Rows], unreadable: int) -> Recorded:
    width = 4 if msgtype == IMU_TYPE else 3
    refused: Counter[str] = Counter()
    for part in parts:
        refused.update(part.refused)
    if not parts:
        empty = np.zeros(0, dtype=np.int64)
        return Recorded(topic, msgtype, empty, empty, np.zeros((0, width)), np.zeros((0, 3)), refused, unreadable)
    order = np.argsort(np.concatenate([part.arrival for part in parts]), kind="stable")
    values = np.concatenate([part.values for part in parts])[order]
    values[~(np.abs(values) < FASTEST)] = np.nan
    variances = np.concatenate([part.variances for part in parts])[order]
    variances[~(variances < FASTEST**2)] = np.nan
    return Recorded(
        topic,
        msgtype,
        np.concatenate([part.stamps_ns for part in parts])[order],
        np.concatenate([part.log_ns for part in parts])[order],
        values,
        variances,
        refused,
        unreadable,
    )
