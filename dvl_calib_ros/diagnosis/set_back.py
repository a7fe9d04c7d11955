"""Where the DVL's clock was set back, by its stamps alone: some were given twice, or what came then was thrown away."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..calibration.numerics.frames import Array

# Two steps of a stream are one where it is stamped twice: shorter than so many usual steps, so many times running
TWO_STEPS, FEWEST = 1.25, 4
# In order of stamps its samples go to and fro between two times, by so many times what they do elsewhere; where they
# do not, the mixture is as good as either
TO_AND_FRO = 2.0
# A step that differs from the usual one by a share of it tells of a clock, where so many do at most: by so many times
# how steps scatter, within these
RARE, REGULAR, FAR = 3, (0.03, 0.1), 8.0
# Of two samples nearer than this share of the usual step, measured a while apart, a curve through both would ring
TOO_SHORT = 0.5
# By as much at most, s, is a clock set back of which the stamps do not tell by how much; and of which they do
UP_TO_S, LONGEST_S = 2.0, 5.0


class SetBack(NamedTuple):
    """before, after: stamps (s) between which a clock was set back. by: s; how much at most, where it is not known."""

    before: float
    after: float
    by: float


def set_back(time: Array, velocity: Array) -> tuple[tuple[SetBack, ...], NDArray[np.bool_]]:
    """Where a clock was set back, and which samples (N,) are to be kept: stamped in a time that was stamped once.

    time: (N,) s, stamps in order. velocity: (N, 3) m/s, of the same samples. A clock that is set back by two seconds
    stamps two seconds once more; or a driver that wants stamps in order throws two seconds away, which leaves one step
    that is short, of which one sample at most is kept. A DVL that pings faster for a while has short steps as well, but
    for longer, and its velocity goes on as smoothly.
    """
    once = np.ones(len(time), dtype=bool)
    if len(time) < 4 * FEWEST:
        return (), once
    steps = np.diff(time)
    usual = float(np.median(steps))
    crowded = time[2:] - time[:-2] < TWO_STEPS * usual
    bent = np.linalg.norm(velocity[1:-1] - 0.5 * (velocity[:-2] + velocity[2:]), axis=1)
    found = []
    for first, behind in np.flatnonzero(np.diff(np.pad(crowded, 1).astype(int))).reshape(-1, 2).tolist():
        inside = float(time[behind + 1] - time[first])
        is_mixed = np.median(bent[first:behind]) > TO_AND_FRO * np.median(bent)
        if behind - first >= FEWEST and inside < LONGEST_S and is_mixed:
            once[first : behind + 2] = False
            found.append(SetBack(float(time[first]), float(time[behind + 1]), inside))
    apart = np.abs(steps - usual) / usual
    odd = np.flatnonzero(apart > np.clip(FAR * np.median(apart), *REGULAR))
    short = odd[steps[odd] < usual]
    if not found and len(short) > 0 and len(odd) <= RARE:
        found = [SetBack(float(time[at]), float(time[at + 1]), UP_TO_S) for at in short.tolist()]
        once[short[steps[short] < TOO_SHORT * usual] + 1] = False
    return tuple(found), once
