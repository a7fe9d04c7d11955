"""Messages of a topic, unfiltered and in their own axes: all, or a preview to choose topics and to find frames.

The messages of a preview come in bursts spread over the recording. So a preview of hours costs no more than one of
minutes, and the streams have samples at the same times, which can be compared.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import accumulate
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import median
from ..calibration.numerics.samples import Codes, Index, Stamps
from ..calibration.streams.screening import NOT_MEASURED_VARIANCE, screen_columns
from ..messages.decode import NO_DATA, UNREADABLE, frame_name, heading_variance, stamp_ns
from ..messages.drivers import IMU_TYPE, VELOCITY_TYPES
from ..messages.positions import SELDOM_S, FixDifference, PositionType
from .columns import ODOMETRY, DecodedRows, TopicColumns, extra_values, stamped

# Number, length and shortest sampling interval of the bursts. 24 bursts of 6 s contain turns and straights, and reveal
# clock offsets of seconds; a DVL has at most 10 Hz.
BURSTS, BURST_NS, BURST_EVERY_NS = 24, 6_000_000_000, 95_000_000
# Clocks of instruments differ by parts per million, intervals between stamps by jitter. A clock whose rate differs from
# the log's by more than this share is a simulator's.
SIMULATED_TIME = 0.1
# largest number of messages of a fast, long topic, evenly spread
MOST = 100_000
# faster values (m/s) are garbage, whose square may overflow; velocities in mm/s still pass
FASTEST = 1e5


@dataclass(frozen=True)
class Preview:
    """N messages of one topic.

    count: messages in the recording.
    rate_hz: average, 0 for a recording of an instant.
    frame_id: of the velocity or the IMU's data, the first.
    stamps_s: (N,) s since the first log time of the recordings, of the header, or of the log if zero.
    ahead_s: median of stamp minus log time; in simulated time, at its start.
    values: velocity (N, 3) m/s, as in the message; of an IMU (N, 10): quaternion x y z w, angular velocity rad/s and
      acceleration m/s², nan if missing.
    rates: angular velocity (N, 3) rad/s of a twist, in the axes of its velocity; zero if missing.
    world: frame_id of the header, which is the pose's frame for an odometry.
    claimed_std: median of the claimed noise per axis, m/s, or of an IMU's heading, rad; nan if not claimed.
    clock_rate: seconds of stamps per second of log; 1 except in simulated time.
    pose: (N, 7) position, m, and quaternion x y z w of an odometry.
    """

    topic: str
    msgtype: str
    count: int
    rate_hz: float
    frame_id: str
    stamps_s: Array
    ahead_s: float
    values: Array
    rates: Array | None = None
    world: str = ""
    claimed_std: float = math.nan
    clock_rate: float = 1.0
    pose: Array | None = None

    @property
    def speed(self) -> float:
        """Root mean square of the velocity, m/s; 0 without samples."""
        return float(np.sqrt((self.values**2).sum(axis=1).mean())) if len(self.values) else 0.0

    @property
    def has_orientation(self) -> bool:
        """Whether an IMU has orientations: most quaternions have unit length, and they change."""
        q = self.values[:, :4]
        if len(q) < 2 or np.isnan(q).any(axis=1).mean() > 0.5:
            return False
        given = q[~np.isnan(q).any(axis=1)]
        unit = np.abs(np.linalg.norm(given, axis=1) - 1.0) < 0.01
        return bool(unit.mean() > 0.5 and np.ptp(given, axis=0).max() > 0.0)


@dataclass(frozen=True)
class Survey:
    """Previews of a recording's topics. transforms: messages of tf_static. descriptions: of robot_description.

    unread: topic -> why none of its messages can be decoded. field_maps: see `Recording`.
    """

    topics: Mapping[str, str]
    counts: Mapping[str, int]
    previews: Mapping[str, Preview]
    transforms: tuple[Any, ...]
    descriptions: tuple[str, ...]
    unread: Mapping[str, str] = field(default_factory=dict)
    field_maps: Mapping[str, str] = field(default_factory=dict)


def preview_of(
    parts: Sequence[TopicColumns],
    count: int,
    start_ns: int,
    spans_ns: Sequence[tuple[int, int]],
    *,
    whole: bool = False,
) -> Preview | None:
    """Return the preview of a topic, of which each recording has a part; None if no message can be read.

    start_ns: first log time of the recordings.
    spans_ns: start and end of each recorded stretch, in order.
    whole: all messages, up to MOST, instead of bursts.
    """
    topic, msgtype = parts[0].topic, parts[0].msgtype
    seconds = 1e-9 * sum(end - start for start, end in spans_ns)
    every_s = seconds / count if count else 0.0
    is_seldom = every_s > SELDOM_S and is_position(msgtype)
    rows = _PreviewRows(msgtype, every_s if is_seldom else 1.0)
    chosen = np.zeros(0, dtype=np.int64) if whole or is_seldom else in_bursts(parts, spans_ns)
    if not len(chosen):  # bursts may miss all messages if one wrong log time makes the recording long
        chosen = np.sort(np.concatenate([part.arrivals[0] for part in parts]))
        if not is_position(msgtype):  # positions are kept, because velocities are differences of successive ones
            chosen = chosen[:: -(-len(chosen) // MOST) or 1]
    rows.add_chosen(parts, chosen)
    ordered = rows.in_order()
    if ordered is None:
        return None
    stamps_ns, log_ns, values, extra, kept = ordered
    clock_rate = _clock_rate(stamps_ns, log_ns)
    ahead_s = 1e-9 * float(median(stamps_ns - start_ns - clock_rate * (log_ns - start_ns)))
    stamps_s = 1e-9 * (stamps_ns[kept] - start_ns)
    rate_hz = count / (seconds * clock_rate) if seconds else 0.0
    rates, pose = extra[kept, :3], extra[kept, 3:] if msgtype == ODOMETRY else None
    if msgtype == IMU_TYPE:
        values, rates = np.hstack([values, extra]), np.full((0, 3), np.nan)
    return Preview(
        topic, msgtype, count, rate_hz, rows.frame_id, stamps_s, ahead_s, values[kept],
        rates=None if np.isnan(rates).all() else rates, world=rows.world, claimed_std=rows.claimed_std,
        clock_rate=clock_rate, pose=pose,
    )  # fmt: skip


def _clock_rate(stamps_ns: Stamps, log_ns: Stamps) -> float:
    """Return seconds of stamps per second of log in simulated time; 1 if the difference may be jitter.

    stamps_ns, log_ns: (N,), in any order.
    """
    if len(stamps_ns) < 2:
        return 1.0
    stamped, logged = (float(median(np.diff(np.sort(times_ns)).astype(float))) for times_ns in (stamps_ns, log_ns))
    rates = (stamped / logged, float(np.ptp(stamps_ns) / np.ptp(log_ns))) if stamped > 0.0 and logged > 0.0 else (1.0,)
    return rates[-1] if min(abs(math.log(rate)) for rate in rates) > SIMULATED_TIME else 1.0


def _places(arrival: Stamps, chosen: Stamps) -> Index:
    """Return the indices of rows, in order of arrival, that are among those taken."""
    if not len(arrival) or not len(chosen):
        return np.zeros(0, dtype=np.intp)
    matching = np.minimum(np.searchsorted(arrival, chosen), len(arrival) - 1)
    return np.asarray(matching[arrival[matching] == chosen])


def in_bursts(parts: Sequence[TopicColumns], spans_ns: Sequence[tuple[int, int]]) -> Stamps:
    """Return the arrivals of a topic's messages in the bursts.

    spans_ns: start and end of each recorded stretch, in order.
    """
    arrivals = [part.arrivals for part in parts]
    arrival, log_ns = (np.concatenate(column) for column in zip(*arrivals, strict=True))
    if len(parts) > 1:
        order = np.argsort(arrival, kind="stable")
        arrival, log_ns = arrival[order], log_ns[order]
    starts_ns = [start_ns for start_ns, _ in spans_ns]
    recorded_before_ns = [0, *accumulate(end_ns - start_ns for start_ns, end_ns in spans_ns)]
    period_ns = max(recorded_before_ns[-1] // BURSTS, BURST_NS)
    chosen = []
    index = 0
    while index < len(log_ns):
        now_ns = int(log_ns[index])
        span = max(bisect_right(starts_ns, now_ns) - 1, 0)
        since_ns = (now_ns - starts_ns[span] + recorded_before_ns[span]) % period_ns
        if since_ns < BURST_NS:
            chosen.append(index)
            next_ns = now_ns + BURST_EVERY_NS
        else:
            next_ns = now_ns + period_ns - since_ns
        index = max(index + 1, int(log_ns.searchsorted(next_ns)))
    return arrival[chosen]


def is_position(msgtype: str) -> bool:
    """Return whether messages of a type have positions, from which velocities are computed."""
    kind = VELOCITY_TYPES.get(msgtype)
    return kind is not None and kind.position is not None


class _PreviewRows:
    """Collector of a preview's rows: arrival, log time (ns), stamp (ns), values and extra values of each message."""

    def __init__(self, msgtype: str, window_s: float) -> None:
        """Start without rows. window_s: averaging time of velocities from positions."""
        self._msgtype, self._kind, self._window_s = msgtype, VELOCITY_TYPES.get(msgtype), window_s
        self._rows: list[tuple[Stamps, Stamps, Stamps, Array, Array]] = []
        self._names: list[tuple[int, str]] = []
        self.world = ""
        self._variances: list[Array] = []

    @property
    def claimed_std(self) -> float:
        """Median claimed noise per axis, m/s, of valid messages if any; nan if none is claimed."""
        variances = np.concatenate([*self._variances, np.zeros(0)])
        claimed = variances[np.isfinite(variances) & (variances > 0.0)]
        measured = claimed[claimed < NOT_MEASURED_VARIANCE]
        claimed = measured if len(measured) else claimed
        return math.sqrt(float(median(claimed))) if len(claimed) else math.nan

    @property
    def frame_id(self) -> str:
        """Frame of the first message that has one."""
        return min(self._names)[1] if self._names else ""

    def add_chosen(self, parts: Sequence[TopicColumns], chosen: Stamps) -> None:
        """Add the messages whose arrivals are chosen."""
        for part in parts:
            self._add_decoded(part, _places(part.decoded.arrival, chosen))
        singles = [row for part in parts for row in part.singles.messages(_places(part.singles.arrival, chosen))]
        singles.sort(key=lambda row: row[0])
        self._add_messages(
            [(arrival, log_ns, message) for arrival, log_ns, message, _ in singles if message is not None]
        )

    def _add_decoded(self, part: TopicColumns, at: Index) -> None:
        """Add the decoded messages at some indices."""
        if not len(at):
            return
        decoded = part.decoded.part(at)
        stamps_ns = np.where(decoded.stamps_ns == 0, decoded.log_ns, decoded.stamps_ns)
        self._rows.append((decoded.arrival, decoded.log_ns, stamps_ns, decoded.values, decoded.extra))
        self.world = self.world or decoded.world
        is_velocity = self._kind is not None
        self._variances.append(decoded.variances.mean(axis=1) if is_velocity else np.array([decoded.heading_variance]))
        # the first message with a frame suffices
        is_named = np.array([bool(frame) for frame in decoded.frames], dtype=bool)
        for row in np.flatnonzero(is_named[decoded.frame])[:1].tolist():
            self._names.append((int(decoded.arrival[row]), decoded.frames[decoded.frame[row]]))

    def _add_messages(self, messages: list[tuple[int, int, Any]]) -> None:
        """Decode and add messages, each with its arrival and log time (ns)."""
        if self._kind is not None and self._kind.position is not None:
            messages = _velocity_messages(messages, self._kind.position, self._window_s)
        for arrival, log_ns, message in messages:
            with suppress(*UNREADABLE):
                values, extra = self._values_of(message)
                row = np.array([[arrival], [log_ns], [stamped(message, log_ns)]])
                name = frame_name(str(message.header.frame_id if self._kind is None else self._kind.frame_id(message)))
                self._rows.append((row[0], row[1], row[2], np.array([values], dtype=float), extra))
                self._names += [(arrival, name)] if name else []
                self._variances.append(np.array([self._claimed_variance(message)]))
                self.world = self.world or frame_name(str(message.header.frame_id))

    def _values_of(self, message: Any) -> tuple[list[float], Array]:
        """Return a velocity, or an IMU's quaternion and angular velocity; and the additional values."""
        if self._kind is not None:
            v = message.velocity if self._kind.position else self._kind.velocity(message)
            return [v.x, v.y, v.z], extra_values(message, self._msgtype)
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        given = (
            ((q.x, q.y, q.z, q.w), message.orientation_covariance),
            ((w.x, w.y, w.z), message.angular_velocity_covariance),
            ((a.x, a.y, a.z), message.linear_acceleration_covariance),
        )
        numbers = [np.nan if covariance[0] == NO_DATA else value for values, covariance in given for value in values]
        return numbers[:7], np.array([numbers[7:]], dtype=float)

    def _claimed_variance(self, message: Any) -> float:
        """Return the variance that a message reports, averaged over axes; nan if missing."""
        if self._kind is None:
            return heading_variance(message.orientation_covariance)
        given = message.covariance if self._kind.position else self._kind.covariance(message)
        if given is None or self._kind.lacks_covariance(message):
            return math.nan
        flat = np.asarray(given, dtype=float).ravel()
        variance = flat[[0, 4, 8] if len(flat) == 9 else [0, 7, 14]]
        # positions without height have a huge vertical variance
        return float(median(variance) if self._kind.position else variance.mean())

    def in_order(self) -> tuple[Stamps, Stamps, Array, Array, Index] | None:
        """Return stamps, log times, values, additional values, and the indices of valid rows in order of stamps."""
        if not self._rows:
            return None
        arrival, log_ns, stamps_ns, values, extra = (np.concatenate(column) for column in zip(*self._rows, strict=True))
        whole = np.ones(len(values), dtype=bool)
        if self._msgtype != IMU_TYPE:
            values[(values == 0.0).all(axis=1)] = np.nan  # sent by drivers without a measurement
            whole = (np.abs(values) < FASTEST).all(axis=1)
        for numbers in (values, extra[:, :3]):
            numbers[~(np.abs(numbers) < FASTEST)] = np.nan  # so that squares are finite
        order = np.lexsort((arrival, stamps_ns))
        return stamps_ns, log_ns, values, extra, order[whole[order]]


def _velocity_messages(
    messages: Iterable[tuple[int, int, Any]], kind: PositionType, window_s: float
) -> list[tuple[int, int, Any]]:
    """Convert positions to velocities between them, at the middle of each window."""
    difference = FixDifference(window_s, kind.between)
    found = []
    for arrival, log_ns, message in messages:
        if not kind.is_valid(message):
            continue
        at_ns = stamped(message, log_ns)
        fixed = difference(at_ns, *kind.place(message), kind.covariance(message))
        if fixed is not None:
            velocity = SimpleNamespace(**dict(zip("xyz", fixed.velocity, strict=True)))
            seconds, nanoseconds = divmod(fixed.stamp_ns, 1_000_000_000)
            header = SimpleNamespace(
                stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=message.header.frame_id
            )
            found.append(
                (arrival, log_ns, SimpleNamespace(velocity=velocity, header=header, covariance=fixed.covariance))
            )
    return found


# All messages of a topic, unfiltered and in their own axes.

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
        counts = np.bincount(part.decoded.broken, minlength=1 + len(rules))[1:].tolist()  # 0: no rule is broken
        refused.update({rule.counter: count for rule, count in zip(rules, counts, strict=True) if count})
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
