"""ROS messages to samples, for rclpy's message objects and for rosbags' alike: only their fields are looked at.

The one place where messages become samples: `MessageFeed` checks frames and stamps and feeds a `Calibrator`. What the
message types of the drivers hold is in `drivers`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.findings import Finding, finding
from ..calibration.frames import FLU_FROM_FRD, Array, Vector
from ..calibration.imu_alignment import ImuAlignment
from ..calibration.parameters import FRD, FROM_FRAME_ID, FROM_MESSAGE
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from .drivers import VelocityType, velocity_type

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
    """Takes the (3, 3) of the linear velocity out of covariances of messages: of it alone, or of a twist.

    Most drivers send the same covariance with every message; it stays the same object then, and what is made of it
    need not be made again. turned: from forward-right-down to forward-left-up, or the other way.
    """

    def __init__(self, turned: bool = False) -> None:
        self._bytes = b""
        self._linear: Array = np.zeros((3, 3))
        self._turned = turned

    def __call__(self, covariance: Any) -> Array | None:
        """(9,) or (36,) -> (3, 3); None -> None. Raises ValueError for any other size."""
        if covariance is None:
            return None
        array = np.asarray(covariance, dtype=float)
        content = array.tobytes()
        if content != self._bytes:
            linear = array.reshape(3, 3) if array.size == 9 else array.reshape(6, 6)[:3, :3]
            self._linear = linear * _TURNED_COVARIANCE if self._turned else linear.copy()
            self._bytes = content
        return self._linear


# F C F of a covariance C and the diagonal F = FLU_FROM_FRD, element by element
_TURNED_COVARIANCE = np.outer(FLU_FROM_FRD.diagonal(), FLU_FROM_FRD.diagonal())
# what a message of another layout than its type's makes the readers raise
_UNREADABLE = (AttributeError, TypeError, ValueError, IndexError, OverflowError)


class _Reader:
    """Reads the velocity and its covariance from messages of one type. turned: as in `LinearCovariance`."""

    def __init__(self, kind: VelocityType, turned: bool = False) -> None:
        self._velocity, self._given = kind.velocity, kind.covariance
        self._covariance = LinearCovariance(turned)
        self._turned = turned

    def __call__(self, message: Any) -> tuple[Vector, Array | None]:
        velocity = self._velocity(message)
        covariance = self._covariance(self._given(message))
        if self._turned:
            return (velocity.x, -velocity.y, -velocity.z), covariance
        return (velocity.x, velocity.y, velocity.z), covariance


class MessageFeed:
    """Feeds a calibrator with messages.

    on_problem is called with a sentence (what is wrong, what to do) when a problem is new; `problems` keeps the latest
    finding of each kind. Counting is the calibrator's. The messages are of the types that its parameters dvl_type and
    gnss_type name; raises InputError for what is none.
    """

    def __init__(self, calibrator: Calibrator, on_problem: Callable[[str], None]) -> None:
        self.calibrator = calibrator
        self.dvl_type = velocity_type("dvl_type", calibrator.parameters.dvl_type)
        self._reference_type = velocity_type("gnss_type", calibrator.parameters.gnss_type)
        self._reference_reader = _Reader(self._reference_type)
        self._imu_alignment = ImuAlignment(calibrator.parameters)
        self._on_problem = on_problem
        self.forget()

    def forget(self) -> None:
        """Forget the problems and the frames seen."""
        self.problems: dict[str, Finding] = {}
        self.zero_stamps = 0
        self.dvl_frame: str | None = self.calibrator.parameters.dvl_frame or None
        self._dvl_reader: _Reader | None = None
        self._imu_frame: str | None = None
        self._reference_frames: dict[str, VelocityFrame | None] = {}

    @property
    def reference_frame(self) -> VelocityFrame | None:
        """Frame of the reference's messages, of the first that were taken; None before."""
        return next((frame for frame in self._reference_frames.values() if frame is not None), None)

    def dvl(self, message: Any, received_ns: int) -> DvlSample | None:
        """Feed a message of dvl_type; the sample as `Calibrator.feed_dvl` gives it back."""
        calibrator, kind = self.calibrator, self.dvl_type
        try:
            frame_id = kind.frame_id(message)
            if frame_id != self.dvl_frame and not self._accept_dvl_frame(frame_id):
                calibrator.refuse("dvl", "wrong_frame")
                return None
            broken = kind.broken_rule(message, calibrator.parameters)
            if broken is not None:
                calibrator.refuse("dvl", broken.counter)
                return None
            velocity, covariance = (self._dvl_reader or self._make_dvl_reader(frame_id))(message)
            stamp = self._stamp_ns("dvl", message.header, received_ns)
        except _UNREADABLE as error:
            self.undecodable("dvl", f"{kind.name}, {type(error).__name__}: {error}")
            return None
        return calibrator.feed_dvl(DvlSample(stamp, velocity, covariance))

    def reference(self, message: Any, received_ns: int) -> ReferenceSample | None:
        """Feed a message of gnss_type with the reference velocity; the sample, or None if refused."""
        try:
            frame_id = self._reference_type.frame_id(message)
            if frame_id not in self._reference_frames:
                if len(self._reference_frames) == MAX_FRAMES:  # garbage, ever new
                    self._reference_frames.clear()
                self._reference_frames[frame_id] = self._reference_frame(frame_id)
            frame = self._reference_frames[frame_id]
            if frame is None:
                self.calibrator.refuse("reference", "wrong_frame")
                return None
            velocity, covariance = self._reference_reader(message)
            stamp = self._stamp_ns("reference", message.header, received_ns)
        except _UNREADABLE as error:
            self.undecodable("reference", f"{self._reference_type.name}, {type(error).__name__}: {error}")
            return None
        sample = ReferenceSample(stamp, velocity, covariance, frame)
        self.calibrator.feed_reference(sample)
        return sample

    def imu(self, message: Any, received_ns: int) -> ImuSample:
        """Feed a sensor_msgs/Imu. A covariance that starts with -1 says that there is no such data.

        The sample that comes back is the body's, in ENU, as parameters imu_rpy and imu_frame turn it.
        """
        frame_id = message.header.frame_id
        if frame_id != self._imu_frame:
            self._note_imu_frame(frame_id)
        q, w = message.orientation, message.angular_velocity
        sample = ImuSample(
            self._stamp_ns("imu", message.header, received_ns),
            None if message.orientation_covariance[0] == -1.0 else (q.x, q.y, q.z, q.w),
            None if message.angular_velocity_covariance[0] == -1.0 else (w.x, w.y, w.z),
        )
        sample = self._imu_alignment.sample(sample)
        self.calibrator.feed_imu(sample)
        return sample

    def undecodable(self, stream: str, reason: str) -> None:
        """Count a message that could not be decoded at all."""
        self.calibrator.refuse(stream, "invalid")
        self._problem(f"{stream} undecodable", finding("MESSAGE_UNDECODABLE", stream=stream, reason=reason))

    def _stamp_ns(self, stream: str, header: Any, received_ns: int) -> int:
        stamp = stamp_ns(header.stamp)
        if stamp:
            return stamp
        self.zero_stamps += 1
        self._problem(f"{stream} stamp", finding("STAMP_MISSING", stream=stream))
        return received_ns

    def _accept_dvl_frame(self, frame_id: str) -> bool:
        p = self.calibrator.parameters
        if not p.dvl_frame and self.dvl_frame is None and not self._is_body_or_earth(frame_id):
            self.dvl_frame = frame_id
            return True
        expected = self.dvl_frame or "the DVL's own frame (dvl_link)"
        self._problem("dvl frame", finding("DVL_FRAME", frame_id=frame_id, expected=expected))
        return False

    @property
    def turns_dvl(self) -> bool:
        """Whether the DVL's data are turned from forward-right-down to forward-left-up."""
        axes = self.calibrator.parameters.dvl_axes
        if axes != FROM_MESSAGE:
            return axes == FRD
        suffix = (self.dvl_frame or "").lower().rpartition("_")[2]
        return suffix == "frd" or (self.dvl_type.points_down and suffix != "flu")

    def _make_dvl_reader(self, frame_id: str) -> _Reader:
        """The reader of the DVL's messages, made at the first that has passed, which tells the frame."""
        self._dvl_reader = _Reader(self.dvl_type, self.turns_dvl)
        if self.turns_dvl and self.calibrator.parameters.rotation_dvl_from_body[2, 2] < 0.0:
            self._problem("dvl axes", finding("DVL_TURNED_TWICE", frame_id=frame_id))
        return self._dvl_reader

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
            known = {"base": p.base_frame, "earth": ", ".join(EARTH_FRAMES)}
            self._problem("reference frame", finding("REFERENCE_FRAME", frame_id=frame_id, **known))
        return frame

    def _note_imu_frame(self, frame_id: str) -> None:
        self._imu_frame = frame_id
        base = self.calibrator.parameters.base_frame
        if self._imu_alignment.is_identity and frame_id.lstrip("/") != base.lstrip("/"):
            self._problem("imu frame", finding("IMU_FRAME", frame_id=frame_id, base=base))

    def _problem(self, kind: str, found: Finding) -> None:
        is_new = kind not in self.problems
        self.problems[kind] = found
        if is_new:  # two frames in turn, or ever new garbage, must not be told of at every message
            self._on_problem(str(found))
