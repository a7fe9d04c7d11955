"""Detection of a clock that drifts, or that steps once, relative to the others.

A recording is registered in stretches of time. If their delays differ, the single clock that explains the differences
is selected: by a drift, or by a step between stretches or within one (whose delay is then free).
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
from ..numerics.tests import RULED_OUT, Z_SLOW_ERRORS
from ..streams.interpolation import DvlColumns, ImuColumns, TurnRates
from .gauss_newton import ARM, DELTA, RHO, Fitted, MotionFit, N
from .motion_streams import MotionStreams

# Change of (δ, ρ) of a fit per second of delay of a stream.
DIRECTIONS: Mapping[str, tuple[float, float]] = {"dvl": (1.0, 0.0), "reference": (-1.0, 1.0), "imu": (0.0, -1.0)}
# σ of the changes of interpolation and filter delays between stretches, s.
LAGS_S = 0.03
# Smallest delay, change of it from end to end, or difference of two estimates of it that is reported, s. It shifts a
# lever arm by a tenth of a second times the speed. Interpolated attitudes and the filters of an INS have smaller delays
# (five real recordings: 0.03 to 0.07 s).
REPORTED_FROM_S = 0.1
# Thresholds of a clock change: chi-square gain, and largest residual chi-square per degree of freedom.
MIN_CHI2_GAIN, MAX_CHI2_LEFT = 18.0, 4.0
# Smallest gap in the stamps as a share of the forward step that caused it.
MIN_GAP_SHARE = 0.8
# Limits of the parameters `dvl_clock_drift`, s/s, and `dvl_time_jump`, s.
MAX_DRIFT, MAX_JUMP_S = 0.01, 10.0
# Length of the stretches, s, and most stretches of a recording.
STRETCH_S, MAX_STRETCHES = 90.0, 16
# Chi-square cost of a stretch with a free delay, and fewest stretches on either side of a step.
FREE_DELAY_CHI2, STRETCHES_A_SIDE = 10.0, 2
NO_STREAMS: Mapping[str, Array] = {}


@dataclass(frozen=True)
class ClockChange:
    """Drift (s/s since time 0) of one clock, or step: additional delay `leap` (s) from `at` (s) on.

    whose: key of `DIRECTIONS`, "" if not identifiable. std: σ of drift or step.
    """

    whose: str
    drift: float = 0.0
    leap: float = 0.0
    at: float = 0.0
    std: float = 0.0

    def reason(self, corrected: float) -> Reason:
        """Return the finding that names the clock, with the remedy. corrected: drift (s/s) subtracted already."""
        whose = {"dvl": "the DVL's", "imu": "the IMU's", "reference": "the reference's", "": "one"}[self.whose]
        ppm = {"ppm": 1e6 * self.drift, "std": 1e6 * self.std}
        if self.drift and self.whose == "dvl":
            return finding("CLOCK_DRIFTS_DVL", drift=corrected + self.drift, **ppm)
        if self.drift:
            return finding("CLOCK_DRIFTS", whose=whose, **ppm)
        way = "ahead" if self.leap > 0.0 else "back"
        return finding("CLOCK_LEAPS", whose=whose, way=way, seconds=abs(self.leap), std=self.std, at=self.at)

    def timed(self, motion: MotionStreams, fit: MotionFit, x: Array, rotation: Array, level: float) -> ClockChange:
        """Return the step at the only matching gap in the stamps, else at the time of least total cost.

        x: (9,) state before the step. rotation (3, 3), level (m/s): fitted by `fit` with the step corrected.
        """
        if not self.leap:
            return self
        reach = _reach(fit.times)
        times = stamps(motion).get(self.whose, motion.dvl.times)
        holes = _holes(times, self.leap, self.at, reach)
        if self.leap > 0.0 and len(holes) == 1:
            return replace(self, at=float(times[holes[0] : holes[0] + 2].mean()))
        after = x.copy()
        after[[DELTA, RHO]] += self.leap * np.array(DIRECTIONS[self.whose or "dvl"])
        (at, before), (later, behind) = (fit.costs(each, rotation, level) for each in (x, after))
        shared, own, other = np.intersect1d(at, later, return_indices=True)
        near = np.abs(fit.times[shared] - self.at) <= reach
        if not near.any():
            return self
        place = int(np.argmin(np.cumsum((before[own] - behind[other])[near])))
        seconds = float(fit.times[shared][near][place])
        # converted to DVL stamps, midway between those before and after a forward step
        return replace(self, at=seconds + (float(x[DELTA]) + max(0.5 * self.leap, 0.0)) * (self.whose == "dvl"))

    def corrections(self, epoch_ns: int) -> dict[str, float]:
        """Return the parameters that correct a change of the DVL clock. epoch_ns: stamp of time 0."""
        if self.whose != "dvl" or abs(self.drift) > MAX_DRIFT or abs(self.leap) > MAX_JUMP_S:
            return {}
        if self.drift:
            return {"dvl_clock_drift": round(self.drift, 7)}
        return {"dvl_time_jump": round(self.leap, 3), "dvl_time_jump_at": round(1e-9 * epoch_ns + self.at, 3)}

    def corrected(self, motion: MotionStreams) -> MotionStreams:
        """Return the motion with the change corrected."""
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
        """Return the corrected times that increase, and their mask (N,)."""
        true = times - self.drift * times - self.leap * (times >= self.at)
        at = np.diff(np.maximum.accumulate(true), prepend=-np.inf) > 0.0
        return true[at], at


class _Course(NamedTuple):
    """Hypothetical delay (S,) in each stretch per unit of the change, with a drift or a step at `at` (s).

    kept: (S,) False for a stretch with a free delay. at: None for a drift.
    """

    of: Array
    kept: Mask
    at: float | None

    def fits(self, value: float, stamps: Array | None, reach: float) -> bool:
        """Return whether stamps (N,) s allow a step of value (s); a forward step needs a gap. None: unknown stamps."""
        if self.at is None or value <= 0.0 or stamps is None:
            return True
        return bool(len(_holes(stamps, value, self.at, reach)))


def stamps(motion: MotionStreams) -> Mapping[str, Array]:
    """Return the times (N,) s of each stream, by the keys of `DIRECTIONS`."""
    return {"dvl": motion.dvl.times, "reference": motion.reference_times, "imu": motion.imu.times}


def _reach(times: Array) -> float:
    """Return the uncertainty (s) of the time of a step within times (N,)."""
    return float(np.ptp(times)) / MAX_STRETCHES + STRETCH_S


def _holes(times: Array, jump: float, at: float, reach: float) -> Index:
    """Return indices of times (N,) before gaps of the size of a step (s), within reach of it."""
    gap = np.diff(times)
    return np.flatnonzero((gap > MIN_GAP_SHARE * jump) & (np.abs(times[1:] - at) < reach + gap))


def unsteady(
    times: Array, stretches: Sequence[Fitted], is_turned: bool, streams: Mapping[str, Array] = NO_STREAMS
) -> ClockChange | None:
    """Return the significant change of one clock over stretches at times (S,) s, else None.

    streams: stamps of each stream; a clock whose stamps have no gap has no forward step.
    """
    if len(times) < 2 * STRETCHES_A_SIDE:
        return None
    # a delay without acceleration looks like a lever arm, which is the same in all stretches
    states = [*range(N)[ARM], DELTA, RHO]
    seen = np.array([each.x[states] for each in stretches])
    lags = np.diag([0.0] * 3 + [LAGS_S**2] * 2)
    # a stretch has few time blocks, so the autocorrelation of its residuals estimates lasting noise
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
            left += FREE_DELAY_CHI2 * (not course.kept.all())
            if course.fits(value, streams.get(name) if is_turned else None, _reach(times)):
                found.append((left, value, std, name, course))
    left, value, std, name, course = min(found, key=lambda each: each[0])
    length = float(np.ptp(times)) if course.at is None else 1.0
    # noise as long as a stretch adds scatter, so all evidence is scaled down
    scatter = max(1.0, left / (seen.size - len(states) - 1.0))
    std *= math.sqrt(scatter)
    is_large = abs(value) * length > REPORTED_FROM_S and abs(value) > Z_SLOW_ERRORS * std
    is_shown = is_large and still - left > MIN_CHI2_GAIN * scatter
    if not is_shown or left > min(but_one) + FREE_DELAY_CHI2 * scatter or scatter > MAX_CHI2_LEFT:
        return None
    others = min((each[0] for each in found if each[3] != name), default=np.inf)
    whose = name if is_turned and others - left > RULED_OUT * scatter else ""
    return ClockChange(whose, value, std=std) if course.at is None else ClockChange(whose, 0.0, value, course.at, std)


def _leaps(times: Array) -> Iterator[_Course]:
    """Yield steps between two stretches, and within one."""
    n = np.arange(len(times))
    for at in range(STRETCHES_A_SIDE, len(times) - STRETCHES_A_SIDE + 1):
        yield _Course((n >= at).astype(float), n >= 0, float(times[at - 1 : at + 1].mean()))
        if at < len(times) - STRETCHES_A_SIDE:
            yield _Course((n > at).astype(float), n != at, float(times[at]))


def _explained(seen: Array, weight: Array, moved: Array, kept: Mask) -> tuple[float, float, float]:
    """Return residual chi-square, value and its σ for states (S, k): one common state plus `moved` (S, k) · value."""
    k = seen.shape[1]
    h = np.concatenate([np.broadcast_to(np.eye(k), (len(seen), k, k)), moved[:, :, None]], axis=2)[kept]
    z, w = seen[kept], weight[kept]
    information = np.einsum("sij,sik,skl->jl", h, w, h)
    is_asked = bool(information[k, k] > 0.0)
    n = k + is_asked
    p = np.linalg.inv(information[:n, :n])
    x = p @ np.einsum("sij,sik,sk->j", h, w, z)[:n]
    residual = z - h[:, :, :n] @ x
    chi_square = float(np.einsum("si,sij,sj->", residual, w, residual))
    return (chi_square, float(x[k]), float(np.sqrt(p[k, k]))) if is_asked else (chi_square, 0.0, np.inf)
