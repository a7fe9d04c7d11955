"""The tables of the alignment: the rows that it makes, and a stretch of columns on the way there."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import ClassVar, NamedTuple

import numpy as np

from .frames import Array
from .samples import AlignedBlock, Codes, Index, Mask, Pairing, Stamps, Streams, Verdict
from .streams import LONG_AGO_NS, Admitted
from .tables import Table


class Rows(Table):
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
        self.verdict[at] = Verdict.AWAITING
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


class ScreenedStreams(NamedTuple):
    """Columns of all streams; which rows are valid, and what is made of them."""

    streams: Streams
    dvl: Mask
    reference: Mask
    imu: Mask
    dvl_covariance: Array
    reference_values: Array
    reference_unmeasured: Codes
    imu_values: Array


class OrderedStreams(NamedTuple):
    """Of every stream what is let through: places in its block, and stamps (the DVL's compensated)."""

    dvl: Admitted
    dvl_at: Index
    dvl_ns: Stamps
    reference: Admitted
    reference_at: Index
    reference_ns: Stamps
    imu: Admitted
    imu_at: Index
    imu_ns: Stamps
    frames: Codes


class Decisions(NamedTuple):
    """Events at which rows are decided: those to orient, those to pair (with their stamps), in order."""

    oriented_at: Index
    paired_at: Index
    stamps_ns: Stamps


NO_DECISIONS = Decisions(*(np.zeros(0, dtype=kind) for kind in (np.intp, np.intp, np.int64)))


class Events(NamedTuple):
    """The T admitted samples in their order of arrival: at which events those of each stream are, and what is known
    after each event: newest stamps of reference and IMU (`LONG_AGO_NS`: none), and the horizon, see
    `Aligner.horizon_ns`."""

    arrival: Stamps
    dvl_at: Index
    reference_at: Index
    imu_at: Index
    reference_ns: Stamps
    imu_ns: Stamps
    horizon_ns: Stamps

    @staticmethod
    def of(
        arrivals: tuple[Stamps, Stamps, Stamps],
        stamps_ns: tuple[Stamps, Stamps, Stamps],
        before_ns: tuple[int | None, int | None, int | None],
        max_jump_ns: int,
    ) -> Events:
        """Each of DVL, reference, IMU."""
        arrival = np.concatenate(arrivals)
        order = np.argsort(arrival, kind="stable")
        at = np.empty(len(order), dtype=np.intp)
        at[order] = np.arange(len(order))
        first, second = len(arrivals[0]), len(arrivals[0]) + len(arrivals[1])
        places = at[:first], at[first:second], at[second:]
        newest = []
        for place, stamps, before in zip(places, stamps_ns, before_ns, strict=True):
            column = np.full(len(order), LONG_AGO_NS if before is None else before, dtype=np.int64)
            column[place] = stamps
            newest.append(np.maximum.accumulate(column))
        dvl_ns = np.maximum(newest[0], 0)
        horizon_ns = dvl_ns
        for track_ns in newest[1:]:
            ahead = (track_ns > dvl_ns) & (track_ns <= dvl_ns + max_jump_ns)
            horizon_ns = np.maximum(horizon_ns, np.where(ahead, track_ns, dvl_ns))
        return Events(arrival[order], *places, newest[1], newest[2], horizon_ns)
