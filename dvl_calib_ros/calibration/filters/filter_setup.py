"""Setup of the Kalman filter by models: initial state, rows, gates, and the meaning of its states.

Shapes: K models, N samples, n states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..models import Model
from ..models.base import Observations, Unmeasured
from ..models.parameters import Parameters
from ..numerics import kalman
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Mask
from ..numerics.tests import chi2_cdf, chi2_isf


class Assembler:
    """Measurements and states of K models with equal size and noise that differ in z and H only.

    start: initial x (K, n), P (K, n, n): the prior, or `initial` by model name.
    prior: of all models (also used for states that differ per recording).
    process_rate: Q per second (K, n, n), a random walk of misalignment and scale, not of nuisance states; None without.
    """

    def __init__(
        self, models: Sequence[Model], parameters: Parameters, initial: Mapping[str, GaussianState] | None = None
    ) -> None:
        """Stack the models' priors, gates and process noise. initial: states by model name, instead of the priors."""
        self.models = tuple(models)
        first = self.models[0]
        self._n, self._m, self._model_noise = first.n_state, first.n_measurement, first.noise
        self._motion_is_noise = first.motion_is_noise
        priors = [prior(model, parameters) for model in self.models]
        self.prior = GaussianState(np.array([begin.x for begin in priors]), np.array([begin.p for begin in priors]))
        initial = initial or {}
        self._starts = [initial.get(model.name) or begin for model, begin in zip(self.models, priors, strict=True)]
        self._floors = [_floor(model, parameters) for model in self.models]  # covariance that no data reduce
        starts = [_without(floor, state) for floor, state in zip(self._floors, self._starts, strict=True)]
        self.start = GaussianState(np.array([state.x for state in starts]), np.array([state.p for state in starts]))
        # gate by the number of unmeasured axes
        self._gates = np.array([gate_of(max(self._m - dropped, 1), parameters) for dropped in range(self._m + 1)])
        self._gate = np.full((len(self.models), 1), self._gates[0])
        self._needs_prior = np.array([model.needs_prior for model in self.models])
        rate = np.zeros(self.start.p.shape)
        for index, model in enumerate(self.models):
            std = [parameters.process_std_misalignment] * 3 + [parameters.process_std_scale] * (model.n_errors - 3)
            rate[index, : model.n_errors, : model.n_errors] = np.diag(np.square(std))
        self.process_rate = rate if rate.any() else None

    def state(self, index: int, x: Array, p: Array) -> GaussianState:
        """Return one model's state and covariance from x (..., n) and P (..., n, n) of the filter."""
        floor = self._floors[index]
        return GaussianState(x.copy(), p.copy() if floor is None else p + floor)

    def measurements(self, observations: Observations, weight: Array, prior_known: Mask) -> kalman.Measurements:
        """Return the measurements of a block of N samples. weight: (N,), see `kalman.Measurements`.

        prior_known: (N,) bool, prior sway and heave were known; models that need them skip other samples.
        """
        k, n_samples = len(self.models), len(observations.velocity_dvl)
        # samples are contiguous in memory for the batch
        z = np.empty((self._m, k, n_samples)).transpose(1, 2, 0)
        h = np.zeros((self._m, self._n, k, n_samples)).transpose(2, 3, 0, 1)
        for index, model in enumerate(self.models):
            z[index], h[index] = model.linearise(observations)
        usable = ~self._needs_prior[:, None] | prior_known
        noise = observations.noise if self._model_noise is None else self._model_noise(observations)
        noise = noise[None, :, : self._m, : self._m]
        own_weight = (observations.motion_weight if self._motion_is_noise else weight)[None]
        if observations.unmeasured is None:
            return kalman.Measurements(z, h, noise, own_weight, usable, self._gate)
        noise, gate = self._drop_unmeasured(z, h, noise, observations, observations.unmeasured)
        return kalman.Measurements(z, h, noise, own_weight, usable, gate)

    def rows_left(self, unmeasured: Unmeasured) -> Array:
        """Return the number of measured rows per model and sample (K, N)."""
        dropped = [_dropped_axes(model, unmeasured).sum(axis=1) for model in self.models]
        return self._m - np.array(dropped, dtype=float)

    def _drop_unmeasured(
        self, z: Array, h: Array, noise: Array, observations: Observations, unmeasured: Unmeasured
    ) -> tuple[Array, Array]:
        """Rotate z and H, in place, to the frame of the reference, and remove unmeasured rows.

        Return R (K, N, 3, 3) and gate (K, N). A removed row is zero, with variance 1.
        """
        k, n_samples = z.shape[:2]
        noise = np.broadcast_to(noise, (k, n_samples, 3, 3)).copy()
        gate = np.repeat(self._gate, n_samples, axis=1)
        for index, model in enumerate(self.models):
            axes = _dropped_axes(model, unmeasured)
            affected = np.flatnonzero(axes.any(axis=1))
            if not len(affected):
                continue
            turned = unmeasured.rotation_reference_from_body[affected] @ observations.rotation_dvl_from_body.T
            is_measured = ~axes[affected]
            z[index, affected] = np.einsum("nij,nj->ni", turned, z[index, affected]) * is_measured
            h[index, affected] = turned @ h[index, affected] * is_measured[:, :, None]
            both_measured = is_measured[:, :, None] & is_measured[:, None, :]
            r = turned @ noise[index, affected] @ turned.swapaxes(1, 2) * both_measured
            noise[index, affected] = r + np.eye(3) * axes[affected, None, :]
            gate[index, affected] = self._gates[axes[affected].sum(axis=1)]
        return noise, gate


def _floor(model: Model, parameters: Parameters) -> Array | None:
    """Return the covariance (n, n) of `Model.sideslip_std` about body z, which no data reduce; None without."""
    if not model.sideslip_std:
        return None
    along = np.zeros(model.n_state)
    along[:3] = parameters.rotation_dvl_from_body[:, 2]
    return np.outer(along, along) * model.sideslip_std**2


def _without(floor: Array | None, state: GaussianState) -> GaussianState:
    """Return the initial state without the floor, which is added to the output."""
    if floor is None:
        return state
    p = state.p - floor
    # a state of another model may have a smaller covariance
    return GaussianState(state.x, p) if np.linalg.eigvalsh(p)[0] > 0.0 else state


def _dropped_axes(model: Model, unmeasured: Unmeasured) -> Mask:
    """Return a mask (N, 3) of reference axes that a model needs but that are not measured."""
    needed = (model.aided, model.aided, model.vertical_from_reference)
    dropped: Mask = unmeasured.axes & needed
    return dropped


# Smallest prior σ: zero, as for an exact heading, would be infinite information.
LEAST_STD = 1e-7


def prior(model: Model, parameters: Parameters) -> GaussianState:
    """Return zero errors with the prior standard deviations of the parameters."""
    std = [parameters.initial_std_misalignment] * 3 + [parameters.initial_std_scale] * (model.n_errors - 3)
    std += [getattr(parameters, spec.std) if isinstance(spec.std, str) else spec.std for spec in model.nuisance]
    return GaussianState(np.zeros(model.n_state), np.diag(np.square(np.maximum(std, LEAST_STD))))


def gate_of(rows: float, parameters: Parameters) -> float:
    """Return the largest accepted νᵀS⁻¹ν of a number of rows: the chi-square quantile, inf without gate."""
    gated = 1.0 - parameters.gate_probability
    return chi2_isf(gated, rows) if 0.0 < gated < 1.0 else float("inf")  # after rounding


def nis_bounds(rows: float, parameters: Parameters, used: int) -> tuple[float, float]:
    """Return two-sided 99 % bounds of the mean νᵀS⁻¹ν over `used` samples of a consistent filter.

    rows: mean per sample. The mean excludes gated samples, so it is that of a chi-square variable truncated at the
    gate: E[qʲ | q <= g] = m (m+2) ... (m+2j-2) F_{m+2j}(g) / F_m(g). The mean of many is near normal. Zero if
    references measured no axis.
    """
    if rows <= 0.0:
        return 0.0, 0.0
    m, gate = rows, gate_of(rows, parameters)
    inside = chi2_cdf(gate, m)
    mean = m * chi2_cdf(gate, m + 2) / inside
    variance = m * (m + 2) * chi2_cdf(gate, m + 4) / inside - mean**2
    half = math.sqrt(chi2_isf(1.0 - 0.99, 1.0) * variance / max(used, 1))  # normal quantile
    return mean - half, mean + half
