"""Sample types of the three streams: single (live) or as columns (recordings).

A live sample is a tuple of floats: built and read once at up to kHz rates, where a float costs a tenth of an array
element. Recorded samples are rows of a `SampleBlock`. Stamps are integer nanoseconds, because a float second cannot
resolve a nanosecond of 2026.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .frames import Array, Quaternion, Vector

Stamps = NDArray[np.int64]
Codes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


class VelocityFrame(Enum):
    """Frame in which a reference velocity is expressed."""

    BODY = "body"
    ENU = "enu"
    NED = "ned"


# Frames by code (index).
FRAMES: tuple[VelocityFrame, ...] = tuple(VelocityFrame)
FRAME_CODES = {frame: code for code, frame in enumerate(FRAMES)}


class DvlSample(NamedTuple):
    """Velocity over ground measured by the DVL.

    velocity: m/s in the DVL frame. covariance: (3, 3) (m/s)², None if the message has none.
    """

    stamp_ns: int
    velocity: Vector
    covariance: Array | None = None


class ReferenceSample(NamedTuple):
    """Reference (GNSS) velocity of the reference point over ground.

    velocity: m/s in `frame`. covariance: (3, 3) (m/s)² in `frame`, None if the message has none.
    """

    stamp_ns: int
    velocity: Vector
    covariance: Array | None = None
    frame: VelocityFrame = VelocityFrame.BODY


class ImuSample(NamedTuple):
    """Attitude and angular velocity of the body; None if the IMU does not provide it.

    orientation: unit quaternion (x, y, z, w) of ``rotation_enu_from_body``. angular_velocity: rad/s, body frame.
    """

    stamp_ns: int
    orientation: Quaternion | None
    angular_velocity: Vector | None


Sample = DvlSample | ReferenceSample | ImuSample


class Stream(Enum):
    """The three streams, by their names in counts."""

    __hash__ = object.__hash__  # Enum.__hash__ is slow and runs for every live sample
    DVL = "dvl"
    REFERENCE = "reference"
    IMU = "imu"


# Bits of the axes x, y, z.
AXIS_BITS = np.array([1, 2, 4], dtype=np.uint8)
# Number of value columns: velocity (m/s); for the IMU quaternion (x, y, z, w) and angular velocity (rad/s).
WIDTH = {Stream.DVL: 3, Stream.REFERENCE: 3, Stream.IMU: 7}


@dataclass(frozen=True)
class Covariances:
    """Velocity covariances of N rows, stored once per distinct value, because most drivers repeat them.

    distinct: (C, 3, 3) (m/s)², as in the messages. index: (N,) into distinct, -1 for a message without covariance.
    """

    distinct: Array
    index: Index

    @staticmethod
    def none(n: int) -> Covariances:
        """Return the covariances of n rows without any."""
        return Covariances(np.zeros((0, 3, 3)), np.full(n, -1, dtype=np.intp))

    @staticmethod
    def of(values: Array, n: int) -> Covariances:
        """Return covariances from one (3, 3) for all rows, or (N, 3, 3); consecutive repetitions are stored once."""
        values = np.asarray(values, dtype=float)
        if values.shape == (3, 3):
            return Covariances(values[None], np.zeros(n, dtype=np.intp))
        if values.shape != (n, 3, 3):
            raise ValueError(f"covariance: expected (3, 3) or ({n}, 3, 3), got {values.shape}")
        if not n:
            return Covariances.none(0)
        raw = np.ascontiguousarray(values).reshape(n, 9).view(np.int64)  # compare bits, so that nan equals nan
        changes = np.concatenate([[True], (raw[1:] != raw[:-1]).any(axis=1)])
        return Covariances(values[changes], np.cumsum(changes) - 1)

    @staticmethod
    def of_matrices(matrices: Sequence[Array | None]) -> Covariances:
        """Return the covariances of rows with a matrix (3, 3) each, or None."""
        (given,) = np.nonzero([matrix is not None for matrix in matrices])
        values = [matrix for matrix in matrices if matrix is not None]
        known = Covariances.of(np.array(values).reshape(-1, 3, 3), len(given))
        index = np.full(len(matrices), -1, dtype=np.intp)
        index[given] = known.index
        return Covariances(known.distinct, index)

    @property
    def matrices(self) -> list[Array | None]:
        """Matrix (3, 3) of each row, or None."""
        distinct = [*self.distinct, None]  # index -1 is None
        return [distinct[place] for place in self.index.tolist()]

    def part(self, at: slice | Index | Mask) -> Covariances:
        """Return the rows of a slice, of indices or of a mask."""
        return Covariances(self.distinct, self.index[at])

    def joined(self, *others: Covariances) -> Covariances:
        """Return these rows followed by those of others."""
        index, n = [self.index], len(self.distinct)
        for other in others:
            index.append(np.where(other.index < 0, -1, other.index + n))
            n += len(other.distinct)
        distinct = np.concatenate([self.distinct, *(other.distinct for other in others)])
        return Covariances(distinct, np.concatenate(index).astype(np.intp))


@dataclass(frozen=True)
class SampleBlock:
    """Columns of one stream: N messages in order of arrival.

    stamps_ns: (N,) of the header.
    values: (N, 3) velocity, m/s, in the DVL frame or the frame of `frames`; for the IMU (N, 7), unit quaternion (x, y,
      z, w) of ``rotation_enu_from_body`` and angular velocity, rad/s, body frame, nan where missing.
    covariances: of velocities.
    frames: (N,) of the reference, indices in `FRAMES`.
    refused: (N,) 0 for a sample, else 1 + index in `reasons` of the reason (wrong frame, no bottom lock, undecodable
      ...); other columns of such a row are undefined.
    arrival: (N,) strictly increasing, the order of arrival over all streams.
    """

    stream: Stream
    stamps_ns: Stamps
    values: Array
    covariances: Covariances
    arrival: Stamps
    frames: Codes
    refused: Codes
    reasons: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the type of the stamps and the shape of each column."""
        n = len(self.stamps_ns)
        shapes = {
            "values": (self.values.shape, (n, WIDTH[self.stream])),
            "covariances": (self.covariances.index.shape, (n,)),
            **{name: (getattr(self, name).shape, (n,)) for name in ("arrival", "frames", "refused")},
        }
        for name, (found, expected) in shapes.items():
            if found != expected:
                raise ValueError(f"{self.stream.value} block: {name} has shape {found}, expected {expected}")
        if self.stamps_ns.dtype != np.int64:
            raise ValueError(f"{self.stream.value} block: stamps_ns are {self.stamps_ns.dtype}, expected int64")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def orientation(self) -> Array:
        """Orientation (N, 4) of the IMU."""
        return self.values[:, :4]

    @property
    def angular_velocity(self) -> Array:
        """Angular velocity (N, 3) rad/s of the IMU."""
        return self.values[:, 4:]

    def part(self, at: slice | Index | Mask) -> SampleBlock:
        """Return the rows of a slice, of indices or of a mask."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[at],
            values=self.values[at],
            covariances=self.covariances.part(at),
            arrival=self.arrival[at],
            frames=self.frames[at],
            refused=self.refused[at],
        )

    def joined(self, *others: SampleBlock) -> SampleBlock:
        """Return these rows followed by those of others of the stream; each call copies all rows."""
        reasons = tuple(dict.fromkeys(reason for block in (self, *others) for reason in block.reasons))
        refused = []
        for block in (self, *others):
            code = np.array([0, *(1 + reasons.index(reason) for reason in block.reasons)], dtype=np.uint8)
            refused.append(code[block.refused])
        stamps_ns, values, arrival, frames = (
            np.concatenate([getattr(block, name) for block in (self, *others)])
            for name in ("stamps_ns", "values", "arrival", "frames")
        )
        covariances = self.covariances.joined(*(other.covariances for other in others))
        return SampleBlock(
            self.stream, stamps_ns, values, covariances, arrival, frames, np.concatenate(refused), reasons
        )

    def samples(self) -> Iterator[Sample | str]:
        """Yield each row as a live sample, or the reason why its message is none."""
        rows = zip(
            self.stamps_ns.tolist(), self.values.tolist(), self.covariances.matrices, self.frames.tolist(),
            self.refused.tolist(), strict=True,
        )  # fmt: skip
        for stamp_ns, values, covariance, frame, refused in rows:
            if refused:
                yield self.reasons[refused - 1]
            elif self.stream is Stream.DVL:
                yield DvlSample(stamp_ns, tuple(values), covariance)
            elif self.stream is Stream.REFERENCE:
                yield ReferenceSample(stamp_ns, tuple(values), covariance, FRAMES[frame])
            else:
                orientation, rate = tuple(values[:4]), tuple(values[4:])
                yield ImuSample(
                    stamp_ns,
                    orientation if orientation[0] == orientation[0] else None,  # nan: not given
                    rate if rate[0] == rate[0] else None,
                )


def sample_block(
    stream: Stream,
    stamps_ns: Stamps,
    values: Array,
    *,
    covariance: Array | Covariances | None = None,
    frames: VelocityFrame | Codes = VelocityFrame.BODY,
    arrival: Stamps | None = None,
    refused: Codes | None = None,
    reasons: Sequence[str] = (),
) -> SampleBlock:
    """Return a `SampleBlock`; values common to all rows may be given once.

    covariance: (3, 3) or (N, 3, 3) (m/s)², None if not given.
    frames: one, or (N,) indices in `FRAMES`.
    arrival: default is row order, valid for a single stream only.
    """
    n = len(stamps_ns)
    if not isinstance(covariance, Covariances):
        covariance = Covariances.none(n) if covariance is None else Covariances.of(covariance, n)
    return SampleBlock(
        stream,
        np.asarray(stamps_ns, dtype=np.int64),
        np.asarray(values, dtype=float).reshape(n, WIDTH[stream]),
        covariance,
        np.arange(n, dtype=np.int64) if arrival is None else np.asarray(arrival, dtype=np.int64),
        np.full(n, FRAME_CODES[frames], dtype=np.uint8) if isinstance(frames, VelocityFrame) else frames,
        np.zeros(n, dtype=np.uint8) if refused is None else refused,
        tuple(reasons),
    )


def no_samples(stream: Stream) -> SampleBlock:
    """Return a block without rows."""
    return sample_block(stream, np.zeros(0, dtype=np.int64), np.zeros((0, WIDTH[stream])))


class Streams(NamedTuple):
    """Blocks of all three streams in one stretch of a recording, ordered by `SampleBlock.arrival`."""

    dvl: SampleBlock
    reference: SampleBlock = no_samples(Stream.REFERENCE)
    imu: SampleBlock = no_samples(Stream.IMU)

    def halves(self) -> tuple[Streams, Streams]:
        """Return the first and second half of the rows by arrival."""
        middle = np.sort(np.concatenate([block.arrival for block in self]))[sum(map(len, self)) // 2]
        at = [int(np.searchsorted(block.arrival, middle)) for block in self]
        return (
            Streams(*(block.part(slice(end)) for block, end in zip(self, at, strict=True))),
            Streams(*(block.part(slice(first, None)) for block, first in zip(self, at, strict=True))),
        )

    def arriving_by_stamp(self) -> Streams:
        """Return the streams with arrival in order of stamps; for equal stamps IMU, reference, DVL."""
        blocks = (self.imu, self.reference, self.dvl)
        stamps = np.concatenate([block.stamps_ns for block in blocks])
        arrival = np.empty(len(stamps), dtype=np.int64)
        arrival[np.argsort(stamps, kind="stable")] = np.arange(len(stamps))
        first, second = len(self.imu), len(self.imu) + len(self.reference)
        imu, reference, dvl = (
            replace(block, arrival=at)
            for block, at in zip(blocks, (arrival[:first], arrival[first:second], arrival[second:]), strict=True)
        )
        return Streams(dvl, reference, imu)

    def in_order(self) -> Iterator[tuple[Stream, Sample | str]]:
        """Yield all rows as live samples, in order of arrival."""
        rows = [block.samples() for block in self]
        streams = np.repeat(np.arange(3), [len(block) for block in self])
        order = np.argsort(np.concatenate([block.arrival for block in self]), kind="stable")
        for stream in streams[order].tolist():
            yield self[stream].stream, next(rows[stream])


class SampleUse:
    """Reason why no model uses a DVL sample in order, or `USED`. Codes of `AlignedBlock.verdict`.

    AWAITING: until an angular velocity arrives, or can no longer arrive.
    """

    USED, SLOW, FROZEN, TURNING, NO_TURN_RATE, AWAITING = range(6)
    NAMES = ("used", "slow", "frozen", "turning", "no_turn_rate", "awaiting_imu")


class Pairing:
    """State of the pairing of a DVL sample with a reference velocity. Codes of `AlignedBlock.pairing`."""

    AWAITING, PAIRED, UNPAIRED, WITHOUT_ATTITUDE = range(4)
    NAMES = ("awaiting_reference", "paired", "unpaired", "without_attitude")


@dataclass(frozen=True)
class AlignedBlock:
    """N DVL samples in order of stamps, with the other streams interpolated at their times.

    stamps_ns: (N,) corrected for dvl_time_offset.
    row: (N,) number of the DVL message since the start, from 0.
    velocity_dvl: (N, 3) m/s, DVL frame.
    covariance: (N, 3, 3) (m/s)² of it, nan where not given.
    interval_ns: (N,) since the previous sample, 0 for the first.
    verdict: (N,) see `SampleUse`.
    prior_known: (N,) prior sway and heave were known.
    attitude: (N, 7) quaternion (x, y, z, w) of ``rotation_enu_from_body`` and angular velocity, rad/s, body frame; nan
      where unknown.
    pairing: (N,) see `Pairing`.
    reference: (N, 12) velocity (3), m/s, and covariance (9, nan where not given), in the frame of frames: (N,) indices
      in `FRAMES`; nan where unpaired.
    unmeasured: (N,) a bit (1, 2, 4) per axis of that frame that the reference does not measure.
    weight: (N,) information weight of the reference, below 1 where neighbours share its samples.
    """

    stamps_ns: Stamps
    row: Stamps
    velocity_dvl: Array
    covariance: Array
    interval_ns: Stamps
    verdict: Codes
    prior_known: Mask
    attitude: Array
    pairing: Codes
    reference: Array
    frames: Codes
    unmeasured: Codes
    weight: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def share(self, with_reference: bool) -> Array:
        """Return the information weight (N,) of each row: 1 for models without reference."""
        return self.weight if with_reference else np.ones(len(self))

    def part(self, at: slice | Index | Mask) -> AlignedBlock:
        """Return the rows of a slice, of indices or of a mask."""
        return AlignedBlock(*(column[at] for column in self.columns()))

    def columns(self) -> tuple[NDArray[Any], ...]:
        """Return all columns, in the order of the fields."""
        return tuple(getattr(self, column.name) for column in fields(self))

    @cached_property
    def usable(self) -> Mask:
        """Mask (N,) of rows for models without further needs."""
        return self.verdict == SampleUse.USED

    @cached_property
    def oriented(self) -> Mask:
        """Mask (N,) of rows for models that need attitude and angular velocity."""
        return self.usable & ~np.isnan(self.attitude[:, 0]) & ~np.isnan(self.attitude[:, 4])

    @cached_property
    def paired(self) -> Mask:
        """Mask (N,) of rows for models that need a reference velocity."""
        return self.usable & (self.pairing == Pairing.PAIRED)

    def reasons(self) -> list[str]:
        """Return per row (N,) in words why some models cannot use it: verdict of the gates, else pairing."""
        return [
            SampleUse.NAMES[verdict] if verdict else Pairing.NAMES[pairing]
            for verdict, pairing in zip(self.verdict.tolist(), self.pairing.tolist(), strict=True)
        ]
