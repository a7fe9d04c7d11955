"""What an effect is: something the simulator lacks and a vehicle has.

One class each, in one registry (`EFFECTS`); the same class adds the effect to a simulation and explains it in a
diagnosis, through one function, `trace`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

from ..calibration.frames import Array


@dataclass(frozen=True)
class EffectInput:
    """The motion that an effect acts on: the truth in the simulator, the best knowledge of it in the diagnosis.

    time: (N,) s, increasing. velocity_body: (N, 3) m/s over ground of the reference point, forward-left-up.
    rotation_dvl_from_body: (3, 3) T. rotation_enu_from_body: (N, 3, 3). angular_velocity: (N, 3) rad/s, body frame;
    None where the bag has none.
    """

    time: Array
    velocity_body: Array
    rotation_dvl_from_body: Array
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None


class Needs(Enum):
    """What a recording must hold for an effect to be testable."""

    ATTITUDE = "attitude"
    ANGULAR_VELOCITY = "angular velocity"


class ActsOn(Enum):
    """Where the simulator adds an effect: to what the DVL measures, or (with the sign turned) to the reference."""

    DVL = "dvl"
    REFERENCE = "reference"


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter. typical: size in `unit` that would be worth knowing of. low, high: bounds of the fit."""

    name: str
    unit: str
    typical: float
    low: float
    high: float
    description: str


class Effect(ABC):
    """A systematic effect.

    name: as in the documentation. parameters: in the order of `values`. needs: what a recording must hold. linear:
    the trace is linear in all parameters. confounded_with: effects that some data cannot tell from this one.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[ParameterSpec, ...]]
    acts_on: ClassVar[ActsOn] = ActsOn.DVL
    needs: ClassVar[frozenset[Needs]] = frozenset()
    linear: ClassVar[bool] = True
    confounded_with: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """What the effect adds to (DVL velocity - ideal DVL velocity as expected from the reference).

        (N, 3) m/s in the nominal body frame, at `motion.time`. An effect on the reference returns minus what it adds to
        the reference velocity.
        """
