"""Check of gravity against an IMU's orientation, and the heading accuracy that its messages claim.

At rest an accelerometer measures the reaction to gravity, which points up; on a vehicle its own accelerations average
out. Rotated by the orientation, the mean must point up in the orientation's world.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..calibration.models.parameters import IMU_ENU, IMU_NED, Parameters, rpy_text
from ..calibration.numerics.frames import FLU_FROM_FRD, Array, rotation_from_quaternion, rotation_from_rpy
from ..calibration.streams.screening import unit_quaternions
from ..verdict.reasons import Reason, finding

# fewer samples, or a smaller acceleration (m/s²), are no information
ENOUGH, LEAST = 20, 0.2
# gravity in its two units, and the relative tolerance of a mean
STANDARD, NEAR = 9.81, 0.15
# smallest share of gravity for a clear direction
CLEARLY = 0.5
# A quaternion counts as inverted if inversion halves a tilt (rad, rms) of at least the first value. A mean angle from
# up above the second (rad) is impossible for a vehicle.
TILTED, LEANS = math.radians(1.0), math.radians(8.0)


class Gravity(NamedTuple):
    """Mean acceleration of an IMU, compared with gravity.

    size: m/s². body (3,) in the IMU's axes and world (3,) in its orientation's world, relative to size. across,
    inverted: rms of the component across the vertical, relative, with given and with inverted quaternions.
    """

    size: float
    body: Array
    world: Array
    across: float
    inverted: float

    @staticmethod
    def of(orientation: Array, acceleration: Array) -> Gravity | None:
        """Compute from quaternions (N, 4) x, y, z, w and accelerations (N, 3) m/s²; None if too few have both."""
        quaternion = unit_quaternions(orientation)
        known = np.isfinite(quaternion).all(axis=1) & np.isfinite(acceleration).all(axis=1)
        size = float(np.linalg.norm(acceleration[known].mean(axis=0))) if np.count_nonzero(known) >= ENOUGH else 0.0
        if size < LEAST:
            return None
        relative, rotation = acceleration[known] / size, rotation_from_quaternion(quaternion[known])
        world, inverted = (np.matmul(turn, relative[..., None])[..., 0] for turn in (rotation, rotation.swapaxes(1, 2)))
        across = [math.sqrt(float((axis[:, :2] ** 2).sum(axis=1).mean())) for axis in (world, inverted)]
        return Gravity(size, relative.mean(axis=0), world.mean(axis=0), *across)

    def contradicts(self, rotation_body_from_imu: Array, world: str, z_down: bool) -> int:
        """Return how many of the body's and the world's up direction point down under a convention (0, 1 or 2).

        z_down: whether the body is forward-right-down.
        """
        return int(self._up_in_body(rotation_body_from_imu, z_down) < -CLEARLY) + int(self._up(world) < -CLEARLY)

    def contradiction(
        self, topic: str, rotation_body_from_imu: Array, world: str, z_down: bool = False
    ) -> Reason | None:
        """Return the contradiction between gravity and an assumed convention of the IMU's data.

        rotation_body_from_imu: (3, 3). world: frame of the orientation, as imu_frame. z_down: of base_frame.
        """
        body_up, up = self._up_in_body(rotation_body_from_imu, z_down), self._up(world)
        if body_up < -CLEARLY and up < -CLEARLY:
            return finding("GRAVITY_SIGN", topic=topic)
        if body_up < -CLEARLY:
            rpy = rpy_text(FLU_FROM_FRD @ rotation_body_from_imu)
            return finding("GRAVITY_UPSIDE_DOWN", topic=topic, where="body", parameter="imu_rpy", value=rpy)
        if up < -CLEARLY:
            frame, where = IMU_ENU if world == IMU_NED else IMU_NED, "world of its orientation"
            return finding("GRAVITY_UPSIDE_DOWN", topic=topic, where=where, parameter="imu_frame", value=frame)
        if self.across > TILTED and self.inverted < CLEARLY * self.across:
            tilts = {"inverted": math.degrees(self.inverted), "given": math.degrees(self.across)}
            return finding("GRAVITY_FITS_INVERTED", topic=topic, **tilts)
        leans = self.across > math.sin(LEANS) and math.hypot(*self.world[:2].tolist()) > math.sin(LEANS)
        if leans or self.across > CLEARLY:  # no wave pulls that hard, and a lean may turn with the heading
            return finding("GRAVITY_LEANS", topic=topic, degrees=math.degrees(math.acos(min(1.0, up))))
        if abs(self.size - 1.0) < NEAR:
            return finding("GRAVITY_IN_G", topic=topic)
        if abs(self.size / STANDARD - 1.0) > NEAR:
            return finding("GRAVITY_SIZE", topic=topic, size=self.size)
        return None

    def _up_in_body(self, rotation_body_from_imu: Array, z_down: bool) -> float:
        return float(rotation_body_from_imu[2] @ self.body) * (-1.0 if z_down else 1.0)

    def _up(self, world: str) -> float:
        return float(self.world[2]) * (-1.0 if world == "ned" else 1.0)


def contradictions(topic: str, orientation: Array, acceleration: Array, parameters: Parameters) -> list[Reason]:
    """Return what gravity says against the configured convention of an IMU, from its quaternions and accelerations."""
    gravity, rotation = Gravity.of(orientation, acceleration), rotation_from_rpy(parameters.imu_rpy)
    found = gravity and gravity.contradiction(topic, rotation, parameters.imu_frame, parameters.is_z_down)
    return [found] if found else []


# Limits of a believed heading σ (rad): few IMUs are better than the first, and one that claims more than the second
# does not know its heading.
BEST_HEADING, WORST_HEADING = math.radians(0.1), math.radians(10.0)


def believed_heading(claimed_std: float) -> float | None:
    """Return `heading_deviation_std` (rad) for a claimed σ of the heading (rad or nan); None if not informative."""
    return float(f"{max(claimed_std, BEST_HEADING):.2g}") if claimed_std <= WORST_HEADING else None
