"""Effect of a DVL bias on states and covariance, common to all estimates of the same DVL."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.frames import Array
from ..numerics.samples import Mask


class BiasCovariance(NamedTuple):
    """Effect of the DVL bias on states (n,).

    columns: (n, 3), change of the states per σ of the bias along each DVL axis: its prior σ (`dvl_bias_std`) at one
    speed, its estimated σ if several speeds make it observable.
    """

    columns: Array

    @property
    def covariance(self) -> Array:
        """Contribution (n, n) of the bias to P."""
        return np.asarray(self.columns @ self.columns.swapaxes(-1, -2))

    @staticmethod
    def none(n: int) -> BiasCovariance:
        """Return the effect on states (n,) that are independent of the bias."""
        return BiasCovariance(np.zeros((n, 3)))

    def where(self, known: Mask) -> BiasCovariance:
        """Return the effect on the states (n,) that are known from data."""
        return BiasCovariance(np.where(known[:, None], self.columns, 0.0))
