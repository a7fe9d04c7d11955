"""Message classes by type name, and conversion of a DVL velocity to a message of any supported type."""

from __future__ import annotations

import math
from importlib import import_module
from operator import attrgetter
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistWithCovarianceStamped

from ..calibration.models import Model
from ..calibration.numerics.frames import FLU_FROM_FRD
from ..calibration.numerics.kalman import GaussianState
from ..calibration.numerics.samples import DvlSample, ReferenceSample
from ..calibration.results.results import NOT_ESTIMATED, twist_terms
from ..errors import InputError
from ..messages.decode import UNREADABLE
from ..messages.drivers import (
    BOTTOM_TRACK,
    DS_INSTRUMENT,
    VELOCITY_TYPES,
    VelocityType,
    may_be_recognised,
    velocity_type,
)
from ..messages.field_map import mapped_type, may_be_mapped, recognised


def velocity_class(parameter: str, name: str, dvl_fields: str = "") -> Any:
    """Return the message class for parameter dvl_type or gnss_type; unlisted DVL types are read by their fields.

    dvl_fields: value of the parameter of that name. Raises InputError for an unusable type, or if its package is
    missing.
    """
    package, _, type_name = name.partition("/")
    full = f"{package}/msg/{type_name.removeprefix('msg/')}"
    if dvl_fields and may_be_mapped(full):
        kind = message_class(parameter, full)
        adapted = mapped_type(full, dvl_fields).adapted
        try:
            assert adapted is not None
            adapted(kind())  # an empty message has all fields
        except UNREADABLE as error:
            raise InputError(f"dvl_fields: {dvl_fields!r} does not fit {full}: {error}") from error
        name = full
    elif parameter == "dvl_type" and name not in VELOCITY_TYPES and may_be_recognised(name):
        kind = message_class(parameter, full)
        recognised(full, kind.get_fields_and_field_types())
        name = full
    return message_class(parameter, velocity_type(parameter, name).name)


def message_class(what: str, name: str) -> Any:
    """Return the class of type ``package/msg/Name``. Raises InputError if its package is not installed.

    what: the parameter or topic, for the error.
    """
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError) as error:
        known = VELOCITY_TYPES.get(name)
        how = known.install if known and known.install else f"install {package}"
        raise InputError(
            f"{what} {name}: the message package {package} is not installed ({error}); {how}, and source its setup.bash"
        ) from error


DVL_FRAME = "dvl_link"
ALTITUDE_M = 10.0
# paths of velocity and covariance in the message types
_VECTORS = ("vector", "twist.twist.linear", "twist.linear", "velocity")
_COVARIANCES = ("velocity_covar", "velocity_covariance", "covariance")
# fields that mark a good measurement; each type has some of them
_GOOD: dict[str, Any] = {
    "velocity_mode": BOTTOM_TRACK,
    "coordinate_mode": DS_INSTRUMENT,
    "num_good_beams": 4,
    "beam_velocities_valid": True,
    "velocity_valid": True,
    "altitude": ALTITUDE_M,
}


def fill(message: Any, kind: VelocityType, sample: DvlSample | ReferenceSample, frame_id: str = DVL_FRAME) -> Any:
    """Fill a new message of a type with a sample, of a DVL forward-left-up, and return it."""
    axes = FLU_FROM_FRD if kind.points_down else np.eye(3)
    set_stamp(message.header.stamp, sample.stamp_ns)
    message.header.frame_id = frame_id
    if hasattr(message, "child_frame_id"):  # child_frame_id is the frame of the velocity, header.frame_id of the pose
        message.header.frame_id, message.child_frame_id = "odom", DVL_FRAME
        message.pose.pose.orientation.w = 1.0
    vector = _first_vector(message, _VECTORS)
    vector.x, vector.y, vector.z = (axes @ np.array(sample.velocity)).tolist()
    covariance = None if sample.covariance is None else axes @ np.asarray(sample.covariance) @ axes
    _put_covariance(message, covariance)
    for name, value in _GOOD.items():
        if hasattr(message, name):
            setattr(message, name, value)
    for beam in getattr(message, "beams", ()):
        if hasattr(beam, "valid"):
            beam.valid = True
    return message


def _first_vector(message: Any, paths: tuple[str, ...]) -> Any:
    """Return the first vector that exists below these attribute paths. Raises ValueError without any."""
    for path in paths:
        try:
            found = attrgetter(path)(message)
        except AttributeError:
            continue
        if hasattr(found, "x"):
            return found
    raise ValueError(f"{type(message).__name__}: no velocity to fill")


def _put_covariance(message: Any, covariance: Any) -> None:
    """Fill the velocity covariance (3, 3) (m/s)² into the fields that the message has."""
    if hasattr(message, "fom"):
        message.fom = 0.0 if covariance is None else math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
    if hasattr(message, "twist"):
        inner = message.twist
        if covariance is not None and hasattr(inner, "covariance"):
            twist_covariance = np.zeros((6, 6))
            twist_covariance[:3, :3] = covariance
            inner.covariance = twist_covariance.ravel()
        return
    for name in _COVARIANCES:
        if hasattr(message, name) and covariance is not None:
            setattr(message, name, covariance.ravel())


def empty_twist() -> TwistWithCovarianceStamped:
    """Return a message that is filled repeatedly, with its constant values set."""
    message = TwistWithCovarianceStamped()
    message.twist.covariance[[21, 28, 35]] = NOT_ESTIMATED  # calibrated_twist has no angular velocity
    return message


def fill_errors(
    message: TwistWithCovarianceStamped, model: Model, state: GaussianState, stamp_ns: int | None, dvl_frame: str | None
) -> None:
    """Fill in a model's scale errors and misalignment, with their joint covariance."""
    terms, covariance = twist_terms(model, state)
    if stamp_ns is not None:
        set_stamp(message.header.stamp, stamp_ns)
    message.header.frame_id = dvl_frame or "dvl_link"
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = terms.tolist()
    message.twist.covariance = covariance.ravel()


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Set a builtin_interfaces/Time."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
