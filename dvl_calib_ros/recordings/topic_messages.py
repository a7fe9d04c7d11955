"""All messages of a topic, unfiltered and in their own axes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Codes, Stamps
from ..calibration.streams.screening import NOT_MEASURED_VARIANCE, screen_columns
from ..messages.decode import NO_DATA, UNREADABLE, stamp_ns
from ..messages.drivers import IMU_TYPE, VELOCITY_TYPES
from ..messages.positions import SELDOM_S, FixDifference, PositionType
from .columns import DecodedRows, TopicColumns, stamped
from .topic_preview import FASTEST

# of an IMU
NOTHING = np.zeros((0, 3)), np.zeros(0, dtype=np.uint8)


@dataclass(frozen=True)
class Recorded:
    """N messages of a topic, in order of log time.

    stamps_ns: (N,) of the header, 0 if missing.
    log_ns: (N,).
    values: (N, 3) m/s; of an IMU its quaternion (N, 4).
    variances: (N, 3) (m/s)², nan if missing; (0, 3) of an IMU.
    unmeasured: (N,) codes of axes that a message marks as not measured, see `screening.Screened`; (0,) of an IMU.
    refused: number of messages by counter of the driver's rules.
    unreadable: number of unreadable messages.
    unreadable_because: reason of the first.
    window_s: averaging time of velocities from positions, 0 for measured velocities.
    """

    topic: str
    msgtype: str
    stamps_ns: Stamps
    log_ns: Stamps
    values: Array
    variances: Array
    unmeasured: Codes
    refused: Mapping[str, int]
    unreadable: int
    window_s: float = 0.0
    unreadable_because: str = ""

    def __len__(self) -> int:
        return len(self.stamps_ns)


class _Row(NamedTuple):
    arrival: int
    log_ns: int
    stamp_ns: int
    values: tuple[float, ...]
    variances: Any


def recorded(parts: Sequence[TopicColumns], parameters: Parameters) -> Recorded:
    """Return all messages of a topic, of which each recording has a part."""
    topic, msgtype = parts[0].topic, parts[0].msgtype
    refused: Counter[str] = Counter()
    unread: list[str] = []
    rules = VELOCITY_TYPES[msgtype].rules if msgtype in VELOCITY_TYPES else ()
    for part in parts:
        for code in np.flatnonzero(np.bincount(part.decoded.broken)).tolist():
            if code:  # 0: no rule is broken
                refused[rules[code - 1].counter] += int(np.count_nonzero(part.decoded.broken == code))
    single_rows = sorted((row for part in parts for row in part.singles.messages()), key=lambda row: row[0])
    rows: list[_Row] = []
    position = VELOCITY_TYPES[msgtype].position if msgtype in VELOCITY_TYPES else None
    window_s = 0.0 if position is None else _window_s(single_rows, parameters)
    if position is not None:
        rows = _differences(single_rows, position, window_s)
        unread = [why for _, _, message, why in single_rows if message is None]
    else:
        for arrival, log_ns, message, why in single_rows:
            try:
                row, broken = _row(arrival, log_ns, message, msgtype, parameters)
            except UNREADABLE as error:
                unread.append(why or f"{msgtype}, {type(error).__name__}: {error}")
                continue
            rows.append(row)
            refused.update(broken)
    is_imu = msgtype == IMU_TYPE
    width = 4 if is_imu else 3
    columns = [_of_decoded(part.decoded, width, is_imu) for part in parts]
    if rows or len(columns) > 1:
        columns.append(_of_rows(rows, width, is_imu))
    _, log_ns, stamps_ns, values, variances, unmeasured = columns[0] if len(columns) == 1 else _in_order(columns)
    values, variances = _plausible(values, FASTEST), _plausible(variances, FASTEST**2)
    first_reason = unread[0] if unread else ""
    return Recorded(
        topic, msgtype, stamps_ns, log_ns, values, variances, unmeasured, refused, len(unread), window_s, first_reason
    )


def _of_decoded(rows: DecodedRows, width: int, is_imu: bool) -> tuple[Any, ...]:
    """Return the columns of decoded messages, as `_of_rows`."""
    claimed = NOTHING if is_imu else (rows.variances, screen_columns(rows.covariances).unmeasured)
    return rows.arrival, rows.log_ns, rows.stamps_ns, rows.values[:, :width], *claimed


def _in_order(columns: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Join rows and sort them by arrival, the first column."""
    joined = [np.concatenate(column_parts) for column_parts in zip(*columns, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return tuple(column[order] if len(column) == len(order) else column for column in joined)


def _plausible(values: Array, most: float) -> Array:
    """Replace implausibly large values by nan."""
    if not len(values) or (values.max() < most and values.min() > -most):
        return values
    return np.where(np.abs(values) < most, values, np.nan)


def _row(arrival: int, log_ns: int, message: Any, msgtype: str, parameters: Parameters) -> tuple[_Row, list[str]]:
    """Convert a message. Return its row, and the name of the validity rule that refuses it, if any.

    Raises `UNREADABLE`.
    """
    stamp = stamp_ns(message.header.stamp)
    if msgtype == IMU_TYPE:
        orientation = message.orientation
        given = message.orientation_covariance[0] != NO_DATA
        values = (orientation.x, orientation.y, orientation.z, orientation.w) if given else (np.nan,) * 4
        return _Row(arrival, log_ns, stamp, values, np.full(3, np.nan)), []
    kind = VELOCITY_TYPES[msgtype]
    v = kind.velocity(message)
    variances = np.full(3, np.nan)
    covariance = kind.covariance(message)
    if covariance is not None and not kind.lacks_covariance(message):
        flat = np.asarray(covariance, dtype=float).reshape(-1)
        diagonal = flat[[0, 4, 8] if len(flat) == 9 else [0, 7, 14]]
        if not (diagonal <= 0.0).any():
            variances = diagonal
    broken = kind.broken_rule(message, parameters)
    return _Row(arrival, log_ns, stamp, (v.x, v.y, v.z), variances), [] if broken is None else [broken.counter]


def _window_s(singly: Sequence[tuple[int, int, Any, str]], parameters: Parameters) -> float:
    """Return the time over which positions are differenced."""
    log_ns = np.array([log_ns for _, log_ns, message, _ in singly if message is not None], dtype=np.int64)
    every_s = 1e-9 * float(np.median(np.diff(log_ns))) if len(log_ns) > 1 else 0.0
    return every_s if every_s > SELDOM_S else parameters.position_window


def _differences(singly: Sequence[tuple[int, int, Any, str]], kind: PositionType, window_s: float) -> list[_Row]:
    """Convert positions to velocities between them."""
    difference = FixDifference(window_s, kind.between)
    rows = []
    for arrival, at_log_ns, message, _ in singly:
        if message is None or not kind.is_valid(message):
            continue
        at_ns = stamped(message, at_log_ns)
        found = difference(at_ns, *kind.place(message), kind.covariance(message))
        if found is not None:
            claimed = None if found.covariance is None else np.diag(found.covariance)
            variances = np.full(3, np.nan) if claimed is None or not (claimed > 0.0).all() else claimed
            # log time of the middle of the window, as for a measurement at that time
            rows.append(_Row(arrival, at_log_ns - (at_ns - found.stamp_ns), found.stamp_ns, found.velocity, variances))
    return rows


def _of_rows(rows: Sequence[_Row], width: int, is_imu: bool) -> tuple[Any, ...]:
    """Return columns: arrival, log time and stamp (N,) ns, values (N, width), variances (N, 3), unmeasured (N,)."""
    times = (np.array([row[column] for row in rows], dtype=np.int64) for column in range(3))
    values = np.array([row.values for row in rows], dtype=float).reshape(-1, width)
    if is_imu:
        return (*times, values, *NOTHING)
    variances = np.array([row.variances for row in rows]).reshape(-1, 3)
    unmeasured = (variances >= NOT_MEASURED_VARIANCE) @ np.array([1, 2, 4])
    return (*times, values, variances, unmeasured.astype(np.uint8))
