"""Base classes of effects, which a vehicle has and a simulator lacks.

Each effect is a class in the registry (`EFFECTS`). Its `trace` both adds the effect to a simulation and explains it in
a diagnosis.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import Enum
from typing import ClassVar

import numpy as np
from scipy.linalg.lapack import dtbtrs
from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import VelocityFrame
from ..errors import InputError

HOUR_S = 3600.0

# Fixed-point iterations that undo a delay, or an effect on the motion it changes; both are small against the motion
PASSES = 3


@dataclass(frozen=True)
class EffectInput:
    """Motion that an effect acts on: the truth in the simulator, its best estimate in the diagnosis.

    time: (N,) s, increasing.
    velocity_body: (N, 3) m/s over ground of the reference point, forward-left-up.
    rotation_dvl_from_body: (3, 3) T.
    rotation_enu_from_body: (N, 3, 3).
    angular_velocity: (N, 3) rad/s, body frame; None if not recorded.
    reference_frame: frame in which the reference velocity was recorded; a delay or filter in that frame rotates with
      the vehicle only if it is the body.
    start: s, beginning of the recording; None: the first time.
    depth_below_start: (N,) m; None if the vertical velocity is not known.
    """

    time: Array
    velocity_body: Array
    rotation_dvl_from_body: Array
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None
    reference_frame: VelocityFrame = VelocityFrame.ENU
    start: float | None = None
    depth_below_start: Array | None = None

    @property
    def depth(self) -> Array:
        """Return depth_below_start for an effect that needs it. Raises ValueError if missing."""
        if self.depth_below_start is None:
            raise ValueError("this effect needs the depth (depth_below_start)")
        return self.depth_below_start

    @property
    def attitude(self) -> Array:
        """Return rotation_enu_from_body for an effect that needs it. Raises ValueError if missing."""
        if self.rotation_enu_from_body is None:
            raise ValueError("this effect needs the attitude (rotation_enu_from_body)")
        return self.rotation_enu_from_body

    @property
    def turn_rate(self) -> Array:
        """Return angular_velocity for an effect that needs it. Raises ValueError if missing."""
        if self.angular_velocity is None:
            raise ValueError("this effect needs the angular velocity")
        return self.angular_velocity

    @property
    def velocity_dvl(self) -> Array:
        """Return the velocity (N, 3) m/s in the nominal frame of the DVL."""
        return self.velocity_body @ self.rotation_dvl_from_body.T

    @property
    def speed(self) -> Array:
        """Return the speed (N,) m/s."""
        return np.linalg.norm(self.velocity_body, axis=1)

    @property
    def elapsed(self) -> Array:
        """Return the time since the start (N,) s."""
        return self.time - (self.time[0] if self.start is None else self.start)


class EffectNeeds(Enum):
    """Data that a recording needs for testing an effect."""

    ATTITUDE = "attitude"
    ANGULAR_VELOCITY = "angular velocity"
    DEPTH = "a dive"


class ActsOn(Enum):
    """Stage of an effect in the physical order of measurement, in which the stages follow each other.

    MOTION: the DVL's velocity at the time of measurement. MOUNTING: the rotation of the DVL in addition to the
    misalignment φ. DVL: its measurement, in addition to the calibrated errors. DVL_CLOCK: its stamps. REFERENCE: the
    simulator subtracts the trace from the reference velocity. REFERENCE_CLOCK, ATTITUDE_CLOCK: their stamps. Traces are
    in the body frame:

        u = v + traces on MOTION(v)                 D = (I + diag(δk)) Exp(φ + turns on MOUNTING(u)) T
        v_dvl = D u + T traces on DVL(u)            stamped s + late on DVL_CLOCK

    Within one stage traces, rotations and delays add up. An effect on a clock is a `ClockEffect`, one on the mounting a
    `MountingEffect`; any other an `Effect`.
    """

    MOTION = "motion"
    MOUNTING = "mounting"
    DVL = "dvl"
    DVL_CLOCK = "clock of the dvl"
    REFERENCE = "reference"
    REFERENCE_CLOCK = "clock of the reference"
    ATTITUDE_CLOCK = "clock of the attitude"


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    typical: a relevant size, in `unit`.
    low, high: bounds.
    default: value if not given; an effect with all defaults does nothing.
    linear: the trace is linear in it, with the others fixed.
    said: text displayed before value and unit, '' if the effect's name suffices; None: `name`.
    """

    name: str
    unit: str
    typical: float
    low: float
    high: float
    description: str
    default: float = 0.0
    linear: bool = True
    said: str | None = None

    @property
    def display_name(self) -> str:
        """Return the displayed name before value and unit."""
        return self.name if self.said is None else self.said


def within(
    name: str, unit: str, typical: float, bound: float, description: str, said: str, linear: bool = True
) -> EffectParameter:
    """Return a parameter within ±bound."""
    return EffectParameter(name, unit, typical, -bound, bound, description, linear=linear, said=said)


def along_axes(
    suffix: str, unit: str, typical: float, bound: float, description: str, linear: bool = True
) -> tuple[EffectParameter, ...]:
    """Return a parameter for each of x, y and z, within ±bound; `{}` in the description is the axis."""
    return tuple(
        within(f"{axis}_{suffix}", unit, typical, bound, description.format(axis), axis, linear) for axis in "xyz"
    )


def vector(values: Mapping[str, float], suffix: str) -> Array:
    """Return the three values (3,) of `along_axes`, 0 if missing."""
    return np.array([values.get(f"{axis}_{suffix}", 0.0) for axis in "xyz"])


class AnyEffect:
    """Base of systematic effects and of effects on the noise.

    name: as in the documentation.
    parameters: in the order of `values`.
    needs: data that a recording must have.
    confounded_with: effects that some data cannot distinguish from this one.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    acts_on: ClassVar[ActsOn]
    needs: ClassVar[frozenset[EffectNeeds]] = frozenset()
    confounded_with: ClassVar[tuple[str, ...]] = ()

    @property
    def defaults(self) -> dict[str, float]:
        """Return the values with which the effect does nothing."""
        return {parameter.name: parameter.default for parameter in self.parameters}


class Effect(AnyEffect, ABC):
    """A systematic effect: the same motion always gives the same trace.

    remedy: what to do about it, as part of a sentence.
    manoeuvre: motion that makes it observable and distinguishes it from confounded effects.
    per_recording: whether its size differs per recording; else it belongs to the vehicle.
    relative_to_first: whether it is a change from the first of several recordings.
    again: parameters of a second occurrence, searched after a first was found -> those of the first.
    rarer: parameters searched only if several recordings need them.
    of_velocity: whether the trace depends on the velocity of the motion.
    """

    remedy: ClassVar[str] = ""
    manoeuvre: ClassVar[str]
    per_recording: ClassVar[bool] = False
    relative_to_first: ClassVar[bool] = False
    again: ClassVar[Mapping[str, str]] = {}
    rarer: ClassVar[frozenset[str]] = frozenset()
    of_velocity: ClassVar[bool] = True

    @property
    def usual(self) -> Effect:
        """Return the effect without its rarer parameters."""
        return self.without(self.rarer)

    @property
    def once(self) -> Effect:
        """Return the effect without a second occurrence."""
        return self.without(self.again)

    @property
    def of_the_vehicle(self) -> Effect:
        """Return the effect with one size in all recordings."""
        found = copy(self)
        vars(found)["per_recording"] = False
        return found

    def without(self, names: Collection[str]) -> Effect:
        """Return the effect without some parameters, which keep their defaults of 0."""
        if not names:
            return self
        found, defaults = copy(self), self.defaults
        for name in ("trace", "late", "turn"):  # these methods expect all parameters
            if act := getattr(self, name, None):
                vars(found)[name] = lambda of, values, act=act: act(of, {**defaults, **values})
        vars(found)["parameters"] = tuple(parameter for parameter in self.parameters if parameter.name not in names)
        return found

    @property
    def linear(self) -> bool:
        """Return whether the trace is linear in all parameters jointly."""
        return all(parameter.linear for parameter in self.parameters)

    @abstractmethod
    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return the effect's part of (DVL velocity - ideal DVL velocity predicted from the reference).

        values: every parameter by name. (N, 3) m/s in the nominal body frame, at `motion.time`; `ActsOn` defines the
        stage. An effect on the reference returns minus its addition to the reference velocity.
        """


class EffectWithMemory(Effect):
    """An effect that is a linear filter of the velocity, with memory of the time before a recording."""

    @abstractmethod
    def filtered(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """Return `trace` for a velocity (N, 3) m/s, body frame, or for several (N, 3, p)."""

    @abstractmethod
    def of_before(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """Return the least-squares part of a velocity that the filter's memory at the start explains.

        velocity: (N, 3) m/s, body frame, or several (N, 3, p).
        """

    def follows(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """Return a velocity minus its filter response, minus the part of that by the initial memory.

        velocity: (N, 3) m/s, body frame, or several (N, 3, p).
        """
        residual: Array = velocity - self.filtered(motion, velocity, values)
        return residual - self.of_before(motion, residual, values)

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return the filter's addition to the motion's own velocity."""
        return self.filtered(motion, motion.velocity_body, values)


class ClockEffect(Effect):
    """A systematic effect on the stamps of one stream."""

    per_recording = True

    def late(self, elapsed: Array, values: Mapping[str, float]) -> Array:
        """Return the delay (N,) s of the stamps of measurements at times (N,) s since the start; here constant."""
        return np.full(len(elapsed), values["seconds"])


class MountingEffect(Effect):
    """A systematic effect on the rotation of the DVL."""

    acts_on = ActsOn.MOUNTING

    @abstractmethod
    def turn(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return (N, 3) rad, or (3,) for all times, added to the misalignment φ; `motion` is the DVL's own."""

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return Tᵀ (Exp(turn) - I) T v, the addition without another misalignment."""
        velocity = motion.velocity_dvl
        return (
            Rotation.from_rotvec(self.turn(motion, values)).apply(velocity) - velocity
        ) @ motion.rotation_dvl_from_body


Disturbance = Callable[[Array, EffectInput], Array]
"""Samples (N, 3) m/s of one sensor and the motion at their times -> the disturbed samples."""


class NoiseEffect(AnyEffect, ABC):
    """An effect on the noise. It is random, so it has no trace; the diagnosis has separate tests for it."""

    def disturb(
        self, velocity: Array, motion: EffectInput, values: Mapping[str, float], rng: np.random.Generator
    ) -> Array:
        """Return the samples (N, 3) m/s of one sensor, in its own frame and at `motion.time`, with the effect.

        One of this method and `following` must be defined.
        """
        return self.following(values, rng)(velocity, motion)

    def following(self, values: Mapping[str, float], rng: np.random.Generator) -> Disturbance:
        """Return a function for batches of samples that continue each other. Raises InputError if impossible."""
        raise InputError(f"effect {self.name}: cannot be made sample by sample; simulate a recorded motion instead")


# Slopes, integrals, and first-order recursions with varying decay, along time.


def slopes(time: Array, values: Array) -> Array:
    """Return slopes (N, k) per s of values (N, k) at times (N,) s, N > 1, faster than `numpy.gradient`."""
    steps = np.diff(time)
    between = np.diff(values, axis=0)
    between /= steps[:, None]
    found: Array = np.empty_like(between, shape=values.shape)
    found[:-1], found[-1] = between, between[-1]
    found[1:-1] += (steps[1:] / (steps[1:] + steps[:-1]))[:, None] * (between[:-1] - between[1:])
    return found


def depth_of(time: Array, upwards: Array, first: float = 0.0) -> Array:
    """Return depths (N,) m at times (N,) s by integrating upward velocities (N,) m/s. first: depth at time[0]."""
    return np.cumsum(np.append(first, -0.5 * (upwards[1:] + upwards[:-1]) * np.diff(time)))


def recursion(decay: Array, added: Array) -> Array:
    """Return x (N, ...) with x_n = decay_n x_(n-1) + added_n and x_0 = added_0.

    decay: (N,), the first is unused. added: (N, ...). It solves a triangular system with two bands.
    """
    if not added.size:
        return added.copy()
    bands = np.ones((2, len(added)))
    bands[1, :-1] = -decay[1:]
    solved, _ = dtbtrs(bands, added.reshape(len(added), -1), uplo="L", diag="U")
    return np.ascontiguousarray(solved).reshape(added.shape)


@dataclass(frozen=True)
class Injection:
    """An effect and the value of each of its parameters."""

    effect: AnyEffect
    values: Mapping[str, float]


def traces(injections: Sequence[Injection], motion: EffectInput, acts_on: ActsOn) -> Array:
    """Return the sum (N, 3) m/s, body frame, of the systematic effects of one stage."""
    total = np.zeros_like(motion.velocity_body)
    for injection in injections:
        if isinstance(injection.effect, Effect) and injection.effect.acts_on is acts_on:
            total += injection.effect.trace(motion, injection.values)
    return total


def at_dvl(injections: Sequence[Injection], motion: EffectInput) -> EffectInput:
    """Return the DVL's own motion: the reference point's with the traces on MOTION."""
    return replace(motion, velocity_body=motion.velocity_body + traces(injections, motion, ActsOn.MOTION))


def turns(injections: Sequence[Injection], motion: EffectInput) -> Array:
    """Return (N, 3) rad, or (3,) for all times, of rotation in addition to φ; motion: of the DVL."""
    total = np.zeros(3)
    for injection in injections:
        if isinstance(injection.effect, MountingEffect):
            total = total + injection.effect.turn(motion, injection.values)
    return total


def late(injections: Sequence[Injection], clock: ActsOn, elapsed: Array) -> Array:
    """Return the delay (N,) s of a clock's stamps for measurements at times (N,) s since the start."""
    total = np.zeros(len(elapsed))
    for injection in injections:
        if isinstance(injection.effect, ClockEffect) and injection.effect.acts_on is clock:
            total += injection.effect.late(elapsed, injection.values)
    return total


def true_times(injections: Sequence[Injection], clock: ActsOn, stamps: Array) -> Array:
    """Return the true times (N,) s of a clock's stamps (N,) s, by fixed-point iteration."""
    time = stamps
    for _ in range(PASSES):
        time = stamps - late(injections, clock, time)
    return time
