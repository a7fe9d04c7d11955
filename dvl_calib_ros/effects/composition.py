"""Joint application of effects in the physical order of `ActsOn`: each acts on the result of the previous ones.

The simulator applies them forwards, the diagnosis backwards from the measurement to the motion; both use this module.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..calibration.numerics.frames import Array
from .base import ActsOn, AnyEffect, ClockEffect, Effect, EffectInput, MountingEffect


@dataclass(frozen=True)
class Injection:
    """An effect and the value of each of its parameters."""

    effect: AnyEffect
    values: Mapping[str, float]


def traces(injections: Sequence[Injection], motion: EffectInput, acts_on: ActsOn) -> Array:
    """Return the sum (N, 3) m/s, body frame, of the systematic effects of one stage."""
    total = np.zeros_like(motion.velocity_body)
    for each in injections:
        if isinstance(each.effect, Effect) and each.effect.acts_on is acts_on:
            total += each.effect.trace(motion, each.values)
    return total


def at_dvl(injections: Sequence[Injection], motion: EffectInput) -> EffectInput:
    """Return the DVL's own motion: the reference point's with the traces on MOTION."""
    return replace(motion, velocity_body=motion.velocity_body + traces(injections, motion, ActsOn.MOTION))


def turns(injections: Sequence[Injection], motion: EffectInput) -> Array:
    """Return (N, 3) rad, or (3,) for all times, of rotation in addition to φ; motion: of the DVL."""
    total = np.zeros(3)
    for each in injections:
        if isinstance(each.effect, MountingEffect):
            total = total + each.effect.turn(motion, each.values)
    return total


def late(injections: Sequence[Injection], clock: ActsOn, elapsed: Array) -> Array:
    """Return the delay (N,) s of a clock's stamps for measurements at times (N,) s since the start."""
    total = np.zeros(len(elapsed))
    for each in injections:
        if isinstance(each.effect, ClockEffect) and each.effect.acts_on is clock:
            total += each.effect.late(elapsed, each.values)
    return total
