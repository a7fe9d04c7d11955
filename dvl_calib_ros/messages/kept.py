"""Live messages from the start on, packed, for a calibration that begins anew not to lose them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..calibration.frames import Array
from ..calibration.samples import (
    FRAME_CODES,
    WIDTH,
    Codes,
    Covariances,
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
from ..calibration.tables import FULL, RowTable

# Messages of all streams, of 140 bytes: an IMU at 100 Hz for a quarter of an hour.
MOST = 100_000
_NOT_GIVEN = (float("nan"),) * 4
_CODES = {stream: code for code, stream in enumerate(Stream)}


class KeptMessages(RowTable):
    """All so far in the order in which they came, or none once they are more than `MOST`.

    The room for `MOST` is taken at once: a node's memory must not grow with what it hears.
    """

    LAYOUT: ClassVar = {
        "stream": (np.uint8, ()),
        "stamps_ns": (np.int64, ()),
        "values": (np.float64, (7,)),
        "covariance": (np.float64, (3, 3)),
        "has_covariance": (np.bool_, ()),
        "frames": (np.uint8, ()),
        "refused": (np.uint8, ()),
    }
    stream: Codes
    stamps_ns: Stamps
    values: Array
    covariance: Array
    has_covariance: Mask
    frames: Codes
    refused: Codes

    def __init__(self) -> None:
        super().__init__()
        self.reserve(int(FULL * MOST))  # as nothing is given up at the start, all of the room is filled
        self._reasons: list[str] = []
        self._is_kept = True

    def add(self, stream: Stream, decoded: Sample | str) -> None:
        """Keep the sample that a message is, or why it is none."""
        if not self._is_kept:
            return
        if self.size == MOST:
            self.forget()
            return
        at = self.extend(1).start
        self.stream[at] = _CODES[stream]
        self.stamps_ns[at] = self.frames[at] = self.refused[at] = 0
        self.has_covariance[at] = False
        if isinstance(decoded, str):
            if decoded not in self._reasons:
                self._reasons.append(decoded)
            self.refused[at] = 1 + self._reasons.index(decoded)
            return
        self.stamps_ns[at] = decoded.stamp_ns
        if isinstance(decoded, ImuSample):
            self.values[at, :4] = decoded.orientation or _NOT_GIVEN
            self.values[at, 4:] = decoded.angular_velocity or _NOT_GIVEN[:3]
            return
        self.values[at, :3] = decoded.velocity
        if decoded.covariance is not None:
            self.covariance[at], self.has_covariance[at] = decoded.covariance, True
        if isinstance(decoded, ReferenceSample):
            self.frames[at] = FRAME_CODES[decoded.frame]

    def forget(self) -> None:
        """Keep nothing any more."""
        self._is_kept = False
        self.clear()
        self._move(0)

    @property
    def is_kept(self) -> bool:
        """Whether all so far is kept."""
        return self._is_kept

    @property
    def streams(self) -> Streams | None:
        """What came; None where that is not kept any more."""
        return Streams(*map(self._block, Stream)) if self._is_kept else None

    def _block(self, stream: Stream) -> SampleBlock:
        (at,) = np.nonzero(self.stream[: self.size] == _CODES[stream])
        given = self.has_covariance[at]
        each = Covariances.of(self.covariance[at[given]], int(given.sum()))
        index = np.full(len(at), -1, dtype=np.intp)
        index[given] = each.index
        return sample_block(
            stream, self.stamps_ns[at], self.values[at, : WIDTH[stream]], covariance=Covariances(each.distinct, index),
            frames=self.frames[at], arrival=at, refused=self.refused[at], reasons=self._reasons,
        )  # fmt: skip
