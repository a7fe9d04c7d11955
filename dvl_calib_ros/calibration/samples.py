"""What the calibration core is fed with: one immutable tuple per measurement.

Tuples of plain floats, not arrays: a sample is built and read once, at up to kHz rates, and a float costs a tenth of
an array element there. Stamps are integer nanoseconds; a float second would lose the nanoseconds of 2026.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from .frames import Array, Quaternion, Vector


class VelocityFrame(Enum):
    """Frame in which a reference velocity is expressed."""

    BODY = "body"
    ENU = "enu"
    NED = "ned"


class DvlSample(NamedTuple):
    """Velocity over ground measured by the DVL.

    velocity: m/s in the DVL frame. covariance: (3, 3) (m/s)², or None where the message does not give one.
    """

    stamp_ns: int
    velocity: Vector
    covariance: Array | None = None


class ReferenceSample(NamedTuple):
    """Reference (GNSS) velocity of the vehicle's reference point over ground.

    velocity: m/s in `frame`. covariance: (3, 3) (m/s)² in `frame`, or None where the message does not give one.
    """

    stamp_ns: int
    velocity: Vector
    covariance: Array | None = None
    frame: VelocityFrame = VelocityFrame.BODY


class ImuSample(NamedTuple):
    """Attitude and angular velocity of the body; either is None where the IMU does not give it.

    orientation: unit quaternion (x, y, z, w) of ``rotation_enu_from_body``. angular_velocity: rad/s, body frame.
    """

    stamp_ns: int
    orientation: Quaternion | None
    angular_velocity: Vector | None
