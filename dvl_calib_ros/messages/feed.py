"""A calibrator fed with ROS messages one by one, as they come live."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from ..calibration.calibrator import Calibrator
from ..calibration.frames import Array
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, Stream
from .decode import MessageDecoder, Refusal
from .kept import KeptMessages

AnySample = TypeVar("AnySample", DvlSample, ReferenceSample, ImuSample)


class MessageFeed:
    """Feeds a calibrator, which counts, with the samples that messages are, or why they are none.

    decoder: what makes them samples; on_problem is told of its problems when they are new. kept: for `begin_again`.
    Raises InputError for message types that are none.
    """

    def __init__(self, calibrator: Calibrator, on_problem: Callable[[str], None] = lambda _: None) -> None:
        self.calibrator = calibrator
        self.decoder = MessageDecoder(calibrator.parameters, on_problem)
        self.decoder.on_fix = self._fix
        self.kept = KeptMessages()
        self._fixes: list[tuple[int, Array, Array]] = []

    def begin_again(self, calibrator: Calibrator) -> None:
        """Feed another calibrator from here on, and what is kept first."""
        self.calibrator = calibrator
        self.decoder.parameters = calibrator.parameters
        streams = self.kept.streams
        if streams is not None:
            for fix in self._fixes:
                calibrator.feed_fix(*fix)
            calibrator.feed(streams)

    def forget(self) -> None:
        """Forget what came so far."""
        self.decoder.forget()
        self.kept = KeptMessages()
        self._fixes.clear()

    def dvl(self, message: Any, received_ns: int) -> DvlSample | None:
        """Feed a message of dvl_type; the sample as `Calibrator.feed_dvl` gives it back."""
        sample = self._taken(Stream.DVL, self.decoder.dvl(message, received_ns))
        return None if sample is None else self.calibrator.feed_dvl(sample)

    def reference(self, message: Any, received_ns: int) -> ReferenceSample | None:
        """Feed a message of gnss_type with the reference velocity; the sample, or None if refused."""
        sample = self._taken(Stream.REFERENCE, self.decoder.reference(message, received_ns))
        if sample is not None:
            self.calibrator.feed_reference(sample)
        return sample

    def imu(self, message: Any, received_ns: int) -> ImuSample | None:
        """Feed a sensor_msgs/Imu; the sample, or None if refused."""
        sample = self._taken(Stream.IMU, self.decoder.imu(message, received_ns))
        if sample is not None:
            self.calibrator.feed_imu(sample)
        return sample

    def _fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        if self.kept.is_kept:
            self._fixes.append((stamp_ns, position, variance))
        else:
            self._fixes.clear()
        self.calibrator.feed_fix(stamp_ns, position, variance)

    def _taken(self, stream: Stream, decoded: AnySample | Refusal) -> AnySample | None:
        """A message's sample; None for one that is refused, which is counted."""
        if isinstance(decoded, Refusal):
            self.kept.add(stream, decoded.reason)
            self.calibrator.refuse(stream.value, decoded.reason)
            return None
        self.kept.add(stream, decoded)
        return decoded

    def undecodable(self, stream: str, reason: str) -> None:
        """Count a message that could not be decoded at all."""
        self.calibrator.refuse(stream, self.decoder.undecodable(Stream(stream), reason).reason)
