"""Cross-validation: folds of a run, and sums per fold to solve without it and to judge on it.

Blocks of `verification_block` are assigned to `FOLDS` folds in turn, so all folds cover the whole run. With Φ = I the
information of samples is additive (kalman.py). One information matrix per fold and model is stored, and solving without
a fold leaves it out: one pass, constant memory.

Shapes: K models, N samples, n states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models import Model
from ..models.base import Observations
from ..models.parameters import Parameters
from ..numerics.error_model import CORRECTION_JACOBIAN, correction_matrix
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState, Measurements
from ..numerics.robust import FEWEST_SAMPLES
from ..numerics.samples import Stamps

FOLDS = 5


def folds_of(stamps_ns: Stamps, parameters: Parameters) -> NDArray[np.int64]:
    """Return the fold (N,) of each sample, by its stamp alone."""
    return stamps_ns // round(parameters.verification_block * 1e9) % FOLDS


class FoldSums:
    """Sums over samples per fold: arrays of given shapes, such as Λ (K, n, n) and Λx (K, n)."""

    def __init__(self, *shapes: tuple[int, ...]) -> None:
        self._each = [np.zeros((FOLDS, *shape)) for shape in shapes]
        self._total: tuple[Array, ...] | None = None

    def copy(self) -> FoldSums:
        """Return an independent copy."""
        made = copy(self)
        made._each = [sums.copy() for sums in self._each]
        return made

    def add(self, fold: int | slice, *more: Array | float) -> None:
        """Add to one fold, or to several (F, ...)."""
        self._total = None
        for sums, addition in zip(self._each, more, strict=True):
            sums[fold] += addition

    def of(self, fold: int) -> tuple[Array, ...]:
        """Return the sums of one fold, read-only."""
        return tuple(sums[fold] for sums in self._each)

    @property
    def total(self) -> tuple[Array, ...]:
        """Sums over all folds, read-only."""
        if self._total is None:
            self._total = tuple(sums.sum(axis=0) for sums in self._each)
        return self._total

    def without(self, fold: int) -> tuple[Array, ...]:
        """Return the sums over all folds but one."""
        others = np.arange(FOLDS) != fold
        return tuple(sums[others].sum(axis=0) for sums in self._each)

    def taken(self, number: int) -> Array:
        """Move one kind of sums (FOLDS, ...) to the caller and reset it here."""
        self._total = None
        sums = self._each[number]
        self._each[number] = np.zeros_like(sums)
        return sums

    def clear(self) -> None:
        """Reset all sums."""
        self._total = None
        for sums in self._each:
            sums[:] = 0.0


class FoldInformation:
    """Information of K models or hypotheses without each fold: prior, and information per fold.

    The random walk is neglected.
    """

    def __init__(self, start: GaussianState) -> None:
        """Start from x (K, n), P (K, n, n) of the filter."""
        self.begin([start.information] * FOLDS)

    def begin(self, information: Sequence[tuple[Array, Array]]) -> None:
        """Restart from Λ (K, n, n) and Λx (K, n) without each fold."""
        self._begin = information
        self._summed = FoldSums(information[0][0].shape, information[0][1].shape)

    def add(self, folds: NDArray[np.int64], data: Measurements, used: NDArray[np.bool_]) -> None:
        """Add N samples where models used them (K, N)."""
        h, z = data.whitened
        rows = np.concatenate([h, z[:, None]], axis=1).transpose(2, 1, 0, 3)  # (K, n + 1, m, N)
        weight = data.weight * used
        for fold in set(folds.tolist()):
            samples = np.flatnonzero(folds == fold)
            part = rows.take(samples, axis=3)
            weighted = part * weight[:, None, None, samples]
            flat = (*part.shape[:2], -1)
            information = weighted.reshape(flat) @ part.reshape(flat).swapaxes(1, 2)
            self._summed.add(fold, information[..., :-1, :-1], information[..., :-1, -1])

    def without(self, fold: int) -> tuple[Array, Array]:
        """Return Λ (K, n, n) and Λx (K, n) without a fold."""
        information, vector = (
            added + begin for added, begin in zip(self._summed.without(fold), self._begin[fold], strict=True)
        )
        return information, vector

    def state(self, fold: int, index: int) -> GaussianState:
        """Return x (n,) and P (n, n) of one of the K without a fold."""
        information, vector = (of_all[index] for of_all in self.without(fold))
        p = np.linalg.inv(information)
        return GaussianState(p @ vector, p)

    def end_day(self, start: GaussianState, of_day: NDArray[np.intp]) -> None:
        """Keep the information on the vehicle for the next recording, and reset what differs per recording.

        start: x (K, n), P (K, n, n), prior of the reset states. of_day: (u,) indices of these states.
        """
        kept = []
        for fold in range(FOLDS):
            states = zip(*(self.state(fold, index) for index in range(len(start.x))), strict=True)
            kept.append(with_states_of(GaussianState(*map(np.stack, states)), start, of_day).information)
        self.begin(kept)


def with_states_of(state: GaussianState, other: GaussianState, which: NDArray[np.intp]) -> GaussianState:
    """Return a state x (..., n), P (..., n, n) with the states `which` (u,) replaced, uncorrelated, from another."""
    x, p = state.x.copy(), state.p.copy()
    x[..., which] = other.x[..., which]
    p[..., which, :] = 0.0
    p[..., :, which] = 0.0
    p[..., which[:, None], which] = other.p[..., which[:, None], which]
    return GaussianState(x, p)


class MomentSums(NamedTuple):
    """Sums over samples with a reference that suffice to judge any correction.

    samples: their number.
    vv (3, 3, 3), gv (3, 3): for each body axis, over samples whose reference measures it, Σ v vᵀ and Σ g vᵀ.
    gg, noise: over all axes, Σ g² and Σ of the variance of R. v (3,) m/s is measured, DVL frame, at the reference
      point; g m/s is the reference velocity along the axis.
    """

    samples: Array | float
    vv: Array
    gv: Array
    gg: Array | float
    noise: Array | float


class Moments(FoldSums):
    """`MomentSums` per fold."""

    def __init__(self) -> None:
        super().__init__((), (3, 3, 3), (3, 3), (), ())

    def in_fold(self, fold: int | None) -> MomentSums:
        """Return the sums of one fold, or of all, read-only."""
        return MomentSums(*(self.total if fold is None else self.of(fold)))

    def take(self, folds: NDArray[np.int64], observations: Observations) -> None:
        """Add N samples to the sums of their folds. folds: (N,) fold of each."""
        assert observations.reference_body is not None
        v, g = observations.velocity_at_reference, observations.reference_body
        measured = np.broadcast_to(observations.measured_in_body, v.shape)
        rotation = observations.rotation_dvl_from_body
        variance = np.broadcast_to(np.einsum("di,ndk,ki->ni", rotation, observations.noise, rotation), v.shape)
        for fold in set(folds.tolist()):
            is_in_fold = folds == fold
            velocity, is_measured = v[is_in_fold], measured[is_in_fold]
            measured_velocity = is_measured.T[:, :, None] * velocity  # (3, N, 3)
            squares, noise = np.sum(g[is_in_fold] ** 2 * is_measured), np.sum(variance[is_in_fold] * is_measured)
            self.add(
                fold,
                int(np.count_nonzero(is_in_fold)),
                measured_velocity.swapaxes(1, 2) @ velocity,
                (g[is_in_fold].T[:, None] @ measured_velocity)[:, 0],
                squares,
                noise,
            )

    def squared_error(self, fold: int, body_from_measured: Array) -> float:
        """Return Σ |g - C v|² (m/s)² over a fold along the measured axes, C (3, 3)."""
        c, sums = body_from_measured, self.in_fold(fold)
        return float(sums.gg - 2.0 * np.sum(c * sums.gv) + np.einsum("ai,aij,aj->", c, sums.vv, c))


@dataclass(frozen=True)
class HeldOutError:
    """Velocity error against the reference on held-out samples, m/s rms over the vector.

    uncorrected: nominal mounting.
    corrected: estimate.
    predicted: expected value of corrected by R of the reference and the covariance of the estimate. All include
      reference noise.
    calibration: contribution of the estimate to predicted.
    interpolated: white reference noise that corrected may contain beyond uncorrected: interpolation attenuates noise
      between samples, and a delay changes the interpolation times.
    independent: equivalent number of independent samples; None: samples.
    claimed: noise of reference and DVL by their messages, if predicted uses the noise estimated from the data.
    """

    samples: int
    uncorrected: float
    corrected: float
    predicted: float
    calibration: float
    interpolated: float = 0.0
    independent: float | None = None
    claimed: float = 0.0


def held_out_error(
    model: Model, without: Sequence[GaussianState], moments: Moments, rotation_dvl_from_body: Array
) -> HeldOutError | None:
    """Return the error of a model on every fold by the state without it; None for too few samples.

    without: one state for each fold.
    moments: sums over the samples of each fold.
    rotation_dvl_from_body: (3, 3) nominal mounting.
    """
    samples = int(moments.in_fold(None).samples)
    if samples < FEWEST_SAMPLES or max(moments.in_fold(fold).samples for fold in range(FOLDS)) == samples:
        return None
    nominal = rotation_dvl_from_body.T
    uncorrected = corrected = noise = calibration = 0.0
    for fold, state in enumerate(without):
        errors = model.error_terms_from_state @ state.x
        covariance = model.error_terms_from_state @ state.p @ model.error_terms_from_state.T
        uncorrected += moments.squared_error(fold, nominal)
        corrected += moments.squared_error(fold, correction_matrix(errors[:3], errors[3:], rotation_dvl_from_body))
        sums = moments.in_fold(fold)
        noise += float(sums.noise)
        calibration += _calibration_variance(covariance, sums.vv, nominal)
    return held_out_from_sums(samples, (uncorrected, corrected, noise + calibration, calibration))


def calibration_error(
    model: Model, covariance: Array, judged: tuple[float, Array], rotation_dvl_from_body: Array
) -> float:
    """Return the velocity error, m/s rms, due to a state covariance (n, n) on judged samples; 0 for none.

    judged: `MomentSums.samples` and `vv` of all samples.
    """
    samples, vv = judged
    error_covariance = model.error_terms_from_state @ covariance @ model.error_terms_from_state.T
    total = _calibration_variance(error_covariance, vv, rotation_dvl_from_body.T)
    return math.sqrt(max(total, 0.0) / float(samples)) if samples else 0.0


def held_out_from_sums(samples: int, sums: Sequence[float] | Array) -> HeldOutError | None:
    """Return the error from sums of squares (m/s)² in the order of `HeldOutError`; None for too few samples."""
    if samples < FEWEST_SAMPLES:
        return None
    return HeldOutError(samples, *(math.sqrt(max(float(total), 0.0) / samples) for total in sums))


def _calibration_variance(covariance: Array, vv: Array, rotation_body_from_dvl: Array) -> float:
    """Return Σ trace(J P Jᵀ) (m/s)² over samples from Σ v vᵀ alone, as J is linear in v.

    vv: (3, 3, 3) Σ v vᵀ of the samples that are judged along each body axis.
    """
    in_body = np.einsum("ij,kaj->kai", rotation_body_from_dvl, _JACOBIAN_BY_ERROR)
    return float(np.einsum("kai,lbi,ab,ikl->", in_body, in_body, covariance, vv))


# d(velocity)/d(error a) for a velocity along k, axis i: [k, a, i]
_JACOBIAN_BY_ERROR: Array = CORRECTION_JACOBIAN.reshape(3, 3, 6).swapaxes(1, 2)
