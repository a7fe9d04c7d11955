"""About a place of the clocks: both clocks, rotation, lever arm and scale together, by robust least squares.

With s the stamp of a reference sample, ρ and τ the delays of reference and DVL and δ = τ - ρ, what is compared is

    B(s - ρ) + ω(s - ρ) × l - (1 + k) C v(s + δ),   B(s - ρ) = R(s - ρ)ᵀ g(s)

in which C, k and l are linear about the last round, and so is δ by the slope of v and ρ by ω × B: where the reference
is turned into the body by an attitude of another time, its velocity turns as the vehicle does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from ..numerics.block_covariance import TimeBlocks
from ..numerics.frames import Array, cross, nearest_rotation, rotation_of, skew, squared, turn_between
from ..numerics.robust import median
from ..numerics.samples import Index, Mask
from ..streams.interpolation import attitude_at
from .motion_streams import GAP_S, Curves, MotionStreams

# States: turn (rad, body), scale, lever arm (m), δ (s), ρ (s).
TURN, SCALE, ARM, APART, LATE = slice(0, 3), 3, slice(4, 7), 7, 8
N = 9
# Whose product with the states is how late a clock is.
DVL: Array = np.array([0.0] * 7 + [1.0, 1.0])
REFERENCE: Array = np.array([0.0] * 8 + [1.0])
# ... and by how much the DVL's is later than the reference's: where it is none, it is the IMU's that is off.
BOTH_ALIKE: Array = np.array([0.0] * 7 + [1.0, 0.0])
# A clock that is in time is so to this, s.
HELD_STD_S = 1e-4
# What is likely of each. A lever arm decides what the motion does not: at one speed a clock looks like one.
LIKELY: Array = np.array([0.1] * 3 + [0.03] + [1.0] * 3 + [30.0, 30.0])
# References that are looked at, evenly spread: more tell little more, and take longer; fewer tell places apart.
MOST_ROWS, FEW_ROWS = 4000, 800
# Rounds at most, and the step (s, m, rad) from which on another one changes nothing.
ROUNDS, SETTLED_S = 12, 5e-4
# A delay moves no further in one round, s: slopes hold that far.
FARTHEST_S = 0.7
# After so many rounds, what leaves so many times the most that is of use, and hardly less than the round before, is
# given up.
ROUNDS_TO_FALL, FAR_ABOVE, HARDLY_LESS = 3, 2.0, 0.9
# Samples so many times further off than usual count by half.
HALF_AT = 3.0
# Slower, nothing is compared, m/s. Fewer rows tell nothing.
SLOW_MPS, ENOUGH = 0.1, 20
# A factor of an axis is within this of 1 (1 σ): ill-conditioned ones stay near it.
WIDEST_FACTOR = 3.0
# No more of what is known of δ is taken for noise.
MOST_OF_NOISE = 0.95
# Blocks of time by whose scatter σ is found. That noise lasts has to be beyond doubt (`time_blocks.LASTS`): where it is
# taken for what a clock that moves leaves, none is found.
BLOCKS, LASTS_BEYOND_DOUBT = 48, 2.5
# Median of chi-square of 1, 2, 3 degrees of freedom.
_MEDIAN_CHI2 = (0.455, 1.386, 2.366)
_Compared = tuple[Index, tuple[Array, ...]]


class Claimed(NamedTuple):
    """Covariance p (9, 9) of the states, σ of it as blocks of time show. raised: (9,) by how much σ of each was, above
    that of white noise. inflation: by how much σ of the clocks is more than white noise makes it, by blocks of time and
    by how long what is left lasts."""

    p: Array
    inflation: float
    raised: Array


class Fitted(NamedTuple):
    """x (9,); rotation_body_from_dvl (3, 3).

    squares (J,) (m/s)²: of what is left of each reference. level: m/s per axis, robust, of what is left of `rows`
    references. speed: RMS of what was compared, m/s. at: (J,) which references these are, of those that are looked at.
    claims: how well x is known, which is asked of few: it takes as long as three rounds.
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
        """As `Claimed.p`."""
        return self.claims().p

    @property
    def inflation(self) -> float:
        """As `Claimed.inflation`."""
        return self.claims().inflation

    @property
    def raised(self) -> Array:
        """As `Claimed.raised`."""
        return self.claims().raised

    def cost(self, level: float, among: Index) -> float:
        """What is left of these references, in chi-square by a level of noise (m/s), robust."""
        return float(_robust(self.squares[np.searchsorted(self.at, among)], self.axes, level).sum())

    @property
    def left(self) -> float:
        """What is not explained, as a share of the speed."""
        return self.level * math.sqrt(3.0) / max(self.speed, 1e-9)

    @property
    def std(self) -> Array:
        """(9,)."""
        return np.sqrt(np.maximum(np.diag(self.p), 0.0))

    def by(self, state: int) -> Array:
        """(9,) by how much all are others for each unit of one: as the motion has it, whatever the noise is."""
        of_white = self.p[:, state] / self.raised
        return np.asarray(of_white / of_white[state])

    @property
    def dvl_late(self) -> float:
        """τ, s."""
        return float(self.x[APART] + self.x[LATE])

    @property
    def dvl_std(self) -> float:
        """σ of τ, s."""
        return float(np.sqrt(max(self.p[[APART, APART, LATE, LATE], [APART, LATE, APART, LATE]].sum(), 0.0)))


class AxisFactors(NamedTuple):
    """factors, std: (3,) of the DVL's axes; 1 is right, with the scale of the fit."""

    factors: Array
    std: Array


class _Rows(NamedTuple):
    """residual (J, A), jacobian (J, A, 9) of it, of references `at` (J,); of_noise (J,): how much of the square of the
    column of δ is expected of noise alone; speed: RMS, m/s."""

    residual: Array
    jacobian: Array
    at: Index
    of_noise: Array
    speed: float


class MotionFit:
    """Least squares of one motion from one place of the clocks. is_turned: whether an attitude turns the reference.

    times: (J,) s of the references that are looked at; speed: their RMS, m/s. dvl_noise: variance of the DVL's white
    noise, (m/s)².
    """

    def __init__(self, motion: MotionStreams, lever_arm: Array, curves: Curves, most: int = MOST_ROWS) -> None:
        """lever_arm: (3,) m, that is known. curves: of the motion. most: references that are looked at."""
        self._motion, self._lever_arm, self._curves = motion, lever_arm, curves
        self.is_turned = motion.in_earth and motion.has_attitude
        m = motion
        moving = np.flatnonzero(squared(m.reference) >= SLOW_MPS**2)
        if len(moving) > most:
            moving = moving[np.linspace(0, len(moving) - 1, most).astype(int)]
        self.times, self._velocity = m.reference_times[moving], m.reference[moving]
        self.speed = math.sqrt(float((self._velocity**2).sum()) / max(len(moving), 1))
        # where hardly anything changes, what seems to is its noise
        self.dvl_noise = float(white_noise(m.dvl.velocity))

    def __call__(
        self,
        reference: float,
        apart: float,
        rotation_body_from_dvl: Array | None,
        in_time: Sequence[Array] = (),
        among: Fitted | None = None,
        most: float = math.inf,
    ) -> Fitted | None:
        """From ρ and δ (s) on; None where too little can be compared, or more is left than the most (m/s) of use.

        rotation_body_from_dvl: (3, 3), about which turns are likely; None to find it. in_time: clocks that are in time,
        `DVL` and `REFERENCE`, or `BOTH_ALIKE`; without an attitude that turns it, the reference's is.
        among: another place that is weighed against this one: of its references, DVL and attitudes alone.
        """
        rotation = self._best_rotation(reference, apart) if rotation_body_from_dvl is None else rotation_body_from_dvl
        if rotation is None:
            return None
        x = np.zeros(N)
        x[APART], x[LATE] = apart, reference
        nominal = rotation
        solved = None
        if not self.is_turned:
            in_time = (*in_time, REFERENCE)
        left = math.inf
        for number in range(ROUNDS):
            rows = self._rows(x, rotation, among)
            if rows is None:
                return None
            solved = self._solved(x, rows, nominal, rotation, in_time)
            step, _, level, _ = solved
            if number >= ROUNDS_TO_FALL and level > max(FAR_ABOVE * most, HARDLY_LESS * left):
                return None
            left = level
            far = float(np.abs(step[[APART, LATE]]).max())
            step = step * min(1.0, FARTHEST_S / max(far, 1e-9))
            x = x + step
            rotation = rotation_of(step[TURN]) @ rotation
            x[TURN] = 0.0
            if far < SETTLED_S and float(np.abs(step).max()) < SETTLED_S:
                break
        rows = self._rows(x, rotation, among)
        if rows is None or solved is None:
            return None
        _, information, level, weight = self._solved(x, rows, nominal, rotation, in_time)
        squares, axes = squared(rows.residual), rows.residual.shape[1]
        claims = cache(partial(_claimed, rows, information, level, weight))
        return Fitted(x, rotation, level, len(rows.at), rows.speed, squares, axes, rows.at, claims)

    def costs(self, x: Array, rotation: Array, level: float) -> tuple[Index, Array]:
        """Which references (J,) are compared at a state, and what is left of each (J,), as in `Fitted.cost`."""
        rows = self._rows(x, rotation, None)
        if rows is None:
            return np.zeros(0, dtype=np.intp), np.zeros(0)
        return rows.at, _robust(squared(rows.residual), rows.residual.shape[1], level)

    def axis_factors(self, fitted: Fitted, nominal: Array) -> AxisFactors:
        """Return by what factors the DVL's axes would fit better, and their standard deviations.

        By least squares about a fit, with turn, lever arm and the DVL's delay as nuisance parameters. A factor of -1 is
        an axis that points the other way. Noise of the DVL makes a factor smaller, never negative.

        Parameters
        ----------
        fitted: A fit, with its robust weights.
        nominal: rotation_body_from_dvl (3, 3), about which turns are likely.

        """
        rows, rotation = self._rows(fitted.x, fitted.rotation_body_from_dvl, None), fitted.rotation_body_from_dvl
        if rows is None:
            return AxisFactors(np.ones(3), np.full(3, np.inf))
        axes = rows.residual.shape[1]
        weight = 1.0 / (1.0 + squared(rows.residual) / (HALF_AT**2 * axes * fitted.level**2))
        own = self._axes_of_dvl(fitted, rows, rotation)
        kept = [*range(N)[TURN], *range(N)[ARM], APART]
        h = np.concatenate([own, rows.jacobian[:, :, kept]], axis=2).reshape(-1, 3 + len(kept))
        w = np.repeat(weight, axes) / fitted.level**2
        away = fitted.x.copy()
        away[TURN], away[APART] = turn_between(nominal, rotation), 0.0
        prior = np.concatenate([np.full(3, WIDEST_FACTOR**-2.0), LIKELY[kept] ** -2.0])
        information = (h * w[:, None]).T @ h + np.diag(prior)
        vector = -(h * w[:, None]).T @ rows.residual.ravel() - prior * np.concatenate([np.zeros(3), away[kept]])
        found = np.linalg.solve(information, vector)
        left = rows.residual.ravel() + h @ found
        # what the factors explain is no noise
        share = float((w * left**2).sum() / max((w * rows.residual.ravel() ** 2).sum(), 1e-30))
        std = np.sqrt(np.diag(np.linalg.inv(information)) * share)[:3] * fitted.inflation
        return AxisFactors(1.0 + found[:3], std)

    def _axes_of_dvl(self, fitted: Fitted, rows: _Rows, rotation: Array) -> Array:
        """What each axis of the DVL adds to the residuals, (J, A, 3) m/s."""
        streams = self._streams(float(fitted.x[LATE]), float(fitted.x[APART]))
        assert streams is not None
        _, (_, _, velocity, _, attitude, _) = streams
        own = -(1.0 + fitted.x[SCALE]) * velocity[:, None, :] * rotation
        measured = np.array(self._motion.measured)
        if measured.all():
            return np.asarray(own)
        return np.asarray((attitude @ own if self._motion.in_earth else own)[:, measured])

    def _streams(self, reference: float, apart: float, among: Fitted | None = None) -> _Compared | None:
        """Which references (J,), and B (J, 3), ω (J, 3), v (J, 3), slope of v (J, 3), R (J, 3, 3), noise gain of
        the slope (J,)."""
        m = self._motion
        own = self.times - reference
        if m.in_earth and not m.has_attitude:
            return None
        velocity, slope, gain, known = self._curves.velocity(self.times + apart)
        needed = m.in_earth or not all(m.measured)
        rotation, oriented = attitude_at(m.imu, own, GAP_S) if needed else (np.zeros((len(own), 3, 3)), known)
        if m.in_earth:
            known = known & oriented
        if among is not None:
            known = known & self._shared(among, reference, apart)
        if np.count_nonzero(known) < ENOUGH:
            return None
        at = np.flatnonzero(known)
        seen, rotation = self._velocity[at], rotation[at]
        body = np.einsum("nji,nj->ni", rotation, seen) if m.in_earth else seen
        return at, (body, self._curves.rates(own[at]), velocity[at], slope[at], rotation, gain[at])

    def _shared(self, other: Fitted, reference: float, apart: float) -> Mask:
        """Which references (J,) are compared at another place, with DVL and attitudes that are compared there."""
        there, shared = self.times[other.at], np.zeros(len(self.times), dtype=bool)
        shared[other.at] = True
        for here, elsewhere in ((apart, float(other.x[APART])), (-reference, -float(other.x[LATE]))):
            at = self.times + here
            shared &= (at >= there[0] + elsewhere) & (at <= there[-1] + elsewhere)
        return shared

    def _best_rotation(self, reference: float, apart: float) -> Array | None:
        """C (3, 3) that fits best without a lever arm, by singular values."""
        streams = self._streams(reference, apart)
        if streams is None:
            return None
        _, (body, _, velocity, *_) = streams
        square = float((velocity**2).sum())
        return nearest_rotation(body.T @ velocity + 1e-3 * square * np.eye(3))

    def _rows(self, x: Array, rotation: Array, among: Fitted | None) -> _Rows | None:
        streams = self._streams(float(x[LATE]), float(x[APART]), among)
        if streams is None:
            return None
        at, (body, rates, velocity, slope, attitude, gain) = streams
        own = (1.0 + x[SCALE]) * velocity @ rotation.T
        residual = body + cross(rates, self._lever_arm + x[ARM]) - own
        jacobian = np.zeros((len(at), 3, N))
        jacobian[:, :, TURN] = skew(own)
        jacobian[:, :, SCALE] = -velocity @ rotation.T
        jacobian[:, :, ARM] = skew(rates)
        jacobian[:, :, APART] = -(1.0 + x[SCALE]) * slope @ rotation.T
        jacobian[:, :, LATE] = cross(rates, body)
        measured = np.array(self._motion.measured)
        if not measured.all():
            if self._motion.in_earth:
                residual = np.einsum("nij,nj->ni", attitude, residual)
                jacobian = attitude @ jacobian
            residual, jacobian = residual[:, measured], jacobian[:, measured]
        speed = float(np.sqrt(squared(body).mean()))
        return _Rows(residual, jacobian, at, gain * self.dvl_noise * residual.shape[1], speed)

    def _solved(
        self, x: Array, rows: _Rows, nominal: Array, rotation: Array, in_time: Sequence[Array]
    ) -> tuple[Array, Array, float, Array]:
        """The step (9,), its information (9, 9), the level of noise (m/s), and the weight of each row (J,)."""
        axes = rows.residual.shape[1]
        squares = squared(rows.residual)
        level2 = max(float(median(squares)) / _MEDIAN_CHI2[axes - 1], 1e-8)
        weight = 1.0 / (1.0 + squares / (HALF_AT**2 * axes * level2))
        h = rows.jacobian.reshape(-1, N)
        w = np.repeat(weight, axes) / level2
        prior = LIKELY**-2.0
        weighted = (h * w[:, None]).T
        information = weighted @ h + np.diag(prior)
        # what is known of δ beside all else: more than that taken off, and it would be less than nothing
        told = 1.0 / float(np.linalg.inv(information)[APART, APART])
        information[APART, APART] -= min(float(weight @ rows.of_noise) / level2, MOST_OF_NOISE * told)
        away = x.copy()
        away[TURN] = turn_between(nominal, rotation)
        away[[APART, LATE]] = 0.0
        vector = -weighted @ rows.residual.ravel() - prior * away
        for row in in_time:
            information += HELD_STD_S**-2.0 * np.outer(row, row)
            vector -= HELD_STD_S**-2.0 * row * float(row @ x)
        return np.linalg.solve(information, vector), information, float(np.sqrt(level2)), weight


def _claimed(rows: _Rows, information: Array, level: float, weight: Array) -> Claimed:
    p = np.linalg.inv(information)
    blocks = TimeBlocks()
    for part in np.array_split(np.arange(len(rows.at)), min(BLOCKS, max(1, len(rows.at) // 10))):
        h = rows.jacobian[part].reshape(-1, N)
        w = np.repeat(weight[part], rows.residual.shape[1])[:, None] / level**2
        blocks.add(((h * w).T @ h)[None], (-(h * w).T @ rows.residual[part].ravel())[None], float(len(h)))
    factor = blocks.inflation(0, np.zeros(N), p, LASTS_BEYOND_DOUBT, None)
    inflation = max(float(factor[[APART, LATE]].max()), _lasting(rows.residual))
    return Claimed(p * np.outer(factor, factor), inflation, factor)


def _robust(squares: Array, axes: int, level: float) -> Array:
    """Squares (J,) (m/s)² of so many axes in chi-square by a level of noise (m/s), far ones by their logarithm."""
    scale = HALF_AT**2 * axes
    return np.asarray(scale * np.log1p(squares / (scale * level**2)))


def white_noise(velocity: Array) -> float:
    """Variance (m/s)² of white noise on a stream (N, 3), by its second differences."""
    if len(velocity) < 3:
        return 0.0
    bent = median(np.diff(velocity, 2, axis=0) ** 2) / (6.0 * _MEDIAN_CHI2[0])
    return float(bent.mean())


def _lasting(residual: Array) -> float:
    """By how much σ of a mean of residuals (J, A) is more than that of white ones, by their autocorrelation."""
    n = len(residual)
    size = 1 << (2 * n - 1).bit_length()
    power = (np.abs(np.fft.rfft(residual, size, axis=0)) ** 2).sum(axis=1)
    alike = np.fft.irfft(power, size)[: max(2, n // 8)]
    alike = alike / max(float(alike[0]), 1e-30)
    # up to where it is lost in chance
    until = int(np.argmax(alike < 2.0 / np.sqrt(n))) or len(alike)
    return float(np.sqrt(1.0 + 2.0 * alike[1:until].sum()))
