"""Decoding of ROS messages to samples, for the message objects of rclpy and rosbags: only fields are accessed.

All decoding is here (individual messages) and in `columns` (arrays). It checks frames and stamps, and applies the rules
of the message types in `drivers`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np

from ..calibration.models.parameters import FLU, FRD, FROM_FRAME_ID, FROM_MESSAGE, NWU, Parameters
from ..calibration.numerics.frames import ENU_FROM_NED, Array, Vector
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, Stream, VelocityFrame
from ..calibration.streams.imu_frame import ImuAlignment
from ..verdict.reasons import Reason, finding
from .drivers import IMU_TYPE, NOT_MEASURED, VelocityType, velocity_type
from .positions import SATELLITES, FixDifference, Place, PositionType

# counters of physically impossible messages, and of messages in another frame
INVALID, WRONG_FRAME = "invalid", "wrong_frame"
# counter of positions without a fix one window earlier
FIRST_FIX = "first_fix"
# first covariance element of a quantity that an IMU does not measure
NO_DATA = -1.0
# value of parameter restamp for every message
RESTAMP_ALL = "log"
# limit of remembered frame_ids of the reference
MAX_FRAMES = 64
# limit of a stored frame_id: garbage may make it megabytes long, and results and messages repeat it
LONGEST_FRAME_ID = 255

EARTH_FRAMES = {
    "enu": VelocityFrame.ENU,
    "map": VelocityFrame.ENU,
    "odom": VelocityFrame.ENU,
    "world": VelocityFrame.ENU,
    "ned": VelocityFrame.NED,
}


class Axes(NamedTuple):
    """A signed permutation of axes: component i is sign[i] times component order[i] of the message."""

    order: tuple[int, int, int]
    sign: tuple[float, float, float]

    def velocity(self, values: Array) -> Array:
        """Return velocities (..., 3) in the other axes."""
        return np.asarray(values[..., self.order] * self.sign)

    def covariance(self, values: Array) -> Array:
        """Return covariances (..., 3, 3) in the other axes."""
        turned = values[..., self.order, :][..., self.order]
        return np.asarray(turned * np.outer(self.sign, self.sign))


AS_SENT = Axes((0, 1, 2), (1.0, 1.0, 1.0))
# forward-right-down to forward-left-up and back; north-west-up to east-north-up
HALF_TURN, QUARTER_TURN = Axes((0, 1, 2), (1.0, -1.0, -1.0)), Axes((1, 0, 2), (-1.0, 1.0, 1.0))


class DeclaredFrame(NamedTuple):
    """A frame of reference velocities: the core's frame, and the axes from which messages are converted to it.

    body_axes: flu or frd, if the body's axes are named; empty for the axes of base_frame.
    """

    frame: VelocityFrame
    axes: Axes = AS_SENT
    body_axes: str = ""

    @property
    def name(self) -> str:
        """Value of parameter gnss_frame."""
        return NWU if self.axes is QUARTER_TURN else self.body_axes or self.frame.value

    def in_base(self, base_axes: str) -> DeclaredFrame:
        """Return the frame to use: the own axes of base_frame need no conversion."""
        return DeclaredFrame(self.frame) if self.body_axes == base_axes else self


# by value of parameter gnss_frame
DECLARED_FRAMES = {
    declared.name: declared
    for declared in (
        *map(DeclaredFrame, VelocityFrame),
        *(DeclaredFrame(VelocityFrame.BODY, HALF_TURN, axes) for axes in (FLU, FRD)),
        DeclaredFrame(VelocityFrame.ENU, QUARTER_TURN),
    )
}
# by suffix of a frame's name
_SUFFIXES = {"enu": "enu", "ned": "ned", "nwu": NWU, "flu": FLU, "frd": FRD}


def frame_name(frame_id: str) -> str:
    """Return a frame_id, shortened if it is too long to be a name."""
    return frame_id if len(frame_id) <= LONGEST_FRAME_ID else f"{frame_id[: LONGEST_FRAME_ID - 1]}…"


def frame_named(frame_id: str, base_frames: Collection[str]) -> DeclaredFrame | None:
    """Return the frame of velocities with this frame_id; None if unknown."""
    name = frame_id.strip("/")
    link = name.rpartition("/")[2]  # without the namespace
    if link in {base.strip("/").rpartition("/")[2] for base in base_frames}:
        return DeclaredFrame(VelocityFrame.BODY)
    if name.lower() in EARTH_FRAMES:
        return DeclaredFrame(EARTH_FRAMES[name.lower()])
    suffix = _SUFFIXES.get(name.lower().rpartition("_")[2]) if "_" in name else None
    return None if suffix is None else DECLARED_FRAMES[suffix]


def declared_frame(
    kind: VelocityType, frame_id: str, parameters: Parameters, base_frame: str = ""
) -> DeclaredFrame | None:
    """Return the frame that a reference declares, by parameter, type or frame_id; None if unknown.

    base_frame: another name of the body.
    """
    if parameters.gnss_frame != FROM_FRAME_ID:
        return DECLARED_FRAMES[parameters.gnss_frame]
    if kind.reference_frame is not None:
        return DeclaredFrame(kind.reference_frame)
    return frame_named(frame_id, (parameters.base_frame, base_frame or parameters.base_frame))


def heading_variance(covariance: Any) -> float:
    """Return the variance of an IMU's orientation about z, rad², from its covariance (9,); nan if not given."""
    given = covariance[0] != NO_DATA and covariance[8] > 0.0
    return float(covariance[8]) if given else math.nan


def stamp_ns(stamp: Any) -> int:
    """Convert builtin_interfaces/Time to integer nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


class Refusal(NamedTuple):
    """A message that is no sample. reason: name of its counter."""

    reason: str


class LinearCovariance:
    """Extractor of the linear velocity's covariance (3, 3) from that of a velocity or a twist.

    Most drivers send the same covariance with every message; the same array is then returned again, so that results
    computed from it can be reused. axes: conversion to apply.
    """

    def __init__(self, axes: Axes = AS_SENT) -> None:
        self._bytes = b""
        self._linear: Array = np.zeros((3, 3))
        self._axes = axes

    def __call__(self, covariance: Any) -> Array | None:
        """Convert (9,) or (36,) to (3, 3); None to None. Raises ValueError for any other size."""
        if covariance is None:
            return None
        array = np.asarray(covariance, dtype=float)
        content = array.tobytes()
        if content != self._bytes:
            linear = array.reshape(3, 3) if array.size == 9 else array.reshape(6, 6)[:3, :3]
            self._linear = self._axes.covariance(linear)
            self._bytes = content
        return self._linear


OnFix = Callable[[int, Array, Array], None]
# exceptions of the readers for a message with an unexpected layout
UNREADABLE = (AttributeError, TypeError, ValueError, IndexError, OverflowError)


class VelocityReader:
    """Reader of the velocity and its covariance from messages of one type. axes: as in `LinearCovariance`."""

    def __init__(self, kind: VelocityType, axes: Axes = AS_SENT) -> None:
        self._velocity, self._given, self._lacks = kind.velocity, kind.covariance, kind.lacks_covariance
        self._covariance = LinearCovariance(axes)
        self._axes = axes

    def __call__(self, message: Any) -> tuple[Vector, Array | None]:
        """Return the vector, m/s or a position, and its covariance (3, 3), None if not given."""
        velocity = self._velocity(message)
        covariance = None if self._lacks(message) else self._covariance(self._given(message))
        if self._axes is AS_SENT:
            return (velocity.x, velocity.y, velocity.z), covariance
        sent = velocity.x, velocity.y, velocity.z
        x, y, z = (sign * sent[place] for place, sign in zip(*self._axes, strict=True))
        return (x, y, z), covariance


def turns_dvl(kind: VelocityType, frame_id: str, parameters: Parameters) -> bool:
    """Return whether a DVL's velocities must be rotated by 180° about x, from their own axes to those of base_frame.

    A z-down vehicle's DVL is z down as well, unless its frame_id ends in _flu.
    """
    if parameters.dvl_axes != FROM_MESSAGE:
        return parameters.dvl_axes != parameters.base_axes
    if parameters.is_z_down:
        return frame_id.lower().endswith("_flu")
    return kind.is_turned(frame_id)


class MessageDecoder:
    """Decoder of messages of the types in parameters dvl_type and gnss_type, and of sensor_msgs/Imu.

    `problems` has the latest finding of each kind; on_problem receives the text of each new one. on_fix receives every
    position: stamp, position (3,) m in ENU from the first, and its variances (3,) m², nan if unknown. The decoder
    remembers only frames of earlier messages: the DVL's first frame is the DVL's own. adapted: by the node's topic, a
    conversion to apply first. Raises InputError for an unknown type.
    """

    def __init__(self, parameters: Parameters, on_problem: Callable[[str], None] = lambda _: None) -> None:
        """Select the conversion of each type. on_problem: receives the text of each new problem."""
        self.parameters = parameters
        self.dvl_type = velocity_type("dvl_type", parameters.dvl_type)
        self.reference_type = velocity_type("gnss_type", parameters.gnss_type)
        self.imu_alignment = ImuAlignment(parameters)
        self._reference_readers: dict[Axes, VelocityReader] = {}
        self.adapted = {"dvl/twist": self.dvl_type.adapted, "gnss/twist": self.reference_type.adapted}
        self._on_problem = on_problem
        self.on_fix: OnFix = lambda *_: None
        self.forget()

    def forget(self) -> None:
        """Forget problems and frames."""
        self.problems: dict[str, Reason] = {}
        self.zero_stamps = 0
        self.dvl_frame: str | None = self.parameters.dvl_frame or None
        self._dvl_reader: VelocityReader | None = None
        self._imu_frame: str | None = None
        self._reference_frames: dict[str, DeclaredFrame | None] = {}
        position = self.reference_type.position
        self.fixes = FixDifference(self.parameters.position_window, None if position is None else position.between)
        self._origin: Place | None = None

    def dvl(self, message: Any, received_ns: int) -> DvlSample | Refusal:
        """Decode a message of dvl_type."""
        kind = self.dvl_type
        try:
            if not self.accepts_dvl_frame(kind.frame_id(message)):
                return Refusal(WRONG_FRAME)
            broken = kind.broken_rule(message, self.parameters)
            if broken:
                return Refusal(kind.rules[broken - 1].counter)
            if self._dvl_reader is None:
                self._dvl_reader = VelocityReader(kind, HALF_TURN if self.turns_dvl else AS_SENT)
                self.note_axes()
            velocity, covariance = self._dvl_reader(message)
            stamp = self._stamp_ns(Stream.DVL, message.header, received_ns)
        except UNREADABLE as error:
            return self.undecodable(Stream.DVL, f"{kind.name}, {type(error).__name__}: {error}")
        return DvlSample(stamp, velocity, covariance)

    def reference(self, message: Any, received_ns: int) -> ReferenceSample | Refusal:
        """Decode a message of gnss_type with the reference velocity."""
        kind = self.reference_type
        try:
            frame = self.reference_frame(kind.frame_id(message))
            if frame is None:
                return Refusal(WRONG_FRAME)
            stamp = self._stamp_ns(Stream.REFERENCE, message.header, received_ns)
            broken = 0 if kind.position is None else kind.broken_rule(message, self.parameters)
            if broken:
                return Refusal(kind.rules[broken - 1].counter)
            axes = AS_SENT if kind.position is SATELLITES else frame.axes  # latitude and longitude have no axes
            if axes not in self._reference_readers:
                self._reference_readers[axes] = VelocityReader(kind, axes)
            values, covariance = self._reference_readers[axes](message)
            if kind.position is not None:
                return self._difference(stamp, values, covariance, frame.frame)
        except UNREADABLE as error:
            return self.undecodable(Stream.REFERENCE, f"{kind.name}, {type(error).__name__}: {error}")
        return ReferenceSample(stamp, values, covariance, frame.frame)

    def _difference(
        self, stamp_ns: int, place: Place, covariance: Array | None, frame: VelocityFrame
    ) -> ReferenceSample | Refusal:
        """Return the velocity between a position and the one a window earlier."""
        self.note_fix(stamp_ns, place, covariance, frame)
        mean = self.fixes(stamp_ns, *place, covariance)
        if mean is None:
            return Refusal(FIRST_FIX)
        return ReferenceSample(mean.stamp_ns, mean.velocity, mean.covariance, frame)

    def note_fix(self, stamp_ns: int, place: Place, covariance: Array | None, frame: VelocityFrame) -> None:
        """Give a valid position to `on_fix`."""
        kind = self.reference_type.position
        if kind is not None and frame is not VelocityFrame.BODY and math.isfinite(sum(place)):
            self._origin = self._origin or place
            self.on_fix(stamp_ns, *_east_north_up(kind, self._origin, place, covariance, frame))

    def imu(self, message: Any, received_ns: int) -> ImuSample | Refusal:
        """Decode a sensor_msgs/Imu. A covariance that starts with -1 means that the quantity is missing.

        The sample describes the body, in ENU, converted by parameters imu_rpy and imu_frame.
        """
        try:
            self.note_imu_frame(message.header.frame_id)
            q, w = message.orientation, message.angular_velocity
            sample = ImuSample(
                self._stamp_ns(Stream.IMU, message.header, received_ns),
                None if message.orientation_covariance[0] == NO_DATA else (q.x, q.y, q.z, q.w),
                None if message.angular_velocity_covariance[0] == NO_DATA else (w.x, w.y, w.z),
            )
        except UNREADABLE as error:
            return self.undecodable(Stream.IMU, f"{IMU_TYPE}, {type(error).__name__}: {error}")
        return self.imu_alignment.sample(sample)

    def undecodable(self, stream: Stream, reason: str) -> Refusal:
        """Note a message that could not be decoded."""
        self._report(f"{stream.value} undecodable", finding("MESSAGE_UNDECODABLE", stream=stream.value, reason=reason))
        return Refusal(INVALID)

    def _stamp_ns(self, stream: Stream, header: Any, received_ns: int) -> int:
        """Return a message's stamp, or the time of reception if it is zero or to be ignored."""
        stamp = received_ns if self.parameters.restamp == RESTAMP_ALL else stamp_ns(header.stamp)
        if stamp:
            return stamp
        self.note_zero_stamps(stream, 1)
        return received_ns

    def note_zero_stamps(self, stream: Stream, count: int) -> None:
        """Note messages without a stamp, for which the time of reception is used."""
        self.zero_stamps += count
        self._report(f"{stream.value} stamp", finding("STAMP_MISSING", stream=stream.value))

    def accepts_dvl_frame(self, frame_id: str) -> bool:
        """Return whether this frame is the DVL's. The first possible frame becomes the DVL's own."""
        frame_id = frame_name(frame_id)
        if frame_id == self.dvl_frame:
            return True
        if not self.parameters.dvl_frame and self.dvl_frame is None and not self._is_body_or_earth(frame_id):
            self.dvl_frame = frame_id
            return True
        expected = self.dvl_frame or "the DVL's own frame (dvl_link)"
        self._report("dvl frame", finding("DVL_FRAME", frame_id=frame_id, expected=expected))
        return False

    def _is_body_or_earth(self, frame_id: str) -> bool:
        name = frame_id.lstrip("/")
        return name == self.parameters.base_frame.lstrip("/") or name.lower() in EARTH_FRAMES

    @property
    def turns_dvl(self) -> bool:
        """Return whether the DVL's data are rotated by 180° about x, to the axes of base_frame."""
        return turns_dvl(self.dvl_type, self.dvl_frame or "", self.parameters)

    def note_axes(self) -> None:
        """Report a DVL with both its data and its mounting upside down; its frame must be known."""
        if self.turns_dvl and self.parameters.rotation_dvl_from_body[2, 2] < 0.0:
            self._report("dvl axes", finding("DVL_TURNED_TWICE", frame_id=self.dvl_frame))

    @property
    def frame_of_reference(self) -> VelocityFrame | None:
        """Frame of the first accepted reference message; None before."""
        return next((declared.frame for declared in self._reference_frames.values() if declared is not None), None)

    @property
    def frame_ids(self) -> tuple[str, str, str]:
        """frame_id of the DVL's, the reference's and the IMU's messages, '' before the first."""
        return self.dvl_frame or "", next(iter(self._reference_frames), ""), self._imu_frame or ""

    def reference_frame(self, frame_id: str) -> DeclaredFrame | None:
        """Return the frame of reference messages with this frame_id; None if unknown."""
        frame_id = frame_name(frame_id)
        if frame_id not in self._reference_frames:
            if len(self._reference_frames) == MAX_FRAMES:  # garbage with ever new names
                self._reference_frames.clear()
            self._reference_frames[frame_id] = self._frame_named(frame_id)
        return self._reference_frames[frame_id]

    def _frame_named(self, frame_id: str) -> DeclaredFrame | None:
        """Return the reference's frame, by parameter, type or frame_id; None, with a note, if unknown."""
        frame, base = declared_frame(self.reference_type, frame_id, self.parameters), self.parameters.base_frame
        if frame is None:
            self._report("reference frame", finding("REFERENCE_FRAME", frame_id=frame_id, base=base))
            return None
        return frame.in_base(self.parameters.base_axes)

    def note_imu_frame(self, frame_id: str) -> None:
        """Note the frame of IMU messages."""
        frame_id = frame_name(frame_id)
        if frame_id == self._imu_frame:
            return
        self._imu_frame = frame_id
        base = self.parameters.base_frame
        if self.imu_alignment.is_identity and frame_id.lstrip("/") != base.lstrip("/"):
            self._report("imu frame", finding("IMU_FRAME", frame_id=frame_id, base=base))

    def _report(self, kind: str, reason: Reason) -> None:
        """Remember a problem, and report it if it is the first of its kind."""
        is_new = kind not in self.problems
        self.problems[kind] = reason
        if is_new:  # alternating frames or ever new garbage must not be reported with every message
            self._on_problem(str(reason))


def _east_north_up(
    kind: PositionType, origin: Place, place: Place, covariance: Array | None, frame: VelocityFrame
) -> tuple[Array, Array]:
    """Return a position (3,) m from the origin, and its variances (3,) m², nan if unknown."""
    away = np.array(kind.between(origin, place))
    variance = np.full(3, math.nan) if covariance is None else np.diag(covariance).copy()
    if frame is VelocityFrame.NED:
        away, variance = ENU_FROM_NED @ away, variance[[1, 0, 2]]
    variance[~((variance > 0.0) & (variance < NOT_MEASURED))] = math.nan
    if not kind.has_height:
        variance[2] = math.nan
    return away, variance
