"""What rows tell each hypothesis of the delay, and how far they are from what it expects."""

from __future__ import annotations

import numpy as np

from ..models.own import N_STATE
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState, distance_squared
from ..numerics.samples import Index, Mask
from .observation_rows import OF_DELAY, OF_NONE, DelayedRows

# Columns of what rows hold for each delay, and the states that they say anything of.
_MOVING: Index = np.append(OF_DELAY, N_STATE)
_SHOWN_BY_ROWS: Index = np.concatenate([OF_NONE, OF_DELAY])


def told_by(rows: DelayedRows, use: Mask) -> Array:
    """What some rows tell each hypothesis (K, n+1, n+1): the sums of HᵀWH, HᵀWz and zᵀWz."""
    some = rows if use.all() else rows.part(use)
    k = len(some.moving)
    weight = np.concatenate([some.weight] * 3)
    n = len(weight)
    moving, standing = some.moving.reshape(k, len(_MOVING), n), some.standing.reshape(len(OF_NONE), n)
    weighted = moving * weight
    told = np.zeros((k, N_STATE + 1, N_STATE + 1))
    across = (weighted.reshape(k * len(_MOVING), n) @ standing.T).reshape(k, len(_MOVING), len(OF_NONE))
    told[:, _MOVING[:, None], _MOVING] = weighted @ moving.swapaxes(1, 2)
    told[:, _MOVING[:, None], OF_NONE], told[:, OF_NONE[:, None], _MOVING] = across, across.swapaxes(1, 2)
    told[:, OF_NONE[:, None], OF_NONE] = (standing * weight) @ standing.T
    return told


def innovation_squared(found: GaussianState, rows: DelayedRows) -> Array:
    """νᵀS⁻¹ν (K, J) of rows, each by itself, with S = HPHᵀ + 1 and P = LLᵀ: HPHᵀ is the square of LᵀHᵀ."""
    k, _, _, n = rows.moving.shape
    h, z = rows.moving[:, :-1].reshape(k, len(OF_DELAY), 3 * n), rows.moving[:, -1]
    standing = rows.standing.reshape(len(OF_NONE), 3 * n)
    expected = found.x[:, None, OF_DELAY] @ h
    expected[:, 0] += found.x[:, OF_NONE] @ standing
    innovation = z - expected.reshape(z.shape)
    # what is the same for all delays first: then most of the root is none of its business
    low = np.linalg.cholesky(found.p[:, _SHOWN_BY_ROWS[:, None], _SHOWN_BY_ROWS]).swapaxes(1, 2)
    m = len(OF_NONE)
    spread = np.empty((k, len(_SHOWN_BY_ROWS), 3 * n))
    np.matmul(low[:, :, m:], h, out=spread)
    spread[:, :m] += (np.ascontiguousarray(low[:, :m, :m]).reshape(-1, m) @ standing).reshape(k, m, 3 * n)
    spread = spread.reshape(k, -1, 3, n)
    s = [
        [np.einsum("kaj,kaj->kj", spread[:, :, i], spread[:, :, j]) + float(i == j) for j in range(i + 1)]
        for i in range(3)
    ]
    return distance_squared(s, [*innovation.swapaxes(0, 1)])
