"""Registration of DVL, reference and IMU: delays, mounting, lever arm and scale (docs/models.md, "Registration").

Correlation over all delays within a minute selects candidates (`delay_search`), least squares refines them
(`gauss_newton`). The IMU's clock is the time base, because its attitude rotates the reference into the body.

Arguments in this module: `rotation` (3, 3) is the rotation_body_from_dvl of the prior mounting, None to estimate it;
`lever_arm` (3,) m is the configured one; ρ and δ (rho, delta) are delays in s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.tests import RULED_OUT, Z_FIFTY_TESTS
from .clock_drift_and_jumps import MAX_STRETCHES, REPORTED_FROM_S, STRETCH_S, ClockChange, stamps, unsteady
from .delay_search import FARTHEST_S, candidate_delays
from .gauss_newton import (  # fmt: skip
    ARM,
    BOTH_ALIKE,
    DELTA,
    DVL,
    FULL_ROWS,
    HELD_STD_S,
    QUICK_ROWS,
    REFERENCE,
    RHO,
    SCALE,
    TURN,
    Fitted,
    MotionFit,
    N,
)
from .motion_streams import MotionStreams

# Chi-square that each additional delayed clock must gain.
GAIN_PER_CLOCK = 12.0
# Chi-square by which the next explanation must be worse for a refusal, if the σ of the calibration cover the delay. The
# chi-square of the same streams varies this much with the selected samples.
REFUSAL_CHI2 = 16.0
# Chi-square that synchronised clocks may cost without a test of other explanations.
IN_SYNC_CHI2 = 3.0
# Largest misfit of a candidate: this multiple of the smallest misfit, plus this share of the squares.
MISFIT_LIMIT = 3.0, 0.02
# Chi-square penalty of early stamps: processing makes stamps late, only a wrong clock makes them early.
EARLY_PENALTY = 6.0
# Spacing of independent samples (s), and log evidence that a larger delay must gain over a smaller one.
INDEPENDENT_S, LOG_GAIN = 1.0, 8.0
# If the best candidate compares fewer references than this share of another one, they are compared on shared ones.
MIN_ROW_SHARE = 0.95
# σ inflation by correlated residuals from which a clock change is searched, and references per stretch of that search.
STEADY_INFLATION, ROWS_OF_STRETCH = 1.05, 400
# Largest σ of a known delay, s: the larger of a constant and a share of the delay, up to a maximum. A short recording
# fits some delay of any clock to half a second.
KNOWN_STD_S, KNOWN_SHARE, KNOWN_MAX_S = 0.25, 0.12, 0.35


OFFSETS = {"dvl_time_offset": "the DVL's", "reference_time_offset": "the reference's", "imu_time_offset": "the IMU's"}
# Smaller DVL delays are left to the calibration (full), which estimates them at any stamps, s.
SMALL_DELAY_S = 2.5
# Prior σ of the reference delay, s: receivers and filters have delays of tenths of a second.
PRIOR_DELAY_STD_S = 0.5
# From this many σ on, the fitted delay of a clock assumed synchronised becomes its σ. From this multiple of the prior σ
# on, the sensitivities are those at zero delay.
OPEN_Z = 2.0
# Smallest relevant lever arm uncertainty due to the reference clock, m (σ).
MIN_OPEN_M = 0.03
# Smallest relevant DVL rotation uncertainty due to the reference clock, rad (σ).
MIN_OPEN_RAD = math.radians(0.1)


@dataclass(frozen=True)
class Clock:
    """Delay (s) of stamps relative to the IMU, positive if late; its σ (s); whether it is significant."""

    delay_s: float
    std: float
    is_shown: bool


@dataclass(frozen=True)
class Registration:
    """Delays, mounting, lever arm and scale of one motion.

    dvl, reference: clocks relative to the IMU.
    imu: its own clock, if it alone is off.
    apart: delay of the DVL relative to the reference.
    is_turned: an attitude rotates the reference; without it the delayed clock is not identifiable, and the reference is
      assumed synchronised.
    are_known: the data determine the delays.

    rotation_body_from_dvl (3, 3), turn_std (3,) rad.
    lever_arm, lever_arm_std (3,) m: DVL from the reference point, body frame.
    scale, scale_std: DVL scale error, dimensionless.
    residual: as a share of the speed.
    spread: residual per axis, m/s.
    speed: RMS, m/s.
    unsteady: clock drift or step; all other fields hold after its correction.

    open_std_s: σ (s) of the reference delay from the data alone.
    open_by: (7,) derivatives of the DVL's rotation (rad, body), lever arm (m) and DVL delay (s) with respect to it.
    next_worse: chi-square margin to the next explanation.
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
    residual: float
    spread: float
    speed: float
    open_std_s: float
    open_by: Array
    next_worse: float
    unsteady: ClockChange | None = None

    @property
    def left_open(self) -> Array:
        """Covariance (7, 7) of rotation (rad, body), lever arm (m) and DVL delay (s) due to the reference clock.

        Zero if negligible. At one speed a delay looks like a lever arm, at one turn rate like a yaw.
        """
        open_by = self.open_by * _with_prior(self.open_std_s)
        turn, arm = (float(np.linalg.norm(part)) for part in (open_by[:3], open_by[3:6]))
        is_little = arm < MIN_OPEN_M and turn < MIN_OPEN_RAD
        return np.zeros((7, 7)) if is_little else np.outer(open_by, open_by)

    @property
    def offsets(self) -> dict[str, float]:
        """Significant delays (s) beyond the configured ones, by parameter name."""
        if self.imu.is_shown:
            return {"imu_time_offset": self.imu.delay_s}
        if not self.is_turned and self.apart.is_shown and self.apart.delay_s < 0.0:
            # the delayed clock is not identifiable; late stamps are likelier than early ones
            return {"reference_time_offset": -self.apart.delay_s}
        clocks = {"dvl_time_offset": self.dvl, "reference_time_offset": self.reference}
        return {name: clock.delay_s for name, clock in clocks.items() if clock.is_shown}

    @property
    def corrections(self) -> dict[str, float]:
        """Delays (s) that a calibration corrects, by parameter; it estimates a small DVL delay itself."""
        found = {name: round(delay_s, 3) for name, delay_s in self.offsets.items()}
        is_little = found.keys() == {"dvl_time_offset"} and abs(found["dvl_time_offset"]) < SMALL_DELAY_S
        return {} if is_little else found

    def clock_reason(self, name: str) -> Reason:
        """Return the finding of the delay that a parameter corrects."""
        clocks = {"dvl_time_offset": self.dvl, "reference_time_offset": self.reference, "imu_time_offset": self.imu}
        if not self.is_turned and name == "reference_time_offset":
            clocks[name] = replace(self.apart, delay_s=-self.apart.delay_s)
        clock, whose = clocks[name], OFFSETS[name]
        if name == "imu_time_offset":
            against = "DVL and reference"
        else:
            against, other = ("reference", self.reference) if name == "dvl_time_offset" else ("DVL", self.dvl)
            if self.is_turned:
                against = "IMU" if other.is_shown else f"{against} and IMU"
        return finding(
            "CLOCK_OFF", whose=whose, seconds=abs(clock.delay_s), std=clock.std, way=_way(clock), against=against
        )

    def contradiction(self, parameters: Parameters) -> Reason | None:
        """Return the finding of a significant delay of reference or IMU, or of a clock change; else None."""
        if self.unsteady is not None:
            return self.unsteady.reason(parameters.dvl_clock_drift)
        name, clock = ("imu_time_offset", self.imu) if self.imu.is_shown else ("reference_time_offset", self.reference)
        if not clock.is_shown or (self.next_worse < REFUSAL_CHI2 and self._holds(clock)):
            return self.ambiguity
        offset = round(getattr(parameters, name) + clock.delay_s, 2)
        values = {"seconds": abs(clock.delay_s), "way": _way(clock), "parameter": name, "offset": offset}
        if clock is self.reference and self.dvl.is_shown:
            return finding("CLOCKS_LATE", dvl_seconds=abs(self.dvl.delay_s), dvl_way=_way(self.dvl), **values)
        return finding("CLOCK_LATE", whose=OFFSETS[name], **values)

    def _holds(self, clock: Clock) -> bool:
        """Return whether the σ of a calibration that assumes synchronisation cover the delay of a clock."""
        return bool(self.left_open.any()) and abs(clock.delay_s) < OPEN_Z * _with_prior(self.open_std_s)

    @property
    def ambiguity(self) -> Reason | None:
        """Finding of a large relative delay whose clock is not identifiable, or None."""
        if self.offsets or not self.apart.is_shown or abs(self.apart.delay_s) < SMALL_DELAY_S:
            return None
        return finding("CLOCKS_NOT_TOLD_APART", seconds=abs(self.apart.delay_s), std=self.apart.std)


def register(motion: MotionStreams, rotation_body_from_dvl: Array | None, lever_arm: Array) -> Registration | None:
    """Register the streams of a motion. Return None if they have too little in common.

    Parameters
    ----------
    motion: Streams, clock corrections of the parameters applied.
    rotation_body_from_dvl: (3, 3) nominal mounting; None to estimate it.
    lever_arm: (3,) m configured DVL position from the reference point, body frame.
    """
    return _registered(motion, rotation_body_from_dvl, lever_arm, are_clocks_steady=False)


def _registered(
    motion: MotionStreams, rotation_body_from_dvl: Array | None, lever_arm: Array, *, are_clocks_steady: bool
) -> Registration | None:
    """Register a motion, see `register`. are_clocks_steady: skip the search for a clock change."""
    full, quick = (MotionFit(motion, lever_arm, motion.curves, most) for most in (FULL_ROWS, QUICK_ROWS))
    likeliest = _fit_at_likeliest_delays(motion, quick, rotation_body_from_dvl)
    if likeliest is None:
        return None
    if not are_clocks_steady and likeliest.inflation > STEADY_INFLATION:
        change = _change(motion, lever_arm, rotation_body_from_dvl)
        if change is not None:
            changed = _with_change_corrected(motion, full, change, rotation_body_from_dvl, lever_arm)
            # several delays fit each stretch in waves; a real clock change lowers the total residual
            if changed is not None and changed.spread < likeliest.level:
                return changed
    return _with_steady_clocks(full, quick, likeliest, rotation_body_from_dvl, lever_arm)


def _with_change_corrected(
    motion: MotionStreams, full: MotionFit, change: ClockChange, rotation: Array | None, lever_arm: Array
) -> Registration | None:
    """Register a motion with a clock change corrected, and refine the time of a step. full: fit of the motion."""
    found = _registered(change.corrected(motion), rotation, lever_arm, are_clocks_steady=True)
    if found is None:
        return None
    before_step = np.zeros(N)
    before_step[SCALE], before_step[ARM] = found.scale, found.lever_arm - lever_arm
    before_step[DELTA], before_step[RHO] = found.dvl.delay_s - found.reference.delay_s, found.reference.delay_s
    timed = change.timed(motion, full, before_step, found.rotation_body_from_dvl, found.spread)
    return replace(found, unsteady=timed)


def _with_steady_clocks(
    full: MotionFit, quick: MotionFit, likeliest: Fitted, rotation: Array | None, lever_arm: Array
) -> Registration | None:
    """Register by the quick fit if it leaves nothing open, else by the full fit, which has more references.

    likeliest: quick fit at the likeliest delays.
    """
    in_sync = _fit_in_sync(quick, likeliest, rotation)
    start, held = likeliest, None
    if in_sync.chi2 < IN_SYNC_CHI2:
        explained = _fewest_delayed_clocks(quick, likeliest, in_sync, rotation, lever_arm)
        if not explained.left_open.any():
            return explained
        free = _refitted(full, likeliest, rotation)
        if free is None:
            return explained
        in_sync = _fit_in_sync(full, free, rotation)
        if in_sync.chi2 < IN_SYNC_CHI2:  # only σ of the reference clock changes
            return replace(explained, **_reference_clock(full, free, 0.0, rotation))
        start, held = free, in_sync.fit
    free = _refitted(full, start, rotation)
    if free is None:
        return None
    in_sync = _fit_in_sync(full, free, rotation) if held is None else _compared(held, free)
    return _fewest_delayed_clocks(full, free, in_sync, rotation, lever_arm)


def _refitted(fit: MotionFit, start: Fitted, rotation: Array | None) -> Fitted | None:
    """Fit from the delays of another fit. Return None without a possible fit."""
    found = fit(float(start.x[RHO]), float(start.x[DELTA]), rotation)
    return found if found is not None and _is_possible(found) else None


def _fit_at_likeliest_delays(motion: MotionStreams, quick: MotionFit, rotation: Array | None) -> Fitted | None:
    """Return the fit with the smallest delays among those that fit about as well as the best one.

    Repeated legs and periodic waves agree at several delays, of which the smallest are the likeliest.
    """
    candidates = candidate_delays(motion, rotation)
    max_misfit = MISFIT_LIMIT[0] * candidates[0].misfit + MISFIT_LIMIT[1] if candidates else 0.0
    delays = [(pair.reference, pair.dvl - pair.reference) for pair in candidates if pair.misfit <= max_misfit]
    fits = [quick(rho, delta, rotation) for rho, delta in {*delays, (0.0, 0.0)}]
    possible = [fit for fit in fits if fit is not None and _is_possible(fit)]
    if not possible:
        return None
    closest = min(possible, key=lambda fit: fit.level)
    as_good = [candidate for candidate in possible if _is_as_good(motion, quick, candidate, closest, rotation)]
    return min(as_good, key=lambda fit: abs(fit.x[RHO]) + abs(fit.dvl_delay_s))


def _change(motion: MotionStreams, lever_arm: Array, rotation: Array | None) -> ClockChange | None:
    """Return the clock drift or step between stretches of a motion, or None."""
    times = motion.reference_times
    n_stretches = min(int((times[-1] - times[0]) / STRETCH_S), MAX_STRETCHES)
    if n_stretches < 2:
        return None
    mean_times, fits = [], []
    for rows in np.array_split(np.arange(len(times)), n_stretches):
        stretch = motion.part(rows, FARTHEST_S)
        best = _fit_at_likeliest_delays(
            stretch, MotionFit(stretch, lever_arm, motion.curves, ROWS_OF_STRETCH), rotation
        )
        if best is not None:
            mean_times.append(float(times[rows].mean()))
            fits.append(best)
    is_turned = motion.in_earth and motion.has_attitude
    return unsteady(np.array(mean_times), fits, is_turned, stamps(motion))


def _fewest_delayed_clocks(
    fit: MotionFit, free: Fitted, in_sync: _HeldFit, rotation: Array | None, lever_arm: Array
) -> Registration:
    """Explain a fit with free delays by the fewest delayed clocks: none, one of three, or two.

    in_sync: fit without a delayed clock.
    """
    rho, delta = float(free.x[RHO]), float(free.x[DELTA])
    dvl_penalty, ref_penalty = (EARLY_PENALTY, 0.0) if delta < 0.0 else (0.0, EARLY_PENALTY)
    tried = {_Delayed.NONE: in_sync}
    if in_sync.chi2 >= IN_SYNC_CHI2:
        tried |= {
            _Delayed.DVL: _fit_in_sync(fit, free, rotation, 0.0, delta, (REFERENCE,), GAIN_PER_CLOCK + dvl_penalty),
            _Delayed.REFERENCE: _fit_in_sync(fit, free, rotation, -delta, delta, (DVL,), GAIN_PER_CLOCK + ref_penalty),
            _Delayed.IMU: _fit_in_sync(fit, free, rotation, rho, 0.0, (BOTH_ALIKE,), GAIN_PER_CLOCK),
        }
    likeliest = min(tried, key=lambda clock: tried[clock].chi2)
    best, chi2 = tried.pop(likeliest)
    next_worse = min((held.chi2 for held in tried.values()), default=math.inf) - chi2
    if best is None or chi2 > 2.0 * GAIN_PER_CLOCK:  # two clocks, which include every other explanation
        likeliest, best, next_worse = _Delayed.BOTH, free, math.inf
    is_identified = next_worse > RULED_OUT
    x, p = best.x, best.p
    # an insignificant delay is set to zero, and σ must cover it
    is_ref_held = likeliest in (_Delayed.NONE, _Delayed.DVL) or not (is_identified and _is_off(best, RHO))
    delay_s = 0.0 if is_ref_held else float(x[RHO])
    std = np.sqrt(np.maximum(np.diag(p), 0.0))
    return Registration(
        dvl=Clock(best.dvl_delay_s, best.dvl_std, is_identified and is_beyond_doubt(best.dvl_delay_s, best.dvl_std)),
        reference=Clock(float(x[RHO]), float(std[RHO]), is_identified and _is_off(best, RHO)),
        imu=Clock(-float(x[RHO]), float(std[RHO]), likeliest is _Delayed.IMU and is_identified and _is_off(best, RHO)),
        apart=Clock(float(x[DELTA]), float(std[DELTA]), likeliest is not _Delayed.NONE and _is_off(best, DELTA)),
        is_turned=fit.is_turned,
        are_known=bool((free.std[[DELTA, RHO] if fit.is_turned else [DELTA]] < KNOWN_STD_S).all()),
        rotation_body_from_dvl=best.rotation_body_from_dvl, turn_std=std[TURN], lever_arm=lever_arm + x[ARM],
        lever_arm_std=std[ARM], scale=float(x[SCALE]), scale_std=float(std[SCALE]), residual=best.residual,
        spread=best.level, speed=best.speed, next_worse=next_worse, **_reference_clock(fit, free, delay_s, rotation),
    )  # fmt: skip


def _reference_clock(fit: MotionFit, free: Fitted, delay_s: float, rotation: Array | None) -> dict[str, Any]:
    """Return `Registration.open_std_s` and `open_by` from a fit with free clocks.

    delay_s: adopted reference delay, s; 0 if the reference is taken as synchronised.
    """
    if not fit.is_turned:
        return {"open_std_s": 0.0, "open_by": np.zeros(7)}
    std, by_delay, offset = float(free.std[RHO]), free.by(RHO), abs(float(free.x[RHO]) - delay_s)
    if offset > OPEN_Z * std and delay_s == 0.0:
        std = offset
    if offset > OPEN_Z * PRIOR_DELAY_STD_S and delay_s == 0.0:
        # the free delay is so large that its sensitivities do not hold at zero delay
        std = max(std, offset)
        prior_fit = fit(0.0, 0.0, rotation, (REFERENCE * (HELD_STD_S / PRIOR_DELAY_STD_S),))
        if prior_fit is not None:
            by_delay = prior_fit.by(RHO)
    return {"open_std_s": std, "open_by": np.concatenate([by_delay[TURN], by_delay[ARM], [1.0 + by_delay[DELTA]]])}


def _with_prior(std: float) -> float:
    """Return σ (s) of the reference delay, prior included, from its σ by the data alone."""
    return 1.0 / math.hypot(1.0 / max(std, 1e-9), 1.0 / PRIOR_DELAY_STD_S)


class _Delayed(Enum):
    """Delayed clock; BOTH: DVL and reference."""

    NONE, DVL, REFERENCE, IMU, BOTH = range(5)


class _HeldFit(NamedTuple):
    """Fit with some clocks synchronised, None if impossible. chi2: growth over the free fit, plus penalties."""

    fit: Fitted | None
    chi2: float


def _fit_in_sync(
    fit: MotionFit,
    free: Fitted,
    rotation: Array | None,
    rho: float = 0.0,
    delta: float = 0.0,
    held_clocks: tuple[Array, ...] = (DVL, REFERENCE),
    penalty: float = 0.0,
) -> _HeldFit:
    """Fit with some or all clocks synchronised, and compare with the fit `free`.

    rho, delta: initial delays, s.
    held_clocks: rows that select the synchronised clocks.
    penalty: chi-square added.
    """
    held = fit(rho, delta, rotation, held_clocks)
    return _HeldFit(None, math.inf) if held is None or not _is_possible(held) else _compared(held, free, penalty)


def _compared(held: Fitted, free: Fitted, penalty: float = 0.0) -> _HeldFit:
    """Compare a fit with synchronised clocks with the fit `free`. penalty: see `_fit_in_sync`."""
    # the number of compared samples depends on the delays
    grown = held.cost(free.level, held.at) * free.rows / held.rows - free.cost(free.level, free.at)
    grown /= free.inflation**2
    return _HeldFit(held, grown + penalty if math.isfinite(grown) else math.inf)


def _is_off(fitted: Fitted, index: int) -> bool:
    return is_beyond_doubt(float(fitted.x[index]), float(fitted.std[index]))


def is_beyond_doubt(seconds: float, std: float) -> bool:
    """Return whether a delay (s) with this σ (s) is significant and large enough to report."""
    is_known = std < min(max(KNOWN_STD_S, KNOWN_SHARE * abs(seconds)), KNOWN_MAX_S)
    return is_known and abs(seconds) > max(REPORTED_FROM_S, Z_FIFTY_TESTS * std)


def _is_possible(fitted: Fitted) -> bool:
    """Return whether the fitted delays are finite and within the search range."""
    delays_s = [fitted.x[RHO], fitted.dvl_delay_s]
    return bool(np.isfinite(fitted.x).all() and np.abs(delays_s).max() <= FARTHEST_S)


def _way(clock: Clock) -> str:
    return "late" if clock.delay_s > 0.0 else "early"


def _is_as_good(motion: MotionStreams, fit: MotionFit, other: Fitted, closest: Fitted, rotation: Array | None) -> bool:
    """Return whether a candidate fits about as well as the one with the smallest residual, on the same data.

    A delay may lower the residual by moving a bad DVL stretch out of the overlap. Candidates with other DVL delays also
    sample other DVL noise; in periodic waves this alone makes a difference.
    """
    has_other_dvl_noise = abs(float(other.x[DELTA]) - float(closest.x[DELTA])) > REPORTED_FROM_S
    chance_gain = LOG_GAIN + (_chance_gain_std(motion, other, fit.dvl_noise) if has_other_dvl_noise else 0.0)
    if _gain(motion, other, closest) < chance_gain:
        return True
    if closest.rows > MIN_ROW_SHARE * other.rows:
        return False
    on_same_rows = fit(float(other.x[RHO]), float(other.x[DELTA]), rotation, (), closest)
    if on_same_rows is None:
        return False
    shared = on_same_rows.at
    grown = on_same_rows.cost(closest.level, shared) - closest.cost(closest.level, shared)
    return 0.5 * grown * min(1.0, _independent_rows(motion, on_same_rows) / on_same_rows.rows) < chance_gain


def _chance_gain_std(motion: MotionStreams, fitted: Fitted, dvl_noise: float) -> float:
    """Return σ of the log-evidence difference of two candidates that sample different DVL noise."""
    dvl_share = min(dvl_noise / max(fitted.level**2, 1e-12), 1.0)  # of the residual variance
    # variance of (g + a)² - (g + b)² in units of the residual variance: g reference noise, a and b DVL noise
    variance_per_sample = 8.0 * dvl_share * (1.0 - dvl_share) + 4.0 * dvl_share**2
    samples = fitted.rows * fitted.axes
    independent_share = min(1.0, _independent_rows(motion, fitted) / fitted.rows)
    return 0.5 * math.sqrt(variance_per_sample * samples) * independent_share


def _gain(motion: MotionStreams, one: Fitted, other: Fitted) -> float:
    """Return the log-evidence gain of the second fit over the first, counting independent samples."""
    return 3.0 * _independent_rows(motion, other) * math.log(max(one.level, 1e-6) / max(other.level, 1e-6))


def _independent_rows(motion: MotionStreams, fitted: Fitted) -> float:
    """Return the number of independent references among the compared ones."""
    times = motion.reference_times
    return min(float(fitted.rows), float(times[-1] - times[0]) / INDEPENDENT_S)
