"""Rows of `full` between two knots of its slow errors: their median, misfit, mean climb and bins.

Shapes: J references of a section, k tested effects.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..checks.beam_faults import N_EFFECTS, effect_velocities
from ..models.own import BIAS
from ..numerics.block_covariance import BLOCK_S
from ..numerics.frames import Array
from ..numerics.robust import median
from .full_forward_model import CONSTANT, SLOW, SPAN_S, FitBlock, PredictedRows
from .slow_errors import WIDTH, Bins, Chain, SlowErrors, binned_rows, gram_of

DENSER_RATIO = 0.7  # references are denser than the DVL below this ratio of intervals
# Squared residual of three axes, in variances, that 1 % of good rows exceed. Beyond it a row has weight gate / misfit.
GATE_SQUARE = 11.3
# σ of a slow error that is left out, rad.
NOTHING_RAD = 1e-6
# Mean of the smaller 90 % of squares of a standard normal variable.
TRIMMED_SQUARE = 0.623


class ReferenceCounts(NamedTuple):
    """References used and gated, and the sum of squared residuals of those used."""

    used: int = 0
    gated: int = 0
    misfit: float = 0.0

    @staticmethod
    def total(parts: Iterable[ReferenceCounts]) -> ReferenceCounts:
        """Return the sum of parts."""
        return ReferenceCounts(*map(sum, zip(*parts, strict=True)))


class CondensedSection(NamedTuple):
    """Interval between two knots.

    seconds: length.
    gram: (WIDTH, WIDTH) Gram matrix of its rows, see slow_errors.py; None without rows.
    fold: hold-out fold.
    up: (21,) mean of `PredictedRows.up`, its velocity at zero states; None without attitude or vertical reference.
    """

    seconds: float
    gram: Array | None
    fold: int
    up: Array | None = None
    counts: ReferenceCounts = ReferenceCounts()


class SectionRows:
    """Rows of one section. level: (3,) m/s, median. residual: (J, 3) m/s about the median, nan if not measured."""

    def __init__(self, from_s: float, rows: PredictedRows | None, block: FitBlock) -> None:
        self.from_s, self.rows, self._bin_s = from_s, rows, _bin_length_s(block)
        self.slope_variance = block.slope_variance
        self._bins: Bins | None = None
        if rows is not None:
            measured = rows.weight > 0.0
            residual = np.where(measured, rows.residual, np.nan)
            self.level = masked_median(residual)
            self.residual = residual - self.level
            self._squares = np.where(measured, self.residual * self.residual, 0.0)

    def with_beam_faults(self) -> SectionRows:
        """Return the rows with derivatives by the k effects of a beam's fault."""
        assert self.rows is not None
        more = self.rows.columns[:, :, BIAS] @ effect_velocities(self.rows.dvl)
        whole = copy.copy(self)
        whole._bins, whole.rows = None, self.rows._replace(columns=np.concatenate([self.rows.columns, more], axis=2))
        return whole

    def misfit(self, single: Array) -> Array:
        """Return the squared deviation (J,) of rows from the median, in variances (3,) of single rows."""
        return np.asarray((self._squares / single).sum(axis=1))

    def up(self, x: Array) -> Array | None:
        """Return the mean velocity upwards (21,): derivatives by the states, and m/s at zero states; None if unknown.

        x: (20,) point of linearisation.
        """
        assert self.rows is not None
        known = self.rows.oriented & (self.rows.weight[:, 2] > 0.0)
        if not known.any():
            return None
        mean: Array = self.rows.up[known].mean(axis=0)
        mean[-1] -= mean[:-1] @ x
        return mean

    def bins(self, single: Array) -> Bins:
        """Average the rows over bins, with robust weights. single: see `misfit`."""
        assert self.rows is not None
        if self._bins is None:
            weight = np.minimum(1.0, GATE_SQUARE / np.maximum(self.misfit(single), 1e-9))
            self._bins = binned_rows(self.rows, weight, self.from_s, self.from_s + BLOCK_S, self._bin_s)
        return self._bins


def beam_fault_grams(sections: Sequence[SectionRows], x: Array, single: Array, white: Array, slow: SlowErrors) -> Array:
    """Return the Gram matrices (S, 21 + k, 21 + k) of S sections over [states, effects, residual], without slow errors.

    x: (20,) point of linearisation.
    single, white: (3,) variances.
    slow: at one point of the prior.
    """
    bins = [section.with_beam_faults().bins(single) for section in sections]
    x, k = np.append(x, np.zeros(N_EFFECTS)), N_EFFECTS
    grams = [gram_of(own, white, x, each.slope_variance) for own, each in zip(bins, sections, strict=True)]
    std = np.where(np.arange(SLOW) == CONSTANT, NOTHING_RAD, slow.std)  # sections cannot differ by a constant
    slow = SlowErrors(*(np.repeat(values, len(sections), axis=0) for values in (std, slow.memory_s)))
    return Chain.begun(slow, k).after(np.reshape(grams, (-1, WIDTH + k, WIDTH + k)), BLOCK_S, slow).ended().gram


def usual_square(values: Array) -> Array:
    """Return the variance (3,) of (J, 3) without nan, by the smaller 90 % of the squares, against outliers."""
    variance = np.zeros(3)
    for axis, column in enumerate(values.T):
        squares = np.sort(column[np.isfinite(column)] ** 2)
        kept = squares[: math.ceil(0.9 * len(squares))]
        variance[axis] = kept.mean() / TRIMMED_SQUARE if len(kept) else 0.0
    return variance


def masked_median(values: Array) -> Array:
    """Return the median (3,) of (J, 3) without nan; 0 for an axis without values."""
    finite = np.isfinite(values)
    if finite.all():
        return np.sort(values, axis=0)[len(values) // 2]
    columns = [column[known] for column, known in zip(values.T, finite.T, strict=True)]
    return np.array([median(column) if len(column) else 0.0 for column in columns])


def _bin_length_s(block: FitBlock) -> float:
    """Return the bin length, s: longer where references are denser than DVL samples, because they then share these."""
    times = block.reference.times
    if len(times) < 2 or len(block.dvl.times) < 2:
        return SPAN_S
    apart = (times[-1] - times[0]) / (len(times) - 1)
    return block.slope_reach_s if apart < DENSER_RATIO * block.interval_s else SPAN_S


def section_starts(block: FitBlock) -> list[float]:
    """Return where the sections of a block begin, s."""
    return [block.from_s + BLOCK_S * n for n in range(round((block.end_s - block.from_s) / BLOCK_S))]
