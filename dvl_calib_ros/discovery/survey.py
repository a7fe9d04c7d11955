"""A first look at recordings: which topics could be what, and some messages of each as columns.

Messages are taken in bursts spread over the recording, so that a look at hours costs no more than one at minutes, and
yet the streams have samples at the same times, which can be compared.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from operator import itemgetter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ..bags.columns import Part, windows
from ..bags.reader import BagReader
from ..calibration.frames import Array
from ..calibration.robust import median
from ..calibration.samples import Mask, Stamps
from ..messages.decode import NO_DATA, UNREADABLE, stamp_ns
from ..messages.drivers import IMU_TYPE, VELOCITY_TYPES
from ..messages.fixes import FixDifference

# Bursts: so many over the recording, each so long, of each topic at most so often. 24 bursts of 6 s show turns and
# straights, and stamps that are late by seconds; 10 Hz is what a DVL gives at most.
BURSTS, BURST_NS, BURST_EVERY_NS = 24, 6_000_000_000, 95_000_000
TF_TYPE, STRING_TYPE = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"
# What is faster (m/s) is garbage, whose square may be no number any more; millimetres per second still pass.
FASTEST = 1e5
# Static transforms and descriptions are few; a recording that repeats them needs no more than the first.
MOST_STATIC = 200
# Of an IMU: quaternion, angular velocity and acceleration.
_IMU_NUMBERS, _TWIST_NUMBERS = 10, 6


@dataclass(frozen=True)
class Look:
    """Some messages of one topic, N of them.

    count: messages in the recording. rate_hz: over the whole of it, 0 if that is an instant. frame_id: of the velocity
    or of the IMU's data, the first. stamps_s: (N,) s since the first log time of the recordings, of the header; of the
    log where it is zero. ahead_s: by how much they are ahead of the log, in the median. values: velocity (N, 3) m/s, as
    in the message; of an IMU (N, 10): quaternion x y z w, angular velocity rad/s and acceleration m/s², nan where not
    given. rates: angular velocity (N, 3) rad/s of a twist, in the axes of its velocity; zero where it has none. world:
    frame_id of the header, which of an odometry is that of its pose.
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

    @property
    def speed(self) -> float:
        """Root mean square of the velocity, m/s; 0 without samples."""
        return float(np.sqrt((self.values**2).sum(axis=1).mean())) if len(self.values) else 0.0

    @property
    def has_orientation(self) -> bool:
        """Whether an IMU gives an orientation: most quaternions are of unit length, and they are not all the same."""
        q = self.values[:, :4]
        if len(q) < 2 or np.isnan(q).any(axis=1).mean() > 0.5:
            return False
        given = q[~np.isnan(q).any(axis=1)]
        unit = np.abs(np.linalg.norm(given, axis=1) - 1.0) < 0.01
        return bool(unit.mean() > 0.5 and np.ptp(given, axis=0).max() > 0.0)


@dataclass(frozen=True)
class Survey:
    """What was seen. looks: by topic. transforms: messages of tf_static; descriptions: of robot_description."""

    topics: Mapping[str, str]
    counts: Mapping[str, int]
    looks: Mapping[str, Look]
    transforms: tuple[Any, ...]
    descriptions: tuple[str, ...]


def survey(bag: BagReader) -> Survey:
    """Look at recordings that are open."""
    types, counts = bag.topics, bag.message_counts
    moving = {topic for topic, kind in types.items() if kind in VELOCITY_TYPES or kind == IMU_TYPE}
    static = {topic for topic, kind in types.items() if _is_static(topic, kind)}
    start_ns = bag.span_ns[0] if types else 0
    spans_ns = bag.recorded_spans_ns if types else [(0, 0)]
    seconds = 1e-9 * sum(end - start for start, end in spans_ns)
    one_by_one = {topic for topic, kind in types.items() if kind != IMU_TYPE and not _is_read_in_columns(kind)}
    taken: dict[str, list[Part]] = {topic: [] for topic in moving}
    transforms: list[Any] = []
    descriptions: list[str] = []
    for window in windows(bag, moving | static, one_by_one, _Bursts(spans_ns, static)):
        for part in window.parts:
            topic = part.channel.topic
            if topic in moving:
                taken[topic].append(part)
                continue
            for message, _ in part.messages():
                if message is None:
                    continue
                if types[topic] == TF_TYPE:
                    transforms += list(message.transforms)
                else:
                    descriptions.append(message.data)
    looks = {}
    for topic, parts in taken.items():
        look = _look(topic, types[topic], counts[topic], counts[topic] / seconds if seconds else 0.0, start_ns, parts)
        if look is not None:
            looks[topic] = look
    return Survey(types, counts, looks, tuple(transforms), tuple(dict.fromkeys(descriptions)))


def _is_read_in_columns(kind: str) -> bool:
    return kind in VELOCITY_TYPES and VELOCITY_TYPES[kind].is_read_in_columns


def _is_static(topic: str, kind: str) -> bool:
    name = topic.rsplit("/", 1)[-1]
    return (kind == TF_TYPE and name == "tf_static") or (kind == STRING_TYPE and name == "robot_description")


class _Bursts:
    """Whether a message is one to look at."""

    def __init__(self, spans_ns: Sequence[tuple[int, int]], static: set[str]) -> None:
        """spans_ns: from and to when was recorded, in order."""
        self._starts_ns = [start_ns for start_ns, _ in spans_ns]
        lengths_ns = [end_ns - start_ns for start_ns, end_ns in spans_ns]
        self._recorded_before_ns = [0, *accumulate(lengths_ns)]
        self._period_ns = max(self._recorded_before_ns[-1] // BURSTS, BURST_NS)
        self._static = dict.fromkeys(static, 0)
        self._next_ns: dict[str, int] = {}

    def __call__(self, topic: str, log_ns: int) -> bool:
        if topic in self._static:
            self._static[topic] += 1
            return self._static[topic] <= MOST_STATIC
        if log_ns < self._next_ns.get(topic, 0):
            return False
        span = max(bisect_right(self._starts_ns, log_ns) - 1, 0)
        recorded_ns = log_ns - self._starts_ns[span] + self._recorded_before_ns[span]
        since_ns = recorded_ns % self._period_ns
        is_wanted = since_ns < BURST_NS
        self._next_ns[topic] = log_ns + (BURST_EVERY_NS if is_wanted else self._period_ns - since_ns)
        return is_wanted


def _look(topic: str, msgtype: str, count: int, rate_hz: float, start_ns: int, parts: list[Part]) -> Look | None:
    """None for a topic whose messages cannot be read."""
    rows = []
    singly: list[_Message] = []
    for part in parts:
        try:
            rows.append(_rows_of_columns(part, msgtype))
        except UNREADABLE:
            places = zip(part.arrival.tolist(), part.log_ns.tolist(), part.messages(), strict=True)
            singly += [(arrival, log_ns, message) for arrival, log_ns, (message, _) in places if message is not None]
    singly.sort(key=itemgetter(0))
    if msgtype in VELOCITY_TYPES and VELOCITY_TYPES[msgtype].is_position:
        singly = _differences(singly)
    for each in singly:
        with suppress(*UNREADABLE):
            rows.append(_row_of_message(*each, msgtype))
    if not rows:
        return None
    arrival, log_ns, stamps_ns, values = (np.concatenate(column) for column in list(zip(*rows, strict=True))[:4])
    names = sorted((int(each.arrival[0]), each.frame_id) for each in rows if each.frame_id)
    if msgtype == IMU_TYPE:
        for number, at in enumerate((slice(0, 4), slice(4, 7), slice(7, 10))):
            values[values[:, _IMU_NUMBERS + number] == NO_DATA, at] = np.nan
        values = values[:, :_IMU_NUMBERS]
    rates = values[:, 3:] if values.shape[1] == _TWIST_NUMBERS else None
    if msgtype != IMU_TYPE:
        values = values[:, :3].copy()
        values[(values == 0.0).all(axis=1)] = np.nan  # what drivers send for want of a measurement
    values[~(np.abs(values) < FASTEST)] = np.nan  # so that their squares are numbers
    whole = (np.abs(values) < FASTEST).all(axis=1) if msgtype != IMU_TYPE else np.ones(len(values), dtype=bool)
    order = np.lexsort((arrival, stamps_ns))
    order = order[whole[order]]
    frame_id = names[0][1] if names else ""
    stamps_s, ahead_s = 1e-9 * (stamps_ns[order] - start_ns), 1e-9 * float(median(stamps_ns - log_ns))
    turning = None if rates is None else rates[order]
    return Look(topic, msgtype, count, rate_hz, frame_id, stamps_s, ahead_s, values[order], turning, rows[0].world)


_Message = tuple[int, int, Any]
"""Place among all that are read, log time (ns), message."""


class _Rows(NamedTuple):
    """N messages. arrival: (N,) their places. log_ns, stamps_ns: (N,). numbers: (N, k). frame_id: of the first; world:
    the header's.
    """

    arrival: Stamps
    log_ns: Stamps
    stamps_ns: Stamps
    numbers: Array
    frame_id: str
    world: str


def _rows_of_columns(part: Part, msgtype: str) -> _Rows:
    """Raises what is `UNREADABLE`."""
    columns = part.columns
    if columns is None:
        raise ValueError("not laid out alike")
    stamps_ns = columns.header.stamp.sec.astype(np.int64) * 1_000_000_000 + columns.header.stamp.nanosec
    name, world = (each[0].tobytes().decode("ascii") for each in (_frame_id(msgtype, columns), columns.header.frame_id))
    numbers = np.column_stack(_numbers(msgtype, columns)).astype(float)
    return _Rows(part.arrival, part.log_ns, np.where(stamps_ns == 0, part.log_ns, stamps_ns), numbers, name, world)


def _row_of_message(arrival: int, log_ns: int, message: Any, msgtype: str) -> _Rows:
    """Raises what is `UNREADABLE`."""
    numbers = np.array([_numbers(msgtype, message)], dtype=float)
    stamp = stamp_ns(message.header.stamp) or log_ns
    place, logged, stamped = np.array([[arrival], [log_ns], [stamp]])
    return _Rows(place, logged, stamped, numbers, str(_frame_id(msgtype, message)), str(message.header.frame_id))


def _differences(messages: list[_Message]) -> list[_Message]:
    """Satellite positions as the velocities between them, at the middle of each window."""
    difference = FixDifference()
    found = []
    for arrival, log_ns, message in messages:
        stamp = stamp_ns(message.header.stamp) or log_ns
        fixed = difference(stamp, message.latitude, message.longitude, message.altitude, None)
        if fixed is not None and message.status.status >= 0:
            velocity = SimpleNamespace(**dict(zip("xyz", fixed.velocity, strict=True)))
            seconds, nanoseconds = divmod(fixed.stamp_ns, 1_000_000_000)
            header = SimpleNamespace(
                stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=message.header.frame_id
            )
            found.append((arrival, log_ns, SimpleNamespace(velocity=velocity, header=header)))
    return found


def _frame_id(msgtype: str, message: Any) -> Any:
    kind = VELOCITY_TYPES.get(msgtype)
    return message.header.frame_id if kind is None else kind.frame_id(message)


def _numbers(msgtype: str, message: Any) -> list[Any]:
    """Of a message, or of columns: a velocity; of an IMU all that `Look` says, then what says whether it is given."""
    if msgtype == IMU_TYPE:
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        given = (
            message.orientation_covariance,
            message.angular_velocity_covariance,
            message.linear_acceleration_covariance,
        )
        return [q.x, q.y, q.z, q.w, w.x, w.y, w.z, a.x, a.y, a.z, *(each[..., 0] for each in given)]
    kind = VELOCITY_TYPES[msgtype]
    v = message.velocity if kind.is_position else kind.velocity(message)
    twist = getattr(message, "twist", None)
    if twist is None:
        return [v.x, v.y, v.z]
    turn = getattr(twist, "twist", twist).angular
    return [v.x, v.y, v.z, turn.x, turn.y, turn.z]


def comparable(a: Look, at_s: Array, longest_gap_s: float = 1.5) -> tuple[Array, Mask]:
    """Columns of a look at other times: (M, k) and whether they lie between two samples that are close (M,)."""
    n = len(a.stamps_s)
    if n < 2:
        return np.full((len(at_s), a.values.shape[1]), np.nan), np.zeros(len(at_s), dtype=bool)
    after = np.clip(np.searchsorted(a.stamps_s, at_s), 1, n - 1)
    t0, t1 = a.stamps_s[after - 1], a.stamps_s[after]
    near = (t1 - t0 <= longest_gap_s) & (at_s >= t0) & (at_s <= t1) & (t1 > t0)
    share = np.divide(at_s - t0, t1 - t0, out=np.zeros(len(at_s)), where=t1 > t0)[:, None]
    before, later = a.values[after - 1], a.values[after].copy()
    if a.msgtype == IMU_TYPE:  # the shorter way round; samples are close, so that a straight line will do
        other_way = (before[:, :4] * later[:, :4]).sum(axis=1) < 0.0
        later[other_way, :4] *= -1.0
    values = before + share * (later - before)
    if a.msgtype == IMU_TYPE:
        with np.errstate(divide="ignore", invalid="ignore"):  # an orientation of zeros is none, and becomes nan
            values[:, :4] /= np.linalg.norm(values[:, :4], axis=1, keepdims=True)
    return values, near
