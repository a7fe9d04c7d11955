"""Noise properties of both sides, and tests to compare them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import fisher_exact, t

from ..calibration.numerics.frames import Array
from .results import Triple

# samples per block, and smallest number of blocks for a level
BLOCK, FEWEST_BLOCKS = 40, 4


@dataclass(frozen=True)
class Candidate:
    """A property on both sides with the unadjusted p of equality.

    there: whether vehicle and simulator have it; true for a level. matters: whether the difference is large enough to
    be claimed.
    """

    name: str
    unit: str
    vehicle: Triple
    simulator: Triple
    p: float
    there: tuple[bool, bool] = (True, True)
    matters: bool = True
    note: str = ""


def mean_of(values: Array) -> Array:
    """Return the mean and its 95 per cent interval (3,)."""
    reach = t.ppf(0.975, max(len(values) - 1, 1)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return np.array([values.mean(), values.mean() - reach, values.mean() + reach])


def welch(one: Array, other: Array) -> float:
    """Return the p-value of equal means of two samples with any scatter."""
    a, b = (float(each.var(ddof=1)) / len(each) for each in (one, other))
    if a + b <= 0.0:
        return 1.0 if one.mean() == other.mean() else 0.0
    dof = (a + b) ** 2 / (a**2 / (len(one) - 1) + b**2 / (len(other) - 1))
    return float(2.0 * t.sf(abs(one.mean() - other.mean()) / np.sqrt(a + b), dof))


def shares_of(name: str, vehicle: tuple[int, int], simulator: tuple[int, int]) -> Candidate | None:
    """Compare numbers of events among samples on both sides."""
    if not vehicle[1] or not simulator[1] or vehicle[0] + simulator[0] == 0:
        return None
    table = [[k, max(n - k, 0)] for k, n in (vehicle, simulator)]
    p = float(fisher_exact(table)[1])
    shares = [_share(*counts) for counts in (vehicle, simulator)]
    # one or two events are not systematic
    return Candidate(name, "share", shares[0], shares[1], p, (vehicle[0] > 2, simulator[0] > 2))


def _share(count: int, n: int) -> Triple:
    value = count / n
    half = 1.96 * np.sqrt(max(value * (1.0 - value), 0.25 / n) / n)
    return value, max(0.0, value - half), min(1.0, value + half)
