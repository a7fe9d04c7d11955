"""Initial DVL delay for `full`, by a linear fit at each delay of a grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..models.parameters import Parameters
from ..numerics.frames import Array, product
from .full_forward_model import FitBlock, attitude_of, dvl_at

# Grid of delays, s, for up to SEARCHED_BLOCKS blocks. A delay is taken if its chi-square is smaller by CLEARLY, where
# ALIKE_ROWS correlated rows count as one independent row. FEWEST_ROWS rows are needed.
STEP_S = 0.2
DELAYS_S: Array = STEP_S * np.arange(-16, 17)
SEARCHED_BLOCKS, CLEARLY, ALIKE_ROWS, FEWEST_ROWS = 64, 30.0, 5.0, 40


def better_delay(blocks: Sequence[FitBlock], delay: float, parameters: Parameters) -> float:
    """Return the DVL delay (s) that fits significantly better than the current one, or the current one."""
    if len(blocks) > SEARCHED_BLOCKS:
        return delay
    rows = [own for block in blocks if (own := _beside(block, parameters)) is not None]
    squares = _left_by_delay(rows) if rows else None
    if squares is None:
        return delay
    best = int(np.argmin(squares))
    now = float(np.interp(delay, DELAYS_S, squares))
    n = sum(len(each.body) for each in rows)
    is_clear = n * math.log(now / squares[best]) > CLEARLY * ALIKE_ROWS
    return float(DELAYS_S[best]) if is_clear and abs(DELAYS_S[best] - delay) > STEP_S else delay


class _Beside(NamedTuple):
    """References and the DVL at every delay: body (J, 3) m/s, velocity (K, J, 3) m/s, rates (J, 3) rad/s."""

    body: Array
    velocity: Array
    rates: Array


def _beside(block: FitBlock, parameters: Parameters) -> _Beside | None:
    """Return a block's references with the DVL at every delay; None without a comparable reference."""
    times = block.reference.times
    if not len(times) or len(block.dvl.times) < 4 or len(block.imu.times) < 2:
        return None
    rotation, oriented, rates, turning_known = attitude_of(block, times, parameters.imu_timeout)
    asked = (times + DELAYS_S[:, None]).ravel()
    seen = dvl_at(block, asked)
    known = seen.known.reshape(len(DELAYS_S), -1).all(axis=0) & (oriented | block.reference.in_body)
    known &= turning_known & block.measured[:, :2].all(axis=1)
    if not known.any():
        return None
    onto = np.where(block.reference.in_body[:, None, None], np.eye(3), rotation.swapaxes(1, 2))
    body = product(onto, np.where(block.measured, block.reference.velocity, 0.0))
    return _Beside(body[known], seen.value.reshape(len(DELAYS_S), -1, 3)[:, known], rates[known])


def _left_by_delay(each: Sequence[_Beside]) -> Array | None:
    """Return the squared residuals (K,) of a linear fit of forward and port velocity; None for too few rows.

    Velocity and rates of three axes have free coefficients, which include mounting, scale and lever arm.
    """
    body = np.concatenate([own.body for own in each])[:, :2]
    if len(body) < FEWEST_ROWS:
        return None
    velocity = np.concatenate([own.velocity for own in each], axis=1)
    rates = np.concatenate([own.rates for own in each])
    h = np.concatenate([velocity, np.broadcast_to(rates, velocity.shape)], axis=2)
    across = h.swapaxes(1, 2)
    known = across @ h + 1e-9 * np.eye(6)
    side = across @ body
    squares: Array = (body**2).sum() - (side * np.linalg.solve(known, side)).sum(axis=(1, 2))
    return np.maximum(squares, 1e-12)
