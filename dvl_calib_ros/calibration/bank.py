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
from .correction_parameters import PriorOnErrors, to_correction, to_errors
from .folds import FOLDS, FoldInformation, folds_of
from .frames import Array
from .kalman import GaussianState
from .models import N_MEASUREMENT, Model
from .observations import Observations
from .parameters import Parameters

# From here on the vectorised batch is faster than the recursion.
BATCH_FROM = 24


class ModelCounts(NamedTuple):
    """What one model did with the samples given to it, and the mean of νᵀS⁻¹ν over those it used (nan if none)."""

    used: int
    gated: int
    mean_nis: float


class Assembler:
    """Between models and the Kalman filter, which holds K of them padded to one size.

    start: what the filter starts from, x (K, n), P (K, n, n): the prior, or `initial` for the models named there
    (shapes as the models' states).
    """

    def __init__(
        self, models: Sequence[Model], parameters: Parameters, initial: Mapping[str, GaussianState] | None = None
    ) -> None:
        self.models = tuple(models)
        self._n = max(model.n_state for model in self.models)
        self._starts = [(initial or {}).get(model.name) or prior(model, parameters) for model in self.models]
        self.start = self._start()
        self._prior_on_errors = {
            index: PriorOnErrors(
                GaussianState(
                    self.start.x[index, : model.n_state], self.start.p[index, : model.n_state, : model.n_state]
                ),
                self._starts[index],
            )
            for index, model in enumerate(self.models)
            if model.in_correction_parameters
        }
        self._gate = np.array([_gate(model, parameters) for model in self.models])
        self._needs_prior = np.array([model.needs_prior for model in self.models])
        rows = np.array([np.arange(N_MEASUREMENT) < model.n_measurement for model in self.models])
        self._own_rows = rows[:, None, :, None] & rows[:, None, None, :]
        self._one_noise = bool(rows.all()) and all(model.noise is None for model in self.models)
        self._one_weight = not any(model.motion_is_noise for model in self.models)
        self.process_rate = self._process_rate(parameters)

    def _start(self) -> GaussianState:
        k = len(self.models)
        x, p = np.zeros((k, self._n)), np.tile(np.eye(self._n), (k, 1, 1))
        for index, (model, state) in enumerate(zip(self.models, self._starts, strict=True)):
            held = to_correction(state) if model.in_correction_parameters else state
            x[index, : model.n_state], p[index, : model.n_state, : model.n_state] = held
        return GaussianState(x, p)

    def _process_rate(self, parameters: Parameters) -> Array | None:
        """Q per second (K, n, n): a random walk of misalignment and scale, not of nuisance states; None if zero."""
        rate = np.zeros(self.start.p.shape)
        for index, model in enumerate(self.models):
            std = [parameters.process_std_misalignment] * 3 + [parameters.process_std_scale] * (model.n_errors - 3)
            rate[index, : model.n_errors, : model.n_errors] = np.diag(np.square(std))
        return rate if rate.any() else None

    def state(self, index: int, x: Array, p: Array) -> GaussianState:
        """One model's state and covariance out of the filter's x (..., n) and P (..., n, n)."""
        model = self.models[index]
        n = model.n_state
        held = GaussianState(x[..., :n].copy(), p[..., :n, :n].copy())
        if not model.in_correction_parameters:
            return held
        if self.process_rate is not None:  # what the prior still weighs is then not known
            return to_errors(held)
        return self._prior_on_errors[index].to_errors(held)

    def measurements(self, seen: Observations, weight: Array, prior_known: kalman.Mask) -> kalman.Measurements:
        """A block of N samples. weight: (N,), see `kalman.Measurements`. prior_known: (N,) bool, whether prior sway and
        heave were known at the sample; models that need them skip it where not."""
        k, n_samples = len(self.models), len(seen.velocity_dvl)
        z = np.zeros((k, n_samples, N_MEASUREMENT))
        h = np.zeros((k, n_samples, N_MEASUREMENT, self._n))
        for index, model in enumerate(self.models):
            z_model, h_model = model.linearise(seen)
            z[index, :, : model.n_measurement] = z_model
            h[index, :, : model.n_measurement, : model.n_state] = h_model
        usable = ~self._needs_prior[:, None] | prior_known
        return kalman.Measurements(z, h, self._noise(seen), self._weight(seen, weight), usable, self._gate)

    def _noise(self, seen: Observations) -> Array:
        """R (K or 1, N or 1, 3, 3); rows that a model has not are of unit variance."""
        if self._one_noise:
            return seen.noise[None]
        own = [seen.noise if model.noise is None else model.noise(seen) for model in self.models]
        length = max(map(len, own))
        stacked = np.stack([np.broadcast_to(r, (length, *r.shape[1:])) for r in own])
        return np.where(self._own_rows, stacked, np.eye(N_MEASUREMENT))

    def _weight(self, seen: Observations, weight: Array) -> Array:
        """(K or 1, N)."""
        if self._one_weight:
            return weight[None]
        return np.stack([seen.motion_weight if model.motion_is_noise else weight for model in self.models])


class ModelBank:
    """K models updated together."""

    def __init__(
        self,
        models: Sequence[Model],
        parameters: Parameters,
        initial: Mapping[str, GaussianState] | None = None,
        verified: bool = False,
    ) -> None:
        """Start from the prior, or from `initial` for the models named there (shapes as the models' states).

        verified: keep what `states_without_folds` needs.
        """
        self._parameters = parameters
        self._assembler = Assembler(models, parameters, initial)
        self._folds = FoldInformation(self._assembler.start) if verified else None
        self.models = self._assembler.models
        self._index = {model.name: k for k, model in enumerate(self.models)}
        self.x, self.p = self._assembler.start
        self._states: dict[str, GaussianState] = {}
        self._last_stamp_ns: int | None = None
        self.n_given = 0
        k = len(self.models)
        self._used = np.zeros(k, dtype=np.int64)
        self._gated = np.zeros(k, dtype=np.int64)
        self._nis_sum = np.zeros(k)

    def update(self, stamps_ns: Sequence[int], seen: Observations, weight: Array, prior_known: kalman.Mask) -> None:
        """Update every model with a block of N samples; weight and prior_known as in `Assembler.measurements`."""
        self.n_given += len(stamps_ns)
        data = self._assembler.measurements(seen, weight, prior_known)
        process = self._process_noise(stamps_ns)
        if process is None and len(stamps_ns) >= BATCH_FROM:
            after = kalman.batch(self.x, self.p, data)
        else:
            after = kalman.recursion(self.x, self.p, data, process)
        self.x, self.p = after.x, after.p
        self._states.clear()
        if self._folds is not None:
            self._folds.add(folds_of(stamps_ns, self._parameters), data, after.used)
        self._used += after.used.sum(axis=1)
        self._gated += (data.usable & ~after.used).sum(axis=1)
        self._nis_sum += np.where(after.used, after.nis, 0.0).sum(axis=1)

    def _process_noise(self, stamps_ns: Sequence[int]) -> Array | None:
        rate = self._assembler.process_rate
        if rate is None:
            return None
        stamps = np.array([stamps_ns[0] if self._last_stamp_ns is None else self._last_stamp_ns, *stamps_ns])
        self._last_stamp_ns = stamps_ns[-1]
        return np.diff(stamps)[:, None, None, None] * 1e-9 * rate

    def state(self, name: str) -> GaussianState:
        """State and covariance of one model; not to be written to."""
        if name not in self._states:  # asked for more than once per sample, live
            index = self._index[name]
            self._states[name] = self._assembler.state(index, self.x[index], self.p[index])
        return self._states[name]

    def states_without_folds(self, name: str) -> list[GaussianState]:
        """For every fold the state and covariance of one model had it not seen that fold."""
        assert self._folds is not None  # asked for when the bank was made
        index = self._index[name]
        held = (self._folds.without(fold, index) for fold in range(FOLDS))
        return [self._assembler.state(index, x, p) for x, p in held]

    def counts(self, name: str) -> ModelCounts:
        """Samples used and gated by one model, and its mean normalised innovation squared."""
        index = self._index[name]
        used = int(self._used[index])
        return ModelCounts(used, int(self._gated[index]), float(self._nis_sum[index] / used) if used else float("nan"))


def prior(model: Model, parameters: Parameters) -> GaussianState:
    """Zero errors with the prior standard deviations of the parameters."""
    std = [parameters.initial_std_misalignment] * 3 + [parameters.initial_std_scale] * (model.n_errors - 3)
    std += [getattr(parameters, each.std) if isinstance(each.std, str) else each.std for each in model.nuisance]
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
