"""Message classes by type name, and a DVL's velocity as a message of any type that is read."""

from __future__ import annotations

import math
from importlib import import_module
from operator import attrgetter
from typing import Any

import numpy as np

from ..calibration.numerics.frames import FLU_FROM_FRD
from ..calibration.numerics.samples import DvlSample
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
from ..messages.field_map import mapped_type, may_be_mapped
from ..messages.type_recognition import recognised


def velocity_class(parameter: str, name: str, dvl_fields: str = "") -> Any:
    """The class of the type that parameter dvl_type or gnss_type names; one that nobody knows is known by its fields.

    dvl_fields: the parameter, of a DVL. Raises InputError if it is none, or its package is not installed.
    """
    package, _, rest = name.partition("/")
    full = f"{package}/msg/{rest.removeprefix('msg/')}"
    if dvl_fields and may_be_mapped(full):
        found = message_class(parameter, full)
        read = mapped_type(full, dvl_fields).adapted
        try:
            assert read is not None
            read(found())
        except UNREADABLE as error:
            raise InputError(f"dvl_fields: {dvl_fields!r} does not fit {full}: {error}") from error
        name = full
    elif parameter == "dvl_type" and name not in VELOCITY_TYPES and may_be_recognised(name):
        found = message_class(parameter, full)
        recognised(full, found.get_fields_and_field_types())
        name = full
    return message_class(parameter, velocity_type(parameter, name).name)


def message_class(what: str, name: str) -> Any:
    """The class of type ``package/msg/Name``. Raises InputError if its package is not installed.

    what: the parameter or topic that asks for it, for the error.
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
# Where types keep velocity and covariance
_VECTORS = ("vector", "twist.twist.linear", "twist.linear", "velocity")
_COVARIANCES = ("velocity_covar", "velocity_covariance", "covariance")
# What says that a measurement is good, by name; each type has some of them
_GOOD: dict[str, Any] = {
    "velocity_mode": BOTTOM_TRACK,
    "coordinate_mode": DS_INSTRUMENT,
    "num_good_beams": 4,
    "beam_velocities_valid": True,
    "velocity_valid": True,
    "altitude": ALTITUDE_M,
}


def fill(message: Any, kind: VelocityType, sample: DvlSample) -> Any:
    """Fill a new message of a type with a sample (forward-left-up); returns it."""
    axes = FLU_FROM_FRD if kind.points_down else np.eye(3)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(sample.stamp_ns, 1_000_000_000)
    message.header.frame_id = DVL_FRAME
    if hasattr(message, "child_frame_id"):  # the velocity's, the header's is that of the pose
        message.header.frame_id, message.child_frame_id = "odom", DVL_FRAME
        message.pose.pose.orientation.w = 1.0
    vector = _first(message, _VECTORS)
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


def _first(message: Any, paths: tuple[str, ...]) -> Any:
    for path in paths:
        try:
            found = attrgetter(path)(message)
        except AttributeError:
            continue
        if hasattr(found, "x"):
            return found
    raise ValueError(f"{type(message).__name__}: no velocity to fill")


def _put_covariance(message: Any, covariance: Any) -> None:
    if hasattr(message, "fom"):
        message.fom = 0.0 if covariance is None else math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
    if hasattr(message, "twist"):
        inner = message.twist
        if covariance is not None and hasattr(inner, "covariance"):
            whole = np.zeros((6, 6))
            whole[:3, :3] = covariance
            inner.covariance = whole.ravel()
        return
    for name in _COVARIANCES:
        if hasattr(message, name) and covariance is not None:
            setattr(message, name, covariance.ravel())
