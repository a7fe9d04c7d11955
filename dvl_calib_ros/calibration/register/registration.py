"""The one answer to how DVL, reference and IMU stand to each other, from their data alone.

From all delays within a minute (`coarse`), by least squares about the likeliest (`fine`). The IMU's clock is the time
base: whose attitude turns the reference into the body. Who starts from an answer, who warns and who corrects asks here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..frames import Array
from .coarse import places
from .fine import APART, ARM, DVL, LATE, REFERENCE, SCALE, TURN, Fit, Fitted
from .motion import Motion

# Said from here on: a lever arm is then a tenth of a second times the speed off, and interpolated attitudes and filters
# of an inertial navigation are late by less (five real recordings: 0.03 to 0.07 s).
SAID_FROM_S = 0.1
# So many σ from which a clock is said to be off. In chi-square: what one more clock that is off has to gain, and by how
# much the next explanation has to be worse to be ruled out.
SIGMAS, ONE_MORE, TOLD_APART = 4.0, 12.0, 8.0
# Stamps are late where something takes time; that they are early, by a clock that is ahead, is less likely by as much.
EARLY = 6.0
# Of places that explain the data about as well the nearest is taken: log evidence, of samples so far apart (s).
INDEPENDENT_S, GAIN = 1.0, 8.0
# The place of the clocks is known where it is to this, s (σ).
KNOWN_STD_S = 0.25


@dataclass(frozen=True)
class Clock:
    """late: by how much stamps are late beside the IMU's, s. std: σ. is_shown: that they are is beyond doubt."""

    late: float
    std: float
    is_shown: bool


@dataclass(frozen=True)
class Registration:
    """dvl, reference: their clocks. apart: by how much the DVL's stamps are later than the reference's.

    Without a reference that an attitude turns, which clock it is does not show: then only `apart` is known, and
    the reference is in time. rotation_body_from_dvl (3, 3), turn_std (3,) rad. lever_arm, lever_arm_std (3,) m: of the
    DVL from the reference point. scale, scale_std: error of the DVL's, dimensionless. left: what no registration
    explains, as a share of the speed; spread: the same, m/s per axis.
    """

    dvl: Clock
    reference: Clock
    apart: Clock
    rotation_body_from_dvl: Array
    turn_std: Array
    lever_arm: Array
    lever_arm_std: Array
    scale: float
    scale_std: float
    left: float
    spread: float

    @property
    def is_in_time(self) -> bool:
        """Whether no clock is shown to be off."""
        return not (self.dvl.is_shown or self.reference.is_shown or self.apart.is_shown)


def register(motion: Motion, rotation_body_from_dvl: Array | None, lever_arm: Array) -> Registration | None:
    """Register the streams of a motion; None where they have too little in common.

    rotation_body_from_dvl: (3, 3) the mounting, None where it is not known. lever_arm: (3,) m, what is known of it.
    """
    fit = Fit(motion, lever_arm)
    tried = [(place.reference, place.dvl - place.reference) for place in places(motion, rotation_body_from_dvl)]
    found = [fit(*place, rotation_body_from_dvl) for place in {*tried, (0.0, 0.0)}]
    fitted = [each for each in found if each is not None and np.isfinite(each.x).all()]
    if not fitted:
        return None
    best = min(fitted, key=lambda each: each.level)
    # legs that repeat agree at more than one delay
    as_good = [each for each in fitted if _gain(motion, each, best) < GAIN]
    best = min(as_good, key=lambda each: abs(each.x[LATE]) + abs(each.dvl_late))
    return _explained(fit, best, rotation_body_from_dvl, lever_arm)


def _explained(fit: Fit, free: Fitted, rotation: Array | None, lever_arm: Array) -> Registration:
    """By the fewest clocks that are off: none, only the DVL's, only the reference's, or both."""
    clocks = ((DVL, REFERENCE), (REFERENCE,), (DVL,))
    held = []
    for in_time in clocks:
        start = 0.0 if in_time is not clocks[2] else -float(free.x[APART])
        apart = 0.0 if in_time is clocks[0] else float(free.x[APART])
        held.append(fit(start, apart, rotation, in_time))
    none, of_dvl, of_reference = (math.inf if each is None else _cost(each, free) for each in held)
    apart = free.x[APART]
    of_dvl += EARLY if apart < 0.0 else 0.0
    of_reference += EARLY if apart > 0.0 else 0.0
    costs = {0: none, 1: of_dvl + ONE_MORE, 2: of_reference + ONE_MORE, 3: 2.0 * ONE_MORE}
    likeliest = min(costs, key=lambda each: costs[each])
    best = free if likeliest == 3 else held[likeliest] or free
    # that both are off holds either one, and is no other cause
    is_told_apart = all(
        cost - costs[likeliest] > TOLD_APART for each, cost in costs.items() if each not in (likeliest, 3)
    )
    x, p = best.x, best.p
    std = np.sqrt(np.maximum(np.diag(p), 0.0))
    return Registration(
        dvl=Clock(best.dvl_late, best.dvl_std, is_told_apart and _is_off(best.dvl_late, best.dvl_std)),
        reference=Clock(float(x[LATE]), float(std[LATE]), is_told_apart and _is_off(float(x[LATE]), float(std[LATE]))),
        apart=Clock(float(x[APART]), float(std[APART]), likeliest > 0 and _is_off(float(x[APART]), float(std[APART]))),
        rotation_body_from_dvl=best.rotation_body_from_dvl,
        turn_std=std[TURN],
        lever_arm=lever_arm + x[ARM],
        lever_arm_std=std[ARM],
        scale=float(x[SCALE]),
        scale_std=float(std[SCALE]),
        left=best.level * math.sqrt(3.0) / max(best.speed, 1e-9),
        spread=best.level,
    )


def _cost(held: Fitted, free: Fitted) -> float:
    """By how much chi-square grows where clocks are held."""
    # at other delays a sample more or less is within both streams
    grown = (held.cost(free.level) * free.rows / held.rows - free.cost(free.level)) / free.inflation**2
    return grown if math.isfinite(grown) else math.inf


def _is_off(seconds: float, std: float) -> bool:
    return std < KNOWN_STD_S and abs(seconds) > max(SAID_FROM_S, SIGMAS * std)


def _gain(motion: Motion, one: Fitted, other: Fitted) -> float:
    """By how much the log evidence of the other is larger, of samples that are so far apart as to be independent."""
    times = motion.reference_times
    independent = min(float(other.rows), (times[-1] - times[0]) / INDEPENDENT_S)
    return 3.0 * independent * math.log(max(one.level, 1e-6) / max(other.level, 1e-6))
