"""The nonlinear DVL error model, its exact inverse, and what follows from it (models.md, "Error model").

``v_d = (I + diag(δk)) (I + [φ×]) T v_b`` with ``T = rotation_dvl_from_body``: the nominal mounting, φ (3,) rad the
residual misalignment and δk (3,) the scale-factor errors, both in the DVL frame.

From the parameters of a correction to those of the errors, and back.

`T v_b = (I - [ψ×] - diag(κ)) v` is linear in what corrects (ψ, κ), `v = (I + diag(δk)) (I + [φ×]) T v_b` is how the
errors are defined (models.md). With B = (I - [ψ×] - diag(κ))⁻¹: δk_i = B_ii - 1, and φ is the skew part of
diag(1 + δk)⁻¹ B. To first order φ = ψ and δk = κ; at 5 degrees the difference is 0.4 per cent of the speed.

Scales are those of x and y. A DVL looks down and a vehicle hardly heaves, so no motion shows that of z; κ_z is zero.

A vehicle moves along its x axis, n in the DVL's frame, and what turns about n (roll) changes no velocity along it. Of a
DVL that is mounted askew it changes B_ii all the same, by -ψ_n² (1 - n_i²): a scale larger than its prior expects would
be taken for a roll that nothing shows. So of axes that motion ahead moves along δk_i is B_ii - 1 + ψ_n² (1 - n_i²), as
B makes of n.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from functools import cache
from typing import NamedTuple

import numpy as np

from .frames import Array, product, skew
from .kalman import GaussianState
from .samples import Index

_IDENTITY: Array = np.eye(3)


def distort(velocity_body: Array, misalignment: Array, scale: Array, rotation_dvl_from_body: Array) -> Array:
    """What a DVL with these errors measures of a body velocity: (..., 3) m/s -> (..., 3) m/s in the DVL frame."""
    matrix = np.diag(1.0 + np.asarray(scale)) @ (np.eye(3) + skew(misalignment)) @ rotation_dvl_from_body
    return velocity_body @ matrix.T


def correction_matrix(misalignment: Array, scale: Array, rotation_dvl_from_body: Array) -> Array:
    """Matrix that takes the measured DVL velocity to the corrected body velocity: the inverse of `distort`.

    (..., 3) rad, (..., 3) -> (..., 3, 3).
    """
    phi = np.asarray(misalignment, dtype=float)
    # (I + [φ×])⁻¹ = (I - [φ×] + φφᵀ) / (1 + ‖φ‖²)
    inverse = _IDENTITY - skew(phi) + phi[..., :, None] * phi[..., None, :]
    inverse /= 1.0 + (phi * phi).sum(axis=-1)[..., None, None]
    matrix: Array = rotation_dvl_from_body.T @ inverse / (1.0 + np.asarray(scale))[..., None, :]
    return matrix


def correct(velocity_dvl: Array, misalignment: Array, scale: Array, rotation_dvl_from_body: Array) -> Array:
    """Corrected body velocity of measured DVL velocities: (..., 3) m/s -> (..., 3) m/s."""
    return velocity_dvl @ correction_matrix(misalignment, scale, rotation_dvl_from_body).T


# [v×] and -diag(v) side by side (3, 6) are linear in v: their elements, row by row, are v @ CORRECTION_JACOBIAN.
CORRECTION_JACOBIAN: Array = np.concatenate([skew(np.eye(3)), [-np.diag(axis) for axis in np.eye(3)]], axis=2).reshape(
    3, 18
)


def correction_jacobian(velocity_dvl: Array, rotation_dvl_from_body: Array) -> Array:
    """d(corrected body velocity)/d(φ, δk) at small errors: (3,) m/s -> (3, 6).

    From the first-order inverse ``v_b = Tᵀ (v - φ×v - δk∘v)``: columns ``Tᵀ[v×]`` and ``-Tᵀ diag(v)``.
    """
    return rotation_dvl_from_body.T @ (velocity_dvl @ CORRECTION_JACOBIAN).reshape(3, 6)


def corrected_mounting(misalignment: Array, rotation_dvl_from_body: Array) -> Array:
    """Corrected mounting as ``rotation_body_from_dvl`` (3, 3).

    ``I + [φ×]`` is not a rotation. The nearest one (its polar factor) turns about φ by atan‖φ‖, because in the plane
    across φ the matrix is ``[[1, -‖φ‖], [‖φ‖, 1]]``, a rotation by that angle times a length.
    """
    norm = float(np.linalg.norm(misalignment))
    if norm == 0.0:
        return np.array(rotation_dvl_from_body.T)
    axis = skew(np.asarray(misalignment) / norm)
    angle = math.atan(norm)
    rotation = np.eye(3) + math.sin(angle) * axis + (1.0 - math.cos(angle)) * axis @ axis
    return rotation_dvl_from_body.T @ rotation.T


_N = 5  # three angles, two scales
# Motion ahead moves along an axis of which this share of it is. What is less askew than that is so by rounding.
ALONG_FROM, _NOT_ASKEW = 0.4, 1e-9
# d([ψ×] + diag(κ)) / d(ψ, κ): (5, 3, 3)
_GENERATORS: Array = np.concatenate([skew(np.eye(3)), [np.diag(axis) for axis in np.eye(3)]])[:_N]
_NEWTON_STEPS = 20
# After a step as small as this what is left is smaller by orders of magnitude, below what anybody reads.
_LAST_STEP = 1e-10
# Where the prior hardly binds and the data do not either, the map is so curved that full steps run away to a DVL that
# measures nothing, with a σ of nothing: no step is longer than this in an angle (rad) or a scale. Gauss-Newton's steps
# go to and fro there, or shrink by so little each that they do not end (by a quarter, where 100 s at 0.02 m/s tell the
# scale to 0.1 per cent and roll not at all). Good data need three of them; from the ninth on the map's curvature is in
# the step.
_LONGEST_STEP, _GAUSS_NEWTON_STEPS, _STEPS = 0.2, 8, 60
_HALVINGS = 10


class Mapped(NamedTuple):
    """φ (3) rad and δk (2) as one vector (..., 5), and its derivative by ψ and κ (..., 5, 5)."""

    errors: Array
    jacobian: Array


def of_unseen_roll(rotation_dvl_from_body: Array) -> Array | None:
    """Q (2, 3, 3), ψᵀQ_i ψ being what δk_i is more than B_ii - 1; None of a DVL that is mounted along the vehicle."""
    ahead = rotation_dvl_from_body[:, 0]
    share = np.where(np.abs(ahead[:2]) > ALONG_FROM, 1.0 - ahead[:2] ** 2, 0.0)
    return share[:, None, None] * np.outer(ahead, ahead) if share.max() > _NOT_ASKEW else None


def errors_from_correction(correction: Array, roll: Array | None = None) -> Mapped:
    """ψ (3) and κ (2) as one vector (..., 5) -> φ, δk with their derivatives.

    roll: (2, 3, 3) of `of_unseen_roll`. Raises numpy.linalg.LinAlgError where there is no such B.
    """
    mapped = _by_inverse(correction)
    if roll is not None:
        slope = product(roll, correction[..., None, :3])
        mapped.errors[..., 3:] += (slope * correction[..., None, :3]).sum(axis=-1)
        mapped.jacobian[..., 3:, :3] += 2.0 * slope
    return mapped


def _by_inverse(correction: Array) -> Mapped:
    """φ, and B_ii - 1 for δk."""
    if correction.ndim == 1:
        try:
            return _errors_from_one_correction(correction)
        except ZeroDivisionError:
            raise np.linalg.LinAlgError("a correction that has no inverse") from None
    b = np.linalg.inv(_IDENTITY - (correction @ _GENERATORS.reshape(_N, 9)).reshape(*correction.shape[:-1], 3, 3))
    db = b[..., None, :, :] @ _GENERATORS @ b[..., None, :, :]  # (..., 5, 3, 3), by each of ψ and κ
    scale, dscale = np.diagonal(b, axis1=-2, axis2=-1), np.diagonal(db, axis1=-2, axis2=-1)
    c = b / scale[..., None]
    dc = (db - dscale[..., None] * c[..., None, :, :]) / scale[..., None, :, None]
    derivative = np.concatenate([_skew_part(dc), dscale], axis=-1)[..., :_N]
    return Mapped(np.concatenate([_skew_part(c), scale - 1.0], axis=-1)[..., :_N], np.swapaxes(derivative, -1, -2))


def _curvature(correction: Array, roll: Array | None) -> Array:
    """ψ, κ (..., 5) -> second derivatives of φ and δk (..., 5, 5, 5), the last axis theirs.

    d²B = B G_i B G_j B + B G_j B G_i B, and those of the quotients c_ij = b_ij / b_ii.
    """
    b = np.linalg.inv(_IDENTITY - (correction @ _GENERATORS.reshape(_N, 9)).reshape(*correction.shape[:-1], 3, 3))
    db = b[..., None, :, :] @ _GENERATORS @ b[..., None, :, :]
    one_way = (b[..., None, :, :] @ _GENERATORS)[..., :, None, :, :] @ db[..., None, :, :, :]
    d2b = one_way + np.swapaxes(one_way, -4, -3)
    scale, dscale, d2scale = (np.diagonal(each, axis1=-2, axis2=-1) for each in (b, db, d2b))
    c = b / scale[..., None]
    dc = (db - dscale[..., None] * c[..., None, :, :]) / scale[..., None, :, None]
    crossed = dscale[..., :, None, :, None] * dc[..., None, :, :, :]
    d2c = d2b - d2scale[..., None] * c[..., None, None, :, :] - crossed - np.swapaxes(crossed, -4, -3)
    d2c /= scale[..., None, None, :, None]
    found: Array = np.concatenate([_skew_part(d2c), d2scale], axis=-1)[..., :_N]
    if roll is not None:
        found[..., :3, :3, 3:] += 2.0 * np.moveaxis(roll, 0, -1)
    return found


def _errors_from_one_correction(correction: Array) -> Mapped:
    """`errors_from_correction` of one (5,): its few numbers are dealt with three times faster one by one, as live."""
    x, y, z, kx, ky = correction.tolist()
    rows = (1.0 - kx, z, -y), (-z, 1.0 - ky, x), (y, -x, 1.0)
    (a, b, c), (d, e, f), (g, h, i) = rows
    cofactors = (
        (e * i - f * h, c * h - b * i, b * f - c * e),
        (f * g - d * i, a * i - c * g, c * d - a * f),
        (d * h - e * g, b * g - a * h, a * e - b * d),
    )
    share = 1.0 / (a * cofactors[0][0] + b * cofactors[1][0] + c * cofactors[2][0])
    rows_of_b = top, middle, bottom = tuple([share * value for value in row] for row in cofactors)
    columns_of_b = tuple(zip(*rows_of_b, strict=True))
    scale = top[0], middle[1], bottom[2]
    slopes = [[_slopes(row, column) for column in columns_of_b] for row in rows_of_b]
    errors, derivatives = [], []
    # φ_x = (c_zy - c_yz) / 2 and so on with c_ij = b_ij / b_ii, whose derivatives are (db_ij - c_ij db_ii) / b_ii
    for i, j in ((2, 1), (0, 2), (1, 0)):
        of_i, of_j = scale[i], scale[j]
        one, other = rows_of_b[i][j] / of_i, rows_of_b[j][i] / of_j
        errors.append(0.5 * (one - other))
        row, opposite = slopes[i], slopes[j]
        derivatives.append(
            [
                0.5 * ((ij - one * ii) / of_i - (ji - other * jj) / of_j)
                for ij, ii, ji, jj in zip(row[j], row[i], opposite[i], opposite[j], strict=True)
            ]
        )
    for i in range(2):
        errors.append(scale[i] - 1.0)
        derivatives.append(list(slopes[i][i]))
    return Mapped(np.array(errors), np.array(derivatives))


def _slopes(row: Sequence[float], column: Sequence[float]) -> tuple[float, float, float, float, float]:
    """d(b_ij) by each of ψ and κ: B G B with B = (I - [ψ×] - diag(κ))⁻¹, from row i and column j of B."""
    left_x, left_y, left_z = row
    x, y, z = column
    return left_z * y - left_y * z, left_x * z - left_z * x, left_y * x - left_x * y, left_x * x, left_y * y


def correction_from_errors(errors: Array, roll: Array | None = None) -> Array:
    """φ, δk (..., 5) -> ψ, κ, by Newton's method from the first-order solution.

    roll: as in `errors_from_correction`.
    """
    correction = np.array(errors, dtype=float)
    for _ in range(_NEWTON_STEPS):
        mapped = errors_from_correction(correction, roll)
        step = _solve(mapped.jacobian, errors - mapped.errors)
        correction += step
        if np.abs(step).max() < 1e-16:
            break
    return correction


def to_errors(held: GaussianState, roll: Array | None) -> GaussianState:
    """States (..., n) whose first five are ψ and κ -> the same with φ and δk. roll: as in `errors_from_correction`."""
    mapped = errors_from_correction(held.x[..., :_N], roll)
    jacobian = _extended(mapped.jacobian, held.x.shape[-1])
    x = np.concatenate([mapped.errors, held.x[..., _N:]], axis=-1)
    return GaussianState(x, _propagated(jacobian, held.p))


def to_correction(state: GaussianState, roll: Array | None) -> GaussianState:
    """The inverse of `to_errors`."""
    correction = correction_from_errors(state.x[..., :_N], roll)
    jacobian = np.linalg.inv(errors_from_correction(correction, roll).jacobian)
    x = np.concatenate([correction, state.x[..., _N:]], axis=-1)
    return GaussianState(x, _propagated(_extended(jacobian, x.shape[-1]), state.p))


class PriorOnErrors:
    """`to_errors` of a filter's states, with the prior where it belongs: on φ and δk.

    The filter ran on ψ and κ from `start`, the first-order image of `prior`. A prior of zero scale that was put on κ
    would pull the found scale towards that of a rotation by no angle, 0.4 per cent off at 5 degrees where the data is
    weak. What the filter has gained, Λ - Λ_start, is the data's alone; with it the maximum of the posterior is found
    by Gauss-Newton, and by Newton where that does not end, exact as the data is linear in ψ and κ.
    """

    def __init__(self, start: GaussianState, prior: GaussianState, roll: Array | None) -> None:
        """Both (n,), or (K, n) for filters with a prior each. roll: as in `errors_from_correction`."""
        self._roll = roll
        self._started, self._started_state = start.information
        self._information = np.linalg.inv(prior.p)
        self._mean = prior.x

    def part(self, at: Index) -> PriorOnErrors:
        """Of some of K filters."""
        some = copy(self)
        some._started, some._started_state = self._started[at], self._started_state[at]
        some._information, some._mean = self._information[at], self._mean[at]
        return some

    def to_errors(self, held: GaussianState) -> GaussianState:
        """States x (..., n), P (..., n, n) of the filter -> of the errors.

        Raises numpy.linalg.LinAlgError where the maximum is not found.
        """
        information, state = held.information
        gained, gained_state = information - self._started, state - self._started_state
        x = held.x
        for n in range(_STEPS):
            mapped = errors_from_correction(x[..., :_N], self._roll)
            errors = np.concatenate([mapped.errors, x[..., _N:]], axis=-1)
            jacobian = _extended(mapped.jacobian, x.shape[-1])
            weighted = np.swapaxes(jacobian, -1, -2) @ self._information
            information = gained + weighted @ jacobian
            if n < _GAUSS_NEWTON_STEPS:
                told = gained_state + product(weighted, product(jacobian, x) + self._mean - errors)
                step = _no_longer(_solve(information, told) - x)
            else:
                slope = gained_state - product(gained, x) + product(weighted, self._mean - errors)
                step = _no_longer(self._newton_step(information, x, errors, slope))
                step = self._ascending(gained, gained_state, x, step)
            x = x + step
            if np.abs(step).max() < _LAST_STEP:
                break
        else:
            raise np.linalg.LinAlgError("no maximum of the posterior is found")
        # the last step is so small that the errors after it need no new linearisation
        return GaussianState(errors + product(jacobian, step), _propagated(jacobian, np.linalg.inv(information)))

    def _newton_step(self, information: Array, x: Array, errors: Array, slope: Array) -> Array:
        """Steps (..., n) by the posterior's own curvature. slope: (..., n), its derivative.

        Where it is curved upwards, as between two maxima of a roll of either sign, a step goes the way of the slope all
        the same: curvatures are taken without their signs.
        """
        curved = information.copy()
        pull = product(self._information, errors - self._mean)[..., :_N]
        curved[..., :_N, :_N] += (_curvature(x[..., :_N], self._roll) @ pull[..., None, :, None])[..., 0]
        curvature, along = np.linalg.eigh(curved)
        curvature = np.abs(curvature)
        curvature = np.maximum(curvature, np.finfo(float).eps * curvature.max(axis=-1, keepdims=True))
        return product(along, product(np.swapaxes(along, -1, -2), slope) / curvature)

    def _ascending(self, gained: Array, gained_state: Array, x: Array, step: Array) -> Array:
        """Steps (..., n), halved until the posterior is not less after them than before."""

        def cost(at: Array) -> Array:
            errors = errors_from_correction(at[..., :_N], self._roll).errors
            off = np.concatenate([errors, at[..., _N:]], axis=-1) - self._mean
            found: Array = 0.5 * (at * product(gained, at) + off * product(self._information, off)) - gained_state * at
            return found.sum(axis=-1, keepdims=True)

        limit = cost(x)
        limit = limit + 1e-12 * np.abs(limit)  # what rounding makes of it
        for _ in range(_HALVINGS):
            worse = cost(x + step) > limit
            if not worse.any():
                break
            step = np.where(worse, 0.5 * step, step)
        return step


def _no_longer(step: Array) -> Array:
    """Steps (..., n), shortened to `_LONGEST_STEP`."""
    longest = np.abs(step[..., :_N]).max(axis=-1, keepdims=True)
    return step * (_LONGEST_STEP / np.maximum(longest, _LONGEST_STEP))


def _extended(jacobian: Array, n: int) -> Array:
    """(..., 5, 5) -> (..., n, n): further states are as they are."""
    if jacobian.ndim == 2:
        one = _identity(n).copy()
        one[:_N, :_N] = jacobian
        return one
    extended = np.empty((*jacobian.shape[:-2], n, n))
    extended[...] = _identity(n)
    extended[..., :_N, :_N] = jacobian
    return extended


@cache
def _identity(n: int) -> Array:
    """(n, n); not to be written to."""
    return np.eye(n)


def _solve(matrix: Array, vector: Array) -> Array:
    """Inverse of (..., n, n) times (..., n)."""
    solved: Array = np.linalg.solve(matrix, vector[..., None])[..., 0]
    return solved


def _propagated(jacobian: Array, p: Array) -> Array:
    p = jacobian @ p @ np.swapaxes(jacobian, -1, -2)
    symmetric: Array = 0.5 * (p + np.swapaxes(p, -1, -2))
    return symmetric


def _skew_part(matrix: Array) -> Array:
    """Vector (..., 3) of the skew-symmetric part of (..., 3, 3)."""
    # the inner product of two skew matrices is twice that of their vectors
    part: Array = 0.5 * matrix.reshape(*matrix.shape[:-2], 9) @ _GENERATORS[:3].reshape(3, 9).T
    return part
