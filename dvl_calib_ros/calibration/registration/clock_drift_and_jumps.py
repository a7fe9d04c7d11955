"""Clocks that do not stand still beside each other: one that drifts, or that leaps once.

A recording is registered in stretches. Where their clocks are not one, it is asked which single clock explains them:
one that is later by so much for each second, or from some stretch on; the stretch in which it leaps may be anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..numerics.samples import Index, Mask
from ..streams.interpolation import DvlColumns, ImuColumns, TurnRates
from .gauss_newton import APART, ARM, LATE, Fitted, MotionFit, N
from .motion_streams import MotionStreams

# By how much (δ, ρ) of a fit are more for each second that a stream's stamps are later.
DIRECTIONS: Mapping[str, tuple[float, float]] = {"dvl": (1.0, 0.0), "reference": (-1.0, 1.0), "imu": (0.0, -1.0)}
# Lags of interpolation and filters change by as much from one stretch to another, s.
LAGS_S = 0.03
# From here on a clock that moves is one, from end to end: s, in σ, and in chi-square; another clock has to explain it
# by so much less to be told from it, and what is left may be so much for each degree of freedom.
SHOWN_FROM_S, SIGMAS, GAIN, TOLD_APART, LEFT = 0.1, 6.0, 18.0, 8.0, 4.0
# A leap ahead leaves a hole of its size in the stamps, which is known to such a share.
HOLE = 0.8
# More is no parameter's (`dvl_clock_drift`, s/s, and `dvl_time_jump`, s).
MOST_DRIFT, MOST_LEAP_S = 0.01, 10.0
# A clock that moves is looked for in stretches this long, s, and no more of them.
STRETCH_S, MOST_STRETCHES = 90.0, 16
# What it costs, in chi-square, that one stretch is anything; and so many at least on either side of a leap.
ANYTHING, EACH_SIDE = 10.0, 2
NO_STREAMS: Mapping[str, Array] = {}


@dataclass(frozen=True)
class ClockChange:
    """whose: by the name of `DIRECTIONS`, "" where that does not show. drift: by how much later its stamps get, s/s
    since time 0. leap: by how much later they are from `at` (s) on. std: σ of whichever of both it is."""

    whose: str
    drift: float = 0.0
    leap: float = 0.0
    at: float = 0.0
    std: float = 0.0

    @property
    def reason(self) -> Reason:
        """Whose clock moves, with the remedy."""
        whose = {"dvl": "the DVL's", "imu": "the IMU's", "reference": "the reference's", "": "one"}[self.whose]
        ppm = {"ppm": 1e6 * self.drift, "std": 1e6 * self.std}
        if self.drift and self.whose == "dvl":
            return finding("CLOCK_DRIFTS_DVL", drift=self.drift, **ppm)
        if self.drift:
            return finding("CLOCK_DRIFTS", whose=whose, **ppm)
        way = "ahead" if self.leap > 0.0 else "back"
        return finding("CLOCK_LEAPS", whose=whose, way=way, seconds=abs(self.leap), std=self.std, at=self.at)

    def timed(self, motion: MotionStreams, fit: MotionFit, x: Array, rotation: Array, level: float) -> ClockChange:
        """A leap ahead at the hole that it leaves in the stamps, if there is just one; else at the time at which the
        clocks before it and those after it explain most together.

        x: (9,) the state before it. rotation: (3, 3) and level (m/s), that `fit` found with it taken off.
        """
        if not self.leap:
            return self
        reach = _reach(fit.times)
        times = stamps(motion).get(self.whose, motion.dvl.times)
        holes = _holes(times, self.leap, self.at, reach)
        if self.leap > 0.0 and len(holes) == 1:
            return replace(self, at=float(times[holes[0] : holes[0] + 2].mean()))
        after = x.copy()
        after[[APART, LATE]] += self.leap * np.array(DIRECTIONS[self.whose or "dvl"])
        (at, before), (later, behind) = (fit.costs(each, rotation, level) for each in (x, after))
        shared, own, other = np.intersect1d(at, later, return_indices=True)
        near = np.abs(fit.times[shared] - self.at) <= reach
        if not near.any():
            return self
        place = int(np.argmin(np.cumsum((before[own] - behind[other])[near])))
        seconds = float(fit.times[shared][near][place])
        # between the DVL's stamps before it and those after it
        return replace(self, at=seconds + (float(x[APART]) + max(0.5 * self.leap, 0.0)) * (self.whose == "dvl"))

    def taken_off(self, epoch_ns: int) -> dict[str, float]:
        """The parameters that take it off, which only the DVL's clock has. epoch_ns: stamp of time 0."""
        if self.whose != "dvl" or abs(self.drift) > MOST_DRIFT or abs(self.leap) > MOST_LEAP_S:
            return {}
        if self.drift:
            return {"dvl_clock_drift": round(self.drift, 7)}
        return {"dvl_time_jump": round(self.leap, 3), "dvl_time_jump_at": round(1e-9 * epoch_ns + self.at, 3)}

    def steadied(self, motion: MotionStreams) -> MotionStreams:
        """The motion without it."""
        m = motion
        if self.whose == "reference":
            times, at = self._true(m.reference_times)
            return replace(m, reference_times=times, reference=m.reference[at])
        if self.whose == "imu":
            times, at = self._true(m.imu.times)
            imu = ImuColumns(times, m.imu.orientation[at], m.imu.angular_velocity[at])
            return replace(m, imu=imu, turns=TurnRates.of(imu))
        times, at = self._true(m.dvl.times)
        return replace(m, dvl=DvlColumns(times, m.dvl.velocity[at]))

    def _true(self, times: Array) -> tuple[Array, Mask]:
        """Times that increase, and whose (N,) they are."""
        true = times - self.drift * times - self.leap * (times >= self.at)
        at = np.diff(np.maximum.accumulate(true), prepend=-np.inf) > 0.0
        return true[at], at


class _Course(NamedTuple):
    """of: (S,) by how much a clock is later in each stretch, for each unit. kept: (S,) False where it is anything. at:
    (s) since when, None of a drift."""

    of: Array
    kept: Mask
    at: float | None

    def fits(self, value: float, stamps: Array | None, reach: float) -> bool:
        """Whether a clock that is later by value (s) has the stamps (N,) s for that; None for unknown ones."""
        if self.at is None or value <= 0.0 or stamps is None:
            return True
        return bool(len(_holes(stamps, value, self.at, reach)))


def stamps(motion: MotionStreams) -> Mapping[str, Array]:
    """Times (N,) s of each stream, by the names of `DIRECTIONS`."""
    return {"dvl": motion.dvl.times, "reference": motion.reference_times, "imu": motion.imu.times}


def _reach(times: Array) -> float:
    """About a leap within times (N,), how far off (s) it may be."""
    return float(np.ptp(times)) / MOST_STRETCHES + STRETCH_S


def _holes(times: Array, leap: float, at: float, reach: float) -> Index:
    """Which of times (N,) come before a hole of the size of a leap (s), within reach of it."""
    gap = np.diff(times)
    return np.flatnonzero((gap > HOLE * leap) & (np.abs(times[1:] - at) < reach + gap))


def unsteady(
    times: Array, stretches: Sequence[Fitted], is_turned: bool, streams: Mapping[str, Array] = NO_STREAMS
) -> ClockChange | None:
    """Which clock moves through stretches at times (S,) s; None where that is not beyond doubt.

    streams: as of `stamps`; where stamps have no hole, their clock has not leapt ahead.
    """
    if len(times) < 2 * EACH_SIDE:
        return None
    # where the vehicle hardly speeds up, a clock looks like an arm; but that is the same in all stretches
    states = [*range(N)[ARM], APART, LATE]
    seen = np.array([each.x[states] for each in stretches])
    lags = np.diag([0.0] * 3 + [LAGS_S**2] * 2)
    # of a stretch blocks of time are few: noise that lasts shows in what is left
    lasting = [np.maximum(each.inflation / each.raised[states], 1.0) for each in stretches]
    p = np.array(
        [each.p[np.ix_(states, states)] * np.outer(*[by] * 2) for each, by in zip(stretches, lasting, strict=True)]
    )
    weight = np.linalg.inv(p + lags)
    names = DIRECTIONS if is_turned else {"dvl": DIRECTIONS["dvl"]}
    everywhere = np.ones(len(times), dtype=bool)
    n = np.arange(len(times))
    stands = np.zeros((len(times), len(states)))
    still, *but_one = (_explained(seen, weight, stands, n != out)[0] for out in (-1, *n))
    found = []
    for course in (_Course(times, everywhere, None), *_leaps(times)):
        for name, direction in names.items():
            moved = np.outer(course.of, (0.0, 0.0, 0.0, *direction))
            left, value, std = _explained(seen, weight, moved, course.kept)
            left += ANYTHING * (not course.kept.all())
            if course.fits(value, streams.get(name) if is_turned else None, _reach(times)):
                found.append((left, value, std, name, course))
    left, value, std, name, course = min(found, key=lambda each: each[0])
    length = float(np.ptp(times)) if course.at is None else 1.0
    # stretches scatter by more than they claim where noise lasts as long as they do: all is worth as much less
    scatter = max(1.0, left / (seen.size - len(states) - 1.0))
    std *= math.sqrt(scatter)
    is_shown = still - left > GAIN * scatter and abs(value) * length > SHOWN_FROM_S and abs(value) > SIGMAS * std
    if not is_shown or left > min(but_one) + ANYTHING * scatter or scatter > LEFT:
        return None
    others = min((each[0] for each in found if each[3] != name), default=np.inf)
    whose = name if is_turned and others - left > TOLD_APART * scatter else ""
    return ClockChange(whose, value, std=std) if course.at is None else ClockChange(whose, 0.0, value, course.at, std)


def _leaps(times: Array) -> Iterator[_Course]:
    """Between two stretches, and within one."""
    n = np.arange(len(times))
    for at in range(EACH_SIDE, len(times) - EACH_SIDE + 1):
        yield _Course((n >= at).astype(float), n >= 0, float(times[at - 1 : at + 1].mean()))
        if at < len(times) - EACH_SIDE:
            yield _Course((n > at).astype(float), n != at, float(times[at]))


def _explained(seen: Array, weight: Array, moved: Array, kept: Mask) -> tuple[float, float, float]:
    """What is left in chi-square of states (S, k) that are one, and `moved` (S, k) times a value; that, and its σ."""
    k = seen.shape[1]
    h = np.concatenate([np.broadcast_to(np.eye(k), (len(seen), k, k)), moved[:, :, None]], axis=2)[kept]
    z, w = seen[kept], weight[kept]
    information = np.einsum("sij,sik,skl->jl", h, w, h)
    is_asked = bool(information[k, k] > 0.0)
    n = k + is_asked
    p = np.linalg.inv(information[:n, :n])
    x = p @ np.einsum("sij,sik,sk->j", h, w, z)[:n]
    rest = z - h[:, :, :n] @ x
    left = float(np.einsum("si,sij,sj->", rest, w, rest))
    return (left, float(x[k]), float(np.sqrt(p[k, k]))) if is_asked else (left, 0.0, np.inf)
