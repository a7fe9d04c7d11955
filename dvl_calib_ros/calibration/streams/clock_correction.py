"""Clock correction: configured delays of all streams are subtracted from the stamps before pairing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ..models.parameters import Parameters
from ..numerics.samples import Stamps

SECOND_NS = 1_000_000_000
# Longest run (s) over which the DVL clock drifts; pairing must wait and store this much
LONGEST_RUN_S = 3600.0
S = TypeVar("S", int, Stamps)


@dataclass(frozen=True)
class Clocks:
    """Configured delays of the stamps.

    dvl_ns, reference_ns, imu_ns: constant offsets, ns.
    drift: of the DVL clock, s/s since its first stamp.
    jump_ns: additional delay of DVL stamps from stamp jump_at_ns on.
    """

    dvl_ns: int = 0
    reference_ns: int = 0
    imu_ns: int = 0
    drift: float = 0.0
    jump_ns: int = 0
    jump_at_ns: int = 0

    @staticmethod
    def of(parameters: Parameters) -> Clocks:
        """Return the delays of the parameters."""
        return Clocks(
            round(parameters.dvl_time_offset * SECOND_NS), round(parameters.reference_time_offset * SECOND_NS),
            round(parameters.imu_time_offset * SECOND_NS), parameters.dvl_clock_drift,
            round(parameters.dvl_time_jump * SECOND_NS), round(parameters.dvl_time_jump_at * SECOND_NS),
        )  # fmt: skip

    def dvl(self, stamp_ns: S, first_ns: int) -> S:
        """Return the true time (ns) of a DVL stamp, or of stamps (N,). first_ns: first stamp of the run."""
        true_ns = stamp_ns - self.dvl_ns
        if self.drift:
            drift = self.drift * (stamp_ns - first_ns)
            true_ns = true_ns - (np.rint(drift).astype(np.int64) if isinstance(drift, np.ndarray) else round(drift))
        if self.jump_ns:
            true_ns = true_ns - self.jump_ns * (stamp_ns >= self.jump_at_ns)
        return true_ns

    @property
    def spread_ns(self) -> int:
        """Largest lag between two simultaneous streams after the correction, ns."""
        drift_ns = round(self.drift * LONGEST_RUN_S * SECOND_NS)
        dvl = [self.dvl_ns + drift + jump for drift in (0, drift_ns) for jump in (0, self.jump_ns)]
        delays = [*dvl, self.reference_ns, self.imu_ns]
        return max(delays) - min(delays)
