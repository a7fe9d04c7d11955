"""Which clock is late: the DVL's, the reference's, or the IMU's. G2 takes it to be the DVL's, and is told otherwise.

Where the reference is stamped late, attitude and angular velocity of the wrong time turn its velocity by ω ρ, which a
lever arm of ρ u explains almost as well: so what G2 has kept of each day is registered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import numpy as np

from ..parameters import Parameters
from ..register.motion import Motion, make_motion
from ..register.registration import Registration, register
from .hold_out import MEASURED_BELOW, Kept, Recording

# Live, what was found stands until so much more is there.
AGAIN_FROM = 1.5
# Fewer blocks tell nothing, and live there is no look before a minute; of more the oldest are forgotten.
ENOUGH, FIRST_LOOK, MOST = 2, 6, 720


class KeptClocks:
    """What registration says of the clocks, of the days that are over and of this one."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._kept: deque[Kept] = deque(maxlen=MOST)
        self._blocks = 0  # of this day
        self._over: Registration | None = None  # of a day that is over, where a clock was off
        self._latest: tuple[int, Registration | None] = (0, None)

    def add(self, kept: Kept) -> None:
        """Take a block's streams."""
        self._kept.append(kept)
        self._blocks += 1

    def end_day(self) -> None:
        """The blocks from here on are of another day, whose clocks may be others."""
        found = self.registration()
        self._over = found if found is not None and found.says(self._parameters) else None
        self._kept.clear()
        self._blocks, self._latest = 0, (0, None)

    def look_again(self) -> None:
        """Look at the clocks if there is so much more to see than the last time."""
        if self._over is None and self._blocks >= max(AGAIN_FROM * self._latest[0], FIRST_LOOK):
            self._latest = self._blocks, self._registered()

    def registration(self, *, fresh: bool = True) -> Registration | None:
        """How the instruments stand by the blocks so far, or on a day that is over, where a clock was off.

        fresh: by all of them, else by those there were when `look_again` looked.
        """
        if self._over is not None:
            return self._over
        if fresh and self._blocks > self._latest[0]:
            self._latest = self._blocks, self._registered()
        return self._latest[1]

    def says(self, *, fresh: bool = True) -> str:
        """What configuration these blocks fit, in words, where a clock is off; else ''."""
        found = self.registration(fresh=fresh)
        return "" if found is None else found.says(self._parameters)

    def _registered(self) -> Registration | None:
        motion = _motion(self._kept) if len(self._kept) >= ENOUGH else None
        if motion is None:
            return None
        try:
            return register(motion, self._parameters.rotation_dvl_from_body.T, np.array(self._parameters.lever_arm))
        except np.linalg.LinAlgError:  # numbers that ran away
            return None


def _motion(kept: Collection[Kept]) -> Motion | None:
    recording = Recording.of(list(kept))
    in_body = recording.reference.in_body
    alike = in_body == (2 * np.count_nonzero(in_body) > len(in_body))
    variance = np.diagonal(recording.reference.noise[alike], axis1=1, axis2=2)
    x, y, z = (2 * np.count_nonzero(variance < MEASURED_BELOW, axis=0) > len(variance)).tolist()
    return make_motion(
        (recording.dvl.times, recording.dvl.velocity),
        (recording.reference.times[alike], recording.reference.velocity[alike]),
        not bool(in_body[alike].all()) if alike.any() else False,
        (x, y, z),
        recording.imu,
    )
