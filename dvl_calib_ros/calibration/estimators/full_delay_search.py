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


class DelaySums(NamedTuple):
    """Normal equations of a linear fit of forward and port velocity at each of K delays, summed over blocks of a day.

    Velocity and rates of three axes have free coefficients, which include mounting, scale and lever arm.

    n_blocks: number of blocks. n_rows: number of references.
    information: (K, 6, 6). vector: (K, 6, 2).
    square: squared velocities, (m/s)².
    """

    n_blocks: int = 0
    n_rows: int = 0
    information: Array = 1e-9 * np.eye(6)
    vector: Array = np.zeros((1, 6, 2))
    square: float = 0.0

    def after(self, blocks: Sequence[FitBlock], parameters: Parameters) -> DelaySums:
        """Return the sums with the new ones of a day's blocks. More than SEARCHED_BLOCKS are not summed."""
        sums = self._replace(n_blocks=len(blocks))
        new = blocks[self.n_blocks :] if len(blocks) <= SEARCHED_BLOCKS else ()
        for _, joined in joined_blocks(new):
            body, design = _rows_at_delays(joined, parameters)
            sums = sums._replace(
                n_rows=sums.n_rows + len(body), square=sums.square + float((body**2).sum()),
                information=sums.information + design.swapaxes(1, 2) @ design,
                vector=sums.vector + design.swapaxes(1, 2) @ body,
            )  # fmt: skip
        return sums

    def better(self, delay: float) -> float:
        """Return the DVL delay (s) that fits significantly better than the current one, or the current one."""
        if self.n_rows < MIN_ROWS or self.n_blocks > SEARCHED_BLOCKS:
            return delay
        solved = np.linalg.solve(self.information, self.vector)
        squares = np.maximum(self.square - (self.vector * solved).sum(axis=(1, 2)), 1e-12)
        best = int(np.argmin(squares))
        at_current = float(np.interp(delay, DELAYS_S, squares))
        is_significant = self.n_rows * math.log(at_current / squares[best]) > MIN_CHI2_GAIN * CORRELATED_ROWS
        return float(DELAYS_S[best]) if is_significant and abs(DELAYS_S[best] - delay) > STEP_S else delay


def _rows_at_delays(joined: JoinedBlocks, parameters: Parameters) -> tuple[Array, Array]:
    """Return the comparable references (J, 2) m/s, body, and the DVL's velocity and rates (K, J, 6) at every delay."""
    reference = joined.reference
    imu = joined.attitude_at(reference.times, parameters.imu_timeout)
    velocity, seen = joined.dvl_at(reference.times + DELAYS_S[:, None])
    known = seen.all(axis=0) & (imu.oriented | reference.in_body)
    known &= imu.rates_known & joined.measured[:, :2].all(axis=1)
    onto = np.where(reference.in_body[:, None, None], np.eye(3), imu.rotation.swapaxes(1, 2))
    body = product(onto, np.where(joined.measured, reference.velocity, 0.0))
    velocity = velocity[:, known]
    return body[known, :2], np.concatenate([velocity, np.broadcast_to(imu.rates[known], velocity.shape)], axis=2)
