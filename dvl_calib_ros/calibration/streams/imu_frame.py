"""Conversion of IMU data to the attitude and angular velocity of the body.

With W the rotation from the IMU's world to ENU and M the IMU's mounting ``rotation_body_from_imu``:
``rotation_enu_from_body = W @ rotation_world_from_imu @ M.T`` and ``ω_body = M @ ω_imu``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..models.parameters import IMU_ENU, IMU_NED, NWU, Parameters
from ..numerics.frames import (
    ENU_FROM_NED,
    ENU_FROM_NWU,
    Array,
    Quaternion,
    Vector,
    quaternion_from_rotation,
    rotation_from_rpy,
)
from ..numerics.samples import ImuSample, SampleBlock

# rotation to ENU for each value of the parameter imu_frame
ENU_FROM: Mapping[str, Array] = {IMU_ENU: np.eye(3), IMU_NED: ENU_FROM_NED, NWU: ENU_FROM_NWU}
# Non-finite values are passed on and counted later.
_QUIET = np.errstate(invalid="ignore", over="ignore")


def enu_from(world: str, heading_offset: float) -> Array:
    """Return the rotation (3, 3) to ENU from the IMU's world. heading_offset: rad, as the parameter."""
    return rotation_from_rpy((0.0, 0.0, heading_offset)) @ ENU_FROM[world]


class ImuAlignment:
    """Rotation of IMU samples by the parameters imu_rpy, imu_frame and heading_offset.

    is_identity: no rotation; samples are returned as the same objects.
    """

    def __init__(self, parameters: Parameters) -> None:
        turns = any(parameters.imu_rpy) or parameters.heading_offset
        self.is_identity = not turns and parameters.imu_frame == IMU_ENU
        rotation_body_from_imu = rotation_from_rpy(parameters.imu_rpy)
        self._rotation_body_from_imu: Array = rotation_body_from_imu
        self._imu_from_body = quaternion_from_rotation(rotation_body_from_imu.T)
        self._enu_from_world = quaternion_from_rotation(enu_from(parameters.imu_frame, parameters.heading_offset))

    def sample(self, sample: ImuSample) -> ImuSample:
        """Rotate one live sample. Missing values stay None, non-finite values stay non-finite."""
        if self.is_identity:
            return sample
        orientation, rate = sample.orientation, sample.angular_velocity
        rotated: Quaternion | None = None
        if orientation is not None:
            x, y, z, w = self._turned(np.array([orientation]))[0].tolist()
            rotated = (x, y, z, w)
        rotated_rate: Vector | None = None
        if rate is not None:
            wx, wy, wz = self._in_body(np.array([rate]))[0].tolist()
            rotated_rate = (wx, wy, wz)
        return ImuSample(sample.stamp_ns, rotated, rotated_rate)

    def block(self, block: SampleBlock) -> SampleBlock:
        """Rotate columns of the IMU stream; rows as in `sample`."""
        if self.is_identity or not len(block):
            return block
        return replace(
            block, values=np.hstack([self._turned(block.orientation), self._in_body(block.angular_velocity)])
        )

    @_QUIET
    def _turned(self, orientation: Array) -> Array:
        """Rotate quaternions (N, 4) of the IMU in its world to the body in ENU."""
        return quaternion_product(quaternion_product(self._enu_from_world, orientation), self._imu_from_body)

    @_QUIET
    def _in_body(self, angular_velocity: Array) -> Array:
        """Rotate rates (N, 3) rad/s; the last bit of a matrix product would depend on N."""
        return np.sum(angular_velocity[:, None, :] * self._rotation_body_from_imu, axis=-1)


def quaternion_product(a: Array | Quaternion, b: Array | Quaternion) -> Array:
    """Return the Hamilton product of quaternions (..., 4) in the order x, y, z, w: rotation b, then a."""
    ax, ay, az, aw = np.moveaxis(np.asarray(a, dtype=float), -1, 0)
    bx, by, bz, bw = np.moveaxis(np.asarray(b, dtype=float), -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )
