"""Nonlinear DVL error model, its exact inverse and derivatives (docs/models.md, "Error model").

``v_d = (I + diag(δk)) (I + [φ×]) T v_b`` with ``T = rotation_dvl_from_body``: the nominal mounting, φ (3,) rad the
residual misalignment and δk (3,) the scale-factor errors, both in the DVL frame.
"""

from __future__ import annotations

import math

import numpy as np

from .frames import Array, skew

_IDENTITY: Array = np.eye(3)


def distort(velocity_body: Array, misalignment: Array, scale: Array, rotation_dvl_from_body: Array) -> Array:
    """Return the DVL measurement (..., 3) m/s, DVL frame, of body velocities (..., 3) m/s with these errors."""
    matrix = np.diag(1.0 + np.asarray(scale)) @ (np.eye(3) + skew(misalignment)) @ rotation_dvl_from_body
    return velocity_body @ matrix.T


def correction_matrix(misalignment: Array, scale: Array, rotation_dvl_from_body: Array) -> Array:
    """Return the matrix from measured DVL velocity to corrected body velocity: the inverse of `distort`.

    (..., 3) rad, (..., 3) -> (..., 3, 3).
    """
    phi = np.asarray(misalignment, dtype=float)
    # (I + [φ×])⁻¹ = (I - [φ×] + φφᵀ) / (1 + ‖φ‖²)
    inverse = _IDENTITY - skew(phi) + phi[..., :, None] * phi[..., None, :]
    inverse /= 1.0 + (phi * phi).sum(axis=-1)[..., None, None]
    matrix: Array = rotation_dvl_from_body.T @ inverse / (1.0 + np.asarray(scale))[..., None, :]
    return matrix


def correct(velocity_dvl: Array, misalignment: Array, scale: Array, rotation_dvl_from_body: Array) -> Array:
    """Return corrected body velocities (..., 3) m/s of measured DVL velocities (..., 3) m/s."""
    return velocity_dvl @ correction_matrix(misalignment, scale, rotation_dvl_from_body).T


# [v×] and -diag(v), joined (3, 6), are linear in v: their elements, row by row, are v @ CORRECTION_JACOBIAN.
CORRECTION_JACOBIAN: Array = np.concatenate([skew(np.eye(3)), [-np.diag(axis) for axis in np.eye(3)]], axis=2).reshape(
    3, 18
)


def correction_jacobian(velocity_dvl: Array, rotation_dvl_from_body: Array) -> Array:
    """Return d(corrected body velocity)/d(φ, δk) at small errors: (3,) m/s -> (3, 6).

    From the first-order inverse ``v_b = Tᵀ (v - φ×v - δk∘v)``: columns ``Tᵀ[v×]`` and ``-Tᵀ diag(v)``.
    """
    return rotation_dvl_from_body.T @ (velocity_dvl @ CORRECTION_JACOBIAN).reshape(3, 6)


def corrected_mounting(misalignment: Array, rotation_dvl_from_body: Array) -> Array:
    """Return the corrected mounting as ``rotation_body_from_dvl`` (3, 3).

    It uses the nearest rotation to ``I + [φ×]`` (its polar factor): the rotation about φ by atan‖φ‖.
    """
    norm = float(np.linalg.norm(misalignment))
    if norm == 0.0:
        return np.array(rotation_dvl_from_body.T)
    axis = skew(np.asarray(misalignment) / norm)
    angle = math.atan(norm)
    rotation = np.eye(3) + math.sin(angle) * axis + (1.0 - math.cos(angle)) * axis @ axis
    return rotation_dvl_from_body.T @ rotation.T
