"""Which samples are valid at all. What is not is counted and never reaches the filter."""

from __future__ import annotations

import math

from .frames import Array, Quaternion, Vector

# A variance below (1 µm/s)² is no claim that a velocity sensor can make; it is taken as not given, like zero.
SMALLEST_VARIANCE = 1e-12


def is_valid_velocity(velocity: Vector, max_speed: float) -> bool:
    """Finite, and not faster than max_speed (m/s)."""
    x, y, z = velocity
    return x * x + y * y + z * z <= max_speed * max_speed  # False for nan and inf, too


def usable_covariance(covariance: Array | None) -> tuple[bool, Array | None]:
    """Whether a velocity covariance (3, 3) is valid, and the covariance if it is given.

    A zero variance means "not given" (the whole covariance then is); a negative or non-finite one, or a matrix that
    is not positive definite, is invalid.
    """
    if covariance is None:
        return True, None
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = covariance.tolist()
    if not math.isfinite(xx + xy + xz + yx + yy + yz + zx + zy + zz) or min(xx, yy, zz) < 0.0:
        return False, None
    if min(xx, yy, zz) < SMALLEST_VARIANCE:
        return True, None
    if not (xy == yx and xz == zx and yz == zy):
        covariance = 0.5 * (covariance + covariance.T)
        xy, xz, yz = 0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy)
    minor = xx * yy - xy * xy
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return minor > 0.0 and determinant > 0.0, covariance


class CovarianceScreen:
    """`usable_covariance` that recognises the covariance of the sample before: most streams repeat it."""

    def __init__(self) -> None:
        self._seen: Array | None = None
        self._result: tuple[bool, Array | None] = (True, None)

    def __call__(self, covariance: Array | None) -> tuple[bool, Array | None]:
        """As `usable_covariance`; the same object in gives the same object out."""
        if covariance is not self._seen:
            self._result = usable_covariance(covariance)
            self._seen = covariance
        return self._result


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
