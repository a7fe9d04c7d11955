"""What an effect is: something the simulator lacks and a vehicle has.

One class each, in one registry (`EFFECTS`); the same class adds the effect to a simulation and explains it in a
diagnosis, through one function, `trace`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from copy import copy
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import VelocityFrame
from ..errors import InputError

HOUR_S = 3600.0


@dataclass(frozen=True)
class EffectInput:
    """The motion that an effect acts on: the truth in the simulator, the best knowledge of it in the diagnosis.

    time: (N,) s, increasing. velocity_body: (N, 3) m/s over ground of the reference point, forward-left-up.
    rotation_dvl_from_body: (3, 3) T. rotation_enu_from_body: (N, 3, 3). angular_velocity: (N, 3) rad/s, body frame;
    None where the bag has none. reference_frame: the frame in which the reference velocity was recorded; what delays or
    filters it there turns with the vehicle only if that is the body. start: s, when the recording began; None: with
    the first time.
    """

    time: Array
    velocity_body: Array
    rotation_dvl_from_body: Array
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None
    reference_frame: VelocityFrame = VelocityFrame.ENU
    start: float | None = None

    @property
    def attitude(self) -> Array:
        """rotation_enu_from_body, of an effect that needs it. Raises ValueError without."""
        if self.rotation_enu_from_body is None:
            raise ValueError("this effect needs the attitude (rotation_enu_from_body)")
        return self.rotation_enu_from_body

    @property
    def turn_rate(self) -> Array:
        """angular_velocity, of an effect that needs it. Raises ValueError without."""
        if self.angular_velocity is None:
            raise ValueError("this effect needs the angular velocity")
        return self.angular_velocity

    @property
    def velocity_dvl(self) -> Array:
        """(N, 3) m/s in the nominal frame of the DVL."""
        return self.velocity_body @ self.rotation_dvl_from_body.T

    @property
    def speed(self) -> Array:
        """(N,) m/s."""
        return np.linalg.norm(self.velocity_body, axis=1)

    @property
    def elapsed(self) -> Array:
        """(N,) s since the start."""
        return self.time - (self.time[0] if self.start is None else self.start)


class EffectNeeds(Enum):
    """What a recording must hold for an effect to be testable."""

    ATTITUDE = "attitude"
    ANGULAR_VELOCITY = "angular velocity"


class ActsOn(Enum):
    """Where an effect stands in the order of physics, in which these follow each other.

    MOTION: the velocity at which the DVL is moved, at the time of measurement. MOUNTING: how the DVL is turned against
    that, on top of the misalignment φ. DVL: what it makes of it, beside the calibration. DVL_CLOCK: when it says that
    was. REFERENCE: the simulator takes the trace off the reference velocity. REFERENCE_CLOCK, ATTITUDE_CLOCK: when
    these say that was. Traces are in the body frame:

        u = v + traces on MOTION(v)                 D = (I + diag(δk)) Exp(φ + turns on MOUNTING(u)) T
        v_dvl = D u + T traces on DVL(u)            stamped s + late on DVL_CLOCK

    Within one stage traces, turns and lateness add up. An effect on a clock is a `ClockEffect`, one on the mounting a
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
    """One parameter.

    typical: size in `unit` that would be worth knowing of. low, high: bounds. default: its value where none is given;
    an effect with all parameters at their defaults does nothing. linear: the trace is linear in it, the others fixed.
    said: what it is called before its value and unit, '' where the effect's name says that; None: as its name.
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
    def spoken(self) -> str:
        """What it is called before its value and unit."""
        return self.name if self.said is None else self.said


def along_axes(
    suffix: str, unit: str, typical: float, bound: float, description: str, linear: bool = True
) -> tuple[EffectParameter, ...]:
    """One parameter for each of x, y and z, within ±bound; `{}` in the description is the axis."""
    return tuple(
        EffectParameter(
            f"{axis}_{suffix}", unit, typical, -bound, bound, description.format(axis), linear=linear, said=axis
        )
        for axis in "xyz"
    )


def vector(values: Mapping[str, float], suffix: str) -> Array:
    """The three values (3,) of `along_axes`, 0 where not given."""
    return np.array([values.get(f"{axis}_{suffix}", 0.0) for axis in "xyz"])


class AnyEffect:
    """What systematic effects and effects on the noise have in common.

    name: as in the documentation. parameters: in the order of `values`. needs: what a recording must hold.
    confounded_with: effects that some data cannot tell from this one.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    acts_on: ClassVar[ActsOn]
    needs: ClassVar[frozenset[EffectNeeds]] = frozenset()
    confounded_with: ClassVar[tuple[str, ...]] = ()

    @property
    def defaults(self) -> dict[str, float]:
        """Values with which the effect does nothing."""
        return {parameter.name: parameter.default for parameter in self.parameters}


class Effect(AnyEffect, ABC):
    """A systematic effect: the same motion always gives the same trace.

    remedy: what to do about it where it is found, as part of a sentence. manoeuvre: what to fly to see it and tell it
    from what it is confounded with. of_the_day: whether its size is another in every recording; else it belongs to the
    vehicle. relative_to_first: whether it is a change against the first of several recordings. bends_arm: whether
    little of it, left out, moves the lever arm by decimetres, as a clock's delay does beside an arm of metres. again:
    parameters of a second time that it happens, which is looked for where a first was found -> those of the first.
    rarer: parameters that are looked for where several recordings ask for them. of_velocity: whether the trace depends
    on the velocity of the motion.
    """

    remedy: ClassVar[str] = ""
    manoeuvre: ClassVar[str]
    of_the_day: ClassVar[bool] = False
    relative_to_first: ClassVar[bool] = False
    bends_arm: ClassVar[bool] = False
    again: ClassVar[Mapping[str, str]] = {}
    rarer: ClassVar[frozenset[str]] = frozenset()
    of_velocity: ClassVar[bool] = True

    @property
    def usual(self) -> Effect:
        """The same, without what is rarer."""
        return self.without(self.rarer)

    @property
    def once(self) -> Effect:
        """The same, happening once at most."""
        return self.without(self.again)

    @property
    def of_the_vehicle(self) -> Effect:
        """The same, of one size in all recordings."""
        found = copy(self)
        vars(found)["of_the_day"] = False
        return found

    def without(self, names: Collection[str]) -> Effect:
        """The same, without some parameters, which stay at their defaults of 0."""
        if not names:
            return self
        found, defaults = copy(self), self.defaults
        for name in ("trace", "late", "turn"):  # what it does goes by all parameters, which it may count
            if act := getattr(self, name, None):
                vars(found)[name] = lambda of, values, act=act: act(of, {**defaults, **values})
        vars(found)["parameters"] = tuple(each for each in self.parameters if each.name not in names)
        return found

    @property
    def linear(self) -> bool:
        """Whether the trace is linear in all parameters together."""
        return all(parameter.linear for parameter in self.parameters)

    @abstractmethod
    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """What the effect adds to (DVL velocity - ideal DVL velocity as expected from the reference).

        values: every parameter by name. (N, 3) m/s in the nominal body frame, at `motion.time`; where it comes in is
        told by `ActsOn`. An effect on the reference returns minus what it adds to the reference velocity.
        """


class EffectWithMemory(Effect):
    """An effect whose trace is that of a filter: linear in the velocity, also of the time before a recording began."""

    @abstractmethod
    def filtered(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """What `trace` is of a velocity (N, 3) m/s, body frame, or of several (N, 3, p)."""

    @abstractmethod
    def of_before(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """That part of a velocity (N, 3) m/s, body frame, or of several (N, 3, p), that what the filter has kept of the
        time before the motion explains, by least squares."""

    def follows(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """A velocity (N, 3) m/s, body frame, or several (N, 3, p), less what is `filtered` of it, less what is
        `of_before` in that."""
        left: Array = velocity - self.filtered(motion, velocity, values)
        return left - self.of_before(motion, left, values)

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """What the filter adds to the motion's own velocity."""
        return self.filtered(motion, motion.velocity_body, values)


class ClockEffect(Effect):
    """A systematic effect on the stamps of one stream."""

    of_the_day = True
    bends_arm = True

    @abstractmethod
    def late(self, elapsed: Array, values: Mapping[str, float]) -> Array:
        """(N,) s by which what is measured at times (N,) s since the start is stamped late."""


class MountingEffect(Effect):
    """A systematic effect on how the DVL is turned."""

    acts_on = ActsOn.MOUNTING

    @abstractmethod
    def turn(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """(N, 3) rad, or (3,) for all times, that is added to the misalignment φ; `motion` is the DVL's own."""

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Tᵀ (Exp(turn) - I) T v: what it adds where there is no other misalignment."""
        velocity = motion.velocity_dvl
        return (
            Rotation.from_rotvec(self.turn(motion, values)).apply(velocity) - velocity
        ) @ motion.rotation_dvl_from_body


Disturbance = Callable[[Array, EffectInput], Array]
"""Samples (N, 3) m/s of one sensor and the motion at their times -> the samples as they come out."""


class NoiseEffect(AnyEffect, ABC):
    """An effect on the noise: it changes samples by chance, so it has no trace; the diagnosis has tests of its own."""

    @abstractmethod
    def disturb(
        self, velocity: Array, motion: EffectInput, values: Mapping[str, float], rng: np.random.Generator
    ) -> Array:
        """Samples (N, 3) m/s of one sensor, in its own frame and at `motion.time`, as they come out with the effect."""

    def following(self, values: Mapping[str, float], rng: np.random.Generator) -> Disturbance:
        """The same for samples that come one by one, or few at a time, which are then a continuation of those before.

        Raises InputError where that cannot be done.
        """
        raise InputError(f"effect {self.name}: cannot be made sample by sample; simulate a recorded motion instead")
