"""Message types from which velocities are read.

Each driver is an entry in `VELOCITY_TYPES`, used by bags, the node, and the documentation's table. The rules follow the
message definitions and the drivers' behaviour: the Water Linked driver (waterlinked_dvl, marine_acoustic_msgs/Dvl) and
dvl-a50 (dvl_msgs/DVL), which both forward the sensor's JSON reports (docs.waterlinked.com/dvl/dvl-json-protocol).
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.samples import VelocityFrame
from ..errors import InputError
from ..verdict.reasons import Reason, finding
from .positions import POSE, SATELLITES, PositionType

# PX4's clock counts microseconds; without synchronisation since boot, and then stamps are invalid
MICROSECOND_NS, SINCE_BOOT_US = 1000, 10**15
# by `velocity_frame`: north-east-down, and the body's forward-right-down; the heading of FRD in the world is arbitrary
FRAMES = {1: "ned", 3: "base_link_frd"}


def of_vehicle_odometry(message: Any) -> SimpleNamespace:
    """Convert a px4_msgs/VehicleOdometry to a stamped twist: header, velocity, covariance (9,), turn rates."""
    at_us = int(message.timestamp_sample or message.timestamp)
    seconds, nanoseconds = divmod(at_us * MICROSECOND_NS if at_us >= SINCE_BOOT_US else 0, 1_000_000_000)
    variance = np.asarray(message.velocity_variance, dtype=float)
    frame_id = FRAMES.get(int(message.velocity_frame), "")
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame_id),
        velocity=_vector(message.velocity),
        covariance=np.diag(variance).ravel() if np.isfinite(variance).all() else None,
        twist=SimpleNamespace(angular=_vector(message.angular_velocity)),
    )


def _vector(values: Any) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip("xyz", map(float, values), strict=True)))


TWIST_TYPE = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE_TYPES = ("geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped")
IMU_TYPE = "sensor_msgs/msg/Imu"
BOTTOM_TRACK, WATER_TRACK = 1, 2
# coordinate_mode of ds_sensor_msgs/Dvl for the instrument's own axes
DS_INSTRUMENT = 1
# variance (m/s)² of an axis that is not measured: it has no information
NOT_MEASURED = 1e6
# smallest number of beams for a velocity in three axes
ENOUGH_BEAMS = 3
_LARGEST = sys.float_info.max


class Rule(NamedTuple):
    """A condition under which a message's velocity is invalid, even if plausible.

    counter: name of the counter of such messages.
    says: the fault.
    broken: the test, for a message or for columns of many, so it uses operators valid for both.
    remedy: what to do.
    """

    counter: str
    says: str
    broken: Callable[[Any, Parameters], Any]
    remedy: str

    @property
    def in_words(self) -> str:
        """The fault as text for a terminal."""
        return self.says.replace("`", "")


@dataclass(frozen=True)
class VelocityType:
    """One message type.

    velocity: message -> object with x, y, z, m/s; of a type of positions the position.
    covariance: message -> covariance of that vector, row-major, 9 numbers or 36 of a twist or pose; None if not given.
    lacks_covariance: message -> whether the field is a placeholder.
    frame_id: message -> frame of the velocity.
    is_read_in_columns: whether these functions also work on columns of messages, which needs a type without lists.
    points_down: forward-right-down unless the frame's name says otherwise.
    rules: of a DVL, or of positions; the first broken one counts.
    is_reference, is_dvl: whether references and DVLs use this type.
    position: properties of positions (positions.py), None for a type of velocities.
    reference_frame: axes of a reference in this type regardless of frame_id; None to use frame_id.
    adapted: conversion of a message without header; None if not needed.
    definitions: versions of the definition, for bags without.
    install: how to get the package, if ROS does not have it.
    """

    name: str
    sent_by: str
    velocity: Callable[[Any], Any] = attrgetter("velocity")
    covariance: Callable[[Any], Any] = lambda _: None
    covariance_says: str = "none"
    lacks_covariance: Callable[[Any], Any] = lambda _: False
    is_read_in_columns: bool = True
    frame_id: Callable[[Any], Any] = attrgetter("header.frame_id")
    frame_says: str = "`header.frame_id`"
    points_down: bool = False
    rules: tuple[Rule, ...] = ()
    is_reference: bool = False
    is_dvl: bool = True
    position: PositionType | None = None
    reference_frame: VelocityFrame | None = None
    adapted: Callable[[Any], Any] | None = None
    definitions: tuple[str, ...] = ()
    install: str = ""

    def is_turned(self, frame_id: str) -> bool:
        """Return whether velocities in this frame are forward-right-down: by the frame's suffix, else by the type."""
        suffix = frame_id.lower().rpartition("_")[2]
        return suffix == "frd" or (self.points_down and suffix != "flu")

    def broken_rule(self, message: Any, parameters: Parameters) -> int:
        """Return 1 + index of the first rule that a message breaks; 0 if none."""
        return next((code for code, rule in enumerate(self.rules, start=1) if rule.broken(message, parameters)), 0)

    def advice(self, counts: Mapping[str, int]) -> list[Reason]:
        """Return findings on the messages refused by rules; counts: `Calibrator.counts` of the DVL."""
        return [
            finding("DVL_REFUSED", count=counts[rule.counter], reason=rule.in_words, remedy=rule.remedy)
            for rule in self.rules
            if counts.get(rule.counter)
        ]


def _zero_velocity(read: Callable[[Any], Any]) -> Rule:
    """Return the rule that a velocity is not exactly zero on all axes."""

    def broken(message: Any, _: Parameters) -> Any:
        velocity = read(message)
        return (velocity.x == 0.0) & (velocity.y == 0.0) & (velocity.z == 0.0)

    # no sensor measures exactly zero on three axes, but drivers send it without a measurement
    return Rule("zero_velocity", "exactly zero on all three axes", broken, "check bottom lock, and the driver")


def _flagged(field: str) -> Rule:
    flag = attrgetter(field)
    return Rule("flagged_invalid", f"`{field}` is false", lambda message, _: flag(message) == 0, CHECK_LOCK)


CHECK_LOCK = "check that the bottom is in range and nothing blocks the beams"


def _has_no_altitude(message: Any) -> Any:
    return _is_outside(message.altitude, 0.0, _LARGEST)


def _has_no_range(message: Any) -> Any:
    """Return whether too few beams for a velocity have a range; Gazebo's bridge never fills in the altitude."""
    ranges = np.asarray(message.range, dtype=float)
    with_range = (ranges > 0.0) & (ranges <= _LARGEST)
    return (message.beam_ranges_valid == 0) | (with_range.sum(axis=-1) < ENOUGH_BEAMS)


# without bottom lock the sensor sends altitude -1; 0 means that the driver does not fill it
_NO_BOTTOM = Rule(
    "no_bottom", "`altitude` is negative or not finite", lambda message, _: _has_no_altitude(message), CHECK_LOCK
)
_NO_BOTTOM_NOR_RANGES = Rule(
    "no_bottom",
    f"`altitude` is negative or not finite, and fewer than {ENOUGH_BEAMS} beams have a range",
    lambda message, _: _has_no_altitude(message) & _has_no_range(message),
    CHECK_LOCK,
)


def _is_outside(value: Any, least: float, most: float) -> Any:
    """Return whether a value, or each of many, is out of bounds or nan."""
    return (value < least) | (value > most) | (value != value)


def _few_beams_listed(message: Any, _: Parameters) -> bool:
    beams = message.beams
    return len(beams) > 0 and sum(1 for beam in beams if beam.valid) < ENOUGH_BEAMS


def _dvl_msgs_covariance(message: Any) -> Any:
    """Return the covariance, or fom² for versions of the message without covariance.

    fom is the worst axis' standard deviation. (Water Linked: fom is calculated from the covariance. In their examples
    it is the root of the largest eigenvalue.)
    """
    covariance = getattr(message, "covariance", ())
    if len(covariance):
        return covariance
    return None if message.fom == 0.0 else np.diag([message.fom**2] * 3)


class _Vector(NamedTuple):
    """Velocity or position of a message without a vector; numbers, or columns of them."""

    x: Any
    y: Any
    z: Any


def _course_and_speed(message: Any) -> _Vector:
    """Return east, north, up from course over ground (degrees from north), speed and climb."""
    course = math.radians(message.track)
    return _Vector(message.speed * math.sin(course), message.speed * math.cos(course), message.climb)


def _speed_covariance(message: Any) -> Any:
    """Return the covariance from the receiver's 95 per cent errors, which are twice the standard deviation."""
    across, up = 0.5 * message.err_speed, 0.5 * message.err_climb
    if not across > 0.0:
        return None
    return np.diag([across**2, across**2, up**2 if up > 0.0 else NOT_MEASURED])


def pose_of(message: Any) -> Any:
    """Return the pose of a message, with or without covariance."""
    return getattr(message.pose, "pose", message.pose)


def _lacks_pose_covariance(message: Any) -> Any:
    covariance = np.asarray(message.pose.covariance)
    return (covariance[..., 0] <= 0.0) | (covariance[..., 7] <= 0.0)


_LINEAR, _TWIST_LINEAR, _VELOCITY = map(attrgetter, ("twist.linear", "twist.twist.linear", "velocity"))
_reference_alone = partial(VelocityType, is_reference=True, is_dvl=False)

_MARINE_DVL = """std_msgs/Header header
uint8 DVL_MODE_BOTTOM=1
uint8 DVL_MODE_WATER=2
uint8 DVL_TYPE_PISTON=0
uint8 DVL_TYPE_PHASED_ARRAY=1
uint8 velocity_mode
uint8 dvl_type
geometry_msgs/Vector3 velocity
float64[9] velocity_covar
float64 altitude
float64 course_gnd
float64 speed_gnd
uint8 num_good_beams
float32 sound_speed
bool beam_ranges_valid
bool beam_velocities_valid
geometry_msgs/Vector3[4] beam_unit_vec
float64[4] range
float32[4] range_covar
float32[4] beam_quality
float32[4] beam_velocity
float32[4] beam_velocity_covar
"""
_DVL_BEAM = f"""{"=" * 80}
MSG: dvl_msgs/DVLBeam
int64 id
float64 velocity
float64 distance
float64 rssi
float64 nsd
bool valid
"""


def _dvl_msgs_definition(covariance: str = "", beams: str = "DVLBeam[]", times: str = "") -> str:
    """Return the definition of a variant of dvl_msgs' DVL message."""
    return (
        "std_msgs/Header header\nfloat64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\n"
        f"{covariance}float64 altitude\n{beams} beams\nbool velocity_valid\nint64 status\n{times}string form\n"
        f"{_DVL_BEAM}"
    )


_TIMES = "int64 time_of_validity\nint64 time_of_transmission\n"

# rules shared by several message types
_WATER_TRACK = Rule(
    "water_track",
    "`velocity_mode` is water track",
    lambda message, _: message.velocity_mode == WATER_TRACK,
    "that is velocity through the water, not over ground; let the DVL track the bottom",
)
_FEW_BEAMS = Rule(
    "few_beams",
    f"`num_good_beams` below {ENOUGH_BEAMS}",
    lambda message, _: message.num_good_beams < ENOUGH_BEAMS,
    CHECK_LOCK,
)
_NO_FIX = Rule(
    "no_fix",
    "`status.status` is negative",
    lambda message, _: message.status.status < 0,
    "check that nothing covers the antenna",
)

# extended by recognised types (field_map.py)
VELOCITY_TYPES: dict[str, VelocityType] = {
    kind.name: kind
    for kind in (
        VelocityType(
            name=TWIST_TYPE,
            sent_by="any driver, the default",
            velocity=_TWIST_LINEAR,
            covariance=attrgetter("twist.covariance"),
            covariance_says="`twist.covariance`; zero: not given, negative: invalid",
            is_reference=True,
        ),
        VelocityType(
            name="geometry_msgs/msg/TwistStamped",
            sent_by="simple drivers and simulators",
            velocity=_LINEAR,
            rules=(_zero_velocity(_LINEAR),),
            is_reference=True,
        ),
        VelocityType(
            name="geometry_msgs/msg/Vector3Stamped",
            sent_by="simple drivers, Gazebo's GNSS velocity",
            velocity=attrgetter("vector"),
            rules=(_zero_velocity(attrgetter("vector")),),
            is_reference=True,
        ),
        VelocityType(
            name="nav_msgs/msg/Odometry",
            sent_by="drivers that track a position as well",
            velocity=_TWIST_LINEAR,
            covariance=attrgetter("twist.covariance"),
            covariance_says="`twist.covariance`; zero: not given, negative: invalid",
            frame_id=attrgetter("child_frame_id"),  # header.frame_id is the pose's
            frame_says="`child_frame_id`",
            rules=(_zero_velocity(_TWIST_LINEAR),),
            is_reference=True,
        ),
        VelocityType(
            name="marine_acoustic_msgs/msg/Dvl",
            sent_by="Water Linked's driver, others",
            covariance=attrgetter("velocity_covar"),
            lacks_covariance=lambda message: np.asarray(message.velocity_covar)[..., 0] == -1.0,
            covariance_says="`velocity_covar`; -1 or zero: not given",
            points_down=True,  # definition: z in the direction the DVL points, x forward
            rules=(
                _WATER_TRACK,
                Rule(
                    "unknown_mode",
                    "`velocity_mode` is neither bottom nor water track",
                    lambda message, _: message.velocity_mode != BOTTOM_TRACK,
                    "let the driver fill velocity_mode (DVL_MODE_BOTTOM is 1)",
                ),
                _flagged("beam_velocities_valid"),  # Water Linked's drivers copy the sensor's velocity_valid here
                _FEW_BEAMS,
                _NO_BOTTOM_NOR_RANGES,
                _zero_velocity(_VELOCITY),
            ),
            definitions=(_MARINE_DVL,),
            install="sudo apt install ros-$ROS_DISTRO-marine-acoustic-msgs",
        ),
        VelocityType(
            name="dvl_msgs/msg/DVL",
            sent_by="dvl-a50 (Water Linked A50, A125)",
            covariance=_dvl_msgs_covariance,
            is_read_in_columns=False,
            covariance_says="`covariance` where the version has it, else `fom`²",
            points_down=True,  # the sensor's axes (docs.waterlinked.com/dvl/axes), forwarded unchanged
            rules=(
                _flagged("velocity_valid"),
                Rule(
                    "few_beams", f"fewer than {ENOUGH_BEAMS} of its `beams` are `valid`", _few_beams_listed, CHECK_LOCK
                ),
                _NO_BOTTOM,
                Rule(
                    "poor_fom",
                    "`fom` (m/s) above `max_fom`, negative or not finite",
                    lambda message, parameters: _is_outside(message.fom, 0.0, parameters.max_fom),
                    CHECK_LOCK,
                ),
                _zero_velocity(_VELOCITY),
            ),
            definitions=(
                _dvl_msgs_definition("float64[9] covariance\n", "DVLBeam[4]", _TIMES),
                _dvl_msgs_definition("float64[] covariance\n", times=_TIMES),
                _dvl_msgs_definition(),
            ),
            install="build the driver's dvl_msgs in your workspace",
        ),
        *(
            VelocityType(
                name=name,
                sent_by=sent_by,
                covariance=attrgetter("velocity_covariance"),
                covariance_says="`velocity_covariance`; zero: not given",
                rules=(
                    Rule(
                        "flagged_invalid",
                        "`velocity_covariance` begins with -1",
                        lambda message, _: np.asarray(message.velocity_covariance)[..., 0] == -1.0,
                        CHECK_LOCK,
                    ),
                    _zero_velocity(_VELOCITY),
                ),
                install=f"build {name.partition('/')[0]} in your workspace",
            )
            for name, sent_by in (
                ("uuv_sensor_ros_plugins_msgs/msg/DVL", "uuv_simulator and Plankton"),
                ("cola2_msgs/msg/DVL", "Girona vehicles (COLA2)"),
                ("stonefish_ros2/msg/DVL", "the Stonefish simulator"),
            )
        ),
        VelocityType(
            name="ds_sensor_msgs/msg/Dvl",
            sent_by="ds_dvl (Sentry, DAVE)",
            covariance=attrgetter("velocity_covar"),
            lacks_covariance=lambda message: np.asarray(message.velocity_covar)[..., 0] == -1.0,
            covariance_says="`velocity_covar`; -1 or zero: not given",
            rules=(
                _WATER_TRACK,
                Rule(
                    "other_axes",
                    "`coordinate_mode` is not the instrument's",
                    lambda message, _: message.coordinate_mode != DS_INSTRUMENT,
                    "let the driver send velocities in the instrument's axes (DVL_COORD_INSTRUMENT is 1)",
                ),
                _FEW_BEAMS,
                _zero_velocity(_VELOCITY),
            ),
            install="build ds_msgs in your workspace",
        ),
        _reference_alone(
            name="gps_msgs/msg/GPSFix",
            sent_by="gpsd_client, swri: course, speed and climb",
            velocity=_course_and_speed,
            covariance=_speed_covariance,
            covariance_says="`err_speed`, `err_climb` (95 %); zero: not given",
            is_read_in_columns=False,
            frame_says="east-north-up",
            reference_frame=VelocityFrame.ENU,
            install="sudo apt install ros-$ROS_DISTRO-gps-msgs",
        ),
        _reference_alone(
            name="px4_msgs/msg/VehicleOdometry",
            sent_by="PX4 (uXRCE-DDS)",
            covariance=attrgetter("covariance"),
            covariance_says="`velocity_variance`; nan: not given",
            is_read_in_columns=False,
            frame_says="`velocity_frame`: NED or BODY_FRD",
            adapted=of_vehicle_odometry,
            install="build px4_msgs in your workspace",
        ),
        _reference_alone(
            name=POSE_TYPES[0],
            sent_by="acoustic positioning (USBL), motion capture",
            velocity=attrgetter("pose.pose.position"),
            covariance=attrgetter("pose.covariance"),
            lacks_covariance=_lacks_pose_covariance,
            covariance_says="of the difference of two positions, from `pose.covariance`; zero: not given",
            position=POSE,
        ),
        _reference_alone(
            name=POSE_TYPES[1], sent_by="motion capture", velocity=attrgetter("pose.position"), position=POSE
        ),
        _reference_alone(
            name="sensor_msgs/msg/NavSatFix",
            sent_by="receivers that give positions alone (RTK)",
            velocity=lambda message: _Vector(message.latitude, message.longitude, message.altitude),
            covariance=attrgetter("position_covariance"),
            lacks_covariance=lambda message: message.position_covariance_type == 0,
            covariance_says="of the difference of two positions, from `position_covariance`",
            frame_says="east-north-up",
            rules=(_NO_FIX,),
            position=SATELLITES,
            reference_frame=VelocityFrame.ENU,
        ),
    )
}
_WRITTEN = tuple(VELOCITY_TYPES.values())
# for bags without message definitions
KNOWN_DEFINITIONS: Mapping[str, tuple[str, ...]] = {
    name: kind.definitions for name, kind in VELOCITY_TYPES.items() if kind.definitions
}
DVL_TYPES = {name: kind for name, kind in VELOCITY_TYPES.items() if kind.is_dvl}
REFERENCE_TYPES = {name: kind for name, kind in VELOCITY_TYPES.items() if kind.is_reference}
# allowed message types of a topic, by its role
WANTED_TYPES: Mapping[str, Set[str]] = {"dvl": DVL_TYPES.keys(), "gnss": REFERENCE_TYPES.keys(), "imu": {IMU_TYPE}}
# allowed values of these parameters
TYPES_OF: Mapping[str, Mapping[str, VelocityType]] = {"dvl_type": DVL_TYPES, "gnss_type": REFERENCE_TYPES}


def add_type(name: str, like: str) -> VelocityType:
    """Add a type of another name that is read like a known one."""
    package = name.partition("/")[0]
    same = VELOCITY_TYPES[like]
    install = f"build {package} in your workspace"
    return register(replace(same, name=name, sent_by=f"as {like}", definitions=(), install=install))


def register(added: VelocityType) -> VelocityType:
    """Add a type."""
    for types, belongs in ((VELOCITY_TYPES, True), (DVL_TYPES, added.is_dvl), (REFERENCE_TYPES, added.is_reference)):
        if belongs:
            types[added.name] = added
    return added


def forget(name: str) -> None:
    """Remove a type that was added."""
    for types in (VELOCITY_TYPES, DVL_TYPES, REFERENCE_TYPES):
        types.pop(name, None)


def may_be_recognised(name: str) -> bool:
    """Return whether an unknown type may be a DVL's, to be decided by its fields."""
    return re.fullmatch(r"[A-Za-z]\w*/(msg/)?(DVL|Dvl)", name, re.ASCII) is not None


def velocity_type(parameter: str, name: str) -> VelocityType:
    """Return the type in parameter dvl_type or gnss_type (package/msg/Name or package/Name). Raises InputError."""
    types = TYPES_OF[parameter]
    package, _, name_in_package = name.partition("/")
    found = types.get(f"{package}/msg/{name_in_package.removeprefix('msg/')}")
    if found is None:
        raise InputError(f"{parameter}: {name!r} is none of {', '.join(types)}")
    return found


def driver_table() -> str:
    """Return the documentation's table of message types, in Markdown."""
    lines = ["| type | sent by | frame, axes | covariance | not used, and counted as |", "|---|---|---|---|---|"]
    for written in _WRITTEN:
        axes = ", forward-right-down" if written.points_down else ", forward-left-up" if written.is_dvl else ""
        # most types have zero_velocity, which the page explains once
        rules = "; ".join(
            f"`{rule.counter}`" + (f": {rule.says}" if rule.counter != "zero_velocity" else "")
            for rule in written.rules
        )
        lines.append(
            f"| {written.name.replace('/msg/', '/')} | {written.sent_by} | {written.frame_says}{axes} | "
            f"{written.covariance_says} | {rules} |"
        )
    return "\n".join(lines) + "\n"
