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

    def timed(self, motion: MotionStreams, fit: MotionFit, state: Array, rotation: Array, level: float) -> ClockChange:
        """Return this step with its time refined: the only matching gap in the stamps, else the time that fits best.

        state: (9,) state before the step. rotation (3, 3), level (m/s): fitted by `fit` with the step corrected.
        """
        if not self.leap:
            return self
        reach_s = _reach(fit.times)
        stamps_of_clock = stamps(motion).get(self.whose, motion.dvl.times)
        gaps = _gaps_near(stamps_of_clock, self.leap, self.at, reach_s)
        if self.leap > 0.0 and len(gaps) == 1:
            return replace(self, at=float(stamps_of_clock[gaps[0] : gaps[0] + 2].mean()))
        state_after = state.copy()
        state_after[[DELTA, RHO]] += self.leap * np.array(DIRECTIONS[self.whose or "dvl"])
        rows_before, costs_before = fit.costs(state, rotation, level)
        rows_after, costs_after = fit.costs(state_after, rotation, level)
        shared, in_before, in_after = np.intersect1d(rows_before, rows_after, return_indices=True)
        near = np.abs(fit.times[shared] - self.at) <= reach_s
        if not near.any():
            return self
        # a step after the first n references costs this sum over them, plus a constant
        cost_of_step_after = np.cumsum((costs_before[in_before] - costs_after[in_after])[near])
        seconds = float(fit.times[shared][near][int(np.argmin(cost_of_step_after))])
        # converted to DVL stamps, midway between those before and after a forward step
        return replace(self, at=seconds + (float(state[DELTA]) + max(0.5 * self.leap, 0.0)) * (self.whose == "dvl"))

    def corrections(self, epoch_ns: int) -> dict[str, float]:
        """Return the parameters that correct a change of the DVL clock. epoch_ns: stamp of time 0."""
        if self.whose != "dvl" or abs(self.drift) > MAX_DRIFT or abs(self.leap) > MAX_JUMP_S:
            return {}
        if self.drift:
            return {"dvl_clock_drift": round(self.drift, 7)}
        return {"dvl_time_jump": round(self.leap, 3), "dvl_time_jump_at": round(1e-9 * epoch_ns + self.at, 3)}

    def corrected(self, motion: MotionStreams) -> MotionStreams:
        """Return the motion with the change corrected."""
        if self.whose == "reference":
            times, kept = self._corrected_times(motion.reference_times)
            return replace(motion, reference_times=times, reference=motion.reference[kept])
        if self.whose == "imu":
            times, kept = self._corrected_times(motion.imu.times)
            imu = ImuColumns(times, motion.imu.orientation[kept], motion.imu.angular_velocity[kept])
            return replace(motion, imu=imu, turns=TurnRates.of(imu))
        times, kept = self._corrected_times(motion.dvl.times)
        return replace(motion, dvl=DvlColumns(times, motion.dvl.velocity[kept]))

    def _corrected_times(self, times: Array) -> tuple[Array, Mask]:
        """Return the corrected times that increase, and their mask (N,)."""
        true = times - self.drift * times - self.leap * (times >= self.at)
        is_increasing = np.diff(np.maximum.accumulate(true), prepend=-np.inf) > 0.0
        return true[is_increasing], is_increasing


class _ChangePattern(NamedTuple):
    """Hypothesis of a drift, or of a step at `at` (s; None for a drift).

    delays: (S,) delay of each stretch per unit of the change. is_fixed: (S,) False for a stretch with a free delay.
    """

    delays: Array
    is_fixed: Mask
    at: float | None

    def is_possible(self, value: float, stamps: Array | None, reach: float) -> bool:
        """Return whether stamps (N,) s allow a step of value (s); a forward step needs a gap. None: unknown stamps."""
        if self.at is None or value <= 0.0 or stamps is None:
            return True
        return bool(len(_gaps_near(stamps, value, self.at, reach)))


def stamps(motion: MotionStreams) -> Mapping[str, Array]:
    """Return the times (N,) s of each stream, by the keys of `DIRECTIONS`."""
    return {"dvl": motion.dvl.times, "reference": motion.reference_times, "imu": motion.imu.times}


def _reach(times: Array) -> float:
    """Return the uncertainty (s) of the time of a step within times (N,)."""
    return float(np.ptp(times)) / MAX_STRETCHES + STRETCH_S


def _gaps_near(times: Array, jump: float, at: float, reach: float) -> Index:
    """Return indices of times (N,) before gaps of the size of a step (s), within reach of it."""
    gap = np.diff(times)
    return np.flatnonzero((gap > MIN_GAP_SHARE * jump) & (np.abs(times[1:] - at) < reach + gap))


def unsteady(
    times: Array, stretches: Sequence[Fitted], is_turned: bool, streams: Mapping[str, Array] = NO_STREAMS
) -> ClockChange | None:
    """Return the significant change of one clock over stretches at times (S,) s, else None.

    streams: stamps (N,) s by the keys of `DIRECTIONS`; a clock whose stamps have no gap has no forward step.
    """
    if len(times) < 2 * STRETCHES_A_SIDE:
        return None
    # a delay without acceleration looks like a lever arm, which is the same in all stretches
    indices = [*range(N)[ARM], DELTA, RHO]
    states = np.array([stretch.x[indices] for stretch in stretches])
    lag_covariance = np.diag([0.0] * 3 + [LAGS_S**2] * 2)
    # a stretch has few time blocks, so the autocorrelation of its residuals estimates lasting noise
    noise_factors = [np.maximum(stretch.inflation / stretch.raised[indices], 1.0) for stretch in stretches]
    covariances = np.array([stretch.p[np.ix_(indices, indices)] for stretch in stretches])
    covariances *= np.array([np.outer(factor, factor) for factor in noise_factors])
    weights = np.linalg.inv(covariances + lag_covariance)
    names = DIRECTIONS if is_turned else {"dvl": DIRECTIONS["dvl"]}
    n, everywhere = np.arange(len(times)), np.ones(len(times), dtype=bool)
    no_change = np.zeros((len(times), len(indices)))
    chi2_unchanged = _fit_change(states, weights, no_change, everywhere).chi2
    chi2_without_one = [_fit_change(states, weights, no_change, n != left_out).chi2 for left_out in n]
    hypotheses = []
    for pattern in (_ChangePattern(times, everywhere, None), *_step_patterns(times)):
        for name, direction in names.items():
            change = np.outer(pattern.delays, (0.0, 0.0, 0.0, *direction))
            fit = _fit_change(states, weights, change, pattern.is_fixed)
            if not pattern.is_fixed.all():
                fit = fit._replace(chi2=fit.chi2 + FREE_DELAY_CHI2)
            if pattern.is_possible(fit.value, streams.get(name) if is_turned else None, _reach(times)):
                hypotheses.append(_ClockHypothesis(name, pattern, fit))
    best = min(hypotheses, key=lambda hypothesis: hypothesis.fit.chi2)
    chi2, value, at = best.fit.chi2, best.fit.value, best.pattern.at
    length = float(np.ptp(times)) if at is None else 1.0
    # noise as long as a stretch adds scatter, so all evidence is scaled down
    scatter = max(1.0, chi2 / (states.size - len(indices) - 1.0))
    std = best.fit.std * math.sqrt(scatter)
    is_large = abs(value) * length > REPORTED_FROM_S and abs(value) > Z_SLOW_ERRORS * std
    is_significant = is_large and chi2_unchanged - chi2 > MIN_CHI2_GAIN * scatter
    is_one_bad_stretch = chi2 > min(chi2_without_one) + FREE_DELAY_CHI2 * scatter
    if not is_significant or is_one_bad_stretch or scatter > MAX_CHI2_LEFT:
        return None
    chi2_other_clocks = min((other.fit.chi2 for other in hypotheses if other.clock != best.clock), default=np.inf)
    whose = best.clock if is_turned and chi2_other_clocks - chi2 > RULED_OUT * scatter else ""
    return ClockChange(whose, value, std=std) if at is None else ClockChange(whose, leap=value, at=at, std=std)


def _step_patterns(times: Array) -> Iterator[_ChangePattern]:
    """Yield steps between two stretches, and within one."""
    n = np.arange(len(times))
    for at in range(STRETCHES_A_SIDE, len(times) - STRETCHES_A_SIDE + 1):
        yield _ChangePattern((n >= at).astype(float), n >= 0, float(times[at - 1 : at + 1].mean()))
        if at < len(times) - STRETCHES_A_SIDE:
            yield _ChangePattern((n > at).astype(float), n != at, float(times[at]))


class _ChangeFit(NamedTuple):
    """Residual chi-square of a fit, and size of the change with its σ: a drift, s/s, or a step, s."""

    chi2: float
    value: float
    std: float


class _ClockHypothesis(NamedTuple):
    """Change of one clock (key of `DIRECTIONS`) with one pattern, fitted."""

    clock: str
    pattern: _ChangePattern
    fit: _ChangeFit


def _fit_change(states: Array, weights: Array, change: Array, used: Mask) -> _ChangeFit:
    """Fit a common state (k,) plus `change` (S, k) · value to the states (S, k) of the `used` (S,) stretches.

    weights: (S, k, k) inverse covariances. change: per unit of the value. Without a change among them: value 0, σ inf.
    """
    k = states.shape[1]  # unknowns: the common state (k), then the value
    design = np.concatenate([np.broadcast_to(np.eye(k), (len(states), k, k)), change[:, :, None]], axis=2)[used]
    observed, used_weights = states[used], weights[used]
    information = np.einsum("sij,sik,skl->jl", design, used_weights, design)
    is_observable = bool(information[k, k] > 0.0)
    n_unknowns = k + is_observable
    p = np.linalg.inv(information[:n_unknowns, :n_unknowns])
    estimate = p @ np.einsum("sij,sik,sk->j", design, used_weights, observed)[:n_unknowns]
    residual = observed - design[:, :, :n_unknowns] @ estimate
    chi_square = float(np.einsum("si,sij,sj->", residual, used_weights, residual))
    if not is_observable:
        return _ChangeFit(chi_square, 0.0, np.inf)
    return _ChangeFit(chi_square, float(estimate[k]), float(np.sqrt(p[k, k])))
