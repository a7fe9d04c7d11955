"""Gravity against an IMU's orientation, and the uncertainty that its messages claim of the heading.

At rest an accelerometer shows what holds against gravity: upwards, and so it stays on a vehicle whose own accelerations
average out. Turned by the orientation it must point up in the world that the orientation is of.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..calibration.numerics.frames import Array, rotation_from_quaternion
from ..calibration.streams.screening import unit_quaternions
from ..verdict.reasons import Reason, finding

# Fewer samples, and an acceleration below this (m/s²), tell nothing.
ENOUGH, LEAST = 20, 0.2
# Gravity in its two units, and how far a mean may be from it, as a share.
STANDARD, NEAR = 9.81, 0.15
# Up is up, and down is down, from this share of gravity on.
CLEARLY = 0.5
# A quaternion is taken for inverted where that leaves less than half, of a tilt (rad, rms) of this and more; so large
# an angle from up in the mean is no vehicle's.
TILTED, LEANS = math.radians(1.0), math.radians(8.0)


class Gravity(NamedTuple):
    """Means: size (m/s²); body (3,) in the IMU's axes and world (3,) in those of its orientation's world, as shares of
    it. across, inverted: rms of what is across the vertical, as a share, as given and with quaternions inverted."""

    size: float
    body: Array
    world: Array
    across: float
    inverted: float

    @staticmethod
    def of(orientation: Array, acceleration: Array) -> Gravity | None:
        """Of an IMU's quaternions (N, 4) x, y, z, w and accelerations (N, 3) m/s²; None where it gives one of them to
        no message, or to too few."""
        quaternion = unit_quaternions(orientation)
        use = np.isfinite(quaternion).all(axis=1) & np.isfinite(acceleration).all(axis=1)
        size = float(np.linalg.norm(acceleration[use].mean(axis=0))) if np.count_nonzero(use) >= ENOUGH else 0.0
        if size < LEAST:
            return None
        a, rotation = acceleration[use] / size, rotation_from_quaternion(quaternion[use])
        world, inverted = (np.matmul(each, a[..., None])[..., 0] for each in (rotation, rotation.swapaxes(1, 2)))
        across = [math.sqrt(float((each[:, :2] ** 2).sum(axis=1).mean())) for each in (world, inverted)]
        return Gravity(size, a.mean(axis=0), world.mean(axis=0), *across)

    def contradicts(self, rotation_body_from_imu: Array, world: str, z_down: bool) -> int:
        """How many of the two, the body's up and the world's, are down if an IMU's data are meant so.

        z_down: whether the body is forward-right-down.
        """
        return int(self._up_in_body(rotation_body_from_imu, z_down) < -CLEARLY) + int(self._up(world) < -CLEARLY)

    def contradiction(
        self, topic: str, rotation_body_from_imu: Array, world: str, z_down: bool = False
    ) -> Reason | None:
        """What is wrong with how the data of an IMU's topic are taken."""
        body_up, up = self._up_in_body(rotation_body_from_imu, z_down), self._up(world)
        if body_up < -CLEARLY and up < -CLEARLY:
            return finding("GRAVITY_SIGN", topic=topic)
        if body_up < -CLEARLY or up < -CLEARLY:
            where = "body" if body_up < -CLEARLY else "world of its orientation"
            return finding("GRAVITY_UPSIDE_DOWN", topic=topic, where=where)
        if self.across > TILTED and self.inverted < CLEARLY * self.across:
            tilts = {"inverted": math.degrees(self.inverted), "given": math.degrees(self.across)}
            return finding("GRAVITY_FITS_INVERTED", topic=topic, **tilts)
        if self.across > math.sin(LEANS) and math.hypot(*self.world[:2].tolist()) > math.sin(LEANS):
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


# What an IMU claims of its heading (rad) is believed between these: few are as good as the first, and one that claims
# more than the second says that it does not know.
BEST_HEADING, WORST_HEADING = math.radians(0.1), math.radians(10.0)


def believed_heading(claimed_std: float) -> float | None:
    """`heading_deviation_std` (rad) by a claimed σ of the heading (rad, nan for none); None where that says nothing."""
    return float(f"{max(claimed_std, BEST_HEADING):.2g}") if claimed_std <= WORST_HEADING else None
