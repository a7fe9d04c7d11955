"""A block of time of all streams, copied from what the aligner holds: what G2 is solved by, in whatever thread."""

from __future__ import annotations

from typing import NamedTuple

from ..numerics.frames import Array
from ..numerics.samples import Codes, Index, Stamps
from ..streams.interpolation import MARGIN_S

MARGIN_NS = round(MARGIN_S * 1e9)


class DvlSamples(NamedTuple):
    """stamps_ns (N,), velocity (N, 3) m/s and covariance (N, 3, 3) (m/s)², nan where not given; DVL frame."""

    stamps_ns: Stamps
    velocity: Array
    covariance: Array


class ReferenceSamples(NamedTuple):
    """stamps_ns (J,), values (J, 12), frames (J,) and unmeasured (J,), as in `Track`."""

    stamps_ns: Stamps
    values: Array
    frames: Codes
    unmeasured: Codes

    def part(self, at: Index) -> ReferenceSamples:
        """Some of them."""
        return ReferenceSamples(self.stamps_ns[at], self.values[at], self.frames[at], self.unmeasured[at])


class ImuSamples(NamedTuple):
    """stamps_ns (M,) and values (M, 12), as in `Track`."""

    stamps_ns: Stamps
    values: Array


class Block(NamedTuple):
    """All streams from MARGIN_NS before from_ns until MARGIN_NS behind end_ns, copied.

    new_days: how many days begin with it. silent: the DVL stops behind it for so long that tracks forget what was
    before.
    """

    from_ns: int
    end_ns: int
    new_days: int
    silent: bool
    dvl: DvlSamples
    reference: ReferenceSamples
    imu: ImuSamples
