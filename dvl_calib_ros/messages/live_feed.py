"""Feeding of live ROS messages to a calibrator, and their storage for a restart."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import (
    FRAME_CODES,
    WIDTH,
    Codes,
    Covariances,
    DvlSample,
    ImuSample,
    Mask,
    ReferenceSample,
    Sample,
    SampleBlock,
    Stamps,
    Stream,
    Streams,
    sample_block,
)
from ..calibration.numerics.tables import FULL, RowTable, column
from .decode import MessageDecoder, Refusal

AnySample = TypeVar("AnySample", DvlSample, ReferenceSample, ImuSample)


class MessageFeed:
    """Feeds a calibrator with decoded samples and refusals, which it counts.

    decoder: the message decoder.
    on_problem: receives the text of its new problems.
    kept: messages for `begin_again`. Raises InputError for unknown message types.
    """

    def __init__(self, calibrator: Calibrator, on_problem: Callable[[str], None] = lambda _: None) -> None:
        self.calibrator = calibrator
        self.decoder = MessageDecoder(calibrator.parameters, on_problem)
        self.decoder.on_fix = self._fix
        self.kept = KeptMessages()
        self._fixes: list[tuple[int, Array, Array]] = []

    def begin_again(self, calibrator: Calibrator) -> None:
        """Continue with another calibrator, which first receives the kept messages."""
        self.calibrator = calibrator
        self.decoder.parameters = calibrator.parameters
        streams = self.kept.streams
        if streams is not None:
            for fix in self._fixes:
                calibrator.feed_fix(*fix)
            calibrator.feed(streams)

    def forget(self) -> None:
        """Forget the messages received so far."""
        self.decoder.forget()
        self.kept = KeptMessages()
        self._fixes.clear()

    def dvl(self, message: Any, received_ns: int) -> DvlSample | None:
        """Feed a message of dvl_type. Return the sample as `Calibrator.feed_dvl` does."""
        sample = self._sample_or_count(Stream.DVL, self.decoder.dvl(message, received_ns))
        return None if sample is None else self.calibrator.feed_dvl(sample)

    def reference(self, message: Any, received_ns: int) -> ReferenceSample | None:
        """Feed a message of gnss_type with the reference velocity. Return the sample, or None if refused."""
        sample = self._sample_or_count(Stream.REFERENCE, self.decoder.reference(message, received_ns))
        if sample is not None:
            self.calibrator.feed_reference(sample)
        return sample

    def imu(self, message: Any, received_ns: int) -> ImuSample | None:
        """Feed a sensor_msgs/Imu. Return the sample, or None if refused."""
        sample = self._sample_or_count(Stream.IMU, self.decoder.imu(message, received_ns))
        if sample is not None:
            self.calibrator.feed_imu(sample)
        return sample

    def _fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """Feed a position (degrees, m) with its variance (3,) m²."""
        if self.kept.is_kept:
            self._fixes.append((stamp_ns, position, variance))
        else:
            self._fixes.clear()
        self.calibrator.feed_fix(stamp_ns, position, variance)

    def _sample_or_count(self, stream: Stream, decoded: AnySample | Refusal) -> AnySample | None:
        """Return a message's sample, or None after counting a refusal."""
        if isinstance(decoded, Refusal):
            self.kept.add(stream, decoded.reason)
            self.calibrator.refuse(stream.value, decoded.reason)
            return None
        self.kept.add(stream, decoded)
        return decoded


# largest number of kept messages, 140 bytes each: an IMU at 100 Hz for a quarter of an hour
MOST = 100_000
_CODES = {stream: code for code, stream in enumerate(Stream)}


class KeptMessages(RowTable):
    """Samples and refusals of all messages so far, or none after more than `MOST`. is_kept: whether it has them.

    The memory is allocated at the start, so that a node's memory does not grow with the messages received.
    """

    stream: Codes = column(np.uint8)
    stamps_ns: Stamps = column(np.int64)
    values: Array = column(np.float64, 7)
    covariance: Array = column(np.float64, 3, 3)
    has_covariance: Mask = column(np.bool_)
    frames: Codes = column(np.uint8)
    refused: Codes = column(np.uint8)

    def __init__(self) -> None:
        super().__init__()
        self.reserve(int(FULL * MOST))  # no row is ever dropped, so the whole capacity of MOST rows is used
        self.is_kept = True
        self._reasons: list[str] = []

    def add(self, stream: Stream, decoded: Sample | str) -> None:
        """Keep a message's sample, or the reason for its refusal."""
        if self.is_kept and self.size == MOST:
            self.forget()
        if not self.is_kept:
            return
        at = self.extend(1).start
        self.stream[at] = _CODES[stream]
        self.stamps_ns[at] = self.frames[at] = self.refused[at] = 0
        self.has_covariance[at] = False
        self.values[at] = math.nan
        if isinstance(decoded, str):
            if decoded not in self._reasons:
                self._reasons.append(decoded)
            self.refused[at] = 1 + self._reasons.index(decoded)
            return
        self.stamps_ns[at] = decoded.stamp_ns
        if isinstance(decoded, ImuSample):
            for columns, given in ((slice(4), decoded.orientation), (slice(4, 7), decoded.angular_velocity)):
                if given is not None:
                    self.values[at, columns] = given
            return
        self.values[at, :3] = decoded.velocity
        if decoded.covariance is not None:
            self.covariance[at], self.has_covariance[at] = decoded.covariance, True
        if isinstance(decoded, ReferenceSample):
            self.frames[at] = FRAME_CODES[decoded.frame]

    def block(self, stream: Stream) -> SampleBlock:
        """Return all samples of one stream."""
        (rows,) = np.nonzero(self.stream[: self.size] == _CODES[stream])
        has_covariance = self.has_covariance[rows]
        given = Covariances.of(self.covariance[rows[has_covariance]], int(has_covariance.sum()))
        index = np.full(len(rows), -1, dtype=np.intp)
        index[has_covariance] = given.index
        return sample_block(
            stream, self.stamps_ns[rows], self.values[rows, : WIDTH[stream]],
            covariance=Covariances(given.distinct, index), frames=self.frames[rows], arrival=rows,
            refused=self.refused[rows], reasons=self._reasons,
        )  # fmt: skip

    def forget(self) -> None:
        """Stop keeping messages."""
        self.is_kept = False
        self.clear()
        self._move(0)

    @property
    def streams(self) -> Streams | None:
        """All messages; None if they are no longer kept."""
        return Streams(*map(self.block, Stream)) if self.is_kept else None
