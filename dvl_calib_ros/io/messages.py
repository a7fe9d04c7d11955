"""ROS messages to samples, for rclpy's message objects and for rosbags' alike: only their fields are looked at.

The one place where messages become samples: `MessageFeed` checks frames and stamps and feeds a `Calibrator`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.frames import Array
from ..calibration.parameters import FROM_FRAME_ID
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame

TWIST_TYPE = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU_TYPE = "sensor_msgs/msg/Imu"

# Different frame_ids of the reference that are remembered.
MAX_FRAMES = 64

EARTH_FRAMES = {
    "enu": VelocityFrame.ENU,
    "map": VelocityFrame.ENU,
    "odom": VelocityFrame.ENU,
    "world": VelocityFrame.ENU,
    "ned": VelocityFrame.NED,
}


def stamp_ns(stamp: Any) -> int:
    """builtin_interfaces/Time -> integer nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


class LinearCovariance:
    """Takes the linear (3, 3) part out of twist covariances (36,).

    Most drivers send the same covariance with every message; it stays the same object then, and what is made of it
    need not be made again.
    """

    def __init__(self) -> None:
        self._bytes = b""
        self._linear: Array = np.zeros((3, 3))

    def __call__(self, covariance: Any) -> Array:
        """(36,) -> (3, 3)."""
        array = np.asarray(covariance, dtype=float)
        content = array.tobytes()
        if content != self._bytes:
            self._bytes = content
            self._linear = array.reshape(6, 6)[:3, :3].copy()
        return self._linear


class MessageFeed:
    """Feeds a calibrator with messages.

    on_problem is called with a sentence (what is wrong, what to do) when a problem is new; `problems` keeps the latest
    sentence of each kind. Counting is the calibrator's.
    """

    def __init__(self, calibrator: Calibrator, on_problem: Callable[[str], None]) -> None:
        self.calibrator = calibrator
        self._dvl_covariance = LinearCovariance()
        self._reference_covariance = LinearCovariance()
        self._on_problem = on_problem
        self.forget()

    def forget(self) -> None:
        """Forget the problems and the frames seen."""
        self.problems: dict[str, str] = {}
        self.zero_stamps = 0
        self.dvl_frame: str | None = self.calibrator.parameters.dvl_frame or None
        self._imu_frame: str | None = None
        self._reference_frames: dict[str, VelocityFrame | None] = {}

    @property
    def reference_frame(self) -> VelocityFrame | None:
        """Frame of the reference's messages, of the first that were taken; None before."""
        return next((frame for frame in self._reference_frames.values() if frame is not None), None)

    def dvl(self, message: Any, received_ns: int) -> DvlSample | None:
        """Feed a TwistWithCovarianceStamped from the DVL; the sample if it is valid and in order."""
        frame_id = message.header.frame_id
        if frame_id != self.dvl_frame and not self._accept_dvl_frame(frame_id):
            self.calibrator.refuse("dvl", "wrong_frame")
            return None
        linear = message.twist.twist.linear
        sample = DvlSample(
            self._stamp_ns("dvl", message.header, received_ns),
            (linear.x, linear.y, linear.z),
            self._dvl_covariance(message.twist.covariance),
        )
        return sample if self.calibrator.feed_dvl(sample) else None

    def reference(self, message: Any, received_ns: int) -> ReferenceSample | None:
        """Feed a TwistWithCovarianceStamped with the reference velocity; the sample, or None if refused."""
        frame_id = message.header.frame_id
        if frame_id not in self._reference_frames:
            if len(self._reference_frames) == MAX_FRAMES:  # garbage, ever new
                self._reference_frames.clear()
            self._reference_frames[frame_id] = self._reference_frame(frame_id)
        frame = self._reference_frames[frame_id]
        if frame is None:
            self.calibrator.refuse("reference", "wrong_frame")
            return None
        linear = message.twist.twist.linear
        sample = ReferenceSample(
            self._stamp_ns("reference", message.header, received_ns),
            (linear.x, linear.y, linear.z),
            self._reference_covariance(message.twist.covariance),
            frame,
        )
        self.calibrator.feed_reference(sample)
        return sample

    def imu(self, message: Any, received_ns: int) -> ImuSample:
        """Feed a sensor_msgs/Imu. A covariance that starts with -1 says that there is no such data."""
        frame_id = message.header.frame_id
        if frame_id != self._imu_frame:
            self._note_imu_frame(frame_id)
        q, w = message.orientation, message.angular_velocity
        sample = ImuSample(
            self._stamp_ns("imu", message.header, received_ns),
            None if message.orientation_covariance[0] == -1.0 else (q.x, q.y, q.z, q.w),
            None if message.angular_velocity_covariance[0] == -1.0 else (w.x, w.y, w.z),
        )
        self.calibrator.feed_imu(sample)
        return sample

    def undecodable(self, stream: str, reason: str) -> None:
        """Count a message that could not be decoded at all."""
        self.calibrator.refuse(stream, "invalid")
        self._problem(f"{stream} undecodable", f"{stream}: a message could not be decoded ({reason}); it is skipped")

    def _stamp_ns(self, stream: str, header: Any, received_ns: int) -> int:
        stamp = stamp_ns(header.stamp)
        if stamp:
            return stamp
        self.zero_stamps += 1
        self._problem(
            f"{stream} stamp",
            f"{stream}: messages without a header stamp; the time of reception is used, which costs accuracy in "
            "turns. Let the driver fill header.stamp.",
        )
        return received_ns

    def _accept_dvl_frame(self, frame_id: str) -> bool:
        p = self.calibrator.parameters
        if not p.dvl_frame and self.dvl_frame is None and not self._is_body_or_earth(frame_id):
            self.dvl_frame = frame_id
            return True
        expected = self.dvl_frame or "the DVL's own frame (dvl_link)"
        self._problem(
            "dvl frame",
            f"dvl: a message has frame_id {frame_id!r} where {expected!r} is expected; it is not used. Let the driver "
            f"publish in the DVL's own frame, or set parameter dvl_frame to {frame_id!r} if that is its name.",
        )
        return False

    def _is_body_or_earth(self, frame_id: str) -> bool:
        name = frame_id.lstrip("/")
        return name == self.calibrator.parameters.base_frame.lstrip("/") or name.lower() in EARTH_FRAMES

    def _reference_frame(self, frame_id: str) -> VelocityFrame | None:
        p = self.calibrator.parameters
        if p.gnss_frame != FROM_FRAME_ID:
            return VelocityFrame(p.gnss_frame)
        name = frame_id.lstrip("/")
        frame = VelocityFrame.BODY if name == p.base_frame.lstrip("/") else EARTH_FRAMES.get(name.lower())
        if frame is None:
            self._problem(
                "reference frame",
                f"reference: frame_id {frame_id!r} says neither body ({p.base_frame}) nor earth "
                f"({', '.join(EARTH_FRAMES)}); its messages are not used. Set parameter gnss_frame to body, enu or "
                "ned.",
            )
        return frame

    def _note_imu_frame(self, frame_id: str) -> None:
        self._imu_frame = frame_id
        base = self.calibrator.parameters.base_frame
        if frame_id.lstrip("/") != base.lstrip("/"):
            self._problem(
                "imu frame",
                f"imu: data is in frame {frame_id!r}; it is taken as the orientation and angular velocity of {base}. "
                "If the IMU is mounted turned, let its driver turn the data.",
            )

    def _problem(self, kind: str, sentence: str) -> None:
        is_new = kind not in self.problems
        self.problems[kind] = sentence
        if is_new:  # two frames in turn, or ever new garbage, must not be told of at every message
            self._on_problem(sentence)
