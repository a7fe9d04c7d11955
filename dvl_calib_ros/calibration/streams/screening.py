"""Which samples are valid at all. What is not is counted and never reaches the filter.

Each rule stands here twice, for one sample and for columns of them; test_alignment.py holds both equal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..numerics.frames import Array, Quaternion, Vector
from ..numerics.samples import Codes, Covariances, Mask

# A variance below (1 µm/s)² is no claim that a velocity sensor can make; it is taken as not given, like zero.
SMALLEST_VARIANCE = 1e-12
# From this variance, (m/s)², on an axis is not measured: at a standard deviation of 30 m/s nothing is known of a
# vehicle's velocity. Drivers of receivers without a vertical velocity send such variances, or -1.
NOT_MEASURED_VARIANCE = 1e3
# rad/s; gyroscopes end at a third of this, and a number that is far above would overflow
LARGEST_RATE = 100.0
_NOT_MEASURED_FLAG = -1.0
_BITS = np.array([1, 2, 4], dtype=np.uint8)
ALL_AXES, VERTICAL = 7, 4


def is_valid_velocity(velocity: Vector, max_speed: float) -> bool:
    """Finite, and not faster than max_speed (m/s)."""
    x, y, z = velocity
    return x * x + y * y + z * z <= max_speed * max_speed  # False for nan and inf, too


def are_valid_velocities(velocity: Array, max_speed: float) -> Mask:
    """`is_valid_velocity` of (N, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = velocity.T
        valid: Mask = x * x + y * y + z * z <= max_speed * max_speed
    return valid


class Screened(NamedTuple):
    """What a velocity's covariance says.

    valid: whether the sample may be used. covariance: (3, 3) (m/s)², symmetric positive definite; None where not
    given. unmeasured: a bit (1, 2, 4) for every axis that is not measured; its variance in the covariance is 1, and
    means nothing.
    """

    valid: bool
    covariance: Array | None
    unmeasured: int = 0


_NOT_GIVEN = Screened(True, None)


def screened_covariance(covariance: Array | None, believed: bool = True) -> Screened:
    """Judge one covariance (3, 3).

    A zero variance means "not given" (the whole covariance then is); a negative or non-finite one, or a matrix that
    is not positive definite, is invalid. A variance of -1 or of `NOT_MEASURED_VARIANCE` and more: not measured.

    believed: whether covariances are used (parameter use_message_covariance); where they are not, one that says that
    no axis is measured is not given.
    """
    if covariance is None:
        return _NOT_GIVEN
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = covariance.tolist()
    if not (min(xx, yy, zz) >= 0.0 and max(xx, yy, zz) < NOT_MEASURED_VARIANCE):
        valid, given, found, unmeasured = screened_covariances(covariance[None], believed)
        return Screened(bool(valid[0]), found[0] if given[0] else None, int(unmeasured[0]))
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


def screened_covariances(covariance: Array, believed: bool = True) -> tuple[Mask, Mask, Array, Codes]:
    """`screened_covariance` of (C, 3, 3): valid (C,), given (C,), covariance (C, 3, 3), unmeasured (C,)."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    with np.errstate(invalid="ignore", over="ignore"):
        finite = np.isfinite(covariance.reshape(-1, 9).sum(axis=1))
        is_large = variance >= NOT_MEASURED_VARIANCE
        says_nothing: Mask = np.logical_and(is_large.all(axis=1), not believed)
        unmeasured = (variance == _NOT_MEASURED_FLAG) | (is_large & ~says_nothing[:, None])
        least = np.where(unmeasured, 1.0, variance).min(axis=1)
        given = (least >= SMALLEST_VARIANCE) & ~says_nothing
        found = 0.5 * (covariance + covariance.swapaxes(1, 2))
        found = np.where(unmeasured[:, :, None] | unmeasured[:, None, :], 0.0, found)
        found[:, range(3), range(3)] = np.where(unmeasured, 1.0, variance)
        xx, yy, zz = found[:, 0, 0], found[:, 1, 1], found[:, 2, 2]
        xy, xz, yz = found[:, 0, 1], found[:, 0, 2], found[:, 1, 2]
        determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        definite = (xx * yy - xy * xy > 0.0) & (determinant > 0.0)
    valid = finite & (least >= 0.0) & (definite | ~given)
    return valid, given, found, (unmeasured * _BITS).sum(axis=1).astype(np.uint8)


def measured_axes(velocity: Array, unmeasured: Codes, gnss_axes: str) -> tuple[bool, bool, bool]:
    """Which axes a reference measures: most of its messages say so, the parameter does, and one is not 0 throughout.

    velocity: (N, 3) m/s. unmeasured: (N,) as of `Screened`. gnss_axes: as the parameter.
    """
    unmeasured = np.where(unmeasured == ALL_AXES, 0, unmeasured)  # such a message says nothing of a single axis
    measured = [2 * np.count_nonzero(unmeasured & bit) < len(unmeasured) for bit in _BITS]
    if gnss_axes != "auto":
        measured[2] = gnss_axes == "xyz"
    x, y, z = map(bool, measured)
    return x, y, z and bool(velocity[:, 2].any())


class CovarianceScreen:
    """`screened_covariance` that recognises the covariance of the sample before: most streams repeat it."""

    def __init__(self, believed: bool) -> None:
        self._believed = believed
        self._seen: Array | None = None
        self._result = _NOT_GIVEN

    def __call__(self, covariance: Array | None) -> Screened:
        """As `screened_covariance`; the same object in gives the same object out."""
        if covariance is not self._seen:
            self._result = screened_covariance(covariance, self._believed)
            self._seen = covariance
        return self._result


class ScreenedColumns(NamedTuple):
    """`Screened` of N rows: valid (N,), covariance (N, 3, 3) with nan where not given, unmeasured (N,)."""

    valid: Mask
    covariance: Array
    unmeasured: Codes


def screen_columns(covariances: Covariances, believed: bool = True) -> ScreenedColumns:
    """`screened_covariance` of N rows."""
    valid, given, found, unmeasured = screened_covariances(covariances.distinct, believed)
    # the last ones are for rows without, whose index is -1
    valid, unmeasured = np.append(valid, True), np.append(unmeasured, np.uint8(0))
    found = np.concatenate([np.where(given[:, None, None], found, np.nan), np.full((1, 3, 3), np.nan)])
    return ScreenedColumns(valid[covariances.index], found[covariances.index], unmeasured[covariances.index])


def unit_quaternion(q: Quaternion | None) -> Quaternion | None:
    """The quaternion with its length made one; None if it has none worth the name (nan, or all zero)."""
    if q is None:
        return None
    x, y, z, w = q
    square = x * x + y * y + z * z + w * w
    if abs(square - 1.0) < 1e-9:
        return q
    if not 0.25 < square < 4.0:  # nan and inf, too
        return None
    scale = 1.0 / math.sqrt(square)
    return x * scale, y * scale, z * scale, w * scale


def unit_quaternions(q: Array) -> Array:
    """`unit_quaternion` of (N, 4); nan where there is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z, w = q.T
        square = x * x + y * y + z * z + w * w
        is_unit = np.abs(square - 1.0) < 1e-9
        usable = is_unit | ((square > 0.25) & (square < 4.0))
        scale = np.where(is_unit, 1.0, 1.0 / np.sqrt(np.where(usable, square, np.nan)))
        scaled: Array = q * scale[:, None]
    return scaled


def is_valid_rate(angular_velocity: Vector) -> bool:
    """Finite, and no faster than anything turns that carries a DVL."""
    x, y, z = angular_velocity
    return x * x + y * y + z * z <= LARGEST_RATE * LARGEST_RATE


def valid_rates(angular_velocity: Array) -> Array:
    """(N, 3) with nan in all of a row that is not as `is_valid_rate` wants it."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = angular_velocity.T
        valid = x * x + y * y + z * z <= LARGEST_RATE * LARGEST_RATE
    return np.where(valid[:, None], angular_velocity, np.nan)
