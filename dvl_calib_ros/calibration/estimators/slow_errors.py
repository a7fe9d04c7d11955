"""Slow errors of reference and attitude, eliminated from the normal equations of `full`.

A slow error is a first-order Gauss-Markov process, piecewise linear between knots. A section between two knots is
condensed once to a Gram matrix over [slow errors at its start, at its end, states, residual]. This does not depend on
the process's parameters. Given those, Schur complements eliminate the knots of a recording in order (a Kalman filter in
information form). A section is held out by a zero Gram matrix; recordings add up after elimination.

Shapes: C points of the prior of the slow errors, J references or bins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.own import DELAY, N_STATE, REFERENCE_DELAY
from ..numerics.frames import Array
from .full_forward_model import SLOW, PredictedRows

# Width of a section's Gram matrix: slow errors at both ends, states, residual.
WIDTH = 2 * SLOW + N_STATE + 1
_DELAY, _REFERENCE_DELAY = 2 * SLOW + DELAY, 2 * SLOW + REFERENCE_DELAY
# Memory (s) of a slow error that is constant.
CONSTANT_S = 1e6
# Safety factor on the false information about a delay that DVL noise gives, because it scatters.
NOISE_TWICE = 2.0
# Smallest share of signal in the acceleration column; with less it is not used. Gauss-Newton steps are too long by 1 /
# √share.
LEAST_SHARE = 0.4


class SlowErrors(NamedTuple):
    """Standard deviation and memory (s) of the slow errors (C, 7) at C points of their prior."""

    std: Array
    memory_s: Array

    def part(self, points: slice) -> SlowErrors:
        """Return some of the points."""
        return SlowErrors(self.std[points], self.memory_s[points])


class LogNormal(NamedTuple):
    """Log-normal prior: two thirds of the instruments are within median / factor and median · factor."""

    median: float
    factor: float

    @property
    def mean_square(self) -> float:
        """Mean of the square."""
        return self.median**2 * math.exp(2.0 * math.log(self.factor) ** 2)


@dataclass(frozen=True)
class Priors:
    """Priors of the slow errors, from instrument specifications.

    horizontal, vertical: GNSS Doppler velocity, 0.5 to 3 cm/s horizontally (90 %), m/s.
    heading, tilt: AHRS, rad.
    heading_offset: constant error of a compass whose declination may not be set, rad.
    memory: 10 to 300 s (90 %).
    deviation: heading deviation as a share of `heading_deviation_std`.
    """

    horizontal: LogNormal = field(default_factory=lambda: LogNormal(0.012, 1.7))
    vertical: LogNormal = field(default_factory=lambda: LogNormal(0.018, 1.7))
    heading: LogNormal = field(default_factory=lambda: LogNormal(math.radians(0.21), 1.7))
    tilt: float = math.radians(0.1)
    heading_offset: float = math.radians(10.0)
    memory: LogNormal = field(default_factory=lambda: LogNormal(55.0, 2.8))
    deviation: LogNormal = field(default_factory=lambda: LogNormal(0.3, 3.0))

    def at(self, points: Array) -> tuple[SlowErrors, Array]:
        """Return the slow errors and scales (C,) of the heading deviation at points (C, 5), in σ of the logarithms."""
        median, factor = np.array([self.horizontal, self.vertical, self.heading, self.memory, self.deviation]).T
        horizontal, vertical, heading, memory, deviation = (median * factor**points).T
        tilt, constant = (np.full_like(heading, std) for std in (self.tilt, self.heading_offset))
        std = np.stack([horizontal, horizontal, vertical, tilt, tilt, heading, constant], axis=1)
        return SlowErrors(std, np.stack([*[memory] * 6, np.full_like(memory, CONSTANT_S)], axis=1)), deviation


def normal_points(k: int, n: int) -> Array:
    """Return n equally likely points (n, k) of k independent standard normal variables; the first is near the median.

    An additive recurrence (R-sequence of Roberts, a generalised golden ratio) through the inverse normal distribution
    gives fixed, evenly spread points.
    """
    root = 1.5
    for _ in range(60):  # solves g^(k+1) = g + 1
        root = (1.0 + root) ** (1.0 / (k + 1))
    uniform = (0.5 + np.arange(n)[:, None] * (1.0 / root) ** np.arange(1, k + 1)) % 1.0
    normal = NormalDist()
    return np.array([normal.inv_cdf(share) for share in uniform.ravel().tolist()]).reshape(n, k)


class Bins(NamedTuple):
    """Rows of one section averaged over bins of time.

    rows: (J, 3, WIDTH), [slow at start, slow at end, states, residual].
    weight: (J, 3).
    fold: (J,).
    """

    rows: Array
    weight: Array
    fold: NDArray[np.int64]


def binned_rows(rows: PredictedRows, row_weight: Array, from_s: float, end_s: float, bin_s: float) -> Bins:
    """Average the rows of a section over bins of at least bin_s. row_weight: (J,) robust weights."""
    weight = rows.weight * row_weight[:, None]
    bins = np.floor((rows.times - from_s) / bin_s)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    total = np.add.reduceat(weight, first, axis=0)
    share = weight / np.maximum(np.repeat(total, np.diff(np.append(first, len(bins))), axis=0), 1e-12)
    states_and_residual = np.concatenate([rows.columns, rows.residual[:, :, None]], axis=2)
    mean = np.add.reduceat(states_and_residual * share[:, :, None], first)
    slow = np.add.reduceat(rows.slow * share[:, :, None], first)
    # slow errors are linear between the ends of the section: fraction of the way
    fraction = np.add.reduceat((rows.times[:, None] - from_s) / (end_s - from_s) * share, first)[:, :, None]
    columns = np.concatenate([(1.0 - fraction) * slow, fraction * slow, mean], axis=2)
    return Bins(columns, total, rows.fold[first])


def scatter(bins: Bins) -> tuple[Array, Array]:
    """Return the residual's sum of squares (3,) about a straight line in time, and its degrees of freedom (3,).

    A section lies between two knots of the slow errors; the line removes them.
    """
    squares, freedom = np.zeros(3), np.zeros(3)
    for axis in range(3):
        weight = bins.weight[:, axis]
        n = int(np.count_nonzero(weight))
        if n < 4:
            continue
        root = np.sqrt(weight)
        line = bins.rows[:, axis][:, [axis, SLOW + axis]] * root[:, None]  # from its values at the start and the end
        residual = bins.rows[:, axis, -1] * root
        information, vector = line.T @ line + 1e-12 * np.eye(2), line.T @ residual
        squares[axis] = residual @ residual - vector @ np.linalg.solve(information, vector)
        freedom[axis] = n - 2
    return np.maximum(squares, 0.0), freedom


def gram_of(bins: Bins, variance: Array, x: Array, slope_variance: float) -> Array:
    """Return the Gram matrix (WIDTH, WIDTH) of a section, for a white variance (3,) (m/s)² of a row of weight one.

    slope_variance: (m/s²)² of the acceleration due to DVL noise, which would pretend information on delays (errors in
    variables); the acceleration column is reduced accordingly. The residual refers to x = 0 by the derivatives at x
    (20,), so that sections with different points of linearisation add.
    """
    rows = bins.rows * np.sqrt(bins.weight / variance)[:, :, None]
    rows = rows.reshape(-1, rows.shape[2])
    delay = rows[:, _DELAY].copy()
    by_noise = NOISE_TWICE * slope_variance * float((bins.weight / variance).sum())
    share = 1.0 - by_noise / max(float(delay @ delay), 1e-300)
    # the reference delay has the same acceleration with opposite sign, in addition to its terms of rotation
    less = (1.0 - (math.sqrt(share) if share > LEAST_SHARE else 0.0)) * delay
    rows[:, _DELAY] -= less
    rows[:, _REFERENCE_DELAY] += less
    rows[:, -1] += rows[:, 2 * SLOW : -1] @ x
    gram: Array = rows.T @ rows
    return gram


class Eliminated(NamedTuple):
    """Information (C, 21, 21) on states and residual without slow errors, and its part of -2 log evidence (C,)."""

    gram: Array
    log_determinant: Array

    def part(self, points: slice) -> Eliminated:
        """Return some of the points."""
        return Eliminated(self.gram[points], self.log_determinant[points])


class Chain(NamedTuple):
    """Chain of sections up to a knot: Gram matrix (C, 28, 28) over [slow errors there, states, residual]."""

    gram: Array
    log_determinant: Array

    @staticmethod
    def begun(slow: SlowErrors, n_tested: int = 0) -> Chain:
        """Return the chain before the first section. n_tested: number of columns tested in addition to the states."""
        width = SLOW + N_STATE + n_tested + 1
        gram = np.zeros((len(slow.std), width, width))
        gram[:, np.arange(SLOW), np.arange(SLOW)] = slow.std**-2.0
        return Chain(gram, 2.0 * np.log(slow.std).sum(axis=1))

    def part(self, points: slice) -> Chain:
        """Return the chain of some points."""
        return Chain(self.gram[points], self.log_determinant[points])

    def after(self, gram: Array | None, seconds: float, slow: SlowErrors) -> Chain:
        """Return the chain with one more section of this length.

        gram: (WIDTH, WIDTH), or (C, WIDTH, WIDTH) at each point; None for a section without rows.
        """
        diagonal = np.arange(SLOW)
        memory = np.exp(-seconds / slow.memory_s)
        driven = slow.std**2 * (1.0 - memory**2)  # variance that the process gains along the section
        # blocks of the Gram matrix over [slow errors at the start | slow errors at the end, states, residual]
        start, between, end = self.gram[:, :SLOW, :SLOW].copy(), self.gram[:, :SLOW].copy(), self.gram.copy()
        between[:, :, :SLOW] = end[:, :SLOW] = end[:, :, :SLOW] = 0.0
        start[:, diagonal, diagonal] += memory**2 / driven
        between[:, diagonal, diagonal] = -memory / driven
        end[:, diagonal, diagonal] = 1.0 / driven
        if gram is not None:
            start += gram[..., :SLOW, :SLOW]
            between += gram[..., :SLOW, SLOW:]
            end += gram[..., SLOW:, SLOW:]
        complement = _schur_complement(start, between, end)
        log_determinant = self.log_determinant + np.log(driven).sum(axis=1) + np.linalg.slogdet(start)[1]
        return Chain(complement, log_determinant)

    def ended(self) -> Eliminated:
        """Eliminate the slow errors at the end."""
        slow, between, rest = self.gram[:, :SLOW, :SLOW], self.gram[:, :SLOW, SLOW:], self.gram[:, SLOW:, SLOW:]
        return Eliminated(_schur_complement(slow, between, rest), self.log_determinant + np.linalg.slogdet(slow)[1])


def _schur_complement(eliminated: Array, between: Array, rest: Array) -> Array:
    """Return the information on the rest after elimination, of [[eliminated, between], [betweenᵀ, rest]]."""
    return rest - between.transpose(0, 2, 1) @ np.linalg.solve(eliminated, between)
