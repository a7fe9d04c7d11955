"""Storage of a topic's messages: columns if the layout is fixed, else bytes.

Values and stamps are stored unchanged, because frames and parameters are known only later.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..bags.channels import Channel, Decoder, DecodingError
from ..bags.columns import MessageColumns, Part
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Codes, Covariances, Index, Mask, Stamps
from ..messages.decode import NO_DATA, UNREADABLE, frame_name, heading_variance, stamp_ns
from ..messages.drivers import IMU_TYPE, VELOCITY_TYPES, VelocityType

ODOMETRY = "nav_msgs/msg/Odometry"


@dataclass(frozen=True)
class DecodedRows:
    """N messages of a fixed layout, decoded together, in order of arrival.

    arrival: (N,) positions among all messages read.
    log_ns: (N,).
    stamps_ns: (N,) of the header, 0 if missing.
    values: (N, 3) velocity, m/s, in the message's axes; of an IMU (N, 7) quaternion (x, y, z, w) and angular velocity,
      rad/s, nan if missing.
    frame: (N,) indices into frames, the frame_ids.
    covariance: (N,) indices into distinct (C, 3, 3), (m/s)², -1 if missing.
    broken: (N,) 1 + index of the first violated rule of the message type, 0 if none.
    extra: (N, 3) acceleration, m/s², of an IMU; else as `extra_values`.
    world: frame_id of the first message's header, which is the pose's frame for an odometry.
    heading_variance: of an IMU's orientation about z, rad², of the first message; nan if missing.
    """

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
    distinct: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.arrival)

    def part(self, at: slice | Index) -> DecodedRows:
        """Return the rows of a slice or of indices."""
        return replace(self, **{name: getattr(self, name)[at] for name in _DTYPES})

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
    def variances(self) -> Array:
        """Variances (N, 3) (m/s)², nan if missing or if one of them is not a valid variance."""
        variances = np.full((len(self), 3), np.nan)
        given = self.covariance >= 0
        if given.any():
            variances[given] = np.diagonal(self.distinct, axis1=1, axis2=2)[self.covariance[given]]
            variances[(variances <= 0.0).any(axis=1)] = np.nan
        return variances


_DTYPES: Mapping[str, Any] = {
    "arrival": np.int64, "log_ns": np.int64, "stamps_ns": np.int64, "values": np.float64, "frame": np.int32,
    "covariance": np.int32, "broken": np.uint8, "extra": np.float64,
}  # fmt: skip


# bytes up to the end of a header's stamp: encoding, seconds and nanoseconds
STAMP_END = 12


@dataclass(frozen=True)
class Singles:
    """M messages that are decoded individually, in order of arrival.

    arrival, log_ns: (M,).
    channel: (M,) indices into channels.
    end: (M,) end of each message in content, which is bytes.
    is_restamped: whether log times replace the stamps.
    """

    arrival: Stamps
    log_ns: Stamps
    channel: NDArray[np.int32]
    end: Stamps
    content: Codes
    channels: tuple[Channel, ...]
    decoder: Decoder
    is_restamped: bool = False

    def __len__(self) -> int:
        return len(self.arrival)

    def messages(self, at: slice | Index = slice(None)) -> Iterator[tuple[int, int, Any, str]]:
        """Yield arrival, log time (ns), message (None if it cannot be decoded) and the reason for None."""
        places = np.arange(len(self))[at]
        starts = np.where(places > 0, self.end[places - 1], 0) if len(places) else places
        rows = zip(
            self.arrival[places].tolist(), self.log_ns[places].tolist(), self.channel[places].tolist(),
            starts.tolist(), self.end[places].tolist(), strict=True,
        )  # fmt: skip
        for arrival, log_ns, channel, start, end in rows:
            kind = VELOCITY_TYPES.get(self.channels[channel].msgtype)
            try:
                message = self.decoder(self.channels[channel], self.content[start:end].tobytes())
                message = message if kind is None or kind.adapted is None else kind.adapted(message)
                if self.is_restamped:
                    seconds, nanoseconds = divmod(log_ns, 1_000_000_000)
                    message.header.stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
                yield arrival, log_ns, message, ""
            except DecodingError as error:
                yield arrival, log_ns, None, str(error)

    def part(self, at: Index) -> Singles:
        """Return the rows of indices."""
        starts = np.concatenate([[0], self.end[:-1]])[at]
        lengths = self.end[at] - starts
        end = np.cumsum(lengths)
        content = self.content[np.repeat(starts - (end - lengths), lengths) + np.arange(int(lengths.sum()))]
        return replace(
            self, arrival=self.arrival[at], log_ns=self.log_ns[at], channel=self.channel[at], end=end, content=content
        )

    @property
    def stamps_ns(self) -> Stamps:
        """Header stamps (M,), 0 if missing or if a message cannot be decoded."""
        if self.is_restamped:
            return self.log_ns
        stamps_ns = np.zeros(len(self), dtype=np.int64)
        for number, channel in enumerate(self.channels):
            of_channel = np.flatnonzero(self.channel == number)
            kind = VELOCITY_TYPES.get(channel.msgtype)
            if kind is not None and kind.adapted is not None:  # a message without header
                messages = (message for _, _, message, _ in self.messages(of_channel))
                stamps_ns[of_channel] = [0 if each is None else stamp_ns(each.header.stamp) for each in messages]
            else:
                stamps_ns[of_channel] = self._header_stamps_ns(of_channel)
        return stamps_ns

    def _header_stamps_ns(self, rows: Index) -> Stamps:
        """Read only the stamps of messages that begin with a header, from their bytes (CDR).

        Byte 0 is 0 and byte 1 the byte order; after the 4 bytes of this encapsulation follow seconds and nanoseconds.
        """
        starts = np.where(rows > 0, self.end[rows - 1], 0)
        is_whole = self.end[rows] - starts >= STAMP_END
        head = self.content[np.where(is_whole, starts, 0)[:, None] + np.arange(STAMP_END if is_whole.any() else 0)]
        stamps_ns = np.zeros(len(rows), dtype=np.int64)
        for byte_order, flag in (("<", 1), (">", 0)):
            readable = is_whole & ((head[:, :1] == 0) & (head[:, 1:2] == flag)).any(axis=1)
            seconds, nanoseconds = (
                np.ascontiguousarray(head[readable, first : first + 4])
                .view(f"{byte_order}{kind}4")
                .astype(np.int64)
                .ravel()
                for first, kind in ((STAMP_END - 8, "i"), (STAMP_END - 4, "u"))
            )
            stamps_ns[readable] = seconds * 1_000_000_000 + nanoseconds
        return stamps_ns


@dataclass(frozen=True)
class TopicColumns:
    """All messages of a topic in one recording."""

    topic: str
    msgtype: str
    decoded: DecodedRows
    singles: Singles

    def __len__(self) -> int:
        return len(self.decoded) + len(self.singles)

    @property
    def arrivals(self) -> tuple[Stamps, Stamps]:
        """Positions of all messages among all messages read, in order, and their log times (ns)."""
        if not len(self.singles):
            return self.decoded.arrival, self.decoded.log_ns
        arrival = np.concatenate([self.decoded.arrival, self.singles.arrival])
        order = np.argsort(arrival, kind="stable")
        return arrival[order], np.concatenate([self.decoded.log_ns, self.singles.log_ns])[order]

    @property
    def stamps_ns(self) -> Stamps:
        """Stamps of all messages in the order of `arrivals`; the log time if missing."""
        _, log_ns = self.arrivals
        stamps_ns: Stamps = self.decoded.stamps_ns
        if len(self.singles):
            order = np.argsort(np.concatenate([self.decoded.arrival, self.singles.arrival]), kind="stable")
            stamps_ns = np.concatenate([stamps_ns, self.singles.stamps_ns])[order]
        return stamps_ns if stamps_ns.all() else np.where(stamps_ns == 0, log_ns, stamps_ns)

    def restamped(self) -> TopicColumns:
        """Return the messages stamped by log time."""
        decoded = replace(self.decoded, stamps_ns=self.decoded.log_ns)
        return replace(self, decoded=decoded, singles=replace(self.singles, is_restamped=True))

    def part(self, kept: Mask) -> TopicColumns:
        """Return the messages of a mask (N,), in the order of `arrivals`."""
        arrival = self.arrivals[0][kept]
        decoded, singles = (np.flatnonzero(np.isin(part.arrival, arrival)) for part in (self.decoded, self.singles))
        return replace(self, decoded=self.decoded.part(decoded), singles=self.singles.part(singles))

    def arriving(self, renumbered: Callable[[Stamps], Stamps]) -> TopicColumns:
        """Return the messages with renumbered arrivals."""
        return replace(
            self,
            decoded=replace(self.decoded, arrival=renumbered(self.decoded.arrival)),
            singles=replace(self.singles, arrival=renumbered(self.singles.arrival)),
        )


def is_kept(msgtype: str) -> bool:
    """Return whether messages of this type may be a DVL's, a reference or an IMU's."""
    return msgtype == IMU_TYPE or msgtype in VELOCITY_TYPES


class Collector:
    """Collector of a topic's messages. expected: number of messages. parameters: for the type's validity rules."""

    def __init__(self, topic: str, msgtype: str, expected: int, parameters: Parameters, decoder: Decoder) -> None:
        """Reserve the columns. expected: number of messages. parameters: for the validity rules of the message type."""
        self._topic, self._msgtype, self._parameters, self._decoder = topic, msgtype, parameters, decoder
        shapes = {"values": (7 if msgtype == IMU_TYPE else 3,), "extra": (extra_width(msgtype),)}
        self._laid = {name: GrowingRows(dtype, shapes.get(name, ()), expected) for name, dtype in _DTYPES.items()}
        self._world = ""
        self._heading_variance = math.nan
        self._frames: dict[bytes, int] = {}
        self._distinct: list[Array] = []
        self._n_distinct = 0
        self._singles = {
            name: GrowingRows(dtype)
            for name, dtype in (("arrival", np.int64), ("log_ns", np.int64), ("channel", np.int32), ("end", np.int64),
                                ("content", np.uint8))
        }  # fmt: skip
        self._bytes = 0
        self._channels: dict[Channel, int] = {}

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
        kind = VELOCITY_TYPES.get(self._msgtype)
        frame_ids = columns.header.frame_id if kind is None else kind.frame_id(columns)
        stamp = columns.header.stamp
        stamps_ns = stamp.sec.astype(np.int64) * 1_000_000_000 + stamp.nanosec
        n = len(part)
        covariances, broken = Covariances.none(n), np.zeros(n, dtype=np.uint8)
        if kind is None:
            values, extra = _imu(columns)
            if math.isnan(self._heading_variance):
                self._heading_variance = heading_variance(columns.orientation_covariance[0])
        else:
            velocity = kind.velocity(columns)
            values, extra = _columns_of(velocity), extra_values(columns, self._msgtype)
            extra = np.broadcast_to(extra, (n, extra.shape[1]))
            covariances = _covariances(kind, columns)
            broken = _broken(kind, columns, self._parameters)
        self._world = self._world or frame_name(columns.header.frame_id[0].tobytes().decode("ascii"))
        # nothing is stored before everything is known to be readable
        index = np.where(covariances.index < 0, -1, covariances.index + self._n_distinct)
        if len(covariances.distinct):
            self._distinct.append(covariances.distinct)
            self._n_distinct += len(covariances.distinct)
        rows = (part.arrival, part.log_ns, stamps_ns, values, self._frame(frame_ids), index, broken, extra)
        for column, each in zip(self._laid.values(), rows, strict=True):
            column.add(each)

    def _frame(self, frame_ids: Any) -> Index:
        """Return the frame's index of each row of (N, length) ASCII."""
        n = len(frame_ids)
        if not frame_ids.shape[1] or (frame_ids == frame_ids[0]).all():
            return np.full(n, self._frames.setdefault(frame_ids[0].tobytes(), len(self._frames)))
        return np.array([self._frames.setdefault(row.tobytes(), len(self._frames)) for row in frame_ids])

    def _take_singly(self, part: Part) -> None:
        """Keep the bytes of messages that have no common layout."""
        data = list(part.data())
        end = self._bytes + np.cumsum([len(message) for message in data], dtype=np.int64)
        self._bytes = int(end[-1])
        channel = np.full(len(data), self._channels.setdefault(part.channel, len(self._channels)))
        content = np.frombuffer(b"".join(data), dtype=np.uint8)
        for column, values in zip(
            self._singles.values(), (part.arrival, part.log_ns, channel, end, content), strict=True
        ):
            column.add(values)

    def columns(self) -> TopicColumns:
        """Return all collected messages, each part in order of arrival."""
        decoded = DecodedRows(
            **{name: column.array() for name, column in self._laid.items()},
            world=self._world,
            heading_variance=self._heading_variance,
            frames=tuple(frame_name(name.decode("ascii")) for name in self._frames),
            distinct=np.concatenate([np.zeros((0, 3, 3)), *self._distinct]),
        )
        if (decoded.arrival[1:] < decoded.arrival[:-1]).any():  # several layouts alternated
            decoded = decoded.part(np.argsort(decoded.arrival, kind="stable"))
        arrival, log_ns, channel, end, content = (column.array() for column in self._singles.values())
        singles = Singles(arrival, log_ns, channel, end, content, tuple(self._channels), self._decoder)
        if (singles.arrival[1:] < singles.arrival[:-1]).any():
            singles = singles.part(np.argsort(singles.arrival, kind="stable"))
        return TopicColumns(self._topic, self._msgtype, decoded, singles)


def _columns_of(vector: Any) -> Array:
    """Stack x, y, z as (N, 3)."""
    return np.column_stack([vector.x, vector.y, vector.z]).astype(float, copy=False)


def extra_width(msgtype: str) -> int:
    """Return the number of additional values per velocity or IMU message."""
    return 10 if msgtype == ODOMETRY else 3


def extra_values(message: Any, msgtype: str) -> Array:
    """Return the angular velocity of a twist (rad/s), or the pose of an odometry.

    Returns
    -------
    (N, 3) of columns or (1, 3) of a message; of an odometry (N, 10) with its position (m) and its quaternion (x, y, z,
    w). nan if a type has none.
    """
    twist = getattr(message, "twist", None)
    if twist is None:
        return np.full((1, extra_width(msgtype)), np.nan)
    rates = _columns_of(getattr(twist, "twist", twist).angular)
    if msgtype != ODOMETRY:
        return rates
    q = message.pose.pose.orientation
    quaternion = np.column_stack([q.x, q.y, q.z, q.w]).astype(float, copy=False)
    return np.hstack([rates, _columns_of(message.pose.pose.position), quaternion])


def _imu(columns: MessageColumns) -> tuple[Array, Array]:
    """Return quaternion and angular velocity (N, 7), and acceleration (N, 3); nan if missing."""
    q, w, a = columns.orientation, columns.angular_velocity, columns.linear_acceleration
    values = np.column_stack([q.x, q.y, q.z, q.w, w.x, w.y, w.z]).astype(float, copy=False)
    values[columns.orientation_covariance[:, 0] == NO_DATA, :4] = np.nan
    values[columns.angular_velocity_covariance[:, 0] == NO_DATA, 4:] = np.nan
    acceleration = _columns_of(a)
    acceleration[columns.linear_acceleration_covariance[:, 0] == NO_DATA] = np.nan
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
    """Return (N,) the number of the first rule that each DVL message breaks, 0 for none."""
    broken = np.zeros(len(columns), dtype=np.uint8)
    if kind.is_dvl:
        for code, rule in enumerate(kind.rules, start=1):
            broken[np.asarray(rule.broken(columns, parameters)) & (broken == 0)] = code
    return broken


def stamped(message: Any, log_ns: int) -> int:
    """Return the stamp of a message (ns), or the log time if missing."""
    return stamp_ns(message.header.stamp) or log_ns


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
