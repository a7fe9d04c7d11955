"""Conversion of estimates to the node's messages."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped

from ..calibration.models import Model
from ..calibration.numerics.kalman import GaussianState
from ..calibration.results.velocity_correction import NOT_ESTIMATED, twist_terms


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
