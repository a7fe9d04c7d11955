"""Live checks: gravity against orientation, clock offsets taken off, pauses of the process."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import rotation_from_rpy
from ..calibration.registration.registration import ALIKE_S, OFFSETS, Registration
from ..discovery.gravity import Gravity
from ..verdict.reasons import Reason, finding

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
        found = (
            None
            if gravity is None
            else gravity.contradiction(topic, body_from_imu, parameters.imu_frame, parameters.is_z_down)
        )
        return [] if found is None else [found]


class LateClocks:
    """What is to be taken off, once: where nobody named an offset, and two looks at the clocks agree.

    found: what is said of it, while it is off. stand: whether nothing more is to be taken off.
    """

    def __init__(self, given: Collection[str]) -> None:
        """given: names of the parameters that the user named."""
        self.stand = bool(OFFSETS.keys() & set(given))
        self._before: Registration | None = None
        self.found: list[Reason] = []

    def parameters(self, registration: Registration | None, parameters: Parameters) -> Parameters | None:
        """The parameters to begin anew with, by the newest look; None for as they are."""
        if self.stand or registration is None or registration is self._before:
            return None
        before, self._before = self._before, registration
        late = registration.taken_off
        if before is None or not late or not _are_alike(before.taken_off, late):
            return None
        self.stand = True
        taken = {name: round(getattr(parameters, name) + seconds, 3) for name, seconds in late.items()}
        self.found = [
            finding("CLOCK_TAKEN_OFF", clock=registration.told(name), parameter=name, value=seconds)
            for name, seconds in taken.items()
        ]
        return parameters.replace(**taken)


def _are_alike(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    return one.keys() == other.keys() and all(abs(one[name] - other[name]) < ALIKE_S for name in other)


# A process that looks at its clock every second and finds so much gone by did not run meanwhile, s.
PAUSE_S = 5.0


def steady_s() -> float:
    """Seconds of a clock that nobody sets and that goes on while the machine sleeps, where there is one (Linux)."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Pauses:
    """To be told about every second that the process runs. now_s: as of `steady_s`."""

    def __init__(self, now_s: float) -> None:
        self._last_s = now_s
        self._paused_s = 0.0
        self._found: list[tuple[float, float]] = []

    def running_s(self, now_s: float) -> float:
        """Take note that the process runs. A clock (s) that stands still while it does not."""
        gone_s = now_s - self._last_s
        self._last_s = now_s
        if gone_s > PAUSE_S:
            self._paused_s += gone_s
            self._found.append((now_s - self._paused_s, gone_s))
        return now_s - self._paused_s

    def within(self, seconds: float) -> list[float]:
        """Lengths (s) of the pauses that ended within so many seconds of running."""
        running_s = self._last_s - self._paused_s
        self._found = [each for each in self._found if running_s - each[0] <= seconds]
        return [length for _, length in self._found]

    def forget(self) -> None:
        """Tell of no pause before now."""
        self._found.clear()
