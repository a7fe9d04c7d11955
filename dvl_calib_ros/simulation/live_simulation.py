"""Simulation that follows a motion sample by sample: the model of `scenario` on a short window.

A sample is computed when the motion is known up to one sample after the time of measurement, because slopes for a lag
are taken across it. It is returned when the motion reaches its stamp, as from a driver that stamps on arrival. No clock
is used, so the same motion gives the same samples.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
from ..effects.base import ActsOn, EffectInput, NoiseEffect, depth_of
from .scenario import GNSS_PHASE_S, START_NS, Run, Scenario, Seeds, dvl_at, gnss_at, imu_at, world_of
from .trajectories import Motion

Sample = DvlSample | ReferenceSample | ImuSample
# across longer gaps the motion is unknown, and nothing is measured
MAX_GAP_S = 1.0
# after this number of time constants a filter's memory has decayed to 1e-13
REMEMBERED_CONSTANTS = 30.0


@dataclass(frozen=True)
class MotionSample:
    """Motion of the vehicle at one time.

    time: s since the beginning.
    velocity_body: (3,) m/s over ground of the reference point.
    rotation_enu_from_body: (3, 3).
    angular_velocity: (3,) rad/s, body frame, forward-left-up.
    """

    time: float
    velocity_body: Array
    rotation_enu_from_body: Array
    angular_velocity: Array


class Follower:
    """Sensors of a scenario that follow a given motion; stamps are `start_ns` plus the time of the motion.

    Samples equal the output of `simulate` for the same motion, except for random outliers and the IMU's noise. Raises
    InputError for a noise effect that cannot be generated sample by sample.
    """

    def __init__(self, scenario: Scenario, start_ns: int = START_NS) -> None:
        """Create the sensors and noise processes with the seeds of `simulate`. start_ns: stamp of time 0."""
        self._scenario = scenario
        self._late_ns = start_ns - START_NS
        seeds = Seeds.of(scenario)
        self._disturbances = [
            (injection.effect, injection.effect.following(injection.values, np.random.default_rng(seed)))
            for injection, seed in zip(scenario.effects, seeds.effects, strict=True)
            if isinstance(injection.effect, NoiseEffect)
        ]
        makers: tuple[Callable[..., Any], ...] = (dvl_at, gnss_at, imu_at)
        rates = (scenario.dvl_rate, scenario.gnss_rate, scenario.imu_rate)
        self._sensors = [
            _Sensor(make, 0.0 if make is not gnss_at else GNSS_PHASE_S, rate, np.random.default_rng(seed))
            for make, rate, seed in zip(makers, rates, (seeds.dvl, seeds.gnss, seeds.imu), strict=True)
            if rate
        ]
        constants = (effect.values.get("time_constant_s", 0.0) for effect in scenario.effects)
        self._memory_s = REMEMBERED_CONSTANTS * max(constants, default=0.0)
        self._window: deque[MotionSample] = deque()
        self._depth = 0.0  # m below the start, of the window's first sample
        self._pending: list[tuple[int, int, Sample]] = []
        self._number = itertools.count()

    def add(self, sample: MotionSample) -> list[Sample]:
        """Add motion and return the new samples, in order of stamps. Times must increase (ValueError)."""
        window = self._window
        if window and sample.time <= window[-1].time:
            raise ValueError(f"time {sample.time} does not come after {window[-1].time}")
        window.append(sample)
        if len(window) > 2 or (len(window) == 2 and self._pending_from_the_start()):
            self._measure(window[-3].time if len(window) > 2 else -np.inf, window[-2].time)
        while len(window) > 3 and window[1].time < sample.time - self._memory_s:
            passed = _motion([window.popleft(), window[0]])
            self._depth = float(depth_of(passed.time, passed.upwards, self._depth)[1])
        reached = START_NS + round(1e9 * sample.time)
        out = []
        while self._pending and self._pending[0][0] <= reached:
            ready = heapq.heappop(self._pending)[2]
            out.append(ready._replace(stamp_ns=ready.stamp_ns + self._late_ns))
        return out

    def _pending_from_the_start(self) -> bool:
        return all(sensor.taken == 0 for sensor in self._sensors)

    def _measure(self, after: float, until: float) -> None:
        """Measure the samples due in (after, until]."""
        is_gap = np.isfinite(after) and until - after > MAX_GAP_S
        # sensors also count the samples that a gap in the motion swallows
        due = [(sensor, sensor.take_times(until)) for sensor in self._sensors]
        if is_gap or not any(len(at) for _, at in due):
            return
        world = world_of(self._scenario, _motion(self._window), self._disturbed, self._depth)
        for sensor, at in due:
            at = at[at > after]
            for made in sensor.make(self._scenario, world, at, sensor.rng) if len(at) else ():
                heapq.heappush(self._pending, (made.stamp_ns, next(self._number), made))

    def _disturbed(self, velocity: Array, motion: EffectInput, acts_on: ActsOn) -> Array:
        """Add the noise effects of one sensor to velocities (N, 3) m/s."""
        for effect, disturbance in self._disturbances:
            if effect.acts_on is acts_on:
                velocity = disturbance(velocity, motion)
        return velocity


def _motion(samples: Iterable[MotionSample]) -> Motion:
    """Return the motion of samples, in their order."""
    columns = zip(
        *((each.time, each.velocity_body, each.rotation_enu_from_body, each.angular_velocity) for each in samples),
        strict=True,
    )
    return Motion(*map(np.array, columns))


class _Sensor:
    """A sensor that measures at phase, phase + 1 / rate, ... s. make: of `scenario`. taken: samples so far."""

    def __init__(self, make: Callable[..., Any], phase: float, rate: float, rng: np.random.Generator) -> None:
        self.make, self.rng, self.taken = make, rng, 0
        self._phase, self._step = phase, (phase + 1.0 / rate) - phase  # as numpy.arange counts

    def take_times(self, until: float) -> Array:
        """Return the sampling times (N,) s up to `until` that are still due, and count them as taken."""
        at = []
        while (time := self._phase + self.taken * self._step) <= until:
            at.append(time)
            self.taken += 1
        return np.array(at)


def in_order(run: Run) -> list[Sample]:
    """Return all samples of a run, in order of stamps."""
    return sorted([*run.imu, *run.gnss, *run.dvl], key=attrgetter("stamp_ns"))


def shifted(samples: list[Sample], late_ns: int) -> list[Sample]:
    """Return the samples with later stamps."""
    return [sample._replace(stamp_ns=sample.stamp_ns + late_ns) for sample in samples]
