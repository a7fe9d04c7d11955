"""The recent past of the reference: its velocities less a constant error, and which axes it does not measure."""

from __future__ import annotations

import numpy as np

from .models.parameters import XY, XYZ, Parameters
from .numerics.frames import Array
from .numerics.samples import FRAMES, Codes, Mask, Stamps, VelocityFrame
from .screening import VERTICAL
from .streams import Track


class ReferenceTrack(Track):
    """A `Track` of reference samples. vertical_seen: whether one of them had a vertical velocity."""

    def __init__(self, parameters: Parameters, max_gap_ns: int, max_latency_ns: int, retention_ns: int) -> None:
        """As `Track`."""
        super().__init__(max_gap_ns, max_latency_ns, retention_ns)
        self.vertical_seen = False
        east, north = parameters.reference_velocity_offset
        offsets = {VelocityFrame.ENU: (east, north, 0.0), VelocityFrame.NED: (north, east, 0.0)}
        self._velocity_offset = np.array([offsets.get(frame, (0.0, 0.0, 0.0)) for frame in FRAMES])

    def append(
        self,
        stamps_ns: Stamps | int,
        values: Array,
        frames: Codes,
        unmeasured: Codes | int,
        late: Mask | bool,
        gnss_axes: str,
    ) -> int:
        """Put samples (N,) on the track, values (N, 12); the slot of the first. gnss_axes: as the parameter."""
        slots = self.extend(len(frames))
        self.stamps_ns[slots], self.late[slots], self.frames[slots] = stamps_ns, late, frames
        vertical = np.logical_or.accumulate(values[:, 2] != 0.0) | self.vertical_seen
        self.vertical_seen = bool(vertical[-1])
        self.values[slots] = values
        self.values[slots, :3] -= self._velocity_offset[frames]
        never = np.where(vertical, _never_measured(gnss_axes, True), _never_measured(gnss_axes, False))
        self.unmeasured[slots] = unmeasured | never.astype(np.uint8)
        return slots.start


def _never_measured(gnss_axes: str, vertical_seen: bool) -> int:
    """The axes, as bits, that are not measured whatever the covariances say."""
    return 0 if gnss_axes == XYZ or (vertical_seen and gnss_axes != XY) else VERTICAL
