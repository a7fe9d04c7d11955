"""What a constant error of the DVL makes of what is found: how much of σ it is, and how far it takes the states.

A DVL has one bias, on one day as on the next. Estimates of two recordings are then off together: of a bias b of σ_b
along each axis by columns_1 b / σ_b and columns_2 b / σ_b, as far as their own speeds did not show it. Their difference
has the variance P_1 + P_2 - columns_1 columns_2ᵀ - columns_2 columns_1ᵀ, which at one speed is without the bias.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .frames import Array
from .samples import Mask


class OfBias(NamedTuple):
    """Of states (..., n).

    covariance: (..., n, n), the part of P that would not be, were the bias known. columns: (..., n, 3), by how much
    states are off where the DVL is off by one σ of its prior (`dvl_bias_std`) along each of its axes.
    """

    covariance: Array
    columns: Array

    @staticmethod
    def none(*shape: int) -> OfBias:
        """Of states (..., n) = shape that no bias reaches."""
        return OfBias(np.zeros((*shape, shape[-1])), np.zeros((*shape, 3)))

    def at(self, index: int | slice) -> OfBias:
        """Of some of several."""
        return OfBias(self.covariance[index], self.columns[index])

    def raised(self, factor: Array) -> OfBias:
        """With each standard deviation times a factor (n,)."""
        return OfBias(self.covariance * (factor[:, None] * factor), self.columns * factor[:, None])

    def mixed(self, share: Array) -> OfBias:
        """Of the mean of M, each with a share (M,)."""
        return OfBias(np.tensordot(share, self.covariance, axes=1), np.tensordot(share, self.columns, axes=1))

    def where(self, known: Mask) -> OfBias:
        """Of those states (n,) alone that are known from data."""
        return OfBias(
            np.where(np.outer(known, known), self.covariance, 0.0), np.where(known[:, None], self.columns, 0.0)
        )
