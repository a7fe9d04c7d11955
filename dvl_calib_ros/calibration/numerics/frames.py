"""Rotations and frames (REP-103, REP-105).

Names of rotations hold both frames: ``v_a = rotation_a_from_b @ v_b``. Quaternions are ``(x, y, z, w)`` as in
geometry_msgs. Angles are radians.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# forward-right-down <-> forward-left-up, and its own inverse
FLU_FROM_FRD: Array = np.diag([1.0, -1.0, -1.0])
# north-west-up -> east-north-up
ENU_FROM_NWU: Array = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# north-east-down -> east-north-up, and its own inverse
ENU_FROM_NED: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


# skew(a) is linear in a: its nine elements, row by row, are a @ _SKEW.
_SKEW: Array = np.zeros((3, 9))
for _axis, _row, _column in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
    _SKEW[_axis, 3 * _row + _column] = 1.0
    _SKEW[_axis, 3 * _column + _row] = -1.0


def skew(a: ArrayLike) -> Array:
    """Return the cross-product matrix, ``skew(a) @ b == cross(a, b)``: (..., 3) -> (..., 3, 3), finite values."""
    a = np.asarray(a, dtype=float)
    return (a @ _SKEW).reshape(*a.shape, 3)


def turned_skew(rotation: Array, a: Array) -> Array:
    """Return ``rotation @ skew(a)`` (m, 3, N) of a rotation (m, 3) and vectors as columns (3, N)."""
    of_axes = (rotation @ _SKEW.reshape(3, 3, 3)).reshape(3, -1)
    return (of_axes.T @ a).reshape(len(rotation), 3, a.shape[1])


def cross(a: Array, b: Array) -> Array:
    """Return a × b of vectors (..., 3); faster than `numpy.cross`, which moves axes."""
    x, y, z = (a[..., axis] for axis in range(3))
    u, v, w = (b[..., axis] for axis in range(3))
    product: Array = np.empty((*np.broadcast_shapes(a.shape, b.shape),))
    product[..., 0] = y * w - z * v
    product[..., 1] = z * u - x * w
    product[..., 2] = x * v - y * u
    return product


def cross_columns(a: Array, b: Array) -> Array:
    """Return a × b (3, N) of vectors as columns, (3, N) or (3,)."""
    x, y, z = a
    u, v, w = b
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def squared(a: Array) -> Array:
    """Return squared lengths (...) of vectors (..., k), k >= 1.

    Equal to ``(a**2).sum(axis=-1)`` to the last bit, and seven times faster for 4000 x 3.
    """
    squares = a * a
    total: Array = squares[..., 0].copy()
    for axis in range(1, a.shape[-1]):
        total += squares[..., axis]
    return total


def product(matrix: Array, vector: Array) -> Array:
    """Return the products (..., m) of matrices (..., m, n) and vectors (..., n)."""
    found: Array = (matrix @ vector[..., None])[..., 0]
    return found


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Return the rotation of a URDF ``origin rpy``: about the fixed axes X, then Y, then Z.

    ``(..., 3)`` -> ``(..., 3, 3)``: ``rotation_parent_from_child`` for the pose of a child in its parent. Roll, pitch,
    yaw of a body in a navigation frame give ``rotation_navigation_from_body``.
    """
    roll, pitch, yaw = np.moveaxis(np.asarray(rpy, dtype=float), -1, 0)
    cr, sr, cp, sp, cy, sy = (
        np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw),
    )  # fmt: skip
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rpy_from_rotation(rotation: ArrayLike) -> Array:
    """Return roll, pitch, yaw (3,) of one rotation (3, 3), pitch within ±pi/2; inverse of `rotation_from_rpy`."""
    r = np.asarray(rotation, dtype=float)
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    if math.hypot(r[0, 0], r[1, 0]) < 1e-12:  # gimbal lock: only yaw -/+ roll is defined; assign it to yaw
        return np.array([0.0, pitch, math.atan2(-r[0, 1], r[1, 1])])
    return np.array([math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])])


def near_angles(angles: ArrayLike, nominal: ArrayLike) -> Array:
    """Unwrap angles (...) rad to within half a turn of nominal ones."""
    angles = np.asarray(angles, dtype=float)
    return angles - 2.0 * np.pi * np.round((angles - nominal) / (2.0 * np.pi))


def over_ground(speed: ArrayLike, course: ArrayLike) -> Array:
    """Return east, north, up (..., 3) m/s of a speed (...) and a course (...) rad, clockwise from true north.

    Up is exactly 0, which marks an axis as not measured.
    """
    speed, course = np.asarray(speed, dtype=float), np.asarray(course, dtype=float)
    return np.stack([speed * np.sin(course), speed * np.cos(course), np.zeros_like(course)], axis=-1)


def whole_degrees(rotation: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw (rad) of a rotation (3, 3), rounded to whole degrees."""
    roll, pitch, yaw = (np.radians(np.round(np.degrees(rpy_from_rotation(rotation)))) + 0.0).tolist()
    return roll, pitch, yaw


def quaternion_from_rotation(rotation: ArrayLike) -> Quaternion:
    """Return the unit quaternion (x, y, z, w), w >= 0, of one rotation (3, 3), by Shepperd's method."""
    r = np.asarray(rotation, dtype=float).tolist()  # for one rotation, plain floats are several times faster
    diagonal = [r[0][0], r[1][1], r[2][2]]
    trace = sum(diagonal)
    terms = [*diagonal, trace]
    largest = terms.index(max(terms))
    if largest == 3:
        q = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1], 1.0 + trace]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = [0.0, 0.0, 0.0, r[k][j] - r[j][k]]
        q[i] = 1.0 + 2.0 * diagonal[i] - trace
        q[j] = r[j][i] + r[i][j]
        q[k] = r[k][i] + r[i][k]
    norm = math.hypot(*q)
    x, y, z, w = (term / norm if q[3] >= 0.0 else -(term / norm) for term in q)
    return x, y, z, w


def rotation_from_quaternion(q: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4) in the order x, y, z, w."""
    q = np.asarray(q, dtype=float)
    x, y, z, w = (q[..., i] for i in range(4))
    xx, yy, zz, xy, xz, yz, xw, yw, zw = x * x, y * y, z * z, x * y, x * z, y * z, x * w, y * w, z * w
    rotation = np.empty((*q.shape[:-1], 3, 3))
    rotation[..., 0, 0], rotation[..., 0, 1], rotation[..., 0, 2] = 1 - 2 * (yy + zz), 2 * (xy - zw), 2 * (xz + yw)
    rotation[..., 1, 0], rotation[..., 1, 1], rotation[..., 1, 2] = 2 * (xy + zw), 1 - 2 * (xx + zz), 2 * (yz - xw)
    rotation[..., 2, 0], rotation[..., 2, 1], rotation[..., 2, 2] = 2 * (xz - yw), 2 * (yz + xw), 1 - 2 * (xx + yy)
    return rotation


def rotation_vector(q: ArrayLike) -> Array:
    """Return axis times angle (..., 3) rad, at most pi, of unit quaternions (..., 4), exact for all angles."""
    quaternion = np.asarray(q, dtype=float)
    vector, scalar = quaternion[..., :3], quaternion[..., 3:]
    sine = np.sqrt(squared(vector))[..., None]
    angle = 2.0 * np.arctan2(sine, np.abs(scalar))
    turn: Array = np.copysign(1.0, scalar) * vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return turn


# Cosine of half the angle of a short arc: below 2 mrad the chord is exact to 1e-10. Half the angle (rad) that gives it.
_SHORT_ARC, _CHORD_RAD = 0.9999995, 1e-8


def slerps(q0: Array, q1: Array, fraction: Array) -> Array:
    """Interpolate N pairs of unit quaternions (N, 4) spherically along the shorter arc.

    fraction: (N,) in 0..1. nan where either is nan. Fastest if the columns are contiguous.
    """
    a, b = q0.T, q1.T
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    size = np.minimum(np.abs(dot), 1.0)
    angle = np.where(size > _SHORT_ARC, _CHORD_RAD, np.arccos(size))
    sine = np.sin(angle)
    w0 = np.sin((1.0 - fraction) * angle) / sine
    w1 = np.sin(fraction * angle) / np.copysign(sine, dot)
    mixed = a * w0 + b * w1
    unit: Array = mixed / np.sqrt(squared(mixed.T))
    return unit.T


def turned_back(q: Array, vectors: Array) -> Array:
    """Return ``rotation.T @ v`` (3, N) of vectors (3, N) for the rotations of unit quaternions (N, 4)."""
    axis, cosine = q.T[:3], q.T[3]
    twice = 2.0 * cross_columns(vectors, axis)
    turned: Array = vectors + cosine * twice + cross_columns(twice, axis)
    return turned


def attitude_enu_flu_from_ned_frd(rpy: ArrayLike) -> Array:
    """Convert the attitude of marine instruments to ROS.

    Roll, pitch, yaw (..., 3) of a forward-right-down body in north-east-down (Z-Y-X order) ->
    ``rotation_enu_from_body`` (..., 3, 3) of the forward-left-up body.
    """
    return ENU_FROM_NED @ rotation_from_rpy(rpy) @ FLU_FROM_FRD


def nearest_rotation(products: Array) -> Array:
    """Return the rotations C (..., 3, 3) that minimise Σ|a - C b|², from Σ a bᵀ (..., 3, 3).

    Wahba's problem, by singular values (Markley, "Attitude determination using vector observations", 1988).
    """
    u, _, vt = np.linalg.svd(products)
    proper = np.ones((*u.shape[:-2], 3))
    proper[..., 2] = np.linalg.det(u @ vt)
    found: Array = u * proper[..., None, :] @ vt
    return found


def turn_between(before: Array, after: Array) -> Array:
    """Return axis times angle (3,) rad of the rotation between two mountings (3, 3), about body axes."""
    return rotation_vector(quaternion_from_rotation(after @ before.T))


def rotation_of(vector: Array) -> Array:
    """Return the rotation (3, 3) of axis times angle (3,) rad, by the formula of Rodrigues."""
    angle = math.hypot(*vector)
    if angle == 0.0:
        return np.eye(3)
    k = skew(np.asarray(vector) / angle)
    return np.asarray(np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * k @ k)
