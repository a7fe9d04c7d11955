"""Which stamps are far from the others', by when messages arrived: for what a registration cannot see.

Where velocities and turns show how the clocks stand, it does not matter when messages came. Where they do not, stamps
that differ by more than any delay that is looked for pair velocities of other times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ..models.parameters import Parameters
from ..numerics.samples import Stream
from ..streams.interpolation import LONGEST_DELAY_S


class Apart(NamedTuple):
    """Stamps of a stream are ahead of those of the other by so many s beyond what the parameters take off."""

    stream: Stream
    other: Stream
    ahead: float

    @property
    def side(self) -> str:
        """In words."""
        return "ahead of" if self.ahead > 0.0 else "behind"


def limit_s(parameters: Parameters) -> float:
    """Clocks that differ by less are for the calibration to find, s."""
    return LONGEST_DELAY_S + parameters.position_window


def apart(ahead: Mapping[Stream, float], parameters: Parameters, late_s: float = 0.0) -> list[Apart]:
    """Streams by another clock than the rest.

    ahead: of each stream, the DVL first, how far its stamps are ahead of its messages' arrival, s, beside any common
    time. late_s: by how much that may be wrong.
    """
    offsets = {
        Stream.DVL: parameters.dvl_time_offset,
        Stream.REFERENCE: parameters.reference_time_offset,
        Stream.IMU: parameters.imu_time_offset,
    }
    corrected = {stream: seconds - offsets[stream] for stream, seconds in ahead.items()}
    if len(corrected) < 2:
        return []
    # beside the DVL's, unless of three that is the one that is alone
    other = next(iter(corrected))
    if len(corrected) > 2:
        middle = sorted(corrected.values())[1]
        if abs(corrected[other] - middle) > limit_s(parameters):
            other = min(corrected, key=lambda stream: abs(corrected[stream] - middle))
    found = (Apart(stream, other, corrected[stream] - corrected[other]) for stream in corrected if stream is not other)
    # samples that are old when they are stamped arrive by neither clock's fault
    return [
        each
        for each in found
        if min(abs(each.ahead), abs(ahead[each.stream] - ahead[other])) - late_s > limit_s(parameters)
    ]
