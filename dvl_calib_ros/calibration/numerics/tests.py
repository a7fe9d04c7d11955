"""Many tests at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .frames import Array


def holm(p_values: Sequence[float]) -> Array:
    """p-values (N,) as large as they are by Holm's step-down procedure, that holds whatever their dependence."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1.0)
    return adjusted
