"""Simulated vehicle motion: legs and turns, and waves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import cycle

import numpy as np

from ..calibration.numerics.frames import Array, rotation_from_rpy

SPEED_MPS = 1.5
TURN_RATE = np.deg2rad(9.0)
# sway in a turn: a vehicle without keel skids outward in proportion to centripetal acceleration (0.25 s: 3.5 degrees of
# sideslip at 9 degrees per second)
SKID_S = 0.25
WAVE_PERIOD_S = 6.0
WAVE_ROLL, WAVE_PITCH = np.deg2rad(2.0), np.deg2rad(1.0)


@dataclass(frozen=True)
class Motion:
    """Motion of the vehicle at N times.

    time: (N,) s from 0.
    velocity_body: (N, 3) m/s of the reference point over ground, forward-left-up.
    rotation_enu_from_body: (N, 3, 3).
    angular_velocity: (N, 3) rad/s, body frame.
    """

    time: Array
    velocity_body: Array
    rotation_enu_from_body: Array
    angular_velocity: Array

    @property
    def upwards(self) -> Array:
        """Return the vertical velocity (N,) m/s; term by term, so that parts of a motion give the same values."""
        row, velocity = self.rotation_enu_from_body[:, 2], self.velocity_body
        return row[:, 0] * velocity[:, 0] + row[:, 1] * velocity[:, 1] + row[:, 2] * velocity[:, 2]


@dataclass(frozen=True)
class Leg:
    """A leg of constant speed (m/s) and yaw rate (rad/s)."""

    seconds: float
    speed: float
    yaw_rate: float = 0.0


def _quarter(sign: float = 1.0, speed: float = SPEED_MPS) -> Leg:
    return Leg(np.pi / 2 / TURN_RATE, speed, sign * TURN_RATE)


def _half(sign: float, speed: float = SPEED_MPS) -> Leg:
    return Leg(np.pi / TURN_RATE, speed, sign * TURN_RATE)


def _full(sign: float, speed: float) -> Leg:
    return Leg(2 * np.pi / TURN_RATE, speed, sign * TURN_RATE)


# one round each, repeated for the requested time
ROUNDS: Mapping[str, Callable[[], list[Leg]]] = {
    "straight": lambda: [Leg(60.0, SPEED_MPS)],
    "box": lambda: [
        part for speed in (1.0, 1.5, 2.0) for _ in range(4) for part in (Leg(20.0, speed), _quarter(1.0, speed))
    ],
    "lawnmower": lambda: [Leg(60.0, SPEED_MPS), _half(1.0), Leg(60.0, SPEED_MPS), _half(-1.0)],
    "figure8": lambda: [part for speed in (1.0, 2.0) for part in (_full(1.0, speed), _full(-1.0, speed))],
}
FREE = "free"
TRAJECTORIES = (*ROUNDS, FREE)
# Free manoeuvres: length, speed and yaw rate of each leg are drawn from these; three legs in ten are straight.
FREE_SECONDS, FREE_SPEEDS_MPS, FREE_YAW_RATE = (5.0, 40.0), (0.6, 2.2), np.deg2rad(12.0)
FREE_STRAIGHT = 0.3
# time over which changes of speed and yaw rate are spread
INERTIA_S = 3.0


def make_motion(trajectory: str, seconds: float, rate_hz: float, rng: np.random.Generator | None = None) -> Motion:
    """Return the motion along one of `TRAJECTORIES`, sampled at a rate. rng: of free manoeuvres; seed 0 if None."""
    time = np.arange(0.0, seconds, 1.0 / rate_hz)
    free = trajectory == FREE
    legs = _free_legs(rng or np.random.default_rng(0)) if free else cycle(ROUNDS[trajectory]())
    speed, yaw_rate = _smoothed(legs, seconds, time)
    yaw = _integral(time, yaw_rate)
    phase = 2 * np.pi * time / WAVE_PERIOD_S
    roll, pitch = WAVE_ROLL * np.sin(phase), WAVE_PITCH * np.cos(1.3 * phase)
    sway = -SKID_S * yaw_rate * speed
    rotation = rotation_from_rpy(np.column_stack([roll, pitch, yaw]))
    rates = body_rates(time, roll, pitch, yaw_rate)
    return Motion(time, np.column_stack([speed, sway, np.zeros_like(speed)]), rotation, rates)


def body_rates(time: Array, roll: Array, pitch: Array, yaw_rate: Array) -> Array:
    """Return body angular velocity (N, 3) rad/s from roll and pitch (N,) rad over time and a yaw rate (N,)."""
    roll_rate, pitch_rate = np.gradient(roll, time), np.gradient(pitch, time)
    # Euler angle rates to body rates, Z-Y-X order
    return np.column_stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
        ]
    )


def _free_legs(rng: np.random.Generator) -> Iterator[Leg]:
    """Yield legs of random duration, speed and yaw rate without end."""
    while True:
        straight = rng.random() < FREE_STRAIGHT
        yaw_rate = 0.0 if straight else float(rng.uniform(-FREE_YAW_RATE, FREE_YAW_RATE))
        yield Leg(float(rng.uniform(*FREE_SECONDS)), float(rng.uniform(*FREE_SPEEDS_MPS)), yaw_rate)


def _smoothed(legs: Iterator[Leg], seconds: float, time: Array) -> tuple[Array, Array]:
    """Return speed (N,) and yaw rate (N,), with changes spread over 3 s by the vehicle's inertia."""
    ends, speeds, yaw_rates = [], [], []
    end = 0.0
    for leg in legs:
        end += leg.seconds
        ends.append(end)
        speeds.append(leg.speed)
        yaw_rates.append(leg.yaw_rate)
        if end > seconds:
            break
    edges = np.array([0.0, *ends])
    lengths = np.diff(edges)

    def mean(values: list[float]) -> Array:
        """Return the mean over 3 s around each time, with the first and last leg extended."""
        travelled = np.concatenate([[0.0], np.cumsum(lengths * np.array(values))])

        def until(at: Array) -> Array:
            beyond = np.minimum(at - edges[0], 0.0) * values[0] + np.maximum(at - edges[-1], 0.0) * values[-1]
            return np.interp(at, edges, travelled) + beyond

        averaged: Array = (until(time + 0.5 * INERTIA_S) - until(time - 0.5 * INERTIA_S)) / INERTIA_S
        return averaged

    return mean(speeds), mean(yaw_rates)


def _integral(time: Array, rate: Array) -> Array:
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    return np.concatenate([[0.0], np.cumsum(steps)])


GRAVITY = 9.81
COMPONENTS = 12
# range of angular frequencies relative to the peak, and spread of directions
BAND = (0.7, 2.0)
SPREAD = np.deg2rad(20.0)


@dataclass(frozen=True)
class Waves:
    """A sea state. height: significant wave height, m. period: of the spectrum's peak, s."""

    height: float
    period: float


def add_waves(motion: Motion, waves: Waves, rng: np.random.Generator) -> Motion:
    """Return the motion of a small vehicle, which follows the water's orbital motion and tilts with its surface.

    Airy waves in deep water with a Bretschneider spectrum, random phases and directions. With θ = k x - ω t + φ the
    surface is a cos θ, its slope -a k sin θ and the water moves at aω cos θ along and aω sin θ upwards.
    """
    steps = np.diff(motion.time, prepend=motion.time[0])
    velocity_enu = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, motion.velocity_body)
    east, north = np.cumsum(velocity_enu[:, :2] * steps[:, None], axis=0).T
    orbital = np.zeros_like(velocity_enu)
    slope = np.zeros((len(east), 2))
    for amplitude, omega, direction, phase in _components(waves, rng):
        wavenumber = omega**2 / GRAVITY
        toward = np.array([np.cos(direction), np.sin(direction)])
        theta = wavenumber * (east * toward[0] + north * toward[1]) - omega * motion.time + phase
        orbital[:, :2] += amplitude * omega * np.cos(theta)[:, None] * toward
        orbital[:, 2] += amplitude * omega * np.sin(theta)
        slope -= amplitude * wavenumber * np.sin(theta)[:, None] * toward
    return _tilted(motion, orbital, slope)


def _components(waves: Waves, rng: np.random.Generator) -> list[tuple[float, float, float, float]]:
    """Draw amplitude (m), angular frequency (rad/s), direction (rad, east to north) and phase (rad) per component."""
    ratio = np.linspace(*BAND, COMPONENTS)
    energy = ratio**-5 * np.exp(-1.25 * ratio**-4)
    amplitudes = np.sqrt(2.0 * energy / energy.sum()) * waves.height / 4.0
    directions = rng.uniform(0.0, 2.0 * np.pi) + rng.normal(0.0, SPREAD, COMPONENTS)
    phases = rng.uniform(0.0, 2.0 * np.pi, COMPONENTS)
    omegas = ratio * 2.0 * np.pi / waves.period
    return list(zip(amplitudes.tolist(), omegas.tolist(), directions.tolist(), phases.tolist(), strict=True))


def _tilted(motion: Motion, orbital_enu: Array, slope_enu: Array) -> Motion:
    """Return the motion with an added velocity (N, 3) m/s, tilted by a surface slope (N, 2) east and north."""
    rotation = motion.rotation_enu_from_body
    ahead = np.einsum("ni,ni->n", slope_enu, rotation[:, :2, 0])
    to_port = np.einsum("ni,ni->n", slope_enu, rotation[:, :2, 1])
    roll, pitch = np.arctan(to_port), -np.arctan(ahead)
    tilt = rotation_from_rpy(np.column_stack([roll, pitch, np.zeros_like(roll)]))
    tilt_rates = body_rates(motion.time, roll, pitch, np.zeros_like(roll))
    velocity = motion.velocity_body + np.einsum("nji,nj->ni", rotation, orbital_enu)
    return Motion(
        motion.time,
        np.einsum("nji,nj->ni", tilt, velocity),
        rotation @ tilt,
        np.einsum("nji,nj->ni", tilt, motion.angular_velocity) + tilt_rates,
    )
