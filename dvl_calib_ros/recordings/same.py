"""Whether two recordings are one by two names, or one a part of the other."""

from __future__ import annotations

import numpy as np

from ..calibration.frames import Array
from ..calibration.samples import Stamps
from .recorded import Recorded


def hold_the_same(one: Recorded, other: Recorded) -> bool:
    """Whether half of the DVL's velocities of one recording are in the other too, at the same stamps."""
    (stamps, values), (its_stamps, its_values) = _velocities(one), _velocities(other)
    if not len(stamps) or not len(its_stamps):
        return False
    at = np.minimum(np.searchsorted(its_stamps, stamps), len(its_stamps) - 1)
    same = (its_stamps[at] == stamps) & (its_values[at] == values).all(axis=1)
    return bool(2 * np.count_nonzero(same) > min(len(stamps), len(its_stamps)))


def _velocities(topic: Recorded) -> tuple[Stamps, Array]:
    """(N,) stamps in order and (N, 3) velocities, of each stamp the first."""
    kept = np.flatnonzero(np.isfinite(topic.values).all(axis=1))
    stamps = np.where(topic.stamps_ns == 0, topic.log_ns, topic.stamps_ns)[kept]
    order = np.argsort(stamps, kind="stable")
    first = np.concatenate([[True], np.diff(stamps[order]) > 0])[: len(order)]
    return stamps[order][first], topic.values[kept[order][first]]
