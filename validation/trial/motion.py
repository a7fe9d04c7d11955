"""How the vehicles of the trial move: manoeuvres of a body with inertia in waves and current.

Euler angles are yaw, pitch, roll (Z-Y-X) of the forward-left-up body in east-north-up, so a positive pitch is bow down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

RATE_HZ = 50.0
# A motion begins before and ends after the recording, for what is late or early
MARGIN_S = 15.0


@dataclass(frozen=True)
class State:
    """The motion at N times: time (N,) s, velocity (N, 3) m/s of the reference point over ground in east-north-up.

    attitude: N rotations of the body in east-north-up. rates: (N, 3) rad/s angular velocity in the body. euler: (N, 3)
    rad yaw, pitch, roll.
    """

    time: Floats
    velocity_enu: Floats
    attitude: Rotation
    rates: Floats
    euler: Floats

    @cached_property
    def velocity_body(self) -> Floats:
        """(N, 3) m/s."""
        return np.asarray(self.attitude.apply(self.velocity_enu, inverse=True))

    @property
    def speed(self) -> Floats:
        """(N,) m/s."""
        return np.linalg.norm(self.velocity_enu, axis=1)


@dataclass(frozen=True)
class Motion:
    """A motion at the full rate; the recording is 0 .. seconds, the motion MARGIN_S longer at both ends.

    velocity_enu: (M, 3) m/s. euler: (M, 3) rad, yaw unwrapped. rates: (M, 3) rad/s.
    """

    seconds: float
    time: Floats
    velocity_enu: Floats
    euler: Floats
    rates: Floats

    def at(self, times: Floats) -> State:
        """The motion at any times (N,) s between its ends."""
        euler = _interpolate(times, self.time, self.euler)
        return State(
            times,
            _interpolate(times, self.time, self.velocity_enu),
            attitude(euler),
            _interpolate(times, self.time, self.rates),
            euler,
        )


def attitude(euler: Floats) -> Rotation:
    """Rotations of N Euler angles (N, 3) rad. scipy's own conversion takes ten times as long, half of a case's time."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(0.5 * euler).T, np.sin(0.5 * euler).T
    return Rotation.from_quat(
        np.column_stack(
            [
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
                cr * cp * cy + sr * sp * sy,
            ]
        )
    )


def _interpolate(at: Floats, time: Floats, columns: Floats) -> Floats:
    return np.column_stack([np.interp(at, time, column) for column in columns.T])


def sampled_motion(seconds: float, time: Floats, velocity_enu: Floats, euler: Floats) -> Motion:
    """A motion from its velocity (M, 3) m/s and Euler angles (M, 3) rad at the full rate."""
    turned = attitude(euler)
    steps = (turned[:-2].inv() * turned[2:]).as_rotvec() / (time[2:] - time[:-2])[:, None]
    rates = np.vstack([steps[:1], steps, steps[-1:]])
    return Motion(seconds, time, velocity_enu, euler, rates)


# ------------------------------------------------------------------ manoeuvres


@dataclass(frozen=True)
class Order:
    """What the helmsman orders for so many seconds: speed m/s, turn rate rad/s (to port), pitch rad (bow down)."""

    seconds: float
    speed: float
    turn_rate: float = 0.0
    pitch: float = 0.0


Round = Callable[[np.random.Generator], list[Order]]


def _straight(rng: np.random.Generator) -> list[Order]:
    return [Order(100.0, 1.5)]


def _one_speed_box(rng: np.random.Generator) -> list[Order]:
    return _legs_and_turns([1.4] * 4, 40.0, [np.pi / 2] * 4, 0.12)


def _legs_and_turns(speeds: list[float], leg_s: float, turns: list[float], turn_rate: float) -> list[Order]:
    orders = []
    for speed, turn in zip(speeds, turns, strict=True):
        orders += [Order(leg_s, speed), Order(abs(turn) / turn_rate, speed, float(np.copysign(turn_rate, turn)))]
    return orders


def _box(rng: np.random.Generator) -> list[Order]:
    side = rng.choice([-1.0, 1.0])
    leg, rate = rng.uniform(12.0, 35.0), rng.uniform(0.08, 0.2)
    slow = rng.uniform(0.7, 1.1)
    laps = [slow, slow + rng.uniform(0.3, 0.6), slow + rng.uniform(0.7, 1.2)]
    return [each for speed in laps for each in _legs_and_turns([speed] * 4, leg, [side * np.pi / 2] * 4, rate)]


def _lawnmower(rng: np.random.Generator) -> list[Order]:
    leg, rate = rng.uniform(30.0, 60.0), rng.uniform(0.1, 0.2)
    slow, fast = rng.uniform(0.8, 1.2), rng.uniform(1.5, 2.2)
    return _legs_and_turns([slow, slow, fast, fast], leg, [np.pi, -np.pi] * 2, rate)


def _figure_eight(rng: np.random.Generator) -> list[Order]:
    rate = rng.uniform(0.08, 0.18)
    slow, fast = rng.uniform(0.7, 1.1), rng.uniform(1.4, 2.2)
    return [
        Order(2 * np.pi / abs(turn), speed, turn)
        for speed in (slow, fast)
        for turn in (rate, -rate * rng.uniform(0.7, 1.3))
    ]


def _zigzag(rng: np.random.Generator) -> list[Order]:
    rate = rng.uniform(0.06, 0.15)
    orders = [Order(rng.uniform(3.0, 8.0), 1.2, rate)]
    for _ in range(4):
        speed, leg = rng.uniform(0.8, 2.2), rng.uniform(8.0, 25.0)
        turn = rng.uniform(0.6, 1.6) / rate
        orders += [
            Order(leg, speed),
            Order(turn, speed, -rate),
            Order(leg, speed),
            Order(turn * rng.uniform(0.7, 1.3), speed, rate),
        ]
    return orders


def _spiral(rng: np.random.Generator) -> list[Order]:
    side, dive = rng.choice([-1.0, 1.0]), rng.uniform(0.05, 0.2)
    tightest = rng.uniform(0.12, 0.2)
    rates = tightest * np.linspace(1.0, 0.2, 6)
    speeds = rng.uniform(0.8, 2.1, 6)
    down = [Order(rng.uniform(20.0, 40.0), v, side * r, dive) for v, r in zip(speeds, rates, strict=True)]
    up = [Order(each.seconds, each.speed, -each.turn_rate, -each.pitch) for each in reversed(down)]
    return [*down, *up]


def _free(rng: np.random.Generator) -> list[Order]:
    orders = []
    for _ in range(12):
        turning = rng.uniform() < 0.6
        turn_rate = rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.2) if turning else 0.0
        pitch = rng.uniform(-0.15, 0.15) if rng.uniform() < 0.4 else 0.0
        orders.append(Order(rng.uniform(5.0, 30.0), rng.uniform(0.5, 2.3), turn_rate, pitch))
    return orders


ROUNDS: Mapping[str, Round] = {
    "box": _box,
    "lawnmower": _lawnmower,
    "figure8": _figure_eight,
    "zigzag": _zigzag,
    "spiral": _spiral,
    "free": _free,
    "straight": _straight,
    "one_speed_box": _one_speed_box,
}
# Real motion: of an AUV in the sea, and of a boat on a lake
RECORDED, BOAT = "snapir", "caputh"
# What the diagnosis may be tuned on, and what is kept from that
TUNING_KINDS = ("box", "lawnmower", "figure8", "zigzag")
HELD_OUT_KINDS = ("free", "spiral", RECORDED)


def manoeuvre(kind: str, seconds: float, rng: np.random.Generator, calm: bool = False) -> Motion:
    """A run of a kind of `ROUNDS`, every one another. calm: without waves."""
    time = np.arange(-MARGIN_S, seconds + MARGIN_S, 1.0 / RATE_HZ)
    speed, turn_rate, pitch = _obeyed(ROUNDS[kind](rng), time, rng)
    swell = _Swell.drawn(rng, 0.0 if calm else rng.uniform(0.0, 1.0))
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(turn_rate) / RATE_HZ
    heel = rng.uniform(-0.15, 0.15) * turn_rate * speed
    trim = rng.uniform(-0.02, 0.02) + rng.uniform(-0.01, 0.01) * speed
    euler = np.column_stack([yaw, pitch + trim + swell.pitch(time), heel + swell.roll(time)])
    skid, rise = rng.uniform(0.1, 0.4), rng.uniform(-0.02, 0.02)
    through_water = np.column_stack([speed, -skid * turn_rate * speed, rise * speed])
    current = np.array([*rng.normal(0.0, 0.1, 2), 0.0])
    velocity = attitude(euler).apply(through_water) + current + swell.velocity(time)
    return sampled_motion(seconds, time, velocity, euler)


def _obeyed(orders: list[Order], time: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Speed, turn rate and pitch (M,) of a vehicle that follows the orders over and over, late by its inertia."""
    length = sum(order.seconds for order in orders)
    at = np.searchsorted(np.cumsum([order.seconds for order in orders]), np.mod(time - time[0], length))
    at = np.minimum(at, len(orders) - 1)
    ordered = np.array([[order.speed, order.turn_rate, order.pitch] for order in orders])[at]
    lags = rng.uniform((1.5, 0.8, 1.0), (3.0, 1.5, 2.0))
    speed, turn_rate, pitch = (_lagged(_lagged(x, lag), lag) for x, lag in zip(ordered.T, lags, strict=True))
    return speed, turn_rate, pitch


def _lagged(values: Floats, time_constant_s: float) -> Floats:
    """First-order low pass at the full rate, settled at the start."""
    keep = np.exp(-1.0 / (RATE_HZ * time_constant_s))
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values, zi=[keep * values[0]])[0])


def lagged(velocity: Floats, time_constant_s: float) -> Floats:
    """First-order low pass of columns (M, n) at the full rate."""
    return np.column_stack([_lagged(column, time_constant_s) for column in velocity.T])


@dataclass(frozen=True)
class _Swell:
    """Three waves: frequencies rad/s (3,); phases and amplitudes (3, 5) of east, north, up m/s, roll, pitch rad."""

    frequency: Floats
    phase: Floats
    amplitude: Floats

    @classmethod
    def drawn(cls, rng: np.random.Generator, height: float) -> _Swell:
        size = height / np.sqrt(3.0) * np.array([0.08, 0.08, 0.08, np.deg2rad(4.0), np.deg2rad(2.5)])
        return cls(
            2 * np.pi / rng.uniform(5.0, 11.0, 3),
            rng.uniform(0.0, 2 * np.pi, (3, 5)),
            rng.uniform(0.3, 1.0, (3, 5)) * size,
        )

    def _sum(self, time: Floats, which: int) -> Floats:
        angle = np.outer(time, self.frequency) + self.phase[:, which]
        return np.asarray(np.sin(angle) @ self.amplitude[:, which])

    def velocity(self, time: Floats) -> Floats:
        return np.column_stack([self._sum(time, axis) for axis in range(3)])

    def roll(self, time: Floats) -> Floats:
        return self._sum(time, 3)

    def pitch(self, time: Floats) -> Floats:
        return self._sum(time, 4)
