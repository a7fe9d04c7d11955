"""Samples of a stream that are far from where their neighbours tell them to be."""

from __future__ import annotations

import numpy as np

from ..numerics.frames import Array
from ..numerics.robust import median, robust_std
from ..numerics.samples import Mask

# Scatter about what neighbours tell, beyond which a sample is a spike; passes in which those beside others come out.
SPIKE, PASSES = 12.0, 6
# Fewer samples tell no scatter.
FEWEST = 10


def deviation_from_neighbours(values: Array) -> Array:
    """(N, k) how far samples are from the cubic through two neighbours on either side; 0 at the ends."""
    off = np.zeros_like(values)
    x = values
    off[2:-2] = x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6.0
    return off


def neighbours(sizes: Array) -> Array:
    """(N,) the larger of the two neighbours of each of (N,), which are not negative."""
    return np.maximum(np.append(sizes[1:], 0.0), np.append(0.0, sizes[:-1]))


def without_spikes(
    values: Array, loudness: Array | None = None, smallest: float = 1e-9, *, also_at_ends: bool = False
) -> Mask:
    """Which samples (N,) are none.

    Parameters
    ----------
    values: (N, k), in order of time and about evenly spaced.
    loudness: (N, k) standard deviation of each sample's noise over that of the usual one; None where all are alike.
    smallest: No scatter is taken to be less, in the unit of the values.
    also_at_ends: Judge the first two and the last two as well, by the median of the five there; at the cost of one that
        is good where the vehicle speeds up.

    """
    kept = np.arange(len(values))
    for _ in range(PASSES):
        if len(kept) < FEWEST:
            break
        x = values[kept]
        loud = np.ones_like(x) if loudness is None else loudness[kept]
        off = deviation_from_neighbours(x) / loud
        scale = np.maximum(robust_std(off), smallest)
        if also_at_ends:
            off[:2], off[-2:] = (x[:2] - median(x[:5])), (x[-2:] - median(x[-5:]))
        far = (np.abs(off) / scale).max(axis=1)
        at = np.flatnonzero(far >= SPIKE)
        if not len(at):
            break
        # the good one between two spikes is far from where these tell it to be, and among the five about it
        about = np.clip(at, 2, len(far) - 3)[:, None] + np.arange(-2, 3)
        alone = np.abs(x[at] - median(x[about].swapaxes(0, 1))) / loud[at]
        far[at] = (np.minimum(np.abs(off[at]), alone) / scale).max(axis=1)
        good = (far < SPIKE) | (far < neighbours(far))  # what a spike does to its neighbours is not theirs
        if good.all():
            break
        kept = kept[good]
    mask: Mask = np.zeros(len(values), dtype=bool)
    mask[kept] = True
    return mask
