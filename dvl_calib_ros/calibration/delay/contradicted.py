"""Samples of a slow DVL that are far off, left out before they bend the curve that references are held against.

Of a fast stream, neighbours tell a sample that is far off (spikes.py). Between the samples of a slow one a vehicle can
turn: there neighbours only raise a suspicion, and the references about it decide. Without a sample that is wrong they
fit much better, with whatever delay they are beside it; without one that is right they do not.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..numerics.frames import Array
from ..numerics.robust import robust_std
from ..numerics.samples import Index, Mask
from ..streams.interpolation import DvlColumns
from ..streams.outliers import beside, off_neighbours
from .rows import DelayedRows

# Scatter about what neighbours tell, from which on a sample is suspicious; less than so much is noise, m/s.
SUSPICIOUS, LEAST_SCATTER_MPS = 6.0, 0.03
# So many of them are looked at, those furthest off: a block of 10 s of a DVL that is wrong more often is lost anyway.
MOST = 8
# It is left out if by that the references' squared misfit falls below this share, and by more than noise can make it.
SHARE_LEFT, LEAST_GAIN = 0.8, 50.0
# Delays whose probability is smaller than that of the likeliest by more than this (logarithm) have no say.
UNLIKELY = 10.0
# A reference is beside a sample that is nearer than this, s: where the curve between samples is most of all that one.
BESIDE_S = 0.25


def without_contradicted(
    dvl: DvlColumns,
    reference_times: Array,
    rows_of: Callable[[DvlColumns], DelayedRows],
    misfits: Callable[[DelayedRows], tuple[Array, Array]],
    delays_s: Array,
) -> tuple[Mask, DelayedRows]:
    """Which DVL samples (N,) are not contradicted, and the references' rows by these.

    reference_times: (J,) s. rows_of: what references are beside some of the DVL's samples. misfits: as
    `DelayBank.misfits`; delays_s: (K,) of its hypotheses.
    """
    kept = np.arange(len(dvl.times))
    rows = rows_of(dvl)
    while len(rows):
        tried = []
        for at in _suspicious(dvl.velocity[kept]).tolist():
            without = np.delete(kept, at)
            fewer = rows_of(DvlColumns(*(column[without] for column in dvl)))
            share = _share_left(dvl.times[kept[at]], reference_times, rows, fewer, misfits, delays_s)
            tried.append((share, without, fewer))
        share, without, fewer = min(tried, key=lambda each: each[0], default=(1.0, kept, rows))
        if share > SHARE_LEFT:
            break
        kept, rows = without, fewer
    mask: Mask = np.zeros(len(dvl.times), dtype=bool)
    mask[kept] = True
    return mask, rows


def _share_left(
    sample_s: float,
    reference_times: Array,
    rows: DelayedRows,
    fewer: DelayedRows,
    misfits: Callable[[DelayedRows], tuple[Array, Array]],
    delays_s: Array,
) -> float:
    """What is left of the misfit without a sample, by the delay to which that matters least; 1 if it gains too little.

    A delay by which no reference is beside the sample cannot say that it is right.
    """
    both = rows.index[np.isin(rows.index, fewer.index)]
    if not len(both):
        return 1.0
    before, _ = misfits(rows.part(np.isin(rows.index, both)))
    after, log_share = misfits(fewer.part(np.isin(fewer.index, both)))
    distance = np.abs(reference_times[both][:, None] + delays_s - sample_s).min(axis=0)
    has_say = (log_share > log_share.max() - UNLIKELY) & (distance < BESIDE_S)
    if not has_say.any():
        return 1.0
    share = np.where(before - after > LEAST_GAIN, after / np.maximum(before, 1e-300), 1.0)
    return float(share[has_say].max())


def _suspicious(velocity: Array) -> Index:
    """Which samples of (N, 3) m/s are further from what neighbours tell than most, and than those beside them."""
    off = off_neighbours(velocity)
    far = (np.abs(off) / np.maximum(robust_std(off), LEAST_SCATTER_MPS)).max(axis=1)
    found = np.flatnonzero((far > SUSPICIOUS) & (far >= beside(far)))
    return found[np.argsort(-far[found], kind="stable")[:MOST]]
