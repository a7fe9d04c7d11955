"""What the bank of delays knows, as it is handed around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..filters.heading_bias import BiasCovariance, HeadingEvidence
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, Mask, Stamps
from .observation_rows import DelayedRows


class Hypotheses(NamedTuple):
    """State (K, n) and covariance (K, n, n), on ψ and κ, with the last state relative to the hypothesis' own delay.

    misfit: (K,) zᵀR⁻¹z that is left, prior included. log_evidence: (K,), of the data as claimed. information, vector:
    Λ (K, n, n) and Λx (K, n).
    """

    x: Array
    p: Array
    misfit: Array
    log_evidence: Array
    information: Array
    vector: Array


class BlockRows(NamedTuple):
    """The rows (J,) of a block of time, their stamps (J,), and how long it is, s."""

    rows: DelayedRows
    stamps_ns: Stamps
    seconds: float


class Sums(NamedTuple):
    """What all rows told: Λ (K, n, n), Λx (K, n), zᵀR⁻¹z (K,), prior included but rows of heave; number of samples that
    they count for; variance of heave, (m/s)²."""

    information: Array
    vector: Array
    square: Array
    weight: float
    heave_variance: float


class Told(NamedTuple):
    """What the rows of a block told (K, n+1, n+1), as of `told_by`, and of each fold by itself; number of samples."""

    of_all: Array
    weight: float
    by_fold: list[tuple[int, Array]]

    @property
    def is_finite(self) -> bool:
        """Whether it can be added to anything."""
        return bool(np.isfinite(self.of_all).all())

    @property
    def parts(self) -> tuple[Array, Array, Array]:
        """Λ (K, n, n), Λx (K, n), zᵀR⁻¹z (K,)."""
        return parts(self.of_all)


def parts(told: Array) -> tuple[Array, Array, Array]:
    """Λ (..., n, n), Λx (..., n) and zᵀR⁻¹z (...,) of what rows told (..., n+1, n+1)."""
    return told[..., :-1, :-1], told[..., :-1, -1], told[..., -1, -1]


class Known(NamedTuple):
    """What is known at some time, before the heading is looked at.

    likely, kept, share: as of `Likely`. best: which of the K is most likely, and its information (n, n).
    regressor_noise: (4,). seen: by blocks of time; None under a random walk.
    """

    likely: GaussianState
    kept: Index
    share: Array
    best: int
    information: Array
    regressor_noise: Array
    seen: HeadingEvidence | None


class After(NamedTuple):
    """After a block: how many samples were used and gated, the mean νᵀS⁻¹ν of the used ones, and what is known; None
    where it had no rows."""

    used: int
    gated: int
    mean_nis: float
    known: Known | None = None


class Likely(NamedTuple):
    """What is known at some time: the likely hypotheses x (M, n), P (M, n, n), on ψ and κ, the numbers kept (M,) of
    their delays, and the share (M,) of each; shown, inflation and heading as of `Posterior`;
    of_bias, drifted as of `HeadingStates`."""

    likely: GaussianState
    kept: Index
    share: Array
    shown: Mask
    inflation: Array
    heading: GaussianState | None
    of_bias: BiasCovariance
    drifted: float


@dataclass(frozen=True)
class Posterior:
    """What the bank says.

    state: x (n,), P (n, n) of G2's states. shown: (n,) which of them the data alone shows. inflation: (n,) by how much
    its standard deviations were raised above the filter's own. turned: (3,) by how much 1 m of lever arm along the
    axis that matters most turns each misalignment, rad; by_lever_arm: (3,) variance of each that comes with what is not
    known of the lever arm, in variances without. heading: coefficients of its deviation, as of `HeadingStates`.
    of_bias: what a bias of the DVL makes of x, which P is without.
    """

    state: GaussianState
    shown: Mask
    inflation: Array
    turned: Array
    by_lever_arm: Array
    heading: GaussianState | None
    of_bias: BiasCovariance


class Ended(NamedTuple):
    """A day that is over.

    known: of all, and without each fold, the state as the filter has it, x (n,), P (n, n). shown: (n,) which of the
    states the data showed. inflation: (n,) by how much σ was to be raised.
    """

    known: list[GaussianState]
    shown: Mask
    inflation: Array


class DayState(NamedTuple):
    """G2's states on one day, x (n,), P (n, n), by all data; and which (n,) of them are shown."""

    state: GaussianState
    shown: Mask
