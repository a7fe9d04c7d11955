"""Tails and quantiles of common distributions by `scipy.special`.

`scipy.stats` takes half a second of CPU to import. No module of everyday commands imports it, or `scipy.signal`, which
imports it; a test lists the exceptions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import bdtrc, betaincinv, chdtr, chdtrc, chdtri, fdtrc, gammaincinv, ndtr, ndtri

from .frames import Array


def chi2_sf(x: ArrayLike, dof: ArrayLike) -> Array:
    """Return P(X > x) of chi-square."""
    return np.asarray(chdtrc(dof, x))


def chi2_isf(p: float, dof: ArrayLike) -> Array:
    """Return the x that chi-square exceeds with probability p."""
    return np.asarray(chdtri(dof, p))


def chi2_logsf(x: ArrayLike, dof: ArrayLike) -> Array:
    """Return log P(X > x) of chi-square; -inf on underflow."""
    x = np.asarray(x, dtype=float)
    median = 2.0 * gammaincinv(0.5 * np.asarray(dof), 0.5)
    with np.errstate(divide="ignore"):  # each branch where it is exact
        return np.where(x > median, np.log(chdtrc(dof, x)), np.log1p(-chdtr(dof, x)))


def f_sf(x: ArrayLike, dof: ArrayLike, dof_of_denominator: ArrayLike) -> Array:
    """Return P(X > x) of Fisher's F."""
    return np.asarray(fdtrc(dof, dof_of_denominator, x))


def normal_sf(x: ArrayLike) -> Array:
    """Return P(X > x) of a standard normal variable."""
    return np.asarray(ndtr(-np.asarray(x, dtype=float)))


def normal_isf(p: ArrayLike) -> Array:
    """Return the x that a standard normal variable exceeds with probability p."""
    return np.asarray(-ndtri(p))


def binomial_sf(count: int, n: int, p: float) -> float:
    """Return P(X >= count) of n trials with success probability p."""
    return 1.0 if count <= 0 else float(bdtrc(count - 1, n, p))


def binomial_interval(count: int, n: int) -> tuple[float, float]:
    """Return the 95 per cent interval of Clopper and Pearson of the success probability, for `count` in n trials."""
    low = 0.0 if count == 0 else float(betaincinv(count, n - count + 1, 0.025))
    high = 1.0 if count == n else float(betaincinv(count + 1, n - count, 0.975))
    return low, high
