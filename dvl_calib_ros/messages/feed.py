"""A calibrator fed with ROS messages one by one, as they come live."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..calibration.calibrator import Calibrator
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, Stream
from .decode import MessageDecoder, Refusal


class MessageFeed:
    """Feeds a calibrator, which counts, with the samples that messages are, or why they are none.

    decoder: what makes them samples; on_problem is told of its problems when they are new. Raises InputError for
    message types that are none.
    """

    def __init__(self, calibrator: Calibrator, on_problem: Callable[[str], None] = lambda _: None) -> None:
        self.calibrator = calibrator
        self.decoder = MessageDecoder(calibrator.parameters, on_problem)

    def dvl(self, message: Any, received_ns: int) -> DvlSample | None:
        """Feed a message of dvl_type; the sample as `Calibrator.feed_dvl` gives it back."""
        decoded = self.decoder.dvl(message, received_ns)
        if isinstance(decoded, Refusal):
            self.calibrator.refuse("dvl", decoded.reason)
            return None
        return self.calibrator.feed_dvl(decoded)

    def reference(self, message: Any, received_ns: int) -> ReferenceSample | None:
        """Feed a message of gnss_type with the reference velocity; the sample, or None if refused."""
        decoded = self.decoder.reference(message, received_ns)
        if isinstance(decoded, Refusal):
            self.calibrator.refuse("reference", decoded.reason)
            return None
        self.calibrator.feed_reference(decoded)
        return decoded

    def imu(self, message: Any, received_ns: int) -> ImuSample | None:
        """Feed a sensor_msgs/Imu; the sample, or None if refused."""
        decoded = self.decoder.imu(message, received_ns)
        if isinstance(decoded, Refusal):
            self.calibrator.refuse("imu", decoded.reason)
            return None
        self.calibrator.feed_imu(decoded)
        return decoded

    def undecodable(self, stream: str, reason: str) -> None:
        """Count a message that could not be decoded at all."""
        self.calibrator.refuse(stream, self.decoder.undecodable(Stream(stream), reason).reason)
