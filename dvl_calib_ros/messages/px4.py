"""PX4's odometry, which has neither header nor frame names: its numbers as the other types have them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

# Its clock counts microseconds, since boot where nothing synchronises it: then its stamps are none.
MICROSECOND_NS, SINCE_BOOT_US = 1000, 10**15
# By `velocity_frame`: north-east-down, and the body's forward-right-down. FRD of the world points anywhere.
FRAMES = {1: "ned", 3: "base_link_frd"}


def of_vehicle_odometry(message: Any) -> SimpleNamespace:
    """A px4_msgs/VehicleOdometry as a stamped twist: header, velocity, covariance (9,), twist with the turn rates."""
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
