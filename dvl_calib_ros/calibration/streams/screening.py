"""Validity of samples: invalid ones are counted and never reach the filter.

Each rule is implemented for one sample and for columns; test_alignment.py holds both equal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..numerics.frames import Array, Quaternion, Vector
from ..numerics.samples import AXIS_BITS, Codes, Covariances, Mask

# Smaller variances, (1 µm/s)², are implausible for a velocity sensor and count as not given, like zero.
SMALLEST_VARIANCE = 1e-12
# Variance, (m/s)², from which an axis is not measured: drivers of receivers without vertical velocity send such values
# (a standard deviation of 30 m/s) or -1.
NOT_MEASURED_VARIANCE = 1e3
# rad/s, three times the range of gyroscopes; limits overflow
LARGEST_RATE = 100.0
_NOT_MEASURED_FLAG = -1.0
ALL_AXES, VERTICAL = 7, 4


def is_valid_velocity(velocity: Vector, max_speed: float) -> bool:
    """Return whether a velocity is finite and not faster than max_speed (m/s)."""
    x, y, z = velocity
    return x * x + y * y + z * z <= max_speed * max_speed  # False for nan and inf, too


def are_valid_velocities(velocity: Array, max_speed: float) -> Mask:
    """Return `is_valid_velocity` for (N, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = velocity.T
        valid: Mask = x * x + y * y + z * z <= max_speed * max_speed
    return valid


class Screened(NamedTuple):
    """Screened covariance of a velocity.

    valid: the sample may be used.
    covariance: (3, 3) (m/s)², symmetric positive definite; None if not given.
    unmeasured: a bit (1, 2, 4) per axis that is not measured; its variance in the covariance is a placeholder of 1.
    """

    valid: bool
    covariance: Array | None
    unmeasured: int = 0


_NOT_GIVEN = Screened(True, None)


def screened_covariance(covariance: Array | None, believed: bool = True) -> Screened:
    """Screen one covariance (3, 3).

    A zero variance marks the whole covariance as not given. A negative or non-finite variance, or a matrix that is not
    positive definite, is invalid. A variance of -1 or from `NOT_MEASURED_VARIANCE` on marks an axis as not measured.

    believed: parameter use_message_covariance. If False, a covariance without any measured axis counts as not given.
    """
    if covariance is None:
        return _NOT_GIVEN
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = covariance.tolist()
    if not (min(xx, yy, zz) >= 0.0 and max(xx, yy, zz) < NOT_MEASURED_VARIANCE):
        one = screened_covariances(covariance[None], believed)
        return Screened(bool(one.valid[0]), one.covariance[0] if one.given[0] else None, int(one.unmeasured[0]))
    if not math.isfinite(xx + xy + xz + yx + yy + yz + zx + zy + zz):
        return Screened(False, None)
    if min(xx, yy, zz) < SMALLEST_VARIANCE:
        return _NOT_GIVEN
    if not (xy == yx and xz == zx and yz == zy):
        covariance = 0.5 * (covariance + covariance.T)
        xy, xz, yz = 0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy)
    minor = xx * yy - xy * xy
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return Screened(minor > 0.0 and determinant > 0.0, covariance)


class ScreenedMatrices(NamedTuple):
    """`Screened` for C matrices: valid (C,), given (C,), covariance (C, 3, 3), unmeasured (C,)."""

    valid: Mask
    given: Mask
    covariance: Array
    unmeasured: Codes


def screened_covariances(covariance: Array, believed: bool = True) -> ScreenedMatrices:
    """Screen covariances (C, 3, 3), see `screened_covariance`."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    with np.errstate(invalid="ignore", over="ignore"):
        finite = np.isfinite(covariance.reshape(-1, 9).sum(axis=1))
        is_large = variance >= NOT_MEASURED_VARIANCE
        is_empty: Mask = np.logical_and(is_large.all(axis=1), not believed)
        unmeasured = (variance == _NOT_MEASURED_FLAG) | (is_large & ~is_empty[:, None])
        smallest = np.where(unmeasured, 1.0, variance).min(axis=1)
        given = (smallest >= SMALLEST_VARIANCE) & ~is_empty
        symmetric = 0.5 * (covariance + covariance.swapaxes(1, 2))
        symmetric = np.where(unmeasured[:, :, None] | unmeasured[:, None, :], 0.0, symmetric)
        symmetric[:, range(3), range(3)] = np.where(unmeasured, 1.0, variance)
        xx, yy, zz = symmetric[:, 0, 0], symmetric[:, 1, 1], symmetric[:, 2, 2]
        xy, xz, yz = symmetric[:, 0, 1], symmetric[:, 0, 2], symmetric[:, 1, 2]
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        definite = (xx * yy - xy * xy > 0.0) & (determinant > 0.0)
    valid = finite & (smallest >= 0.0) & (definite | ~given)
    return ScreenedMatrices(valid, given, symmetric, (unmeasured * AXIS_BITS).sum(axis=1).astype(np.uint8))


def measured_axes(velocity: Array, unmeasured: Codes, gnss_axes: str) -> tuple[bool, bool, bool]:
    """Return the measured axes of a reference: by most messages, by the parameter, and z not constantly 0.

    velocity: (N, 3) m/s.
    unmeasured: (N,) as in `Screened`.
    gnss_axes: the parameter.
    """
    unmeasured = np.where(unmeasured == ALL_AXES, 0, unmeasured)  # all unmeasured: no evidence per axis
    measured = [2 * np.count_nonzero(unmeasured & bit) < len(unmeasured) for bit in AXIS_BITS]
    if gnss_axes != "auto":
        measured[2] = gnss_axes == "xyz"
    x, y, z = map(bool, measured)
    return x, y, z and bool(velocity[:, 2].any())


class CovarianceScreen:
    """`screened_covariance` with a cache of the last covariance, which most streams repeat."""

    def __init__(self, believed: bool) -> None:
        self._believed = believed
        self._seen: Array | None = None
        self._result = _NOT_GIVEN

    def __call__(self, covariance: Array | None) -> Screened:
        """Return the screened covariance; the same object for the same input object."""
        if covariance is not self._seen:
            self._result = screened_covariance(covariance, self._believed)
            self._seen = covariance
        return self._result


class ScreenedColumns(NamedTuple):
    """`Screened` for N rows: valid (N,), covariance (N, 3, 3) with nan where not given, unmeasured (N,)."""

    valid: Mask
    covariance: Array
    unmeasured: Codes


def screen_columns(covariances: Covariances, believed: bool = True) -> ScreenedColumns:
    """Screen the covariances of N rows."""
    each = screened_covariances(covariances.distinct, believed)
    known = np.where(each.given[:, None, None], each.covariance, np.nan)
    # the last entry is for rows without covariance, whose index is -1
    valid, unmeasured = np.append(each.valid, True), np.append(each.unmeasured, np.uint8(0))
    covariance = np.concatenate([known, np.full((1, 3, 3), np.nan)])
    return ScreenedColumns(valid[covariances.index], covariance[covariances.index], unmeasured[covariances.index])


def unit_quaternion(q: Quaternion | None) -> Quaternion | None:
    """Return the normalised quaternion, or None if its length is not near 1."""
    if q is None:
        return None
    x, y, z, w = q
    square = x * x + y * y + z * z + w * w
    if abs(square - 1.0) < 1e-9:
        return q
    if not 0.25 < square < 4.0:  # nan and inf are rejected, too
        return None
    scale = 1.0 / math.sqrt(square)
    return x * scale, y * scale, z * scale, w * scale


def unit_quaternions(q: Array) -> Array:
    """Return `unit_quaternion` for (N, 4); nan where invalid."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z, w = q.T
        square = x * x + y * y + z * z + w * w
        is_unit = np.abs(square - 1.0) < 1e-9
        usable = is_unit | ((square > 0.25) & (square < 4.0))
        scale = np.where(is_unit, 1.0, 1.0 / np.sqrt(np.where(usable, square, np.nan)))
        scaled: Array = q * scale[:, None]
    return scaled


def is_valid_rate(angular_velocity: Vector) -> bool:
    """Return whether an angular velocity is finite and plausible for a vehicle."""
    x, y, z = angular_velocity
    return x * x + y * y + z * z <= LARGEST_RATE * LARGEST_RATE


def valid_rates(angular_velocity: Array) -> Array:
    """Return rates (N, 3) with nan in rows that `is_valid_rate` rejects."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = angular_velocity.T
        valid = x * x + y * y + z * z <= LARGEST_RATE * LARGEST_RATE
    return np.where(valid[:, None], angular_velocity, np.nan)
