"""The table that an alignment makes."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import ClassVar

import numpy as np

from .numerics.frames import Array
from .numerics.samples import AlignedBlock, Codes, Mask, Pairing, SampleUse, Stamps
from .numerics.tables import RowTable


class Rows(RowTable):
    """The columns of `AlignedBlock` as they come to be known."""

    LAYOUT: ClassVar = {
        "stamps_ns": (np.int64, ()),
        "row": (np.int64, ()),
        "velocity_dvl": (np.float64, (3,)),
        "covariance": (np.float64, (3, 3)),
        "interval_ns": (np.int64, ()),
        "verdict": (np.uint8, ()),
        "prior_known": (np.bool_, ()),
        "attitude": (np.float64, (7,)),
        "pairing": (np.uint8, ()),
        "reference": (np.float64, (12,)),
        "frames": (np.uint8, ()),
        "unmeasured": (np.uint8, ()),
        "weight": (np.float64, ()),
        "late": (np.bool_, ()),
    }
    stamps_ns: Stamps
    row: Stamps
    velocity_dvl: Array
    covariance: Array
    interval_ns: Stamps
    verdict: Codes
    prior_known: Mask
    attitude: Array
    pairing: Codes
    reference: Array
    frames: Codes
    unmeasured: Codes
    weight: Array
    late: Mask

    def await_partners(self, at: int | slice) -> None:
        """Fill in what is not known yet."""
        self.verdict[at] = SampleUse.AWAITING
        self.prior_known[at] = False
        self.attitude[at] = math.nan
        self.pairing[at] = Pairing.AWAITING
        self.reference[at] = math.nan
        self.frames[at] = self.unmeasured[at] = 0
        self.weight[at] = 1.0

    def block(self, first: int, end: int) -> AlignedBlock:
        """The rows with these numbers, as long as nothing is added."""
        at = slice(first - self.base, end - self.base)
        return AlignedBlock(*[getattr(self, name)[at] for name in _COLUMNS])


_COLUMNS = [each.name for each in fields(AlignedBlock)]
