"""Content of a DVL's log: samples, attitudes, and angular velocities derived from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..calibration.numerics.frames import Array, attitude_enu_flu_from_ned_frd, quaternion_from_rotation
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
from ..messages.encode import WaterReading

# 2000 deg/s, the largest range of common gyros; longest gap that a curve through attitudes bridges, s
FASTEST_RADPS, LONGEST_GAP_S = 35.0, 10.0


def imu_samples(stamps_ns: Sequence[int], rpy: Array) -> list[ImuSample]:
    """Convert roll, pitch, yaw (N, 3) rad of a forward-right-down body in north-east-down, at increasing stamps."""
    rotations = attitude_enu_flu_from_ned_frd(rpy)
    time = 1e-9 * (np.array(stamps_ns, dtype=np.int64) - (stamps_ns[0] if len(stamps_ns) else 0))
    rates = angular_velocities(time, rotations).tolist()
    return [
        ImuSample(at, quaternion_from_rotation(rotation), (x, y, z))
        for at, rotation, (x, y, z) in zip(stamps_ns, rotations, rates, strict=True)
    ]


def angular_velocities(time: Array, rotation_enu_from_body: Array) -> Array:
    """Return the angular velocity (N, 3) rad/s in the body frame from attitudes (N, 3, 3) at times (N,) s.

    It is the derivative of a smooth curve at the times themselves. A difference of successive attitudes would be
    delayed by half an interval: at 1 Hz with a lever arm of 2 m, an error of 3 cm/s in turns.
    """
    from scipy.spatial.transform import Rotation, RotationSpline

    rates: Array = np.zeros((len(time), 3))
    if len(time) < 2:
        return rates
    attitudes = Rotation.from_matrix(rotation_enu_from_body)
    turned = (attitudes[:-1].inv() * attitudes[1:]).magnitude()
    step = np.diff(time)
    # a curve across would swing to infinity
    cuts = np.flatnonzero((turned > FASTEST_RADPS * step) | (step > LONGEST_GAP_S)) + 1
    for part in np.split(np.arange(len(time)), cuts):
        if len(part) > 1:
            rates[part] = RotationSpline(time[part], attitudes[part])(time[part], 1)
    return rates


class DvlLog(NamedTuple):
    """DVL samples (forward-left-up) in order of time, and the number of unusable reports by reason.

    references, attitudes, waters: other samples in the log.
    notes: remarks in sentences.
    nominal_yaw: rad, of the DVL in the body of the attitudes (forward-left-up), as configured in the instrument; 0 if
      it has its own compass.
    """

    samples: list[DvlSample]
    left_out: Counter[str]
    references: Sequence[ReferenceSample] = ()
    attitudes: Sequence[ImuSample] = ()
    notes: tuple[str, ...] = ()
    waters: Sequence[WaterReading] = ()
    nominal_yaw: float | None = None
