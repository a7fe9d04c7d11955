"""Which clock is late: the DVL's, the reference's, or the IMU's. G2 takes it to be the DVL's, and is told otherwise.

Where the reference is stamped late, attitude and angular velocity of the wrong time turn its velocity by ω ρ, which a
lever arm of ρ u explains almost as well: so what G2 has kept of each day is registered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..frames import Array
from ..parameters import Parameters
from ..register.configuration import fitting_configuration
from ..register.motion import Motion, make_motion
from ..register.registration import Registration, register
from ..samples import FRAMES, Codes, Mask
from .hold_out import MEASURED_BELOW, Kept
from .rows import ImuColumns

# Live, what was found stands until so much more is there.
AGAIN_FROM = 1.5
# Fewer blocks tell nothing, and live there is no look before a minute. Of more, which are 40 minutes, the oldest are
# forgotten: no more rows are looked at than a third of these have, and a node's memory is to be flat.
ENOUGH, FIRST_LOOK, MOST = 2, 6, 240


class _Seen(NamedTuple):
    """What is registered of a block: times (N,) s and velocities (N, 3) of the DVL; of M references the same, whether
    they are in the body (M,) and which axes they measure (M, 3); times, attitudes and rates of the IMU."""

    dvl_times: Array
    dvl_velocity: Array
    times: Array
    velocity: Array
    in_body: Mask
    is_measured: NDArray[np.bool_]
    imu_times: Array
    orientation: Array
    angular_velocity: Array

    @staticmethod
    def of(kept: Kept) -> _Seen:
        """What is kept of a block, without what is of no use here: covariances alone are half of it."""
        r = kept.reference
        is_measured = np.diagonal(r.noise, axis1=1, axis2=2) < MEASURED_BELOW
        return _Seen(*kept.dvl, r.times, r.velocity, r.in_body, is_measured, *kept.imu)


class Looked(NamedTuple):
    """After so many blocks: how the instruments stand, and what configuration fits where the one given does not."""

    blocks: int = 0
    registration: Registration | None = None
    configuration: str = ""


class KeptClocks:
    """What registration says of clocks and frames, of the days that are over and of this one."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._seen: deque[_Seen] = deque(maxlen=MOST)
        self._blocks = 0  # of this day
        self._declared = np.zeros(len(FRAMES), dtype=np.int64)  # references said to be in each frame
        self._over: Looked | None = None  # of a day that is over, where something was off
        self._latest = Looked()

    def add(self, kept: Kept, frames: Codes) -> None:
        """Take a block's streams. frames: (J,) codes of the frames that its references are said to be in."""
        self._seen.append(_Seen.of(kept))
        self._declared += np.bincount(frames, minlength=len(FRAMES))
        self._blocks += 1

    def end_day(self) -> None:
        """The blocks from here on are of another day, whose clocks may be others."""
        found = self.looked()
        self._over = found if found.configuration or self._says(found) else None
        self._seen.clear()
        self._blocks, self._latest = 0, Looked()

    def look_again(self) -> None:
        """Look if there is so much more to see than the last time."""
        if self._over is None and self._blocks >= max(AGAIN_FROM * self._latest.blocks, FIRST_LOOK):
            self._latest = self._look()

    def looked(self, *, fresh: bool = True) -> Looked:
        """What the blocks so far show, or a day that is over, where something was off.

        fresh: all of them, else those there were when `look_again` looked.
        """
        if self._over is not None:
            return self._over
        if fresh and self._blocks > self._latest.blocks:
            self._latest = self._look()
        return self._latest

    def says(self, *, fresh: bool = True) -> str:
        """What clocks these blocks fit, in words, where one is off; else ''."""
        return self._says(self.looked(fresh=fresh))

    def _says(self, looked: Looked) -> str:
        return "" if looked.registration is None else looked.registration.says(self._parameters)

    def _look(self) -> Looked:
        motion = _motion(tuple(self._seen)) if len(self._seen) >= ENOUGH else None
        if motion is None:
            return Looked(self._blocks)
        nominal, lever_arm = self._parameters.rotation_dvl_from_body.T, np.array(self._parameters.lever_arm)
        declared = FRAMES[int(self._declared.argmax())]
        try:
            found = register(motion, nominal, lever_arm)
            return Looked(self._blocks, found, fitting_configuration(motion, declared, nominal, lever_arm, found))
        except np.linalg.LinAlgError:  # numbers that ran away
            return Looked(self._blocks)


def _motion(seen: Sequence[_Seen]) -> Motion | None:
    dvl_times, velocity, times, reference, in_body, is_measured, *imu = map(np.concatenate, zip(*seen, strict=True))
    alike = in_body == (2 * np.count_nonzero(in_body) > len(in_body))
    x, y, z = (2 * np.count_nonzero(is_measured[alike], axis=0) > np.count_nonzero(alike)).tolist()
    return make_motion(
        (dvl_times, velocity),
        (times[alike], reference[alike]),
        not bool(in_body[alike].all()) if alike.any() else False,
        (x, y, z),
        ImuColumns(*imu),
    )
