"""All models at once: every model that can use a sample is updated by it, always.

So switching models by hand or automatically is a change of what is read, never of what is computed, and the state
after a switch is that of having run the model from the start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, gammaincinv, ndtri

from . import kalman
from .frames import Array
from .models import N_MEASUREMENT, Model, Observations
from .parameters import Parameters

# From here on the vectorised batch is faster than the recursion.
BATCH_FROM = 24


class GaussianState(NamedTuple):
    """A state (n,) and its covariance (n, n)."""

    x: Array
    p: Array


class ModelCounts(NamedTuple):
    """What one model did with the samples given to it, and the mean of νᵀS⁻¹ν over those it used (nan if none)."""

    used: int
    gated: int
    mean_nis: float


class ModelBank:
    """K models updated together."""

    def __init__(
        self, models: Sequence[Model], parameters: Parameters, initial: Mapping[str, GaussianState] | None = None
    ) -> None:
        """Start from the prior, or from `initial` for the models named there (shapes as the models' states)."""
        self.models = tuple(models)
        self._index = {model.name: k for k, model in enumerate(self.models)}
        self._n = max(model.n_state for model in self.models)
        k = len(self.models)
        self.x: Array = np.zeros((k, self._n))
        self.p: Array = np.tile(np.eye(self._n), (k, 1, 1))
        for index, model in enumerate(self.models):
            start = (initial or {}).get(model.name) or prior(model, parameters)
            self.x[index, : model.n_state] = start.x
            self.p[index, : model.n_state, : model.n_state] = start.p
        rows = np.array([np.arange(N_MEASUREMENT) < model.n_measurement for model in self.models])
        self._own_rows = rows[:, None, :, None] & rows[:, None, None, :]
        self._gate = np.array([_gate(model, parameters) for model in self.models])
        self._process = self._process_rate(parameters)
        self._needs_prior = np.array([model.needs_prior for model in self.models])
        self._last_stamp_ns: int | None = None
        self.n_given = 0
        self._used = np.zeros(k, dtype=np.int64)
        self._gated = np.zeros(k, dtype=np.int64)
        self._nis_sum = np.zeros(k)

    def _process_rate(self, parameters: Parameters) -> Array | None:
        rate = np.zeros((len(self.models), self._n, self._n))
        for index, model in enumerate(self.models):
            std = np.r_[[parameters.process_std_misalignment] * 3, [parameters.process_std_scale] * self._n][: self._n]
            rate[index, : model.n_state, : model.n_state] = np.diag(std**2)[: model.n_state, : model.n_state]
        return rate if rate.any() else None

    def update(
        self, stamps_ns: Sequence[int], seen: Observations, noise: Array, weight: Array, prior_known: Array
    ) -> None:
        """Update every model with a block of N samples.

        noise: R, (N or 1, 3, 3) (m/s)². weight: (N,), see `kalman.Measurements`. prior_known: (N,) bool,
        whether prior sway and heave were known at the sample; models that need them skip it where not.
        """
        self.n_given += len(stamps_ns)
        data = self._measurements(seen, noise, weight, prior_known)
        process = self._process_noise(stamps_ns)
        if process is None and len(stamps_ns) >= BATCH_FROM:
            after = kalman.batch(self.x, self.p, data)
        else:
            after = kalman.recursion(self.x, self.p, data, process)
        self.x, self.p = after.x, after.p
        self._used += after.used.sum(axis=1)
        self._gated += (data.usable & ~after.used).sum(axis=1)
        self._nis_sum += np.where(after.used, after.nis, 0.0).sum(axis=1)

    def _measurements(self, seen: Observations, noise: Array, weight: Array, prior_known: Array) -> kalman.Measurements:
        k, n_samples = len(self.models), len(seen.velocity_dvl)
        z = np.zeros((k, n_samples, N_MEASUREMENT))
        h = np.zeros((k, n_samples, N_MEASUREMENT, self._n))
        for index, model in enumerate(self.models):
            z_model, h_model = model.linearise(seen)
            z[index, :, : model.n_measurement] = z_model
            h[index, :, : model.n_measurement, : model.n_state] = h_model
        r = noise[None] if self._own_rows.all() else np.where(self._own_rows, noise, np.eye(N_MEASUREMENT))
        usable = ~self._needs_prior[:, None] | prior_known
        return kalman.Measurements(z, h, r, weight, usable, self._gate)

    def _process_noise(self, stamps_ns: Sequence[int]) -> Array | None:
        if self._process is None:
            return None
        stamps = np.array([stamps_ns[0] if self._last_stamp_ns is None else self._last_stamp_ns, *stamps_ns])
        self._last_stamp_ns = stamps_ns[-1]
        return np.diff(stamps)[:, None, None, None] * 1e-9 * self._process

    def state(self, name: str) -> GaussianState:
        """State and covariance of one model."""
        index = self._index[name]
        n = self.models[index].n_state
        return GaussianState(self.x[index, :n].copy(), self.p[index, :n, :n].copy())

    def counts(self, name: str) -> ModelCounts:
        """Samples used and gated by one model, and its mean normalised innovation squared."""
        index = self._index[name]
        used = int(self._used[index])
        return ModelCounts(used, int(self._gated[index]), float(self._nis_sum[index] / used) if used else float("nan"))


def prior(model: Model, parameters: Parameters) -> GaussianState:
    """Zero errors with the prior standard deviations of the parameters."""
    std = [parameters.initial_std_misalignment] * 3 + [parameters.initial_std_scale] * (model.n_state - 3)
    return GaussianState(np.zeros(model.n_state), np.diag(np.square(std)))


def _gate(model: Model, parameters: Parameters) -> float:
    """Largest νᵀS⁻¹ν that is used: the chi-square quantile, inf for no gate."""
    if parameters.gate_probability in (0.0, 1.0):
        return float("inf")
    return 2.0 * float(gammaincinv(0.5 * model.n_measurement, parameters.gate_probability))


def nis_bounds(model: Model, parameters: Parameters, used: int, confidence: float = 0.99) -> tuple[float, float]:
    """Two-sided bounds of the mean νᵀS⁻¹ν over `used` samples of a consistent filter.

    Gated samples are not in the mean, so it is that of a chi-square variable cut off at the gate:
    E[qʲ | q <= g] = m (m+2) ... (m+2j-2) F_{m+2j}(g) / F_m(g). The mean of many is near normal.
    """
    m, gate = model.n_measurement, _gate(model, parameters)
    inside = chdtr(m, gate)
    mean = m * chdtr(m + 2, gate) / inside
    variance = m * (m + 2) * chdtr(m + 4, gate) / inside - mean**2
    half = float(ndtri(0.5 + 0.5 * confidence) * np.sqrt(variance / max(used, 1)))
    return float(mean) - half, float(mean) + half
