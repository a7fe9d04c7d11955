"""Initial DVL delay for `full`, by a linear fit at each delay of a grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..models.parameters import Parameters
from ..numerics.frames import Array, product
from .full_forward_model import FitBlock, JoinedBlocks, joined_blocks

# Grid of delays, s, for up to SEARCHED_BLOCKS blocks. A delay is taken if its chi-square is smaller by MIN_CHI2_GAIN.
# CORRELATED_ROWS rows count as one independent row. MIN_ROWS rows are needed.
STEP_S = 0.2
DELAYS_S: Array = STEP_S * np.arange(-16, 17)
SEARCHED_BLOCKS, MIN_CHI2_GAIN, CORRELATED_ROWS, MIN_ROWS = 64, 30.0, 5.0, 40


def better_delay(blocks: Sequence[FitBlock], delay: float, parameters: Parameters) -> float:
    """Return the DVL delay (s) that fits significantly better than the current one, or the current one."""
    if len(blocks) > SEARCHED_BLOCKS:
        return delay
    rows = [_dvl_at_delays(joined, parameters) for _, joined in joined_blocks(blocks)]
    squares = _residual_squares(rows) if rows else None
    if squares is None:
        return delay
    best = int(np.argmin(squares))
    at_current = float(np.interp(delay, DELAYS_S, squares))
    n = sum(len(row.body) for row in rows)
    is_significant = n * math.log(at_current / squares[best]) > MIN_CHI2_GAIN * CORRELATED_ROWS
    return float(DELAYS_S[best]) if is_significant and abs(DELAYS_S[best] - delay) > STEP_S else delay


class _DvlAtDelays(NamedTuple):
    """References and the DVL at every delay: body (J, 3) m/s, velocity (K, J, 3) m/s, rates (J, 3) rad/s."""

    body: Array
    velocity: Array
    rates: Array


def _dvl_at_delays(joined: JoinedBlocks, parameters: Parameters) -> _DvlAtDelays:
    """Return the comparable references of blocks with the DVL at every delay."""
    reference = joined.reference
    imu = joined.attitude_at(reference.times, parameters.imu_timeout)
    velocity, seen = joined.dvl_at(reference.times + DELAYS_S[:, None])
    known = seen.all(axis=0) & (imu.oriented | reference.in_body)
    known &= imu.rates_known & joined.measured[:, :2].all(axis=1)
    onto = np.where(reference.in_body[:, None, None], np.eye(3), imu.rotation.swapaxes(1, 2))
    body = product(onto, np.where(joined.measured, reference.velocity, 0.0))
    return _DvlAtDelays(body[known], velocity[:, known], imu.rates[known])


def _residual_squares(parts: Sequence[_DvlAtDelays]) -> Array | None:
    """Return the squared residuals (K,) of a linear fit of forward and port velocity; None for too few rows.

    Velocity and rates of three axes have free coefficients, which include mounting, scale and lever arm.
    """
    body = np.concatenate([part.body for part in parts])[:, :2]
    if len(body) < MIN_ROWS:
        return None
    velocity = np.concatenate([part.velocity for part in parts], axis=1)
    rates = np.concatenate([part.rates for part in parts])
    design = np.concatenate([velocity, np.broadcast_to(rates, velocity.shape)], axis=2)  # (K, J, 6)
    information = design.swapaxes(1, 2) @ design + 1e-9 * np.eye(6)
    vector = design.swapaxes(1, 2) @ body
    squares: Array = (body**2).sum() - (vector * np.linalg.solve(information, vector)).sum(axis=(1, 2))
    return np.maximum(squares, 1e-12)
