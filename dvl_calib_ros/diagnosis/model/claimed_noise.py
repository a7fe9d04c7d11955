"""Dependence of each sample's noise on its reported standard deviation.

Receivers switch between fixed and float solutions and DVLs report ping quality, so reported covariances differ between
samples. The data determine the overall noise; the reported values may determine the relative weights. The exponent of
the reported values is estimated: 1 if they are valid, 0 if uninformative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import normal_isf
from ...calibration.numerics.frames import Array
from .settings import SETTINGS

# Largest exponent: if standard deviations are written as variances, the reported values are square roots
MAX_EXPONENT = 2.0
# Bound of the log noise level about its mean, so that one sample with a wrong claim does not decide alone
MAX_LOG_LEVEL = 4.0
# Least standard deviation of the logarithm of reported values that is informative
MIN_LOG_STD = 0.05


@dataclass(frozen=True)
class Exponents:
    """Exponents (c,) of reported values and their standard deviations, by name of the stream."""

    names: tuple[str, ...]
    exponents: Array
    stds: Array

    @property
    def is_significant(self) -> NDArray[np.bool_]:
        """Return (c,) whether the noise depends significantly on the reported value."""
        return np.asarray(self.exponents > normal_isf(SETTINGS.robust_level) * self.stds)


def is_informative(log_claims: Array) -> bool:
    """Return whether reported values (M, A) are informative."""
    return bool(np.max(np.std(log_claims, axis=0), initial=0.0) > MIN_LOG_STD)


def exponents(names: Sequence[str], log_claims: Array, values: Array, stretch: NDArray[np.intp]) -> Exponents:
    """Fit log squares of values (M, A) to reported values (M, A, c), each axis about its own mean.

    Parameters
    ----------
    names: Of the c streams.
    log_claims: Logarithms of standard deviations.
    values: Noise, white; of any size.
    stretch: (M,) index of stretches of time, by whose scatter the fit is judged.
    """
    y = np.log(np.maximum(values**2, 1e-12 * np.median(values**2) + 1e-300))
    y = y - y.mean(axis=0)
    x = log_claims - log_claims.mean(axis=0)
    inverse = np.linalg.pinv(np.einsum("mac,mad->cd", x, x))
    slopes = inverse @ np.einsum("mac,ma->c", x, y)
    scores = np.einsum("mac,ma->mc", x, y - x @ slopes)
    _, number = np.unique(stretch, return_inverse=True)  # a pause has no stretches
    sums = np.stack([np.bincount(number, column) for column in scores.T], axis=1)
    n = len(sums)
    covariance = inverse @ (sums.T @ sums) @ inverse * n / max(n - len(slopes) - 1, 1)
    return Exponents(tuple(names), 0.5 * slopes, 0.5 * np.sqrt(np.maximum(np.diag(covariance), 1e-300)))


def relative_std(log_claims: Array, values: Array, names: Sequence[str], stretch: NDArray[np.intp]) -> Array:
    """Return relative standard deviations (M, A) of values (M, A), if significant, from reported ones (M, A, c)."""
    kept = list(range(log_claims.shape[2]))
    while kept:
        found = exponents([names[each] for each in kept], log_claims[:, :, kept], values, stretch)
        if found.is_significant.all():
            logarithm = (log_claims - log_claims.mean(axis=0))[:, :, kept] @ np.minimum(found.exponents, MAX_EXPONENT)
            return np.asarray(np.exp(np.clip(logarithm, -MAX_LOG_LEVEL, MAX_LOG_LEVEL)))
        kept.pop(int(np.argmin(found.exponents / found.stds)))
    return np.ones(values.shape)


# ------------------------------------------------------------------ of one stream


def relative_noise(time: Array, sample_std: Array | None, differences: Array, weights: Array) -> Array:
    """Return the relative standard deviation (N, k) of a stream's samples, as far as reported values predict it.

    Parameters
    ----------
    time: (N,) s.
    sample_std: (N, k) standard deviations, None without.
    differences: (N - w + 1, k) of w neighbours, free of motion.
    weights: (w,) of the neighbours in these.
    """
    shape = len(time), differences.shape[1]
    if sample_std is None or len(differences) < len(weights) or not is_informative(np.log(sample_std)):
        return np.ones(shape)
    variance = np.stack([np.convolve(column, weights**2, "valid") for column in (sample_std**2).T], axis=1)
    middle = time[len(weights) // 2 :][: len(differences)]
    stretch = np.floor((middle - middle[0]) / SETTINGS.block).astype(np.intp)
    found = exponents(["own"], 0.5 * np.log(variance)[:, :, None], differences, stretch)
    if not found.is_significant.all():
        return np.ones(shape)
    median = np.median(sample_std, axis=0)
    return np.asarray((sample_std / median) ** min(float(found.exponents[0]), MAX_EXPONENT))
