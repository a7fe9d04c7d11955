"""The one answer to how DVL, reference and IMU stand to each other, from their data alone.

From all delays within a minute (`coarse`), by least squares about the likeliest (`fine`). The IMU's clock is the time
base: whose attitude turns the reference into the body. Who starts from an answer, who warns and who corrects asks here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models.parameters import Parameters
from ..numerics.frames import Array
from .clock_drift_and_jumps import MOST_STRETCHES, STRETCH_S, ClockChange, stamps, unsteady
from .delay_search import LONGEST_S, places
from .gauss_newton import (  # fmt: skip
    APART,
    ARM,
    BOTH_ALIKE,
    DVL,
    FEW_ROWS,
    HELD_STD_S,
    LATE,
    MOST_ROWS,
    REFERENCE,
    SCALE,
    TURN,
    Fitted,
    MotionFit,
    N,
)
from .motion_streams import Curves, MotionStreams

# Said from here on: a lever arm is then a tenth of a second times the speed off, and interpolated attitudes and filters
# of an inertial navigation are late by less (five real recordings: 0.03 to 0.07 s).
SAID_FROM_S = 0.1
# So many σ from which a clock is said to be off. In chi-square: what one more clock that is off has to gain, and by how
# much the next explanation has to be worse to be ruled out.
SIGMAS, ONE_MORE, TOLD_APART = 4.0, 12.0, 8.0
# ... and for a calibration to be refused that has it in time, where σ holds as much: the same streams, cut and thinned
# otherwise, differ by so much that what was not taken off of all of them may be told apart in what was calibrated with.
REFUSED_FROM = 16.0
# In chi-square: what clocks in time may cost for no other explanation to be tried.
NO_DOUBT = 3.0
# Places whose misfit is so much more than the best one's are none: of it, and a share of the squares.
WORSE = 3.0, 0.02
# Stamps are late where something takes time; that they are early, by a clock that is ahead, is less likely by as much.
EARLY = 6.0
# Of places that explain the data about as well the nearest is taken: log evidence, of samples so far apart (s).
INDEPENDENT_S, GAIN = 1.0, 8.0
# Against a place that compares fewer references than this share of its own another is weighed on what both compare.
AS_MANY = 0.95
# What is left lasts by so much longer than noise where a clock moves, which is then looked for by so many references of
# each stretch.
STEADY, ROWS_OF_STRETCH = 1.05, 400
# The place of the clocks is known where it is to this, s (σ); of one that is far off to a share of it, and to no more
# than this: a short run finds some place for any clock, to half a second.
KNOWN_STD_S, KNOWN_SHARE, KNOWN_AT_MOST_S = 0.25, 0.12, 0.35


OFFSETS = {"dvl_time_offset": "the DVL's", "reference_time_offset": "the reference's", "imu_time_offset": "the IMU's"}
# A DVL that is late by less is found by the calibration itself (full), at whatever its stamps say, s.
LEFT_TO_CALIBRATION_S = 2.5
# Clocks that are found twice are one clock if they agree to this, s.
ALIKE_S = 0.1
# A reference's clock of which nobody says anything is in time to this, s (σ): receivers and filters are late by tenths.
IN_TIME_STD_S = 0.5
# A clock that stays in time, though the data have it farther off than so many σ, is open by that. Farther off than so
# many times what is known of one in time no place of the data says what that leaves open.
FAR_OPEN = 2.0
# What it leaves open of a lever arm is none to speak of below this, m (σ).
OPEN_FROM_M = 0.03
# ... and of the DVL's yaw, rad (σ).
OPEN_FROM_RAD = math.radians(0.1)


@dataclass(frozen=True)
class Clock:
    """late: by how much stamps are late beside the IMU's, s. std: σ. is_shown: that they are is beyond doubt."""

    late: float
    std: float
    is_shown: bool


@dataclass(frozen=True)
class Registration:
    """dvl, reference: their clocks beside the IMU's. imu: its own, where it alone is off.

    Without a reference that an attitude turns, which clock it is does not show: then the reference is in time. apart:
    by how much the DVL's stamps are later than the reference's. is_turned: whether an attitude turns the reference.
    are_known: whether the data show how the clocks stand, in time or not.
    rotation_body_from_dvl (3, 3), turn_std (3,) rad. lever_arm, lever_arm_std (3,) m: of the DVL from the reference
    point. scale, scale_std: error of the DVL's, dimensionless. left: what no registration explains, as a share of the
    speed; spread: the same, m/s per axis; speed: RMS, m/s.
    unsteady: a clock that drifts or leaps beside the others; all else is what holds with that taken off.
    open_late: σ (s) of the reference's clock by the data alone; open_by: (7,) by how much the DVL's turn (rad, body),
    the lever arm (m) and the DVL's delay (s) are others for each second of it. next_worse: by how
    much (chi-square) the next explanation is worse than the one that is taken.
    """

    dvl: Clock
    reference: Clock
    imu: Clock
    apart: Clock
    is_turned: bool
    are_known: bool
    rotation_body_from_dvl: Array
    turn_std: Array
    lever_arm: Array
    lever_arm_std: Array
    scale: float
    scale_std: float
    left: float
    spread: float
    speed: float
    open_late: float
    open_by: Array
    next_worse: float
    unsteady: ClockChange | None = None

    @property
    def left_open(self) -> Array:
        """Covariance (7, 7) of what its clock leaves open of turn (rad, body), lever arm (m) and the DVL's delay (s).

        At one speed a clock looks like a lever arm, at one rate of turn like a yaw, and then none is known. Zero where
        that is nothing to speak of.
        """
        open_by = self.open_by * _with_prior(self.open_late)
        turn, arm = (float(np.linalg.norm(part)) for part in (open_by[:3], open_by[3:6]))
        is_little = arm < OPEN_FROM_M and turn < OPEN_FROM_RAD
        return np.zeros((7, 7)) if is_little else np.outer(open_by, open_by)

    @property
    def offsets(self) -> dict[str, float]:
        """By parameter, how late (s) the stamps are of the clocks that are shown to be off, beyond what it says."""
        if self.imu.is_shown:
            return {"imu_time_offset": self.imu.late}
        if not self.is_turned and self.apart.is_shown and self.apart.late < 0.0:
            # which of the two it is does not show, but stamps are late more often than early
            return {"reference_time_offset": -self.apart.late}
        clocks = {"dvl_time_offset": self.dvl, "reference_time_offset": self.reference}
        return {name: clock.late for name, clock in clocks.items() if clock.is_shown}

    @property
    def taken_off(self) -> dict[str, float]:
        """Those that a calibration takes off, s: a DVL that is late by little it finds itself, at whatever stamps."""
        found = {name: round(late, 3) for name, late in self.offsets.items()}
        is_little = found.keys() == {"dvl_time_offset"} and abs(found["dvl_time_offset"]) < LEFT_TO_CALIBRATION_S
        return {} if is_little else found

    def told(self, name: str) -> Reason:
        """Whose stamps are how late, by the parameter that takes it off."""
        clocks = {"dvl_time_offset": self.dvl, "reference_time_offset": self.reference, "imu_time_offset": self.imu}
        if not self.is_turned and name == "reference_time_offset":
            clocks[name] = replace(self.apart, late=-self.apart.late)
        clock = clocks[name]
        return finding("CLOCK_OFF", whose=OFFSETS[name], seconds=abs(clock.late), std=clock.std, way=_way(clock))

    def contradiction(self, parameters: Parameters) -> Reason | None:
        """What the data fit, where a clock beside the DVL's is off beyond doubt."""
        if self.unsteady is not None:
            return self.unsteady.reason
        name, clock = ("imu_time_offset", self.imu) if self.imu.is_shown else ("reference_time_offset", self.reference)
        if not clock.is_shown or (self.next_worse < REFUSED_FROM and self._holds(clock)):
            return self.not_told_apart
        offset = round(getattr(parameters, name) + clock.late, 2)
        off = {"seconds": abs(clock.late), "way": _way(clock), "parameter": name, "offset": offset}
        if clock is self.reference and self.dvl.is_shown:
            return finding("CLOCKS_LATE", dvl_seconds=abs(self.dvl.late), dvl_way=_way(self.dvl), **off)
        return finding("CLOCK_LATE", whose=OFFSETS[name], **off)

    def _holds(self, clock: Clock) -> bool:
        """Whether σ of a calibration with a clock in time holds that it is late by so much."""
        return bool(self.left_open.any()) and abs(clock.late) < FAR_OPEN * _with_prior(self.open_late)

    @property
    def not_told_apart(self) -> Reason | None:
        """Clocks that are further apart than a calibration finds, where whose is off does not show."""
        if self.offsets or not self.apart.is_shown or abs(self.apart.late) < LEFT_TO_CALIBRATION_S:
            return None
        return finding("CLOCKS_NOT_TOLD_APART", seconds=abs(self.apart.late), std=self.apart.std)


def register(motion: MotionStreams, rotation_body_from_dvl: Array | None, lever_arm: Array) -> Registration | None:
    """Register the streams of a motion; None where they have too little in common.

    rotation_body_from_dvl: (3, 3) the mounting, None where it is not known. lever_arm: (3,) m, what is known of it.
    """
    return _registered(motion, rotation_body_from_dvl, lever_arm, None)


def _registered(
    motion: MotionStreams, rotation_body_from_dvl: Array | None, lever_arm: Array, moves: ClockChange | None
) -> Registration | None:
    """moves: what has been taken off a clock; None to look whether one moves."""
    curves = Curves(motion)
    fit, quick = (MotionFit(motion, lever_arm, curves, most) for most in (MOST_ROWS, FEW_ROWS))
    best = _placed(motion, quick, rotation_body_from_dvl)
    if best is None:
        return None
    if moves is None and best.inflation > STEADY:
        moves = _unsteady(motion, curves, lever_arm, rotation_body_from_dvl)
        if moves is not None:
            found = _registered(moves.steadied(motion), rotation_body_from_dvl, lever_arm, moves)
            # in stretches without manoeuvres waves agree at several delays; without a clock that moves they all agree
            if found is not None and found.spread < best.level:
                x = np.zeros(N)
                x[SCALE], x[ARM] = found.scale, found.lever_arm - lever_arm
                x[APART], x[LATE] = found.dvl.late - found.reference.late, found.reference.late
                return replace(found, unsteady=moves.timed(motion, fit, x, found.rotation_body_from_dvl, found.spread))
    in_time = _held(quick, best, rotation_body_from_dvl, 0.0, 0.0, (DVL, REFERENCE))
    if in_time[1] < NO_DOUBT:  # all that there is would show nothing more
        seen = _explained(quick, best, rotation_body_from_dvl, lever_arm)
        if not seen.left_open.any():
            return seen
        # fewer references show less of a clock
        free = fit(float(best.x[LATE]), float(best.x[APART]), rotation_body_from_dvl)
        if free is None or not _is_possible(free):
            return seen
        if _held(fit, free, rotation_body_from_dvl, 0.0, 0.0, (DVL, REFERENCE))[1] < NO_DOUBT:
            return replace(seen, **_open(fit, free, 0.0, rotation_body_from_dvl))
        best = free
    best = fit(float(best.x[LATE]), float(best.x[APART]), rotation_body_from_dvl)
    return None if best is None or not _is_possible(best) else _explained(fit, best, rotation_body_from_dvl, lever_arm)


def _placed(motion: MotionStreams, quick: MotionFit, rotation: Array | None) -> Fitted | None:
    """The likeliest place of the clocks of a motion."""
    likely = places(motion, rotation)
    enough = WORSE[0] * likely[0].misfit + WORSE[1] if likely else 0.0
    tried = [(place.reference, place.dvl - place.reference) for place in likely if place.misfit <= enough]
    found = [quick(*place, rotation) for place in {*tried, (0.0, 0.0)}]
    fitted = [each for each in found if each is not None and _is_possible(each)]
    if not fitted:
        return None
    closest = min(fitted, key=lambda each: each.level)
    # legs that repeat agree at more than one delay
    as_good = [each for each in fitted if _is_as_good(motion, quick, each, closest, rotation)]
    return min(as_good, key=lambda each: abs(each.x[LATE]) + abs(each.dvl_late))


def _unsteady(motion: MotionStreams, curves: Curves, lever_arm: Array, rotation: Array | None) -> ClockChange | None:
    """A clock that moves, by the places of all of them in stretches of a motion."""
    times = motion.reference_times
    number = min(int((times[-1] - times[0]) / STRETCH_S), MOST_STRETCHES)
    found = []
    for at in np.array_split(np.arange(len(times)), max(number, 1)) if number > 1 else ():
        own = motion.part(at, LONGEST_S)
        best = _placed(own, MotionFit(own, lever_arm, curves, ROWS_OF_STRETCH), rotation)
        if best is not None:
            found.append((float(times[at].mean()), best))
    is_turned = motion.in_earth and motion.has_attitude
    return unsteady(np.array([at for at, _ in found]), [each for _, each in found], is_turned, stamps(motion))


def _explained(fit: MotionFit, free: Fitted, rotation: Array | None, lever_arm: Array) -> Registration:
    """By the fewest clocks that are off: none, one of the three, or both of DVL and reference."""
    apart = float(free.x[APART])
    early, too_early = (EARLY, 0.0) if apart < 0.0 else (0.0, EARLY)
    tried = {_Off.NONE: _held(fit, free, rotation, 0.0, 0.0, (DVL, REFERENCE))}
    if tried[_Off.NONE][1] >= NO_DOUBT:
        tried |= {
            _Off.DVL: _held(fit, free, rotation, 0.0, apart, (REFERENCE,), ONE_MORE + early),
            _Off.REFERENCE: _held(fit, free, rotation, -apart, apart, (DVL,), ONE_MORE + too_early),
            _Off.IMU: _held(fit, free, rotation, float(free.x[LATE]), 0.0, (BOTH_ALIKE,), ONE_MORE),
        }
    likeliest, (best, cost) = min(tried.items(), key=lambda each: each[1][1])
    # that both are off holds either one, and is no other cause
    next_worse = min((c for each, (_, c) in tried.items() if each is not likeliest), default=math.inf) - cost
    if best is None or cost > 2.0 * ONE_MORE:
        likeliest, best, next_worse = _Off.BOTH, free, math.inf
    is_told_apart = next_worse > TOLD_APART
    x, p = best.x, best.p
    # what is not shown stays in time, and σ has to hold it
    stays = likeliest in (_Off.NONE, _Off.DVL) or not (is_told_apart and _is_off(best, LATE))
    late = 0.0 if stays else float(x[LATE])
    std = np.sqrt(np.maximum(np.diag(p), 0.0))
    return Registration(
        dvl=Clock(best.dvl_late, best.dvl_std, is_told_apart and is_beyond_doubt(best.dvl_late, best.dvl_std)),
        reference=Clock(float(x[LATE]), float(std[LATE]), is_told_apart and _is_off(best, LATE)),
        imu=Clock(-float(x[LATE]), float(std[LATE]), likeliest is _Off.IMU and is_told_apart and _is_off(best, LATE)),
        apart=Clock(float(x[APART]), float(std[APART]), likeliest is not _Off.NONE and _is_off(best, APART)),
        is_turned=fit.is_turned,
        are_known=bool((free.std[[APART, LATE] if fit.is_turned else [APART]] < KNOWN_STD_S).all()),
        rotation_body_from_dvl=best.rotation_body_from_dvl,
        turn_std=std[TURN],
        lever_arm=lever_arm + x[ARM],
        lever_arm_std=std[ARM],
        scale=float(x[SCALE]),
        scale_std=float(std[SCALE]),
        left=best.left,
        spread=best.level,
        speed=best.speed,
        next_worse=next_worse,
        **_open(fit, free, late, rotation),
    )


def _open(fit: MotionFit, free: Fitted, late: float, rotation: Array | None) -> dict[str, Any]:
    """open_late and open_by of a fit with all clocks free. late: s, where the reference's is said to be."""
    if not fit.is_turned:
        return {"open_late": 0.0, "open_by": np.zeros(7)}
    std, by, off = float(free.std[LATE]), free.by(LATE), abs(float(free.x[LATE]) - late)
    if off > FAR_OPEN * std and late == 0.0:
        std = off
    if off > FAR_OPEN * IN_TIME_STD_S and late == 0.0:
        # as good as in time, and so far away that it turns another arm there
        near = fit(0.0, 0.0, rotation, (REFERENCE * (HELD_STD_S / IN_TIME_STD_S),))
        std, by = max(std, off), by if near is None else near.by(LATE)
    return {"open_late": std, "open_by": np.concatenate([by[TURN], by[ARM], [1.0 + by[APART]]])}


def _with_prior(std: float) -> float:
    """Of a reference's clock that is known to so much (σ, s) by the data alone."""
    return 1.0 / math.hypot(1.0 / max(std, 1e-9), 1.0 / IN_TIME_STD_S)


class _Off(Enum):
    """Which clock is off."""

    NONE, DVL, REFERENCE, IMU, BOTH = range(5)


def _held(
    fit: MotionFit,
    free: Fitted,
    rotation: Array | None,
    reference: float,
    apart: float,
    in_time: tuple[Array, ...],
    costs: float = 0.0,
) -> tuple[Fitted | None, float]:
    """The fit with some clocks in time, and by how much chi-square grows, and what it costs beside; None: nothing."""
    held = fit(reference, apart, rotation, in_time)
    if held is None or not _is_possible(held):
        return None, math.inf
    # at other delays a sample more or less is within both streams
    grown = held.cost(free.level, held.at) * free.rows / held.rows - free.cost(free.level, free.at)
    grown /= free.inflation**2
    return held, grown + costs if math.isfinite(grown) else math.inf


def _is_off(fitted: Fitted, index: int) -> bool:
    return is_beyond_doubt(float(fitted.x[index]), float(fitted.std[index]))


def is_beyond_doubt(seconds: float, std: float) -> bool:
    """Whether a clock is off that is late by so much: from here on it is said."""
    is_known = std < min(max(KNOWN_STD_S, KNOWN_SHARE * abs(seconds)), KNOWN_AT_MOST_S)
    return is_known and abs(seconds) > max(SAID_FROM_S, SIGMAS * std)


def _is_possible(fitted: Fitted) -> bool:
    """Whether its clocks stand where they are looked for: what is found beyond, on the way there, is unknown."""
    late = [fitted.x[LATE], fitted.dvl_late]
    return bool(np.isfinite(fitted.x).all() and np.abs(late).max() <= LONGEST_S)


def _way(clock: Clock) -> str:
    return "late" if clock.late > 0.0 else "early"


def _is_as_good(motion: MotionStreams, fit: MotionFit, one: Fitted, closest: Fitted, rotation: Array | None) -> bool:
    """Whether a place explains the data about as well as the one that leaves least, and the same data.

    A delay that pushes a bad stretch of the DVL out of the overlap leaves less of the rest, as any other place does.
    Read at other times, the DVL's noise is another one: in waves that repeat, that alone tells two places apart.
    """
    is_read_elsewhere = abs(float(one.x[APART]) - float(closest.x[APART])) > ALIKE_S
    enough = GAIN + (_by_chance(motion, one, fit.dvl_noise) if is_read_elsewhere else 0.0)
    if _gain(motion, one, closest) < enough:
        return True
    if closest.rows > AS_MANY * one.rows:
        return False
    again = fit(float(one.x[LATE]), float(one.x[APART]), rotation, (), closest)
    if again is None:
        return False
    grown = again.cost(closest.level, again.at) - closest.cost(closest.level, again.at)
    return 0.5 * grown * min(1.0, _independent(motion, again) / again.rows) < enough


def _by_chance(motion: MotionStreams, fitted: Fitted, dvl_noise: float) -> float:
    """σ of the difference in log evidence of two places at which the DVL's noise is not the same."""
    share = min(dvl_noise / max(fitted.level**2, 1e-12), 1.0)  # of what is left
    # variance of (g + a)² - (g + b)², in squares of what is left: g the reference's noise, a and b the DVL's
    each = 8.0 * share * (1.0 - share) + 4.0 * share**2
    samples = fitted.rows * fitted.axes
    return 0.5 * math.sqrt(each * samples) * min(1.0, _independent(motion, fitted) / fitted.rows)


def _gain(motion: MotionStreams, one: Fitted, other: Fitted) -> float:
    """By how much the log evidence of the other is larger, of samples that are so far apart as to be independent."""
    return 3.0 * _independent(motion, other) * math.log(max(one.level, 1e-6) / max(other.level, 1e-6))


def _independent(motion: MotionStreams, fitted: Fitted) -> float:
    """How many of the references that are compared are so far apart as to be independent."""
    times = motion.reference_times
    return min(float(fitted.rows), float(times[-1] - times[0]) / INDEPENDENT_S)
