"""What a constant error of the DVL makes of what is found: how much of σ it is, and how far it takes the states.

A DVL has one bias, on one day as on the next. Estimates of two recordings are then off together: of a bias b of σ_b
along each axis by columns_1 b / σ_b and columns_2 b / σ_b, as far as their own speeds did not show it. Their difference
has the variance P_1 + P_2 - columns_1 columns_2ᵀ - columns_2 columns_1ᵀ, which at one speed is without the bias.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .numerics.frames import Array
from .numerics.kalman import GaussianState
from .numerics.samples import Mask


class OfBias(NamedTuple):
    """Of states (..., n).

    columns: (..., n, 3), by how much states are off where the DVL is off by one σ along each of its axes: of its prior
    (`dvl_bias_std`) at one speed, of what is left of it where speeds show it.
    """

    columns: Array

    @property
    def covariance(self) -> Array:
        """(..., n, n), the part of P that would not be, were there no bias."""
        return np.asarray(self.columns @ self.columns.swapaxes(-1, -2))

    @staticmethod
    def none(*shape: int) -> OfBias:
        """Of states (..., n) = shape that no bias reaches."""
        return OfBias(np.zeros((*shape, 3)))

    def at(self, index: int | slice) -> OfBias:
        """Of some of several."""
        return OfBias(self.columns[index])

    def mixed(self, share: Array) -> OfBias:
        """Of the mean of M, each with a share (M,)."""
        return OfBias(np.tensordot(share, self.columns, axes=1))

    def where(self, known: Mask) -> OfBias:
        """Of those states (n,) alone that are known from data."""
        return OfBias(np.where(known[:, None], self.columns, 0.0))

    def added_to(self, state: GaussianState) -> GaussianState:
        """The state x (n,), P (n, n) of a DVL that may be off so far."""
        return GaussianState(state.x, state.p + self.covariance) if self.columns.any() else state
