"""Least-squares registration: both delays, rotation, lever arm and scale from one start, with robust weights.

With s the stamp of a reference sample, ρ and τ the delays of reference and DVL and δ = τ - ρ, the residual is

    B(s - ρ) + ω(s - ρ) × l - (1 + k) C v(s + δ),   B(s - ρ) = R(s - ρ)ᵀ g(s).

It is linearised about the last round: δ by the slope of v, ρ by ω × B, because another attitude rotates the reference.

Shapes: J compared references, A measured axes, 9 states. References are the last axis: operations on whole rows are
several times faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from ..numerics.block_covariance import TimeBlocks
from ..numerics.frames import (
    Array,
    cross_columns,
    nearest_rotation,
    rotation_from_quaternion,
    rotation_of,
    squared,
    turn_between,
    turned_back,
    turned_skew,
)
from ..numerics.robust import FEWEST_SAMPLES, MEDIAN_SQUARE, median
from ..numerics.samples import Index, Mask
from ..numerics.tests import chi2_isf
from ..streams.interpolation import GAP_S, quaternion_at
from .motion_streams import Curves, MotionStreams

# States: rotation (rad, body), scale, lever arm (m), delays δ and ρ (s).
TURN, SCALE, ARM, DELTA, RHO = slice(0, 3), 3, slice(4, 7), 7, 8
N = 9
# Rows whose product with the state is the delay of DVL or reference,
DVL: Array = np.array([0.0] * 7 + [1.0, 1.0])
REFERENCE: Array = np.array([0.0] * 8 + [1.0])
# or the DVL delay relative to the reference; zero if only the IMU is delayed.
BOTH_ALIKE: Array = np.array([0.0] * 7 + [1.0, 0.0])
# σ of the constraint on a synchronised clock, s.
HELD_STD_S = 1e-4
# Prior σ of the states; it decides what the motion does not: at one speed a delay looks like a lever arm.
PRIOR_STD: Array = np.array([0.1] * 3 + [0.03] + [1.0] * 3 + [30.0, 30.0])
# Most references in a full and in a quick fit, evenly spread.
FULL_ROWS, QUICK_ROWS = 4000, 800
# Most rounds, and the largest step (s, m, rad) of a converged fit.
ROUNDS, CONVERGED_STEP = 12, 5e-4
# Largest delay step per round, s: the slopes are valid this far.
MAX_DELAY_STEP_S = 0.7
# Round from which a fit is given up if its residual exceeds `most` and this share of the last one.
FAILED_AFTER, MAX_LEVEL_RATIO = 3, 0.9
# Residual in σ at which a sample has half the weight.
HALF_WEIGHT_Z = 3.0
# Lowest compared reference speed, m/s.
MIN_SPEED_MPS = 0.1
# Prior σ of an axis factor about 1, for factors that are not observable.
FACTOR_STD = 3.0
# Largest share of the information on δ that is attributed to DVL noise.
MAX_NOISE_SHARE = 0.95
# Time blocks that σ is estimated from, and the threshold for correlated noise instead of `LASTING_Z`: high, so that the
# residual of a clock change does not count as noise.
BLOCKS, CLOCK_LASTING_Z = 48, 2.5


class Claimed(NamedTuple):
    """Covariance of the states with σ from the scatter of time blocks.

    p: (9, 9).
    raised: (9,) factor of each σ over white noise.
    inflation: factor of the clocks' σ over white noise, by time blocks and by the autocorrelation of the residuals.
    """

    p: Array
    inflation: float
    raised: Array


class Fitted(NamedTuple):
    """State of a fit.

    x (9,); rotation_body_from_dvl (3, 3).
    squares: (J,) squared residual of each reference, (m/s)².
    level: robust residual per axis, m/s, of `rows` references.
    speed: RMS of the compared references, m/s.
    at: (J,) indices of these references.
    claims: covariance, computed on demand because it takes as long as three rounds.
    """

    x: Array
    rotation_body_from_dvl: Array
    level: float
    rows: int
    speed: float
    squares: Array
    axes: int
    at: Index
    claims: Callable[[], Claimed]

    @property
    def p(self) -> Array:
        """Covariance (9, 9), see `Claimed.p`."""
        return self.claims().p

    @property
    def inflation(self) -> float:
        """σ factor of the clocks, see `Claimed.inflation`."""
        return self.claims().inflation

    @property
    def raised(self) -> Array:
        """σ factors (9,), see `Claimed.raised`."""
        return self.claims().raised

    def cost(self, level: float, among: Index) -> float:
        """Return the robust chi-square of these references at a noise level (m/s)."""
        return float(_robust(self.squares[np.searchsorted(self.at, among)], self.axes, level).sum())

    @property
    def residual(self) -> float:
        """Residual as a share of the speed."""
        return self.level * math.sqrt(3.0) / max(self.speed, 1e-9)

    @property
    def std(self) -> Array:
        """σ (9,) of the states."""
        return np.sqrt(np.maximum(np.diag(self.p), 0.0))

    def by(self, state: int) -> Array:
        """Return derivatives (9,) of all states with respect to one, from the white-noise covariance."""
        of_white = self.p[:, state] / self.raised
        return np.asarray(of_white / of_white[state])

    @property
    def dvl_delay_s(self) -> float:
        """DVL delay τ, s."""
        return float(self.x[DELTA] + self.x[RHO])

    @property
    def dvl_std(self) -> float:
        """σ of the DVL delay τ, s."""
        return float(np.sqrt(max(self.p[[DELTA, DELTA, RHO, RHO], [DELTA, RHO, DELTA, RHO]].sum(), 0.0)))


class AxisFactors(NamedTuple):
    """Scale factors (3,) of the DVL's axes relative to the fit, and their σ (3,); 1 is right.

    level: residual with the factors, m/s per axis.
    """

    factors: Array
    std: Array
    level: float


class _AtDelays(NamedTuple):
    """Streams at the times of the J compared references, for delays ρ and δ.

    at: (J,) their indices.
    body: (3, J) m/s, B.
    rates: (3, J) rad/s, ω.
    velocity: (3, J) m/s, v, DVL frame, with its slope (3, J) m/s² and the slope's noise gain (J,).
    attitude: (J, 4) quaternions of the body; None for a reference in the body.
    """

    at: Index
    body: Array
    rates: Array
    velocity: Array
    slope: Array
    slope_noise_gain: Array
    attitude: Array | None


class _Rows(NamedTuple):
    """Residuals linearised about a state, along the A measured axes.

    residual: (A, J) m/s.
    jacobian: (9, A, J) by the states.
    at: (J,) indices of the references.
    delay_noise: (J,) (m/s²)², expected squares of the δ column by DVL noise alone.
    speed: RMS, m/s.
    """

    residual: Array
    jacobian: Array
    at: Index
    delay_noise: Array
    speed: float


class _Step(NamedTuple):
    """Gauss-Newton step (9,) of the states and its information (9, 9).

    level: robust residual per axis, m/s. weight: (J,) robust weights.
    """

    step: Array
    information: Array
    level: float
    weight: Array


class MotionFit:
    """Least squares of one motion.

    is_turned: an attitude rotates the reference.
    times: (J,) s of the used references.
    speed: their RMS, m/s.
    dvl_noise: variance of the DVL's white noise, (m/s)².
    """

    def __init__(self, motion: MotionStreams, lever_arm: Array, curves: Curves, most: int = FULL_ROWS) -> None:
        """Prepare a fit. lever_arm: (3,) m configured. curves: smoothed motion. most: most references used."""
        self._motion, self._lever_arm, self._curves = motion, lever_arm, curves
        self.is_turned = motion.in_earth and motion.has_attitude
        self._measured = np.array(motion.measured)
        m = motion
        moving = np.flatnonzero(squared(m.reference) >= MIN_SPEED_MPS**2)
        if len(moving) > most:
            moving = moving[np.linspace(0, len(moving) - 1, most).astype(int)]
        self.times, self._velocity = m.reference_times[moving], m.reference[moving].T.copy()
        self.speed = math.sqrt(float((self._velocity**2).sum()) / max(len(moving), 1))
        # at slow changes, the slope of the velocity is mostly its noise
        self.dvl_noise = float(white_noise(m.dvl.velocity))

    def __call__(
        self,
        rho: float,
        delta: float,
        rotation_body_from_dvl: Array | None,
        in_time: Sequence[Array] = (),
        among: Fitted | None = None,
        most: float = math.inf,
    ) -> Fitted | None:
        """Fit from initial delays ρ and δ (s). Return None if too little overlaps or it is given up.

        Parameters
        ----------
        rho, delta: Initial ρ and δ, s.
        rotation_body_from_dvl: (3, 3) prior mounting; None to estimate it.
        in_time: Rows of synchronised clocks (`DVL`, `REFERENCE`, `BOTH_ALIKE`); REFERENCE is added without an attitude.
        among: Another fit, to compare only its references, DVL samples and attitudes.
        most: Residual per axis (m/s) above which a fit that hardly improves is given up.
        """
        rotation = self._best_rotation(rho, delta) if rotation_body_from_dvl is None else rotation_body_from_dvl
        if rotation is None:
            return None
        x = np.zeros(N)
        x[DELTA], x[RHO] = delta, rho
        nominal = rotation
        if not self.is_turned:
            in_time = (*in_time, REFERENCE)
        previous_level = math.inf
        for round_number in range(ROUNDS):
            rows = self._rows(x, rotation, among)
            if rows is None:
                return None
            solved = self._solved(x, rows, nominal, rotation, in_time)
            if round_number >= FAILED_AFTER and solved.level > max(most, MAX_LEVEL_RATIO * previous_level):
                return None
            previous_level = solved.level
            delay_step = float(np.abs(solved.step[[DELTA, RHO]]).max())
            step = solved.step * min(1.0, MAX_DELAY_STEP_S / max(delay_step, 1e-9))
            x = x + step
            rotation = rotation_of(step[TURN]) @ rotation
            x[TURN] = 0.0
            if delay_step < CONVERGED_STEP and float(np.abs(step).max()) < CONVERGED_STEP:
                break
        rows = self._rows(x, rotation, among)
        if rows is None:
            return None
        last = self._solved(x, rows, nominal, rotation, in_time)
        return Fitted(
            x, rotation, level=last.level, rows=len(rows.at), speed=rows.speed, squares=squared(rows.residual.T),
            axes=len(rows.residual), at=rows.at, claims=cache(partial(_claimed, rows, last)),
        )  # fmt: skip

    def costs(self, x: Array, rotation: Array, level: float) -> tuple[Index, Array]:
        """Return compared references (J,) at a state, and the robust chi-square (J,) of each (`Fitted.cost`)."""
        rows = self._rows(x, rotation, None)
        if rows is None:
            return np.zeros(0, dtype=np.intp), np.zeros(0)
        return rows.at, _robust(squared(rows.residual.T), len(rows.residual), level)

    def axis_factors(self, fitted: Fitted, nominal: Array) -> AxisFactors:
        """Estimate the scale factor of each DVL axis by least squares about a fit.

        Rotation, lever arm and DVL delay are nuisance parameters. A factor of -1 is a reversed axis. DVL noise lowers a
        factor, but never below zero.

        Parameters
        ----------
        fitted: Fit with its robust weights.
        nominal: (3, 3) rotation_body_from_dvl of the prior.
        """
        rows, rotation = self._rows(fitted.x, fitted.rotation_body_from_dvl, None), fitted.rotation_body_from_dvl
        if rows is None:
            return AxisFactors(np.ones(3), np.full(3, np.inf), fitted.level)
        axes = len(rows.residual)
        weight = 1.0 / (1.0 + squared(rows.residual.T) / (HALF_WEIGHT_Z**2 * axes * fitted.level**2))
        nuisance = [*range(N)[TURN], *range(N)[ARM], DELTA]
        design = np.concatenate([self._axis_columns(fitted), rows.jacobian[nuisance]]).reshape(3 + len(nuisance), -1)
        weights = np.tile(weight, axes) / fitted.level**2
        from_prior = fitted.x.copy()
        from_prior[TURN], from_prior[DELTA] = turn_between(nominal, rotation), 0.0
        prior = np.concatenate([np.full(3, FACTOR_STD**-2.0), PRIOR_STD[nuisance] ** -2.0])
        weighted = design * weights
        information = weighted @ design.T + np.diag(prior)
        gradient = -(weighted @ rows.residual.ravel()) - prior * np.concatenate([np.zeros(3), from_prior[nuisance]])
        errors = np.linalg.solve(information, gradient)
        residual = rows.residual.ravel() + errors @ design
        # residuals that the factors explain are no noise
        share = float((weights * residual**2).sum() / max((weights * rows.residual.ravel() ** 2).sum(), 1e-30))
        std = np.sqrt(np.diag(np.linalg.inv(information)) * share)[:3] * fitted.inflation
        return AxisFactors(1.0 + errors[:3], std, fitted.level * math.sqrt(share))

    def _axis_columns(self, fitted: Fitted) -> Array:
        """Return the derivative (3, A, J) m/s of the residuals by the factors of the DVL's axes, see `AxisFactors`."""
        compared = self._interpolated(float(fitted.x[RHO]), float(fitted.x[DELTA]))
        assert compared is not None
        # the velocity along each axis of the DVL, in the direction of that axis in the body
        in_body = compared.velocity[:, None] * (-(1.0 + fitted.x[SCALE]) * fitted.rotation_body_from_dvl.T)[:, :, None]
        return self._measured_part(in_body, compared)

    def _measured_part(self, in_body: Array, compared: _AtDelays) -> Array:
        """Return vectors (..., 3, J) in the A measured axes: of the body if all, else of the reference's frame."""
        if self._measured.all():
            return in_body
        if compared.attitude is None:
            return np.asarray(in_body[..., self._measured, :])
        rotation = rotation_from_quaternion(compared.attitude)[:, self._measured].transpose(1, 2, 0).copy()
        return np.einsum("ijn,...jn->...in", rotation, in_body)

    def _interpolated(self, rho: float, delta: float, among: Fitted | None = None) -> _AtDelays | None:
        """Return the streams at delays ρ and δ (s), or None for too few references. among: see `__call__`."""
        m = self._motion
        body_at = self.times - rho
        if m.in_earth and not m.has_attitude:
            return None
        dvl = self._curves.velocity(self.times + delta)
        known, attitude = dvl.found, None
        if m.in_earth:
            attitude, oriented = quaternion_at(m.imu, body_at, GAP_S)
            known = known & oriented
        if among is not None:
            known = known & self._shared(among, rho, delta)
        rows = np.flatnonzero(known)
        if len(rows) < FEWEST_SAMPLES:
            return None
        # views, without copies, of rows that follow each other
        at = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] < len(rows) else rows
        body, rates = self._velocity[:, at], self._curves.rates(body_at[at])
        if attitude is not None:
            attitude = attitude[at]
            body = turned_back(attitude, body)
        return _AtDelays(rows, body, rates, dvl.value[at].T, dvl.slope[at].T, dvl.slope_gain[at], attitude)

    def _shared(self, other: Fitted, rho: float, delta: float) -> Mask:
        """Return which of the used references (J,) share DVL samples and attitudes with another fit."""
        other_times, shared = self.times[other.at], np.zeros(len(self.times), dtype=bool)
        shared[other.at] = True
        for delay, other_delay in ((delta, float(other.x[DELTA])), (-rho, -float(other.x[RHO]))):
            shifted = self.times + delay
            shared &= (shifted >= other_times[0] + other_delay) & (shifted <= other_times[-1] + other_delay)
        return shared

    def _best_rotation(self, rho: float, delta: float) -> Array | None:
        """Return the least-squares rotation C (3, 3) at delays ρ and δ (s), without lever arm."""
        compared = self._interpolated(rho, delta)
        if compared is None:
            return None
        square = float((compared.velocity**2).sum())
        return nearest_rotation(compared.body @ compared.velocity.T + 1e-3 * square * np.eye(3))

    def _rows(self, x: Array, rotation: Array, among: Fitted | None) -> _Rows | None:
        """Linearise the residuals about a state, in the measured axes; None if too few overlap."""
        compared = self._interpolated(float(x[RHO]), float(x[DELTA]), among)
        if compared is None:
            return None
        body, rates = compared.body, compared.rates
        through = (1.0 + x[SCALE]) * rotation
        dvl_in_body = through @ compared.velocity
        jacobian: Array = np.empty((N, 3, len(compared.at)))
        jacobian[TURN] = turned_skew(-np.eye(3), dvl_in_body)  # the transpose of skew(a) is -skew(a)
        jacobian[SCALE] = -rotation @ compared.velocity
        jacobian[ARM] = turned_skew(-np.eye(3), rates)
        jacobian[DELTA] = -through @ compared.slope
        jacobian[RHO] = cross_columns(rates, body)
        residual = body + cross_columns(rates, self._lever_arm + x[ARM]) - dvl_in_body
        residual, jacobian = (self._measured_part(vectors, compared) for vectors in (residual, jacobian))
        delay_noise = compared.slope_noise_gain * self.dvl_noise * len(residual)
        speed = float(np.sqrt(squared(body.T).mean()))
        return _Rows(residual, jacobian, compared.at, delay_noise, speed)

    def _solved(self, x: Array, rows: _Rows, nominal: Array, rotation: Array, in_time: Sequence[Array]) -> _Step:
        """Solve one Gauss-Newton step with priors, robust weights and the constraints of synchronised clocks.

        nominal, rotation: (3, 3) rotation_body_from_dvl of the prior and of the state. in_time: see `__call__`.
        """
        axes = len(rows.residual)
        squares = squared(rows.residual.T)
        variance = max(float(median(squares)) / chi2_isf(0.5, axes), 1e-8)
        weight = 1.0 / (1.0 + squares / (HALF_WEIGHT_Z**2 * axes * variance))
        prior = PRIOR_STD**-2.0
        weighted = (rows.jacobian * (weight / variance)).reshape(N, -1)
        information = weighted @ rows.jacobian.reshape(N, -1).T + np.diag(prior)
        # DVL noise in the slope counts as information on δ: subtract it, but less than the marginal information on δ
        marginal = 1.0 / float(np.linalg.inv(information)[DELTA, DELTA])
        information[DELTA, DELTA] -= min(float(weight @ rows.delay_noise) / variance, MAX_NOISE_SHARE * marginal)
        from_prior = x.copy()
        from_prior[TURN] = turn_between(nominal, rotation)
        from_prior[[DELTA, RHO]] = 0.0
        gradient = -(weighted @ rows.residual.ravel()) - prior * from_prior
        for constraint in in_time:
            information += HELD_STD_S**-2.0 * np.outer(constraint, constraint)
            gradient -= HELD_STD_S**-2.0 * constraint * float(constraint @ x)
        return _Step(np.linalg.solve(information, gradient), information, float(np.sqrt(variance)), weight)


def _claimed(rows: _Rows, solved: _Step) -> Claimed:
    """Return covariance and σ factors of a solution, inflated for residuals that are correlated in time."""
    p = np.linalg.inv(solved.information)
    blocks = TimeBlocks()
    weighted, n_parts = rows.jacobian * (solved.weight / solved.level**2), min(BLOCKS, max(1, len(rows.at) // 10))
    columns = (np.array_split(values, n_parts, axis=-1) for values in (rows.jacobian, weighted, rows.residual))
    for h, w, residual in zip(*columns, strict=True):
        h, w = h.reshape(N, -1), w.reshape(N, -1)
        blocks.add((w @ h.T)[None], -(w @ residual.ravel())[None], float(h.shape[1]))
    factor = blocks.inflation(0, np.zeros(N), p, CLOCK_LASTING_Z, None)
    inflation = max(float(factor[[DELTA, RHO]].max()), _correlation_inflation(rows.residual))
    return Claimed(p * np.outer(factor, factor), inflation, factor)


def _robust(squares: Array, axes: int, level: float) -> Array:
    """Return squares (J,) (m/s)² over `axes` axes as chi-square at a noise level (m/s), logarithmic for outliers."""
    scale = HALF_WEIGHT_Z**2 * axes
    return np.asarray(scale * np.log1p(squares / (scale * level**2)))


def white_noise(velocity: Array) -> float:
    """Return the white-noise variance (m/s)² of a stream (N, 3) from its second differences."""
    if len(velocity) < 3:
        return 0.0
    bent = median(np.diff(velocity, 2, axis=0) ** 2) / (6.0 * MEDIAN_SQUARE)
    return float(bent.mean())


def _correlation_inflation(residual: Array) -> float:
    """Return the σ factor of the mean of residuals (A, J) over white noise, by their autocorrelation."""
    n = residual.shape[1]
    size = 1 << (2 * n - 1).bit_length()
    power = (np.abs(np.fft.rfft(residual, size)) ** 2).sum(axis=0)
    autocorrelation = np.fft.irfft(power, size)[: max(2, n // 8)]
    autocorrelation = autocorrelation / max(float(autocorrelation[0]), 1e-30)
    # up to where the autocorrelation is insignificant
    end = int(np.argmax(autocorrelation < 2.0 / np.sqrt(n))) or len(autocorrelation)
    return float(np.sqrt(1.0 + 2.0 * autocorrelation[1:end].sum()))
