"""Slow errors of reference and attitude, eliminated from the normal equations of `full`.

What errs slowly is a first-order Gauss-Markov process, piecewise linear between knots. Rows are multiplied out once per
section between two knots, before anything is known of the slow errors: a section is a Gram matrix over [slow errors at
its start, at its end, states, residual]. For any level and memory a recording is then a chain of sections whose knots
are eliminated one after another (a Kalman filter in information form; Schur complement). So levels and memories cost
little to try, a section is left out by setting it to zero, and recordings add once their knots are gone.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.own import DELAY, N_STATE, REFERENCE_DELAY
from ..numerics.frames import Array
from .full_forward_model import SLOW, PredictedRows

# Width of a section's Gram matrix: both ends, states, residual.
WIDTH = 2 * SLOW + N_STATE + 1
_DELAY, _REFERENCE_DELAY = 2 * SLOW + DELAY, 2 * SLOW + REFERENCE_DELAY
# So many times what noise tells of a delay is taken for that: what it tells scatters.
NOISE_TWICE = 2.0
# Steps are too long by 1 / √share of the acceleration that is no noise: with a smaller share it tells nothing.
LEAST_SHARE = 0.4


class SlowErrors(NamedTuple):
    """Standard deviation and memory (s) of the slow errors (C, 6) for C points of their prior."""

    std: Array
    memory_s: Array

    def part(self, points: slice) -> SlowErrors:
        """Those of some points."""
        return SlowErrors(self.std[points], self.memory_s[points])


class LogNormal(NamedTuple):
    """Two thirds of the instruments are within median / factor and median · factor."""

    median: float
    factor: float


def normal_points(k: int, n: int) -> Array:
    """Points (n, k) of k independent standard normal numbers, all equally likely; the first is near their medians.

    They are an additive recurrence (the R-sequence of Roberts, which generalises the golden ratio) through the inverse
    of the normal distribution: fixed, and even in few dimensions.
    """
    root = 1.5
    for _ in range(60):  # of g^(k+1) = g + 1
        root = (1.0 + root) ** (1.0 / (k + 1))
    uniform = (0.5 + np.arange(n)[:, None] * (1.0 / root) ** np.arange(1, k + 1)) % 1.0
    normal = NormalDist()
    return np.array([[normal.inv_cdf(each) for each in row] for row in uniform.tolist()])


class Bins(NamedTuple):
    """Rows averaged over bins of time, of one section.

    rows (J, 3, WIDTH): [slow at start, slow at end, states, residual]. weight (J, 3): of samples. along (J,): share of
    the way to the section's end. fold (J,).
    """

    rows: Array
    weight: Array
    fold: NDArray[np.int64]


def binned_rows(rows: PredictedRows, row_weight: Array, from_s: float, end_s: float, bin_s: float) -> Bins:
    """Average the rows of a section over bins of at least bin_s; row_weight (J,): the robust weight of each."""
    weight = rows.weight * row_weight[:, None]
    bins = np.floor((rows.times - from_s) / bin_s)
    first = np.flatnonzero(np.diff(bins, prepend=-1.0))
    total = np.add.reduceat(weight, first, axis=0)
    share = weight / np.maximum(np.repeat(total, np.diff(np.append(first, len(bins))), axis=0), 1e-12)
    both = np.concatenate([rows.columns, rows.residual[:, :, None]], axis=2)
    mean = np.add.reduceat(both * share[:, :, None], first)
    slow = np.add.reduceat(rows.slow * share[:, :, None], first)
    along = np.add.reduceat((rows.times[:, None] - from_s) / (end_s - from_s) * share, first)[:, :, None]
    whole = np.concatenate([(1.0 - along) * slow, along * slow, mean], axis=2)
    return Bins(whole, total, rows.fold[first])


def scatter(bins: Bins) -> tuple[Array, Array]:
    """Sum of squares (3,) of the residual about a straight line over the section, per axis, and degrees of freedom.

    It does not depend on slow errors: the line takes these away.
    """
    squares, freedom = np.zeros(3), np.zeros(3)
    for axis in range(3):
        weight = bins.weight[:, axis]
        n = int(np.count_nonzero(weight))
        if n < 4:
            continue
        root = np.sqrt(weight)
        lines = bins.rows[:, axis][:, [axis, SLOW + axis]] * root[:, None]
        residual = bins.rows[:, axis, -1] * root
        known = lines.T @ lines + 1e-12 * np.eye(2)
        side = lines.T @ residual
        squares[axis] = residual @ residual - side @ np.linalg.solve(known, side)
        freedom[axis] = n - 2
    return np.maximum(squares, 0.0), freedom


def gram_of(bins: Bins, variance: Array, x: Array, slope_variance: float) -> Array:
    """Gram matrix (WIDTH, WIDTH) of a section, in units of the white variance (3,) (m/s)² of a row of weight one.

    slope_variance: (m/s²)² of the acceleration by noise of the DVL alone. That would tell a delay where nothing does
    (errors in variables), so its column is as much smaller as it is noise. The residual is that of x = 0 by the
    derivatives at x (20,), so that sections of other points of linearisation add.
    """
    rows = bins.rows * np.sqrt(bins.weight / variance)[:, :, None]
    rows = rows.reshape(-1, WIDTH)
    delay = rows[:, _DELAY].copy()
    by_noise = NOISE_TWICE * slope_variance * float((bins.weight / variance).sum())
    share = 1.0 - by_noise / max(float(delay @ delay), 1e-300)
    # the reference's delay has the same acceleration the other way round, beside what turns
    less = (1.0 - (math.sqrt(share) if share > LEAST_SHARE else 0.0)) * delay
    rows[:, _DELAY] -= less
    rows[:, _REFERENCE_DELAY] += less
    rows[:, -1] += rows[:, 2 * SLOW : -1] @ x
    gram: Array = rows.T @ rows
    return gram


class Eliminated(NamedTuple):
    """Information (C, 21, 21) on states and residual without the slow errors, and what that adds to minus twice the log
    evidence (C,)."""

    gram: Array
    log_determinant: Array


class Chain(NamedTuple):
    """A chain of sections that goes on: Gram matrix (C, 27, 27) over [slow errors at its end, states, residual], and as
    of `Eliminated`."""

    gram: Array
    log_determinant: Array

    @staticmethod
    def begun(slow: SlowErrors) -> Chain:
        """Before the first section."""
        gram = np.zeros((len(slow.std), SLOW + N_STATE + 1, SLOW + N_STATE + 1))
        gram[:, np.arange(SLOW), np.arange(SLOW)] = slow.std**-2.0
        return Chain(gram, 2.0 * np.log(slow.std).sum(axis=1))

    def part(self, points: slice) -> Chain:
        """That of some points."""
        return Chain(self.gram[points], self.log_determinant[points])

    def after(self, gram: Array | None, seconds: float, slow: SlowErrors) -> Chain:
        """With another section (WIDTH, WIDTH) of so many seconds; None for one without rows."""
        own, first, rest = np.arange(SLOW), slice(SLOW), slice(2 * SLOW, WIDTH)
        memory = np.exp(-seconds / slow.memory_s)
        driven = slow.std**2 * (1.0 - memory**2)
        joint = np.zeros((len(self.gram), WIDTH, WIDTH))
        if gram is not None:
            joint += gram
        joint[:, first, first] += self.gram[:, :SLOW, :SLOW]
        joint[:, first, rest] += self.gram[:, :SLOW, SLOW:]
        joint[:, rest, first] += self.gram[:, SLOW:, :SLOW]
        joint[:, rest, rest] += self.gram[:, SLOW:, SLOW:]
        joint[:, own, own] += memory**2 / driven
        joint[:, own + SLOW, own + SLOW] += 1.0 / driven
        joint[:, own, own + SLOW] -= memory / driven
        joint[:, own + SLOW, own] -= memory / driven
        without, more = _without_first(joint)
        return Chain(without, self.log_determinant + np.log(driven).sum(axis=1) + more)

    def ended(self) -> Eliminated:
        """Without the slow errors at its end."""
        rest, more = _without_first(self.gram)
        return Eliminated(rest, self.log_determinant + more)


def _without_first(gram: Array) -> tuple[Array, Array]:
    """Schur complement after the first six variables, and the logarithm of the determinant of their part."""
    head, side = gram[:, :SLOW, :SLOW], gram[:, :SLOW, SLOW:]
    return gram[:, SLOW:, SLOW:] - side.transpose(0, 2, 1) @ np.linalg.solve(head, side), np.linalg.slogdet(head)[1]
