"""Outliers of a stream: samples far from the value that their neighbours predict."""

from __future__ import annotations

import numpy as np

from ..numerics.frames import Array
from ..numerics.robust import FEWEST_VALUES, median, robust_std
from ..numerics.samples import Mask

# Deviation in robust σ from which a sample is an outlier; most passes, as outliers hide each other.
SPIKE, PASSES = 12.0, 6


def deviation_from_neighbours(values: Array) -> Array:
    """Return deviations (N, k) from the cubic through two neighbours on either side; 0 at the ends."""
    deviation = np.zeros_like(values)
    v = values
    deviation[2:-2] = v[2:-2] - (4.0 * (v[1:-3] + v[3:-1]) - v[:-4] - v[4:]) / 6.0
    return deviation


def neighbours(sizes: Array) -> Array:
    """Return the larger neighbour (N,) of each of (N,) non-negative sizes."""
    return np.maximum(np.append(sizes[1:], 0.0), np.append(0.0, sizes[:-1]))


def without_spikes(
    values: Array, relative_noise: Array | None = None, smallest: float = 1e-9, *, also_at_ends: bool = False
) -> Mask:
    """Return a mask (N,) of the samples that are no outliers.

    Parameters
    ----------
    values: (N, k), in order of time and about evenly spaced.
    relative_noise: (N, k) noise σ of each sample relative to the usual one; None if equal.
    smallest: Lower limit of the robust σ, in the unit of the values.
    also_at_ends: Also judge the first and last two samples, by the median of five; may reject good ones while the
        vehicle accelerates.
    """
    kept = np.arange(len(values))
    for _ in range(PASSES):
        if len(kept) < FEWEST_VALUES:
            break
        x = values[kept]
        noise = np.ones_like(x) if relative_noise is None else relative_noise[kept]
        deviation = deviation_from_neighbours(x) / noise
        scale = np.maximum(robust_std(deviation), smallest)
        if also_at_ends:
            deviation[:2], deviation[-2:] = (x[:2] - median(x[:5])), (x[-2:] - median(x[-5:]))
        far = (np.abs(deviation) / scale).max(axis=1)
        suspects = np.flatnonzero(far >= SPIKE)
        if not len(suspects):
            break
        # a good sample between two outliers deviates from them, but not from the median of five
        window = np.clip(suspects, 2, len(far) - 3)[:, None] + np.arange(-2, 3)
        from_median = np.abs(x[suspects] - median(x[window].swapaxes(0, 1))) / noise[suspects]
        far[suspects] = (np.minimum(np.abs(deviation[suspects]), from_median) / scale).max(axis=1)
        is_good = (far < SPIKE) | (far < neighbours(far))  # the neighbour of a larger outlier deviates because of it
        if is_good.all():
            break
        kept = kept[is_good]
    mask: Mask = np.zeros(len(values), dtype=bool)
    mask[kept] = True
    return mask
