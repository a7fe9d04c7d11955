"""Storage of a topic's messages as columns.

Values and stamps are stored unchanged, because frames and parameters are known only later.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..bags.columns import MessageColumns, Part
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Codes, Covariances, Index, Mask, Stamps
from ..messages.decode import NO_DATA, UNREADABLE, VelocityReader, frame_name, heading_variance, stamp_ns
from ..messages.drivers import IMU_TYPE, POSE_TYPES, VELOCITY_TYPES, VelocityType, pose_of
from ..messages.positions import FixDifference

ODOMETRY = "nav_msgs/msg/Odometry"


@dataclass(frozen=True)
class TopicColumns:
    """N messages of a topic in one recording, in order of arrival.

    arrival: (N,) positions among all messages read.
    log_ns: (N,).
    stamps_ns: (N,) of the header, 0 if missing.
    values: (N, 3) velocity, m/s, in the message's axes, or the position of a type of positions; of an IMU (N, 7)
      quaternion (x, y, z, w) and angular velocity, rad/s, nan if missing.
    frame: (N,) indices into frames, the frame_ids; of a message that cannot be read -1 minus an index into unread, the
      reasons.
    covariance: (N,) indices into distinct (C, 3, 3), (m/s)² or m², -1 if missing.
    broken: (N,) 1 + index of the first violated rule of the message type, 0 if none.
    extra: (N, 3) acceleration, m/s², of an IMU; else as `extra_values`.
    world: frame_id of the first message's header, which is the pose's frame for an odometry.
    heading_variance: of an IMU's orientation about z, rad², of the first message; nan if missing.
    """

    topic: str
    msgtype: str
    arrival: Stamps
    log_ns: Stamps
    stamps_ns: Stamps
    values: Array
    frame: NDArray[np.int32]
    covariance: NDArray[np.int32]
    broken: Codes
    extra: Array
    world: str = ""
    heading_variance: float = math.nan
    frames: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    distinct: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.arrival)

    def part(self, at: slice | Index | Mask) -> TopicColumns:
        """Return the rows of a slice, of indices or of a mask."""
        return replace(self, **{name: getattr(self, name)[at] for name in _DTYPES})

    @property
    def readable(self) -> TopicColumns:
        """Messages that could be read."""
        return self.part(self.frame >= 0) if self.unread else self

    @property
    def unread_reasons(self) -> list[str]:
        """Reasons why messages could not be read, one per message, in order."""
        return [self.unread[-1 - place] for place in self.frame[self.frame < 0].tolist()] if self.unread else []

    @property
    def stamped_ns(self) -> Stamps:
        """Stamps (N,), the log time if missing."""
        return self.stamps_ns if self.stamps_ns.all() else np.where(self.stamps_ns == 0, self.log_ns, self.stamps_ns)

    @property
    def covariances(self) -> Covariances:
        """Covariances of these rows, restricted to the distinct ones in use."""
        given = self.covariance[self.covariance >= 0]
        if not len(given):
            return Covariances.none(len(self))
        first, last = int(given.min()), int(given.max())
        index = np.where(self.covariance < 0, -1, self.covariance - first).astype(np.intp)
        return Covariances(self.distinct[first : last + 1], index)

    @property
    def diagonals(self) -> Array:
        """Diagonals (N, 3) of the covariances, nan if missing."""
        diagonals = np.full((len(self), 3), np.nan)
        given = self.covariance >= 0
        diagonals[given] = np.diagonal(self.distinct, axis1=1, axis2=2)[self.covariance[given]]
        return diagonals

    @property
    def variances(self) -> Array:
        """Variances (N, 3) (m/s)², nan if missing or if one of them is not a valid variance."""
        variances = self.diagonals
        variances[(variances <= 0.0).any(axis=1)] = np.nan
        return variances


_DTYPES: Mapping[str, Any] = {
    "arrival": np.int64, "log_ns": np.int64, "stamps_ns": np.int64, "values": np.float64, "frame": np.int32,
    "covariance": np.int32, "broken": np.uint8, "extra": np.float64,
}  # fmt: skip


def joined(parts: Sequence[TopicColumns]) -> TopicColumns:
    """Return the messages of a topic in several recordings, in order of arrival."""
    if len(parts) == 1:
        return parts[0]
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _DTYPES}
    frames = np.cumsum([0, *(len(part.frames) for part in parts)]).tolist()
    unread = np.cumsum([0, *(len(part.unread) for part in parts)]).tolist()
    columns["frame"] = np.concatenate(
        [
            np.where(part.frame < 0, part.frame - n_unread, part.frame + n_frames)
            for part, n_frames, n_unread in zip(parts, frames, unread, strict=False)
        ]
    )
    covariances = parts[0].covariances.joined(*(part.covariances for part in parts[1:]))
    whole = replace(
        parts[0], **columns | {"covariance": covariances.index}, distinct=covariances.distinct,
        world=next((part.world for part in parts if part.world), ""),
        heading_variance=next((part.heading_variance for part in parts if part.heading_variance > 0.0), math.nan),
        frames=tuple(name for part in parts for name in part.frames),
        unread=tuple(reason for part in parts for reason in part.unread),
    )  # fmt: skip
    return whole.part(np.argsort(whole.arrival, kind="stable"))


def differenced(positions: TopicColumns, difference: FixDifference) -> TopicColumns:
    """Return valid positions as velocities between them, at the middle of their windows.

    A valid position that ends no window counts as breaking one more rule than its type has.
    """
    rows = zip(
        positions.stamped_ns.tolist(), *positions.values.T.tolist(), positions.covariances.matrices,
        positions.broken.tolist(), strict=True,
    )  # fmt: skip
    found = [None if broken else difference(*fix) for *fix, broken in rows]
    known = np.array([fixed is not None for fixed in found], dtype=bool)
    fixes = [fixed for fixed in found if fixed is not None]
    covariances = Covariances.of_matrices([None if fixed is None else fixed.covariance for fixed in found])
    stamps_ns, values = positions.stamped_ns.copy(), np.full((len(positions), 3), np.nan)
    stamps_ns[known] = [fixed.stamp_ns for fixed in fixes]
    values[known] = np.array([fixed.velocity for fixed in fixes]).reshape(-1, 3)
    first = np.uint8(1 + len(VELOCITY_TYPES[positions.msgtype].rules))
    return replace(
        positions, stamps_ns=stamps_ns, values=values, extra=np.full_like(values, np.nan),
        broken=np.where(known | (positions.broken > 0), positions.broken, first),
        covariance=covariances.index.astype(np.int32), distinct=covariances.distinct,
    )  # fmt: skip


Row = tuple[np.int64, Array, int, Array | None, int, Array]
"""Stamp, values, frame, covariance, code of the broken rule and additional values of a message."""


def is_kept(msgtype: str) -> bool:
    """Return whether messages of this type may be a DVL's, a reference or an IMU's."""
    return msgtype == IMU_TYPE or msgtype in VELOCITY_TYPES


class Collector:
    """Collector of a topic's messages. expected: number of messages. parameters: for the type's validity rules."""

    def __init__(self, topic: str, msgtype: str, expected: int, parameters: Parameters) -> None:
        """Reserve the columns. expected: number of messages. parameters: for the validity rules of the message type."""
        self._topic, self._msgtype, self._parameters = topic, msgtype, parameters
        self._kind = VELOCITY_TYPES.get(msgtype)
        self._velocity = None if self._kind is None else VelocityReader(self._kind)
        shapes = {"values": (7 if self._kind is None else 3,), "extra": (extra_width(msgtype),)}
        self._columns = {name: GrowingRows(dtype, shapes.get(name, ()), expected) for name, dtype in _DTYPES.items()}
        self._nothing = np.full(shapes["values"], np.nan), np.full(shapes["extra"], np.nan)
        self._world = ""
        self._heading_variance = math.nan
        self._frames: dict[str, int] = {}
        self._unread: dict[str, int] = {}
        self._distinct: list[Array] = []
        self._n_distinct = 0

    def take(self, part: Part) -> None:
        """Add the next messages of one channel."""
        try:
            self._take_columns(part)
        # no fixed layout, or a definition with other fields: individual decoding reports the missing field
        except UNREADABLE:
            self._take_singly(part)

    def _take_columns(self, part: Part) -> None:
        """Store a part's columns. Raises ValueError, storing nothing, if its messages have no common layout."""
        columns = part.columns
        if columns is None:
            raise ValueError("not laid out alike")
        kind = self._kind
        frame_ids = columns.header.frame_id if kind is None else kind.frame_id(columns)
        stamp = columns.header.stamp
        stamps_ns = stamp.sec.astype(np.int64) * 1_000_000_000 + stamp.nanosec
        n = len(part)
        covariances, broken = Covariances.none(n), np.zeros(n, dtype=np.uint8)
        if kind is None:
            values, extra = _imu(columns)
        else:
            values, extra = _columns_of(kind.velocity(columns)), extra_values(columns, self._msgtype)
            extra = np.broadcast_to(extra, (n, extra.shape[1]))
            covariances = _covariances(kind, columns)
            broken = _broken(kind, columns, self._parameters)
        world = columns.header.frame_id[0].tobytes().decode("ascii")
        # nothing is stored before everything is known to be readable
        self._note_first(world, None if kind else columns.orientation_covariance[0])
        self._store(part, stamps_ns, values, self._frames_of(frame_ids), covariances, broken, extra)

    def _store(
        self, part: Part, stamps_ns: Any, values: Any, frame: Any, covariances: Covariances, broken: Any, extra: Any
    ) -> None:
        """Store the columns of a part."""
        index = np.where(covariances.index < 0, -1, covariances.index + self._n_distinct)
        if len(covariances.distinct):
            self._distinct.append(covariances.distinct)
            self._n_distinct += len(covariances.distinct)
        rows = (part.arrival, part.log_ns, stamps_ns, values, frame, index, broken, extra)
        for column, each in zip(self._columns.values(), rows, strict=True):
            column.add(each)

    def _note_first(self, world: str, orientation_covariance: Any) -> None:
        """Keep the frame_id of the first header and an IMU's first heading variance."""
        self._world = self._world or frame_name(world)
        if self._kind is None and math.isnan(self._heading_variance):
            self._heading_variance = heading_variance(orientation_covariance)

    def _frames_of(self, frame_ids: Any) -> Index:
        """Return the frame's index of each row of (N, length) ASCII."""
        n = len(frame_ids)
        if not frame_ids.shape[1] or (frame_ids == frame_ids[0]).all():
            return np.full(n, self._frame(frame_ids[0].tobytes().decode("ascii")))
        return np.array([self._frame(row.tobytes().decode("ascii")) for row in frame_ids])

    def _frame(self, name: str) -> int:
        return self._frames.setdefault(frame_name(name), len(self._frames))

    def _take_singly(self, part: Part) -> None:
        """Store messages that have no common layout, decoded individually."""
        rows = [self._row(message, why) for message, why in part.messages()]
        stamps_ns, values, frame, matrices, broken, extra = zip(*rows, strict=True)
        self._store(part, stamps_ns, values, frame, Covariances.of_matrices(matrices), broken, extra)

    def _row(self, message: Any, why: str) -> Row:
        """Return the row of a message. message: None if it cannot be decoded. why: the reason."""
        if message is not None:
            try:
                return self._read(message)
            except UNREADABLE as error:
                why = f"{self._msgtype}, {type(error).__name__}: {error}"
        values, extra = self._nothing
        return np.int64(0), values, -1 - self._unread.setdefault(why, len(self._unread)), None, 0, extra

    def _read(self, message: Any) -> Row:
        """Return the row of a message. Raises `UNREADABLE`."""
        kind = self._kind
        if kind is None or self._velocity is None:
            frame_id, matrix, broken = message.header.frame_id, None, 0
            (values,), (extra,) = _imu(message)
        else:
            message = message if kind.adapted is None else kind.adapted(message)
            frame_id = kind.frame_id(message)
            broken = kind.broken_rule(message, self._parameters)
            vector, matrix = self._velocity(message)
            values, (extra,) = np.array(vector, dtype=float), extra_values(message, self._msgtype)
        # a stamp beyond 64 bits cannot be read
        row = np.int64(stamp_ns(message.header.stamp)), values, self._frame(frame_id), matrix, broken, extra
        self._note_first(message.header.frame_id, None if kind else message.orientation_covariance)
        return row

    def columns(self) -> TopicColumns:
        """Return all collected messages, in order of arrival."""
        columns = TopicColumns(
            self._topic,
            self._msgtype,
            **{name: column.array() for name, column in self._columns.items()},
            world=self._world,
            heading_variance=self._heading_variance,
            frames=tuple(self._frames),
            unread=tuple(self._unread),
            distinct=np.concatenate([np.zeros((0, 3, 3)), *self._distinct]),
        )
        if (columns.arrival[1:] < columns.arrival[:-1]).any():  # several layouts alternated
            columns = columns.part(np.argsort(columns.arrival, kind="stable"))
        return columns


def _columns_of(vector: Any) -> Array:
    """Stack x, y, z as (N, 3)."""
    return np.column_stack([vector.x, vector.y, vector.z]).astype(float, copy=False)


def extra_width(msgtype: str) -> int:
    """Return the number of additional values per velocity or IMU message."""
    return 10 if msgtype == ODOMETRY else 4 if msgtype in POSE_TYPES else 3


def extra_values(message: Any, msgtype: str) -> Array:
    """Return the angular velocity of a twist (rad/s), the pose of an odometry, or the orientation of a pose.

    Returns
    -------
    (N, 3) of columns or (1, 3) of a message; of an odometry (N, 10) with its position (m) and its quaternion (x, y, z,
    w); of a pose (N, 4) its quaternion. nan if a type has none.
    """
    if msgtype in POSE_TYPES:
        return _quaternions(pose_of(message).orientation)
    twist = getattr(message, "twist", None)
    if twist is None:
        return np.full((1, extra_width(msgtype)), np.nan)
    rates = _columns_of(getattr(twist, "twist", twist).angular)
    if msgtype != ODOMETRY:
        return rates
    pose = message.pose.pose
    return np.hstack([rates, _columns_of(pose.position), _quaternions(pose.orientation)])


def _quaternions(q: Any) -> Array:
    """Stack x, y, z, w as (N, 4)."""
    return np.column_stack([q.x, q.y, q.z, q.w]).astype(float, copy=False)


def _imu(message: Any) -> tuple[Array, Array]:
    """Return quaternion and angular velocity (N, 7), and acceleration (N, 3); nan if missing."""
    values = np.hstack([_quaternions(message.orientation), _columns_of(message.angular_velocity)])
    acceleration = _columns_of(message.linear_acceleration)
    for part, covariance in (
        (values[:, :4], message.orientation_covariance),
        (values[:, 4:], message.angular_velocity_covariance),
        (acceleration, message.linear_acceleration_covariance),
    ):
        part[np.atleast_1d(covariance[..., 0] == NO_DATA)] = np.nan
    return values, acceleration


def _covariances(kind: VelocityType, columns: MessageColumns) -> Covariances:
    """Return the velocity covariances of messages, -1 as index where missing. Raises ValueError."""
    given, n = kind.covariance(columns), len(columns)
    if given is None:
        return Covariances.none(n)
    size = {9: 3, 36: 6}.get(given.shape[1])
    if size is None:
        raise ValueError(f"a covariance of {given.shape[1]} numbers")
    covariances = Covariances.of(given.reshape(n, size, size)[:, :3, :3], n)
    lacks = kind.lacks_covariance(columns)
    return Covariances(covariances.distinct, np.where(lacks, -1, covariances.index).astype(np.intp))


def _broken(kind: VelocityType, columns: MessageColumns, parameters: Parameters) -> Codes:
    """Return (N,) the number of the first rule that each message breaks, 0 for none."""
    broken = np.zeros(len(columns), dtype=np.uint8)
    for code, rule in enumerate(kind.rules, start=1):
        broken[np.asarray(rule.broken(columns, parameters)) & (broken == 0)] = code
    return broken


# a larger column (bytes) is kept on disk; only extraordinary recordings have one
IN_MEMORY = 128 << 20


class GrowingRows:
    """Growing array of rows with one shape and type."""

    def __init__(self, dtype: Any, shape: tuple[int, ...] = (), expected: int = 0) -> None:
        """Set up. shape: of a row. expected: number of rows, if known; more are accepted."""
        self._file: BinaryIO | None = None
        row = np.dtype(dtype).itemsize * max(1, math.prod(shape))
        self._rows = np.empty((max(1, min(expected, IN_MEMORY // row)), *shape), dtype)
        self._n = 0

    def add(self, rows: Any) -> None:
        """Append rows (N, ...)."""
        if self._n + len(rows) > len(self._rows):
            if self._rows.nbytes >= IN_MEMORY:
                self._spill()
            # resized in place, which avoids a second copy
            wanted = max(self._n + len(rows), 2 * self._n)
            self._rows.resize((max(wanted, len(self._rows)), *self._rows.shape[1:]), refcheck=False)
        self._rows[self._n : self._n + len(rows)] = rows
        self._n += len(rows)

    def _spill(self) -> None:
        """Move the rows in memory to a temporary file."""
        if self._file is None:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115  # until its rows are mapped
        self._file.write(self._rows[: self._n].tobytes())
        self._n = 0

    def array(self) -> NDArray[Any]:
        """Return all rows. This can be called once."""
        if self._file is None:
            self._rows.resize((self._n, *self._rows.shape[1:]), refcheck=False)
            return self._rows
        self._spill()
        self._file.flush()
        rows = np.asarray(np.memmap(self._file, dtype=self._rows.dtype, mode="r"))
        self._file.close()  # the memory map keeps the file
        return rows.reshape(-1, *self._rows.shape[1:])
