"""Kalman filter over a constant state for K models, per sample or per block.

x state, P covariance, z measurement, H its matrix, R its noise, S innovation covariance, K gain.

`recursion` predicts and updates per sample, with the covariance in Joseph form. `batch` uses that with Φ = I and Q = 0
the filter is prior-regularised weighted least squares for every k: the information of the first k samples is a running
sum, vectorised over time. Both agree to 1e-10 (test_kalman.py); `batch` is thirty times faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .frames import Array, product

Mask = NDArray[np.bool_]

# Most passes of the gate decisions of a block (see `batch`), else the recursion is used. Data with ordinary outliers
# need two or three.
MAX_GATE_PASSES = 12


class GaussianState(NamedTuple):
    """State (n,) and covariance (n, n)."""

    x: Array
    p: Array

    @property
    def information(self) -> tuple[Array, Array]:
        """P⁻¹ and P⁻¹x of (..., n) states; raises LinAlgError if P is singular."""
        inverse = np.linalg.inv(self.p)
        return inverse, product(inverse, self.x)

    def raised(self, factor: Array) -> GaussianState:
        """Return the state with each σ multiplied by a factor (n,); P stays exactly symmetric."""
        return GaussianState(self.x, self.p * (factor[:, None] * factor))


def covariance_of(information: Array, prior: Array) -> Array:
    """Return the covariances (..., n, n) of information (..., n, n) that holds a prior's, as positive as the prior's.

    Information of very different size, as of rates beyond any vehicle's, cancels in the inverse. Its eigenvalues, in
    units of the prior's diagonal, are then raised to the prior's smallest.
    """
    try:
        inverse: Array = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        inverse = np.zeros_like(information)
    if not (np.diagonal(inverse, axis1=-2, axis2=-1) > 0.0).all():
        scale = np.sqrt(np.diagonal(prior, axis1=-2, axis2=-1))
        scales = scale[..., None] * scale[..., None, :]
        floor = np.maximum(np.linalg.eigvalsh(prior / scales)[..., :1], np.finfo(float).eps)
        values, vectors = np.linalg.eigh(information / scales)
        inverse = (vectors / np.maximum(values, floor)[..., None, :]) @ vectors.swapaxes(-1, -2) / scales
    return np.asarray(0.5 * (inverse + inverse.swapaxes(-1, -2)))


@dataclass(frozen=True)
class Measurements:
    """N measurements of m rows for each of K models with n states.

    z: (K, N, m).
    h: (K, N, m, n).
    r: (K or 1, N or 1, m, m), symmetric positive definite.
    weight: (K or 1, N), information weight of a sample, in 0..1 (below 1 for samples that share noise).
    usable: (K, N), False where a model must not use a sample.
    gate: (K or 1, N or 1), largest accepted normalised innovation squared, inf without gate.
    """

    z: Array
    h: Array
    r: Array
    weight: Array
    usable: Mask
    gate: Array

    @cached_property
    def whitened(self) -> tuple[Array, Array]:
        """H (m, n, K, N) and z (m, K, N), transformed to unit noise."""
        h, z = np.moveaxis(self.h, (2, 3), (0, 1)), np.moveaxis(self.z, 2, 0)
        low, inverse_diagonal = _cholesky([[self.r[..., i, j] for j in range(i + 1)] for i in range(len(z))])
        return np.stack(_forward(low, inverse_diagonal, [*h])), np.stack(_forward(low, inverse_diagonal, [*z]))

    def part(self, at: slice) -> Measurements:
        """Return the samples of a slice."""
        r = self.r if self.r.shape[1] == 1 else self.r[:, at]
        gate = self.gate if self.gate.shape[1] == 1 else self.gate[:, at]
        return Measurements(self.z[:, at], self.h[:, at], r, self.weight[:, at], self.usable[:, at], gate)

    def model(self, k: int) -> Measurements:
        """Return the measurements of one model, as K = 1."""
        own = slice(k, k + 1)
        r = self.r if len(self.r) == 1 else self.r[own]
        weight = self.weight if len(self.weight) == 1 else self.weight[own]
        gate = self.gate if len(self.gate) == 1 else self.gate[own]
        return Measurements(self.z[own], self.h[own], r, weight, self.usable[own], gate)


@dataclass(frozen=True)
class Updated:
    """State after a block of measurements.

    x: (K, n), p: (K, n, n) after the last sample.
    used: (K, N).
    nis: (K, N) normalised innovation squared νᵀS⁻¹ν of usable samples against the state before them, else 0.
    at: x (E, K, n), P (E, K, n, n) after the requested numbers of samples, if any.
    """

    x: Array
    p: Array
    used: Mask
    nis: Array
    at: GaussianState | None = None

    @staticmethod
    def joined(models: Sequence[Updated]) -> Updated:
        """Return the joined updates of models, each with K = 1."""
        x, p, used, nis = (
            np.concatenate(parts) for parts in zip(*((m.x, m.p, m.used, m.nis) for m in models), strict=True)
        )
        found = [model.at for model in models if model.at is not None]
        at = GaussianState(*(np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))) if found else None
        return Updated(x, p, used, nis, at)


def recursion(
    x: Array, p: Array, data: Measurements, process: Array | None = None, ends: NDArray[np.intp] | None = None
) -> Updated:
    """Filter N samples in sequence.

    x: (K, n).
    p: (K, n, n).
    process: (N, K, n, n) covariance Q added before each sample, or None.
    ends: (E,) ascending numbers of samples (0..N) after which the state is returned, too. Raises LinAlgError if S is
      not positive definite, or a number is not finite.
    """
    # per model: products of single matrices cost a third of those of stacks, and a live block has one sample
    models = [
        _recursion_of_one(x[k], p[k], data, k, None if process is None else process[:, k], ends is not None)
        for k in range(len(x))
    ]
    paths, used, nis = zip(*models, strict=True)
    at_ends = None
    if ends is not None:
        states = [[path[end] for path in paths] for end in ends.tolist()]
        at_ends = GaussianState(
            *(np.array([[state[k] for state in of_models] for of_models in states]) for k in range(2))
        )
    x, p = (np.array([path[-1][k] for path in paths]) for k in range(2))
    return Updated(x, p, np.array(used), np.array(nis), at_ends)


def _recursion_of_one(
    x: Array, p: Array, data: Measurements, k: int, process: Array | None, with_path: bool
) -> tuple[list[GaussianState], list[bool], list[float]]:
    """Filter with the k-th model: x (n,), P (n, n), Q (N, n, n), see `recursion`.

    Return the final state or, if with_path, the states before the first and after each sample; used flags; nis.
    """
    n_samples, n = data.z.shape[1], len(x)
    identity = _identity(n)
    z, h_all = data.z[k], data.h[k]
    r, gate, weight = (values[k] if len(values) > 1 else values[0] for values in (data.r, data.gate, data.weight))
    r, gate = (values if len(values) == n_samples else [values[0]] * n_samples for values in (r, gate.tolist()))
    usable, weight = data.usable[k].tolist(), weight.tolist()
    used, nis = [], []
    path = [GaussianState(x, p)]
    for i in range(n_samples):
        if process is not None:
            p = p + process[i]
        h, r_i = h_all[i], r[i]
        pht = p @ h.T
        hpht = h @ pht
        innovation = z[i] - h @ x
        nis_i = float(innovation @ _solve_definite(hpht + r_i, innovation))
        if not math.isfinite(nis_i):
            raise np.linalg.LinAlgError("the filter diverged")
        is_used = usable[i] and nis_i <= gate[i]
        if is_used:
            if weight[i] != 1.0:  # the gate tests the sample at full weight; only the update uses the reduced one
                r_i = r_i / weight[i]
            gain = _solve_definite(hpht + r_i, pht.T).T
            x = x + gain @ innovation
            # Joseph form: a sum of positive semidefinite terms, so rounding cannot make P indefinite
            ikh = identity - gain @ h
            p = ikh @ p @ ikh.T + gain @ r_i @ gain.T
            p = 0.5 * (p + p.T)
        used.append(is_used)
        nis.append(nis_i if usable[i] else 0.0)
        if with_path:
            path.append(GaussianState(x, p))
    return path if with_path else [GaussianState(x, p)], used, nis


@cache
def _identity(n: int) -> Array:
    """Return the identity (n, n), read-only."""
    return np.eye(n)


@cache
def _dposv() -> Callable[[Array, Array], tuple[Array, Array, int]]:
    """Return dposv of LAPACK. The import takes 0.2 s, so it waits for the first single sample.

    Live, `prepare` imports it before the first message.
    """
    from scipy.linalg.lapack import dposv

    solver: Callable[[Array, Array], tuple[Array, Array, int]] = dposv
    return solver


def prepare() -> None:
    """Import what the first single sample needs."""
    _dposv()


def _solve_definite(s: Array, b: Array) -> Array:
    """Return S⁻¹b for one symmetric positive definite S (m, m), else raise LinAlgError."""
    _, solution, failed = _dposv()(s, b)
    if failed:
        raise np.linalg.LinAlgError("S is not positive definite")
    return solution


def batch(x: Array, p: Array, data: Measurements, ends: NDArray[np.intp] | None = None) -> Updated:
    """Filter N samples together, without process noise; the same result as `recursion`."""
    h, _ = data.whitened
    # unmeasured states change only by their correlation with measured ones
    measured = np.flatnonzero([column.any() for column in h.swapaxes(0, 1)])
    if not len(measured):
        measured = np.zeros(1, dtype=np.intp)  # any state
    solved = _solve(x[:, measured], p[:, measured[:, None], measured], data, measured)
    if solved is None:
        return recursion(x, p, data, None, ends)
    after = solved.after(np.append([] if ends is None else ends, data.z.shape[1]).astype(np.intp))
    if len(measured) < x.shape[1]:
        after = _with_unmeasured(x, p, measured, after)
    at = None if ends is None else GaussianState(after.x[:-1], after.p[:-1])
    return Updated(after.x[-1], after.p[-1], solved.used, solved.nis, at)


def _with_unmeasured(x: Array, p: Array, measured: NDArray[np.intp], after: GaussianState) -> GaussianState:
    """Return all states x (E, K, n), P (E, K, n, n) after measurements of some.

    x (K, n), P (K, n, n): all states before. measured: (s,) indices of the measured states. after: the measured states,
    x (E, K, s), P (E, K, s, s).
    """
    rest = np.delete(np.arange(x.shape[1]), measured)
    before = p[:, measured[:, None], measured]
    gain = np.linalg.solve(before, p[:, measured[:, None], rest]).swapaxes(1, 2)  # (K, r, s)
    states = np.empty((*after.x.shape[:2], x.shape[1]))
    states[..., measured] = after.x
    states[..., rest] = x[:, rest] + (gain @ (after.x - x[:, measured])[..., None])[..., 0]
    covariance = np.empty((*states.shape, x.shape[1]))
    cross = gain @ after.p
    covariance[..., measured[:, None], measured] = after.p
    covariance[..., rest[:, None], measured], covariance[..., measured[:, None], rest] = cross, cross.swapaxes(-1, -2)
    conditional = p[:, rest[:, None], rest] - gain @ (before - after.p) @ gain.swapaxes(1, 2)
    covariance[..., rest[:, None], rest] = 0.5 * (conditional + conditional.swapaxes(-1, -2))
    return GaussianState(states, covariance)


def least_squares(x: Array, p: Array, data: Measurements, ends: Sequence[int]) -> GaussianState:
    """Solve prior-regularised least squares over the first `ends` samples: x (E, K, n), P (E, K, n, n).

    ends: E ascending numbers. Equal to the filters without gate and process noise, and the fastest: it sums over the
    samples without innovations or history.
    """
    k, n_samples, m, n = data.h.shape
    weighted = _inverse(data.r) @ data.h
    share = data.weight * data.usable
    if (share != 1.0).any():
        weighted *= share[..., None, None]
    weighted = weighted.reshape(k, n_samples * m, n).transpose(0, 2, 1)
    h, z = data.h.reshape(k, n_samples * m, n), data.z.reshape(k, n_samples * m, 1)
    rows = [slice(m * start, m * end) for start, end in pairwise((0, *ends))]
    prior = np.linalg.inv(p)
    information = prior + np.cumsum([weighted[..., at] @ h[:, at] for at in rows], axis=0)
    state = prior @ x[..., None] + np.cumsum([weighted[..., at] @ z[:, at] for at in rows], axis=0)
    p_after = np.linalg.inv(information)
    p_after = 0.5 * (p_after + np.swapaxes(p_after, -1, -2))
    return GaussianState((p_after @ state)[..., 0], p_after)


# Small dense algebra by elements, each an array over models and time: for 3x3 and 4x4 matrices ten times faster than a
# LAPACK call per matrix. Symmetric matrices and lower triangles are lists of rows [i][j<=i].

Elements = Sequence[Sequence[Array]]


class _Solved(NamedTuple):
    """Information Λ (lower triangle) and Λx, each (K, N+1) before and after every sample; used, nis (K, N)."""

    information: list[list[Array]]
    information_state: list[Array]
    used: Mask
    nis: Array

    def after(self, ends: NDArray[np.intp]) -> GaussianState:
        """Return x (E, K, n) and P (E, K, n, n) after these numbers of samples."""
        p = np.linalg.inv(_full([[column[:, ends].T for column in row] for row in self.information]))
        p = 0.5 * (p + p.swapaxes(-1, -2))
        vector = np.stack([column[:, ends].T for column in self.information_state], axis=-1)
        return GaussianState((p @ vector[..., None])[..., 0], p)


def _solve(x: Array, p: Array, data: Measurements, measured: NDArray[np.intp]) -> _Solved | None:
    """Return the information after every sample on the measured states (s,): x (K, s), P (K, s, s).

    The gate of a sample depends on the samples before it, so gate decisions are iterated: start with the decisions of
    the initial state, compute all states, gate every sample against its state, and repeat until nothing changes. Each
    pass settles at least the first wrong sample, so the fixed point has the decisions of the recursion. Return None
    without convergence in MAX_GATE_PASSES.
    """
    n = x.shape[1]
    prior = np.linalg.inv(p)
    prior_state = (prior @ x[:, :, None])[:, :, 0]
    h, z = data.whitened
    if len(measured) < h.shape[1]:
        h = h[:, measured]
    wh = h if (data.weight == 1.0).all() else h * data.weight
    # a leading column for the prior, so that running sums are in place
    shape = (x.shape[0], data.z.shape[1] + 1)
    gains = [[_gain(wh[:, i], h[:, j], shape) for j in range(i + 1)] for i in range(n)]
    vector_gains = [_gain(wh[:, i], z, shape) for i in range(n)]
    used = data.usable
    gated = bool(np.isfinite(data.gate).any())
    if gated:
        used = used & _passes_before(x, prior, prior_state, h, z, data.gate)
    for _ in range(MAX_GATE_PASSES):
        mask = None if used.all() else used
        information = [[_running_sum(prior[:, i, j], gains[i][j], mask) for j in range(i + 1)] for i in range(n)]
        information_state = [_running_sum(prior_state[:, i], vector_gains[i], mask) for i in range(n)]
        nis = _normalised_innovation_squared(
            [[column[:, :-1] for column in row] for row in information],
            [column[:, :-1] for column in information_state],
            h,
            z,
        )
        passed = data.usable & (nis <= data.gate)
        if not gated or np.array_equal(passed, used):
            return _Solved(information, information_state, used, np.where(data.usable, nis, 0.0))
        used = passed
    return None


def _passes_before(x: Array, prior: Array, prior_state: Array, h: Array, z: Array, gate: Array) -> Mask:
    """Return which samples (K, N) pass the gate of the initial x (K, n), Λ (K, n, n), Λx (K, n)."""
    innovation = [measured - _dot(row, x.T[..., None]) for row, measured in zip(h, z, strict=True)]
    passes = _dot(innovation, innovation) <= gate
    # S >= R, so only samples that fail with R alone may fail
    k, at = np.nonzero(~passes)
    if len(k):
        n = x.shape[1]
        information = [[prior[k, i, j] for j in range(i + 1)] for i in range(n)]
        nis = _normalised_innovation_squared(information, [*prior_state[k].T], h[:, :, k, at], z[:, k, at])
        passes[k, at] = nis <= np.broadcast_to(gate, passes.shape)[k, at]
    return passes


def _gain(a: Array, b: Array, room: tuple[int, int]) -> Array:
    gained = np.empty(room)
    _dot(a, b, gained[:, 1:])
    return gained


def _running_sum(first: Array, gained: Array, used: Mask | None) -> Array:
    """Return sums (K, N+1) of the prior (K,) and the gains of samples (K, 1 + N, first column free)."""
    gained[:, 0] = first
    if used is None:
        return np.cumsum(gained, axis=1)
    total = np.empty_like(gained)
    total[:, 0] = first
    np.multiply(gained[:, 1:], used, out=total[:, 1:])
    return np.cumsum(total, axis=1, out=total)


def _full(lower: Elements) -> Array:
    """Return the symmetric matrices (..., n, n) of rows [i][j<=i]."""
    n = len(lower)
    return np.stack([np.stack([lower[max(i, j)][min(i, j)] for j in range(n)], axis=-1) for i in range(n)], axis=-2)


def _cholesky(a: Elements) -> tuple[list[list[Array]], list[Array]]:
    """Return the lower L of A = L Lᵀ, and the inverses of its diagonal."""
    low: list[list[Array]] = []
    inverse_diagonal: list[Array] = []
    for i, row in enumerate(a):
        low.append([])
        for j in range(i + 1):
            value = row[j]
            if j:
                value = value - _dot(low[i][:j], low[j][:j] if j < i else low[i][:j])
            if i == j:
                value = np.sqrt(value)
                inverse_diagonal.append(1.0 / value)
            else:
                value = value * inverse_diagonal[j]
            low[i].append(value)
    return low, inverse_diagonal


def _invert_lower(low: Elements, inverse_diagonal: Sequence[Array]) -> list[list[Array]]:
    """Return the inverse of lower triangular matrices L, row by row."""
    n = len(low)
    inverse: list[list[Array]] = []
    for i in range(n):
        inverse.append([])
        for j in range(i):
            total = _dot(low[i][j:i], [inverse[row][j] for row in range(j, i)])
            inverse[i].append(-(total * inverse_diagonal[i]))
        inverse[i].append(inverse_diagonal[i])
    return inverse


def _inverse(a: Array) -> Array:
    """Return inverses of symmetric positive definite matrices (..., m, m)."""
    m = a.shape[-1]
    low = _invert_lower(*_cholesky([[a[..., i, j] for j in range(i + 1)] for i in range(m)]))
    columns = [[low[row][j] for row in range(j, m)] for j in range(m)]
    return _full([[_dot(columns[i], columns[j][i - j :]) for j in range(i + 1)] for i in range(m)])  # L⁻ᵀ L⁻¹


def _forward(low: Elements, inverse_diagonal: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    """Return L⁻¹ b."""
    y: list[Array] = []
    for i, value in enumerate(b):
        if i:
            value = value - _dot(y, low[i][:i])
        y.append(value * inverse_diagonal[i])
    return y


def _dot(a: Sequence[Array] | Array, b: Sequence[Array] | Array, out: Array | None = None) -> Array:
    """Return the sum of products of two rows of arrays."""
    total: Array = np.multiply(a[0], b[0], out=out)
    if len(a) > 1:
        product = np.empty_like(total)
        for left, right in zip(a[1:], b[1:], strict=False):
            np.multiply(left, right, out=product)
            total += product
    return total


def _normalised_innovation_squared(
    information: Elements, information_state: Sequence[Array], h: Array, z: Array
) -> Array:
    """Return νᵀS⁻¹ν (K, N) with S = HPHᵀ + 1 and ν = z - Hx.

    With P⁻¹ = LLᵀ and U = L⁻¹Hᵀ, HPHᵀ = UᵀU. information, information_state: Λ and Λx before each sample, elements (K,
    N or 1).
    """
    low, inverse_diagonal = _cholesky(information)
    y = _forward(low, inverse_diagonal, information_state)
    u = [_forward(low, inverse_diagonal, row) for row in h]
    s = [[_dot(u[i], u[j]) for j in range(i + 1)] for i in range(len(u))]
    for i, row in enumerate(s):
        row[i] += 1.0
    innovation = [measured - _dot(u[row], y) for row, measured in enumerate(z)]
    return distance_squared(s, innovation)


def distance_squared(s: Elements, innovation: Sequence[Array]) -> Array:
    """Return νᵀS⁻¹ν. s: lower triangle of S, innovation: ν, both by elements."""
    whitened = _forward(*_cholesky(s), innovation)
    return _dot(whitened, whitened)
