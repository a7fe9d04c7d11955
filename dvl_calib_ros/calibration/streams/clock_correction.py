"""Stamps of the three streams in one time: what the parameters say of each clock is taken off before pairing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ..models.parameters import Parameters
from ..numerics.samples import Stamps

SECOND_NS = 1_000_000_000
# A clock is wrong by up to `dvl_clock_drift` over as long as a run may last, for which pairing has to wait and remember
LONGEST_RUN_S = 3600.0
S = TypeVar("S", int, Stamps)


@dataclass(frozen=True)
class Clocks:
    """By how much the stamps of each stream are late.

    dvl_ns, reference_ns, imu_ns: constant offsets, ns. drift: of the DVL's clock, s/s since its first stamp. jump_ns:
    by how much the DVL's stamps are later still from its stamp jump_at_ns on.
    """

    dvl_ns: int = 0
    reference_ns: int = 0
    imu_ns: int = 0
    drift: float = 0.0
    jump_ns: int = 0
    jump_at_ns: int = 0

    @staticmethod
    def of(parameters: Parameters) -> Clocks:
        """As the parameters have it."""
        p = parameters
        return Clocks(
            round(p.dvl_time_offset * SECOND_NS),
            round(p.reference_time_offset * SECOND_NS),
            round(p.imu_time_offset * SECOND_NS),
            p.dvl_clock_drift,
            round(p.dvl_time_jump * SECOND_NS),
            round(p.dvl_time_jump_at * SECOND_NS),
        )

    def dvl(self, stamp_ns: S, first_ns: int) -> S:
        """True time (ns) of a DVL's stamp, or of stamps (N,). first_ns: the first stamp of the run."""
        true_ns = stamp_ns - self.dvl_ns
        if self.drift:
            late = self.drift * (stamp_ns - first_ns)
            true_ns = true_ns - (np.rint(late).astype(np.int64) if isinstance(late, np.ndarray) else round(late))
        if self.jump_ns:
            true_ns = true_ns - self.jump_ns * (stamp_ns >= self.jump_at_ns)
        return true_ns

    @property
    def spread_ns(self) -> int:
        """By how much a stream that arrives in time can seem to lag another once their stamps are put right."""
        drift_ns = round(self.drift * LONGEST_RUN_S * SECOND_NS)
        dvl = [self.dvl_ns + drift + jump for drift in (0, drift_ns) for jump in (0, self.jump_ns)]
        late = [*dvl, self.reference_ns, self.imu_ns]
        return max(late) - min(late)
