"""Live, whether the IMU's acceleration says the same of up as its orientation, by a message of each second."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..calibration.frames import rotation_from_rpy
from ..calibration.parameters import Parameters
from ..discovery.gravity import Gravity
from ..verdict.reasons import Reason

# What ten minutes do not show, no more does.
MOST = 600


class GravitySeen:
    """Takes messages of the IMU, of which stamps decide which count: a recording of them says the same."""

    def __init__(self) -> None:
        self._second = -1
        self._rows: list[tuple[float, ...]] = []

    def add(self, message: Any) -> None:
        """Take a sensor_msgs/Imu."""
        second = message.header.stamp.sec
        if second == self._second or len(self._rows) == MOST:
            return
        self._second = second
        q, a = message.orientation, message.linear_acceleration
        self._rows.append((q.x, q.y, q.z, q.w, a.x, a.y, a.z))

    def problems(self, topic: str, parameters: Parameters) -> list[Reason]:
        """What is wrong with how the data of this topic are taken."""
        rows = np.array(self._rows, dtype=float).reshape(-1, 7)
        gravity = Gravity.of(rows[:, :4], rows[:, 4:])
        body_from_imu = rotation_from_rpy(parameters.imu_rpy)
        found = None if gravity is None else gravity.contradiction(topic, body_from_imu, parameters.imu_frame)
        return [] if found is None else [found]
