"""All models at once: every model that can use a sample is updated by it, always.

So switching models by hand or automatically is a change of what is read, never of what is computed, and the state
after a switch is that of having run the model from the start. (Long, because the padding of models to one size, and its
undoing, stand beside each other.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, gammaincinv, ndtri

from . import kalman
from .correction_parameters import PriorOnErrors, to_correction, to_errors
from .folds import FOLDS, FoldInformation, folds_of
from .frames import Array
from .history import Standing
from .kalman import GaussianState
from .models import N_MEASUREMENT, Model, Needs
from .observations import Observations, Unmeasured
from .parameters import Parameters
from .samples import Index, Mask, Stamps

Ends = Index

# From here on the vectorised batch is faster than the recursion.
BATCH_FROM = 24


class ModelCounts(NamedTuple):
    """What one model did with the samples given to it.

    mean_nis, mean_rows: νᵀS⁻¹ν (nan if none) and number of rows, means over those it used. restarted: how often its
    state was not finite, and it went on from before.
    """

    used: int
    gated: int
    mean_nis: float
    mean_rows: float
    restarted: int


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
        # by how many of its rows are left where axes of the reference are not measured
        self._gates = np.array(
            [
                [gate_of(max(model.n_measurement - dropped, 1), parameters) for dropped in range(N_MEASUREMENT)]
                for model in self.models
            ]
        )
        self.n_rows = np.array([float(model.n_measurement) for model in self.models])
        self._needs_prior = np.array([model.needs_prior for model in self.models])
        rows = np.array([np.arange(N_MEASUREMENT) < model.n_measurement for model in self.models])
        self._own_rows = rows[:, None, :, None] & rows[:, None, None, :]
        self._one_noise = bool(rows.all()) and all(model.noise is None for model in self.models)
        self._one_weight = not any(model.motion_is_noise for model in self.models)
        self.process_rate = self._process_rate(parameters)

    def start_of(self, index: int) -> GaussianState:
        """State and covariance that one model starts from."""
        return self._starts[index]

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
            # a model that extends another has columns for what that has; the rest is not shown sample by sample
            h[index, :, : model.n_measurement, : h_model.shape[2]] = h_model
        usable = ~self._needs_prior[:, None] | prior_known
        noise, gate = self._noise(seen), self._gates[:, :1]
        if seen.unmeasured is not None:
            noise, gate = self._drop_unmeasured(z, h, noise, seen, seen.unmeasured)
        return kalman.Measurements(z, h, noise, self._weight(seen, weight), usable, gate)

    def rows_left(self, unmeasured: Unmeasured) -> Array:
        """Rows that each model is told by each sample (K, N)."""
        dropped = [_dropped_axes(model, unmeasured).sum(axis=1) for model in self.models]
        return self.n_rows[:, None] - np.array(dropped)

    def _drop_unmeasured(
        self, z: Array, h: Array, noise: Array, seen: Observations, unmeasured: Unmeasured
    ) -> tuple[Array, Array]:
        """R (K, N, 3, 3) and gate (K, N), with z and H turned into the reference's frame, unmeasured rows taken out."""
        k, n_samples = z.shape[:2]
        noise = np.broadcast_to(noise, (k, n_samples, 3, 3)).copy()
        gate = np.repeat(self._gates[:, :1], n_samples, axis=1)
        for index, model in enumerate(self.models):
            axes = _dropped_axes(model, unmeasured)
            at = np.flatnonzero(axes.any(axis=1))
            if not len(at):
                continue
            turned = unmeasured.rotation_reference_from_body[at]
            if not model.rows_in_body:
                turned = turned @ seen.rotation_dvl_from_body.T
            kept = ~axes[at]
            z[index, at] = np.einsum("nij,nj->ni", turned, z[index, at]) * kept
            h[index, at] = turned @ h[index, at] * kept[:, :, None]
            r = turned @ noise[index, at] @ turned.swapaxes(1, 2) * (kept[:, :, None] & kept[:, None, :])
            noise[index, at] = r + np.eye(3) * axes[at, None, :]
            gate[index, at] = self._gates[index, axes[at].sum(axis=1)]
        return noise, gate

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


def _dropped_axes(model: Model, unmeasured: Unmeasured) -> Mask:
    """(N, 3) axes of the reference's frame that a model would need, and that are not measured."""
    needed = (model.aided, model.aided, model.vertical_from_reference)
    dropped: Mask = unmeasured.axes & needed
    return dropped


class ModelBank:
    """All models, updated together as far as they need the same."""

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
        by_needs = {needs: [model for model in models if model.needs is needs] for needs in Needs}
        self._groups = {
            needs: _Group(group, parameters, initial, verified) for needs, group in by_needs.items() if group
        }
        self._group_of = {model.name: self._groups[model.needs] for model in models}

    def n_given(self, needs: Needs) -> int:
        """Number of rows that the models with these needs have had."""
        return self._groups[needs].n_given

    def update(
        self,
        needs: Needs,
        stamps_ns: Stamps,
        seen: Observations,
        weight: Array,
        prior_known: Mask,
        ends: Ends | None = None,
    ) -> Standing | None:
        """Update the models with these needs by a block of N samples that have them.

        weight, prior_known: (N,) as in `Assembler.measurements`. The states after `ends` samples (E), if given.
        """
        return self._groups[needs].update(stamps_ns, seen, weight, prior_known, ends)

    def standing(self, needs: Needs, n: int) -> Standing:
        """The states as they are now, n times."""
        return self._groups[needs].standing(n)

    def state(self, name: str) -> GaussianState:
        """State and covariance of one model; not to be written to."""
        return self._group_of[name].state(name)

    def states_at(self, name: str, standing: Standing) -> GaussianState:
        """States x (E, n) and covariances P (E, n, n) of one model, from those of all that need the same."""
        return self._group_of[name].states_at(name, standing)

    def counts_at(self, name: str, standing: Standing) -> tuple[NDArray[np.int64], Array]:
        """Samples used so far (E,) and the sum of νᵀS⁻¹ν over them (E,), likewise."""
        index = self._group_of[name].index[name]
        return standing.used[:, index], standing.nis_sum[:, index]

    def states_without_folds(self, name: str) -> list[GaussianState]:
        """For every fold the state and covariance of one model had it not seen that fold."""
        return self._group_of[name].states_without_folds(name)

    def counts(self, name: str) -> ModelCounts:
        """Samples used and gated by one model, and its mean normalised innovation squared."""
        return self._group_of[name].counts(name)


class _Group:
    """K models that need the same."""

    def __init__(
        self,
        models: Sequence[Model],
        parameters: Parameters,
        initial: Mapping[str, GaussianState] | None,
        verified: bool,
    ) -> None:
        self._parameters = parameters
        self._assembler = Assembler(models, parameters, initial)
        self._folds = FoldInformation(self._assembler.start) if verified else None
        self.index = {model.name: k for k, model in enumerate(models)}
        self.x, self.p = self._assembler.start
        self._states: dict[str, GaussianState] = {}
        self._sound: dict[str, GaussianState] = {}  # the last that could be published
        self._last_stamp_ns: int | None = None
        self.n_given = 0
        k = len(models)
        self._used = np.zeros(k, dtype=np.int64)
        self._gated = np.zeros(k, dtype=np.int64)
        self._nis_sum, self._rows_sum = np.zeros(k), np.zeros(k)
        self._restarted = np.zeros(k, dtype=np.int64)

    def update(
        self, stamps_ns: Stamps, seen: Observations, weight: Array, prior_known: Mask, ends: Ends | None
    ) -> Standing | None:
        n_samples = len(stamps_ns)
        self.n_given += n_samples
        data = self._assembler.measurements(seen, weight, prior_known)
        process = self._process_noise(stamps_ns)
        after = self._after(data, process, ends)
        self.x, self.p = after.x, after.p
        self._states.clear()
        if self._folds is not None:
            self._folds.add(folds_of(stamps_ns, self._parameters), data, after.used)
        standing = None if ends is None else self._standing_at(after, ends)
        n_used = after.used.sum(axis=1)
        self._used += n_used
        self._gated += (data.usable & ~after.used).sum(axis=1)
        self._nis_sum += np.where(after.used, after.nis, 0.0).sum(axis=1)
        if seen.unmeasured is None:
            self._rows_sum += n_used * self._assembler.n_rows
        else:
            self._rows_sum += (after.used * self._assembler.rows_left(seen.unmeasured)).sum(axis=1)
        return standing

    def _after(self, data: kalman.Measurements, process: Array | None, ends: Ends | None) -> kalman.Updated:
        """The models updated; one whose numbers run away stays as it was before, and is counted."""
        try:
            after = _filtered(self.x, self.p, data, process, ends)
            if _is_sound(after.x, after.p):
                return after
        except np.linalg.LinAlgError:
            pass  # of one of them: each by itself
        return kalman.Updated.joined([self._after_alone(k, data, process, ends) for k in range(len(self.x))])

    def _after_alone(
        self, k: int, data: kalman.Measurements, process: Array | None, ends: Ends | None
    ) -> kalman.Updated:
        own = slice(k, k + 1)
        x, p, own_data = self.x[own], self.p[own], data.model(k)
        with suppress(np.linalg.LinAlgError):
            after = _filtered(x, p, own_data, None if process is None else process[:, own], ends)
            if _is_sound(after.x, after.p):
                return after
        self._restarted[k] += 1
        nothing = own_data.usable & False
        at = None if ends is None else GaussianState(np.stack([x] * len(ends)), np.stack([p] * len(ends)))
        return kalman.Updated(x, p, nothing, nothing.astype(float), at)

    def _standing_at(self, after: kalman.Updated, ends: Ends) -> Standing:
        assert after.at is not None
        used = np.cumsum(np.pad(after.used, ((0, 0), (1, 0))), axis=1)[:, ends].T
        nis = np.cumsum(np.pad(np.where(after.used, after.nis, 0.0), ((0, 0), (1, 0))), axis=1)[:, ends].T
        return Standing(after.at.x, after.at.p, self._used + used, self._nis_sum + nis)

    def standing(self, n: int) -> Standing:
        return Standing.joined([Standing(self.x[None], self.p[None], self._used[None], self._nis_sum[None])] * n)

    def _process_noise(self, stamps_ns: Stamps) -> Array | None:
        rate = self._assembler.process_rate
        if rate is None:
            return None
        before_ns = stamps_ns[0] if self._last_stamp_ns is None else self._last_stamp_ns
        self._last_stamp_ns = int(stamps_ns[-1])
        return np.diff(stamps_ns, prepend=before_ns)[:, None, None, None] * 1e-9 * rate

    def state(self, name: str) -> GaussianState:
        if name not in self._states:  # asked for more than once per sample, live
            self._states[name] = self._sound[name] = self._sound_state(name)
        return self._states[name]

    def _sound_state(self, name: str) -> GaussianState:
        """The state as it is to be published; the one before where the way from the filter's to it fails."""
        index = self.index[name]
        found = self._published(index, self.x[index], self.p[index])
        if found is not None:
            return found
        self._restarted[index] += 1
        return self._sound.get(name) or self._assembler.start_of(index)

    def _published(self, index: int, x: Array, p: Array) -> GaussianState | None:
        """A state (n,) of the filter as the model's; None if it has none that is finite."""
        with suppress(np.linalg.LinAlgError):
            state = self._assembler.state(index, x, p)
            if not self._assembler.models[index].in_correction_parameters or _is_sound(state.x, state.p):
                return state  # the filter's own has been looked at
        return None

    def states_at(self, name: str, standing: Standing) -> GaussianState:
        index = self.index[name]
        x, p = standing.x[:, index], standing.p[:, index]
        with suppress(np.linalg.LinAlgError):
            states = self._assembler.state(index, x, p)
            if _is_sound(states.x, states.p):
                return states
        singly = [self._published(index, *each) or self.state(name) for each in zip(x, p, strict=True)]
        return GaussianState(np.array([state.x for state in singly]), np.array([state.p for state in singly]))

    def states_without_folds(self, name: str) -> list[GaussianState]:
        assert self._folds is not None  # asked for when the bank was made
        index, found = self.index[name], []
        for fold in range(FOLDS):
            state = None
            with suppress(np.linalg.LinAlgError):
                state = self._published(index, *self._folds.without(fold, index))
            found.append(state or self.state(name))
        return found

    def counts(self, name: str) -> ModelCounts:
        index = self.index[name]
        used = int(self._used[index])
        model = self._assembler.models[index]
        return ModelCounts(
            used,
            int(self._gated[index]),
            float(self._nis_sum[index] / used) if used else float("nan"),
            float(self._rows_sum[index] / used) if used else float(model.n_measurement),
            int(self._restarted[index]),
        )


def _filtered(
    x: Array, p: Array, data: kalman.Measurements, process: Array | None, ends: Ends | None
) -> kalman.Updated:
    if process is None and data.z.shape[1] >= BATCH_FROM:
        return kalman.batch(x, p, data, ends)
    return kalman.recursion(x, p, data, process, ends)


def _is_sound(x: Array, p: Array) -> bool:
    """Whether all of states x (..., n), P (..., n, n) are finite, with variances above zero."""
    flat_x, flat_p = x.ravel(), p.ravel()
    finite = math.isfinite(float(flat_x @ flat_x) + float(flat_p @ flat_p))  # nan and inf stay in sums
    return finite and bool(np.diagonal(p, axis1=-2, axis2=-1).min() > 0.0)


def prior(model: Model, parameters: Parameters) -> GaussianState:
    """Zero errors with the prior standard deviations of the parameters."""
    std = [parameters.initial_std_misalignment] * 3 + [parameters.initial_std_scale] * (model.n_errors - 3)
    std += [getattr(parameters, each.std) if isinstance(each.std, str) else each.std for each in model.nuisance]
    return GaussianState(np.zeros(model.n_state), np.diag(np.square(std)))


def gate_of(rows: float, parameters: Parameters) -> float:
    """Largest νᵀS⁻¹ν of so many rows that is used: the chi-square quantile, inf for no gate."""
    if parameters.gate_probability in (0.0, 1.0):
        return float("inf")
    return 2.0 * float(gammaincinv(0.5 * rows, parameters.gate_probability))


def nis_bounds(rows: float, parameters: Parameters, used: int, confidence: float = 0.99) -> tuple[float, float]:
    """Two-sided bounds of the mean νᵀS⁻¹ν over `used` samples of a consistent filter. rows: of a sample, on average.

    Gated samples are not in the mean, so it is that of a chi-square variable cut off at the gate:
    E[qʲ | q <= g] = m (m+2) ... (m+2j-2) F_{m+2j}(g) / F_m(g). The mean of many is near normal.
    """
    m, gate = rows, gate_of(rows, parameters)
    inside = chdtr(m, gate)
    mean = m * chdtr(m + 2, gate) / inside
    variance = m * (m + 2) * chdtr(m + 4, gate) / inside - mean**2
    half = float(ndtri(0.5 + 0.5 * confidence) * np.sqrt(variance / max(used, 1)))
    return float(mean) - half, float(mean) + half
