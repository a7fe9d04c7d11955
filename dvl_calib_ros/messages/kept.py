"""Live messages from the start on, packed, for a calibration that begins anew not to lose them."""

from __future__ import annotations

from array import array

import numpy as np

from ..calibration.frames import Array
from ..calibration.samples import (
    FRAME_CODES,
    Covariances,
    ImuSample,
    ReferenceSample,
    Sample,
    SampleBlock,
    Stream,
    Streams,
    VelocityFrame,
    sample_block,
)

# Messages of all streams, of 80 bytes: an IMU at 100 Hz for a quarter of an hour.
MOST = 100_000
_NOT_GIVEN = (float("nan"),) * 4


class KeptMessages:
    """All so far, or none once they are more than `MOST`."""

    def __init__(self) -> None:
        self._columns: tuple[_Columns, ...] | None = tuple(map(_Columns, Stream))
        self._by_stream = {each.stream: each for each in self._columns}
        self._count = 0

    def add(self, stream: Stream, decoded: Sample | str) -> None:
        """Keep the sample that a message is, or why it is none."""
        if self._columns is None:
            return
        self._by_stream[stream].add(decoded, self._count)
        self._count += 1
        if self._count > MOST:
            self.forget()

    def forget(self) -> None:
        """Keep nothing any more."""
        self._columns, self._by_stream = None, {}

    @property
    def streams(self) -> Streams | None:
        """What came; None where that is not kept any more."""
        return None if self._columns is None else Streams(*(each.block() for each in self._columns))


class _Columns:
    """Of one stream."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self._stamps, self._arrival, self._index = array("q"), array("q"), array("q")
        self._values, self._frames, self._refused = array("d"), bytearray(), bytearray()
        self._none = (float("nan"),) * (7 if stream is Stream.IMU else 3)
        self._distinct: list[Array] = []
        self._reasons: list[str] = []

    def add(self, decoded: Sample | str, arrival: int) -> None:
        """Take a message's sample, or why it is none."""
        stamp_ns, values, covariance, frame, refused = 0, self._none, None, VelocityFrame.BODY, 0
        if isinstance(decoded, str):
            if decoded not in self._reasons:
                self._reasons.append(decoded)
            refused = 1 + self._reasons.index(decoded)
        elif isinstance(decoded, ImuSample):
            stamp_ns = decoded.stamp_ns
            values = *(decoded.orientation or _NOT_GIVEN), *(decoded.angular_velocity or _NOT_GIVEN[:3])
        else:
            stamp_ns, values, covariance = decoded.stamp_ns, decoded.velocity, decoded.covariance
            frame = decoded.frame if isinstance(decoded, ReferenceSample) else frame
        if covariance is not None and not (self._distinct and self._distinct[-1] is covariance):
            self._distinct.append(covariance)
        self._index.append(-1 if covariance is None else len(self._distinct) - 1)
        self._stamps.append(stamp_ns)
        self._arrival.append(arrival)
        self._values.extend(values)
        self._frames.append(FRAME_CODES[frame])
        self._refused.append(refused)

    def block(self) -> SampleBlock:
        """All of them."""
        covariances = Covariances(np.reshape(self._distinct, (-1, 3, 3)), np.array(self._index, dtype=np.intp))
        return sample_block(
            self.stream, np.array(self._stamps, dtype=np.int64), np.array(self._values), covariance=covariances,
            frames=np.array(self._frames), arrival=np.array(self._arrival, dtype=np.int64),
            refused=np.array(self._refused), reasons=self._reasons,
        )  # fmt: skip
