"""Times in which this process did not run, so that what it missed is not laid to a sensor."""

from __future__ import annotations

import time

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
