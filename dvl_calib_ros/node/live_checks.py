"""Live checks: gravity against orientation, subtracted clock offsets, pauses of the process."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import rotation_from_rpy
from ..calibration.registration.clock_drift_and_jumps import REPORTED_FROM_S
from ..calibration.registration.registration import OFFSETS, Registration
from ..discovery.gravity import Gravity
from ..verdict.reasons import Reason, finding

# more than ten minutes of samples add nothing
MOST = 600


class GravitySeen:
    """Collector of gravity samples of the IMU, selected by stamps so that a replay selects the same."""

    def __init__(self) -> None:
        self._second = -1
        self._rows: list[tuple[float, ...]] = []

    def add(self, message: Any) -> None:
        """Add a sensor_msgs/Imu."""
        second = message.header.stamp.sec
        if second == self._second or len(self._rows) == MOST:
            return
        self._second = second
        q, a = message.orientation, message.linear_acceleration
        self._rows.append((q.x, q.y, q.z, q.w, a.x, a.y, a.z))

    def problems(self, topic: str, parameters: Parameters) -> list[Reason]:
        """Return the contradictions between gravity and the configured use of this topic."""
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
    """Clock offsets to subtract, once, if none was configured and two successive estimates agree.

    found: reasons for the subtraction. is_final: whether nothing more is subtracted.
    """

    def __init__(self, given: Collection[str]) -> None:
        """Set up. given: names of the parameters that the user set."""
        self.is_final = bool(OFFSETS.keys() & set(given))
        self._before: Registration | None = None
        self.found: list[Reason] = []

    def parameters(self, registration: Registration | None, parameters: Parameters) -> Parameters | None:
        """Return parameters with the offsets of the newest estimate for a restart, or None if nothing changes."""
        if self.is_final or registration is None or registration is self._before:
            return None
        before, self._before = self._before, registration
        corrections = registration.corrections
        if before is None or not corrections or not _are_alike(before.corrections, corrections):
            return None
        self.is_final = True
        offsets = {name: round(getattr(parameters, name) + seconds, 3) for name, seconds in corrections.items()}
        self.found = [
            finding("CLOCK_TAKEN_OFF", clock=registration.clock_reason(name), parameter=name, value=seconds)
            for name, seconds in offsets.items()
        ]
        return parameters.replace(**offsets)


def _are_alike(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    return one.keys() == other.keys() and all(abs(one[name] - other[name]) < REPORTED_FROM_S for name in other)


# A process that checks its clock every second and finds this much time gone was paused, s.
PAUSE_S = 5.0


def steady_s() -> float:
    """Return seconds of a clock that nobody sets and that runs while the machine sleeps, if it has one (Linux)."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Pauses:
    """Detector of pauses, to be called every second that the process runs. now_s: of `steady_s`."""

    def __init__(self, now_s: float) -> None:
        self._last_s = now_s
        self._paused_s = 0.0
        self._pauses: list[tuple[float, float]] = []

    def running_s(self, now_s: float) -> float:
        """Take a reading of the steady clock, detect a pause before it, and return the time (s) without pauses."""
        gone_s = now_s - self._last_s
        self._last_s = now_s
        if gone_s > PAUSE_S:
            self._paused_s += gone_s
            self._pauses.append((now_s - self._paused_s, gone_s))
        return now_s - self._paused_s

    def within(self, seconds: float) -> list[float]:
        """Return the lengths (s) of pauses that ended within the last `seconds` of running."""
        running_s = self._last_s - self._paused_s
        self._pauses = [pause for pause in self._pauses if running_s - pause[0] <= seconds]
        return [length for _, length in self._pauses]

    def forget(self) -> None:
        """Forget all pauses before now."""
        self._pauses.clear()
