"""Effects together, in the order of physics (`ActsOn`): each acts on what those before it have made of the motion.

The simulator goes this way forwards, the diagnosis backwards, from what was measured to the motion; both through here.
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
    """Sum (N, 3) m/s, body frame, of what the systematic effects of one stage add there."""
    total = np.zeros_like(motion.velocity_body)
    for each in injections:
        if isinstance(each.effect, Effect) and each.effect.acts_on is acts_on:
            total += each.effect.trace(motion, each.values)
    return total


def at_dvl(injections: Sequence[Injection], motion: EffectInput) -> EffectInput:
    """The motion of the DVL itself: that of the reference point with the traces on MOTION."""
    return replace(motion, velocity_body=motion.velocity_body + traces(injections, motion, ActsOn.MOTION))


def turns(injections: Sequence[Injection], motion: EffectInput) -> Array:
    """(N, 3) rad, or (3,) for all times, by which the mounting is turned on top of φ; motion: of the DVL."""
    total = np.zeros(3)
    for each in injections:
        if isinstance(each.effect, MountingEffect):
            total = total + each.effect.turn(motion, each.values)
    return total


def late(injections: Sequence[Injection], clock: ActsOn, elapsed: Array) -> Array:
    """(N,) s by which a clock's stamps are late of what is measured at times (N,) s since the start."""
    total = np.zeros(len(elapsed))
    for each in injections:
        if isinstance(each.effect, ClockEffect) and each.effect.acts_on is clock:
            total += each.effect.late(elapsed, each.values)
    return total
