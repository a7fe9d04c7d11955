"""What a bias of the DVL makes of states and their covariance: two estimates of one DVL share it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.frames import Array
from ..numerics.samples import Mask


class BiasCovariance(NamedTuple):
    """Of states (n,).

    columns: (n, 3), by how much states are off where the DVL is off by one σ along each of its axes: of its prior
    (`dvl_bias_std`) at one speed, of what is left of it where speeds show it.
    """

    columns: Array

    @property
    def covariance(self) -> Array:
        """(n, n), the part of P that would not be, were there no bias."""
        return np.asarray(self.columns @ self.columns.swapaxes(-1, -2))

    @staticmethod
    def none(n: int) -> BiasCovariance:
        """Of states (n,) that no bias reaches."""
        return BiasCovariance(np.zeros((n, 3)))

    def where(self, known: Mask) -> BiasCovariance:
        """Of those states (n,) alone that are known from data."""
        return BiasCovariance(np.where(known[:, None], self.columns, 0.0))
