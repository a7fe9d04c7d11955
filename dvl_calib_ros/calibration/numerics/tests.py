"""Levels of significance, each once, and significance of one test (chi-square) and of many (Holm), without SciPy.

A level is in σ of a normal error, two-sided, and allows for the number of tests of its kind (Bonferroni); where one
decision tests several quantities, `holm` corrects for these. Significance decides whether an effect is there; its cost
in m per km of dead reckoning decides the severity.

A calibration needs few probabilities; importing `scipy.special` (`distributions`) takes a quarter of a second of CPU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from .frames import Array

# Standard scores. Two-sided 95 %: an error within the interval that the answer states.
Z_95_PERCENT = 2.0
# A recording is tested once: 0.3 %.
Z_ONE_TEST = 3.0
# One of about fifty tests of a recording: 1 % for all, 2e-4 each.
Z_FIFTY_TESTS = 3.7
# Tests repeated with every block for hours: 6e-7 each.
Z_REPEATED_TEST = 5.0
# Tests next to slow errors of references, attitudes and clocks at sea, which no model holds entirely.
Z_SLOW_ERRORS = 6.0

# False-alarm rate of a comparison of two recordings, or of held-out errors with their prediction.
CHANCE = 0.01
# Chi-square by which an explanation must be worse to be ruled out: a likelihood ratio of e⁴, 55 to 1.
RULED_OUT = 8.0


def chance_of(sigmas: float) -> float:
    """Return the two-sided probability of a normal error beyond this many σ."""
    return chi2_sf(sigmas * sigmas, 1.0)


def holm(p_values: Sequence[float]) -> Array:
    """Return p-values (N,) adjusted by Holm's step-down procedure, which holds under any dependence."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted


def smallest_found(p: float, power: float) -> float:
    """Return the true error, in σ, that a two-sided test at level p detects with a power above 0.5."""
    return math.sqrt(chi2_isf(p, 1.0)) + math.sqrt(chi2_isf(2.0 * (1.0 - power), 1.0))


_EPSILON = 4e-16
# Limits of passes for a quantile (Newton takes about ten) and of terms of a fraction (about √dof).
_PASSES, _TERMS = 200, 100_000


def chi2_cdf(x: float, dof: float) -> float:
    """Return P(X <= x) of chi-square with dof > 0, not necessarily an integer."""
    return _tails(0.5 * x, 0.5 * dof)[0]


def chi2_sf(x: float, dof: float) -> float:
    """Return P(X > x) of chi-square."""
    return _tails(0.5 * x, 0.5 * dof)[1]


@lru_cache
def chi2_isf(p: float, dof: float) -> float:
    """Return the x that chi-square exceeds with probability p, 0 < p < 1, by bracketed Newton's method."""
    a, x, low, high = 0.5 * dof, 0.5 * dof, 0.0, math.inf
    for _ in range(_PASSES):
        below, above = _tails(x, a)
        too_small = above - p if p < 0.5 else (1.0 - p) - below
        low, high = (x, high) if too_small > 0.0 else (low, x)
        density = math.exp((a - 1.0) * math.log(x) - x - math.lgamma(a))
        tried = x + too_small / density if density > 0.0 else math.inf
        if not low < tried < high:
            tried = 0.5 * (low + high) if high < math.inf else 2.0 * x
        if abs(tried - x) <= _EPSILON * x:
            break
        x = tried
    return 2.0 * x


def _tails(x: float, a: float) -> tuple[float, float]:
    """Return the regularised incomplete gamma functions P(a, x) and Q(a, x); the smaller one to rounding.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 6.5.29 (series) and 6.5.31 (continued fraction).
    """
    if not 0.0 < x < math.inf:
        return (1.0, 0.0) if x > 0.0 else (0.0, 1.0)
    scale = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        n = a
        while term > _EPSILON * total:
            n += 1.0
            term *= x / n
            total += term
        below = scale * total
        return below, 1.0 - below
    # Lentz: ratios of neighbouring numerators and denominators
    b = x + 1.0 - a
    c, d = math.inf, 1.0 / b
    fraction = d
    for n in range(1, _TERMS):
        b += 2.0
        numerator = n * (a - n)
        c, d = b + numerator / c, 1.0 / (b + numerator * d)
        fraction *= c * d
        if abs(c * d - 1.0) < _EPSILON:
            break
    above = scale * fraction
    return 1.0 - above, above
