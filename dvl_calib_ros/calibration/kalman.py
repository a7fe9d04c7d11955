"""The Kalman filter over a constant state, for K models at once: sample by sample, or a whole block.

Letters as in the literature: x state, P covariance, z measurement, H its matrix, R its noise, S innovation
covariance, K gain. Models of different sizes share arrays by padding: rows of z and H that a model does not have are
zero with a unit R, states that it does not have are never touched because their columns of H are zero.

Two ways to the same numbers (equal to 1e-10, proved in test_kalman.py):

`recursion` is the filter: one predict and update per sample, covariance in Joseph form.
`batch` uses that with Φ = I and Q = 0 the filter is prior-regularised weighted least squares for every k at once: the
information of the first k samples is a running sum. Vectorised over time it is about a hundred times faster, and it
holds the whole history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .frames import Array

Mask = NDArray[np.bool_]

# Gate decisions of a block are found by repetition (see `batch`); a block that needs more than this goes to the
# recursion instead. Data with ordinary outliers settles in two or three.
MAX_GATE_PASSES = 12


@dataclass(frozen=True)
class Measurements:
    """N measurements for each of K models, padded to m rows and n states.

    z: (K, N, m). h: (K, N, m, n). r: (K or 1, N or 1, m, m), symmetric positive definite. weight: (N,), share
    of its own information that a sample adds, in 0..1 (below 1 for samples that share one reference sample's noise).
    usable: (K, N), False where a model must not use a sample. gate: (K,), largest normalised innovation squared that
    is used, inf for no gate.
    """

    z: Array
    h: Array
    r: Array
    weight: Array
    usable: Mask
    gate: Array


@dataclass(frozen=True)
class Updated:
    """What a block of measurements made of the state.

    x: (K, n), p: (K, n, n) after the last sample. used: (K, N). nis: (K, N) normalised innovation squared νᵀS⁻¹ν of
    every sample against the state before it, of usable samples only (0 elsewhere).
    """

    x: Array
    p: Array
    used: Mask
    nis: Array


@dataclass(frozen=True)
class History:
    """State after every sample: x (K, N, n), p (K, N, n, n); used and nis as in `Updated`."""

    x: Array
    p: Array
    used: Mask
    nis: Array


def recursion(x: Array, p: Array, data: Measurements, process: Array | None = None) -> Updated:
    """Filter N samples one after the other.

    x: (K, n). p: (K, n, n). process: (N, K, n, n) covariance Q that the state gains before each sample, or None.
    """
    k, n_samples = data.z.shape[:2]
    x, p = x.copy(), p.copy()
    identity = np.eye(x.shape[1])
    one_r = data.r.shape[1] == 1
    used = np.zeros((k, n_samples), dtype=bool)
    nis = np.zeros((k, n_samples))
    for i in range(n_samples):
        if process is not None:
            p += process[i]
        h, r_i, weight = data.h[:, i], data.r[:, 0 if one_r else i], data.weight[i]
        pht = p @ h.transpose(0, 2, 1)
        s = h @ pht + r_i
        s_inverse = np.linalg.inv(s)
        innovation = data.z[:, i, :, None] - h @ x[:, :, None]
        nis_i = (innovation.transpose(0, 2, 1) @ s_inverse @ innovation)[:, 0, 0]
        used_i = data.usable[:, i] & (nis_i <= data.gate)
        if weight != 1.0:  # the gate asks whether this sample fits; the update, how much news is in it
            r_i = r_i / weight
            s_inverse = np.linalg.inv(h @ pht + r_i)
        gain = (pht @ s_inverse) * used_i[:, None, None]  # a gain of zero leaves x and P exactly as they are
        x += (gain @ innovation)[:, :, 0]
        # Joseph form: a sum of two positive semidefinite terms, so rounding cannot make P indefinite
        ikh = identity - gain @ h
        p = ikh @ p @ ikh.transpose(0, 2, 1) + gain @ r_i @ gain.transpose(0, 2, 1)
        p = 0.5 * (p + p.transpose(0, 2, 1))
        used[:, i] = used_i
        nis[:, i] = nis_i
    return Updated(x, p, used, np.where(data.usable, nis, 0.0))


def batch(x: Array, p: Array, data: Measurements) -> Updated:
    """Filter N samples at once, without process noise; the same result as `recursion`."""
    solved = _solve(x, p, data)
    if solved is None:
        return recursion(x, p, data)
    information, information_state, used, nis = solved
    p = np.linalg.inv(information[:, -1])
    p = 0.5 * (p + p.transpose(0, 2, 1))
    return Updated((p @ information_state[:, -1, :, None])[:, :, 0], p, used, nis)


def history(x: Array, p: Array, data: Measurements) -> History:
    """Filter N samples at once, without process noise, and keep the state after each of them."""
    solved = _solve(x, p, data)
    if solved is None:
        return _recursion_history(x, p, data)
    information, information_state, used, nis = solved
    low, inverse_diagonal = _cholesky(_elements(information[:, 1:]))
    n = x.shape[1]
    unit = np.eye(n)
    shape = (len(information), information.shape[1] - 1)
    columns = []
    for j in range(n):
        right = [np.full(shape, unit[i, j]) for i in range(n)]
        columns.append(_backward(low, inverse_diagonal, _forward(low, inverse_diagonal, right)))
    p_all = np.moveaxis(np.array(columns), (0, 1), (-1, -2))
    p_all = 0.5 * (p_all + np.swapaxes(p_all, -1, -2))
    x_all = np.einsum("knij,knj->kni", p_all, information_state[:, 1:])
    return History(x_all, p_all, used, nis)


def _solve(x: Array, p: Array, data: Measurements) -> tuple[Array, Array, Mask, Array] | None:
    """Information Λ (K, N+1, n, n) and Λx (K, N+1, n) before and after every sample, used, nis.

    Whether a sample passes the gate depends on the samples before it. So: assume all pass, compute every state at
    once, gate every sample against its state, and repeat with what passed until nothing changes. Each pass settles at
    least the first sample still wrong, so the fixed point is the recursion's own sequence of decisions. None when it
    does not settle in MAX_GATE_PASSES.
    """
    prior = np.linalg.inv(p)
    wh = np.matmul(np.linalg.inv(data.r) * data.weight[:, None, None], data.h)
    gained = np.matmul(data.h.swapaxes(-1, -2), wh)
    gained_state = np.einsum("knmi,knm->kni", wh, data.z)
    gated = bool(np.isfinite(data.gate).any())
    used = data.usable
    for _ in range(MAX_GATE_PASSES):
        information = _running_sum(prior, gained, used[:, :, None, None])
        information_state = _running_sum((prior @ x[:, :, None])[:, :, 0], gained_state, used[:, :, None])
        nis = _normalised_innovation_squared(information[:, :-1], information_state[:, :-1], data)
        passed = data.usable & (nis <= data.gate[:, None])
        if not gated or np.array_equal(passed, used):
            return information, information_state, used, np.where(data.usable, nis, 0.0)
        used = passed
    return None


def _running_sum(first: Array, gained: Array, used: Mask) -> Array:
    return np.cumsum(np.concatenate([first[:, None], gained * used], axis=1), axis=1)


def _recursion_history(x: Array, p: Array, data: Measurements) -> History:
    xs, ps, used, nis = [], [], [], []
    for i in range(data.z.shape[1]):
        at = slice(i, i + 1)
        one = Measurements(
            data.z[:, at],
            data.h[:, at],
            data.r if data.r.shape[1] == 1 else data.r[:, at],
            data.weight[at],
            data.usable[:, at],
            data.gate,
        )
        after = recursion(x, p, one)
        x, p = after.x, after.p
        xs.append(x)
        ps.append(p)
        used.append(after.used[:, 0])
        nis.append(after.nis[:, 0])
    return History(np.stack(xs, axis=1), np.stack(ps, axis=1), np.stack(used, axis=1), np.stack(nis, axis=1))


# Small dense algebra, element by element, each element an array over models and time: for 3x3 and 4x4 matrices this
# is ten times faster than a LAPACK call per matrix.

Elements = Sequence[Sequence[Array]]


def _elements(matrices: Array) -> Elements:
    """(..., n, n) -> nested list [i][j] of contiguous arrays (...), lower triangle only."""
    n = matrices.shape[-1]
    return [[np.ascontiguousarray(matrices[..., i, j]) for j in range(i + 1)] for i in range(n)]


def _cholesky(a: Elements) -> tuple[Elements, list[Array]]:
    """Lower L with A = L Lᵀ, and the inverses of its diagonal."""
    low: list[list[Array]] = []
    inverse_diagonal: list[Array] = []
    for i, row in enumerate(a):
        low.append([])
        for j in range(i + 1):
            value = row[j]
            for k in range(j):
                value = value - low[i][k] * low[j][k]
            if i == j:
                value = np.sqrt(value)
                inverse_diagonal.append(1.0 / value)
            else:
                value = value * inverse_diagonal[j]
            low[i].append(value)
    return low, inverse_diagonal


def _forward(low: Elements, inverse_diagonal: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    """L⁻¹ b."""
    y: list[Array] = []
    for i, value in enumerate(b):
        for k in range(i):
            value = value - low[i][k] * y[k]
        y.append(value * inverse_diagonal[i])
    return y


def _backward(low: Elements, inverse_diagonal: Sequence[Array], y: Sequence[Array]) -> list[Array]:
    """L⁻ᵀ y."""
    n = len(y)
    x: list[Array] = [y[0]] * n
    for i in reversed(range(n)):
        value = y[i]
        for k in range(i + 1, n):
            value = value - low[k][i] * x[k]
        x[i] = value * inverse_diagonal[i]
    return x


def _dot(a: list[Array], b: Sequence[Array]) -> Array:
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = total + left * right
    return total


def _normalised_innovation_squared(information: Array, information_state: Array, data: Measurements) -> Array:
    """νᵀS⁻¹ν (K, N) with S = HPHᵀ + R and ν = z - Hx, from Λ = P⁻¹ = LLᵀ: with U = L⁻¹Hᵀ, HPHᵀ = UᵀU."""
    low, inverse_diagonal = _cholesky(_elements(information))
    m, n = data.h.shape[2:]
    y = _forward(low, inverse_diagonal, [information_state[..., i] for i in range(n)])
    h = np.ascontiguousarray(np.moveaxis(data.h, (2, 3), (0, 1)))
    u = [_forward(low, inverse_diagonal, list(h[row])) for row in range(m)]
    s = [[_dot(u[i], u[j]) + data.r[..., i, j] for j in range(i + 1)] for i in range(m)]
    innovation = [data.z[..., row] - _dot(u[row], y) for row in range(m)]
    whitened = _forward(*_cholesky(s), innovation)
    return _dot(whitened, whitened)
