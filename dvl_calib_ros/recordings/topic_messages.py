"""Messages of a topic, unfiltered and in their own axes: all, or a preview to choose topics and to find frames.

The messages of a preview come in bursts spread over the recording. So a preview of hours costs no more than one of
minutes, and the streams have samples at the same times, which can be compared.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import median
from ..calibration.numerics.samples import Codes, Index, Stamps
from ..calibration.streams.screening import NOT_MEASURED_VARIANCE, screen_columns
from ..messages.drivers import IMU_TYPE, VELOCITY_TYPES
from ..messages.positions import SELDOM_S, FixDifference
from .columns import ODOMETRY, TopicColumns, differenced, joined

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
    position = VELOCITY_TYPES[msgtype].position if msgtype in VELOCITY_TYPES else None
    seconds = 1e-9 * sum(end - start for start, end in spans_ns)
    every_s = seconds / count if count else 0.0
    is_seldom = every_s > SELDOM_S and position is not None
    chosen = np.zeros(0, dtype=np.int64) if whole or is_seldom else in_bursts(parts, spans_ns)
    if not len(chosen):  # bursts may miss all messages if one wrong log time makes the recording long
        chosen = np.sort(np.concatenate([part.arrival for part in parts]))
        if position is None:  # positions are kept, because velocities are differences of successive ones
            chosen = chosen[:: -(-len(chosen) // MOST) or 1]
    rows = joined([part.part(_places(part.arrival, chosen)) for part in parts]).readable
    if position is not None:
        rows = differenced(rows, FixDifference(every_s if is_seldom else 1.0, position.between))
        rows = rows.part(rows.broken == 0)
    if not len(rows):
        return None
    log_ns, stamps_ns, values, extra = rows.log_ns, rows.stamped_ns, rows.values, rows.extra
    is_plausible = np.ones(len(rows), dtype=bool)
    if msgtype != IMU_TYPE:
        values[(values == 0.0).all(axis=1)] = np.nan  # sent by drivers without a measurement
        is_plausible &= (np.abs(values) < FASTEST).all(axis=1)
    for numbers in (values, extra[:, :3]):
        numbers[~(np.abs(numbers) < FASTEST)] = np.nan  # so that squares are finite
    kept = np.lexsort((rows.arrival, stamps_ns))
    kept = kept[is_plausible[kept]]
    clock_rate = _clock_rate(stamps_ns, log_ns)
    ahead_s = 1e-9 * float(median(stamps_ns - start_ns - clock_rate * (log_ns - start_ns)))
    rates, pose = extra[kept, :3], extra[kept, 3:] if msgtype == ODOMETRY else None
    if msgtype == IMU_TYPE:
        values, rates = np.hstack([values, extra]), np.full((0, 3), np.nan)
    return Preview(
        topic, msgtype, count, count / (seconds * clock_rate) if seconds else 0.0, _first_frame(rows),
        1e-9 * (stamps_ns[kept] - start_ns), ahead_s, values[kept], rates=None if np.isnan(rates).all() else rates,
        world=rows.world, claimed_std=_claimed_std(rows, position is not None), clock_rate=clock_rate, pose=pose,
    )  # fmt: skip


def _first_frame(rows: TopicColumns) -> str:
    """Return the frame of the first message that has one."""
    is_named = np.array([bool(frame) for frame in rows.frames], dtype=bool)[rows.frame]
    return rows.frames[rows.frame[np.argmax(is_named)]] if is_named.any() else ""


def _claimed_std(rows: TopicColumns, is_position: bool) -> float:
    """Return the median claimed noise per axis, m/s, or of an IMU's heading, rad; nan if none is claimed."""
    if rows.msgtype == IMU_TYPE:
        claimed = np.array([rows.heading_variance])
    else:  # positions without height have a huge vertical variance
        claimed = np.median(rows.diagonals, axis=1) if is_position else rows.variances.mean(axis=1)
    claimed = claimed[np.isfinite(claimed) & (claimed > 0.0)]
    measured = claimed[claimed < NOT_MEASURED_VARIANCE]
    claimed = measured if len(measured) else claimed
    return math.sqrt(float(median(claimed))) if len(claimed) else math.nan


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
    arrival = np.concatenate([part.arrival for part in parts])
    log_ns = np.concatenate([part.log_ns for part in parts])
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


def recorded(parts: Sequence[TopicColumns], parameters: Parameters) -> Recorded:
    """Return all messages of a topic, of which each recording has a part."""
    rows = joined(parts)
    unread, rows = rows.unread_reasons, rows.readable
    kind = VELOCITY_TYPES.get(rows.msgtype)
    rules = () if kind is None else kind.rules
    counts = np.bincount(rows.broken, minlength=1 + len(rules))[1:].tolist()  # 0: no rule is broken
    refused = {rule.counter: count for rule, count in zip(rules, counts, strict=True) if count}
    window_s = 0.0
    if kind is not None and kind.position is not None:
        window_s = _window_s(rows.log_ns, parameters)
        velocities = differenced(rows, FixDifference(window_s, kind.position.between))
        # log time of the middle of the window, as for a measurement at that time
        rows = replace(velocities, log_ns=rows.log_ns - (rows.stamped_ns - velocities.stamps_ns))
        rows = rows.part(rows.broken == 0)
    claimed = NOTHING if kind is None else (rows.variances, screen_columns(rows.covariances).unmeasured)
    variances, unmeasured = claimed
    return Recorded(
        rows.topic, rows.msgtype, rows.stamps_ns, rows.log_ns, _plausible(rows.values[:, :4], FASTEST),
        _plausible(variances, FASTEST**2), unmeasured, refused, len(unread), window_s, unread[0] if unread else "",
    )  # fmt: skip


def _plausible(values: Array, most: float) -> Array:
    """Replace implausibly large values by nan."""
    if not len(values) or (values.max() < most and values.min() > -most):
        return values
    return np.where(np.abs(values) < most, values, np.nan)


def _window_s(log_ns: Stamps, parameters: Parameters) -> float:
    """Return the time over which positions are differenced."""
    every_s = 1e-9 * float(np.median(np.diff(log_ns))) if len(log_ns) > 1 else 0.0
    return every_s if every_s > SELDOM_S else parameters.position_window
