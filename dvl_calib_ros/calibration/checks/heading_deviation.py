"""Check of the heading for a deviation that changes with the heading.

A constant error of the IMU's heading is harmless, because the same IMU navigates. `full` estimates the deviation with
the mounting; this check judges it on the headings driven.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.tests import Z_ONE_TEST, chance_of, chi2_isf

# Reported from this rms (rad).
REPORTED_FROM_RAD = math.radians(0.3)
# Rms (rad) from which the compass must be calibrated first (QRev's rule).
FIRST = math.radians(3.0)


class HeadingDeviation(NamedTuple):
    """Heading deviation on the headings driven.

    rms, std: rad, of the deviation about its mean, and of its estimate. most, least: rad, at headings most_at, least_at
    (rad, from north, clockwise).
    """

    rms: float
    std: float
    most: float
    most_at: float
    least: float
    least_at: float


def heading_deviation(yaw: Array, coefficients: GaussianState) -> HeadingDeviation | None:
    """Return the heading deviation; None if not significant.

    Parameters
    ----------
    yaw: (N,) rad, from east, counterclockwise.
    coefficients: x (4,), P (4, 4), see `Estimate.heading_deviation`.
    """
    if not len(yaw):
        return None
    terms = np.stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw)], axis=1)
    terms -= terms.mean(axis=0)
    deviation = terms @ coefficients.x
    rms = float(np.sqrt((deviation**2).mean()))
    std = math.sqrt(max(float(np.einsum("ni,ij,nj->n", terms, coefficients.p, terms).mean()), 0.0))
    chi_square = float(coefficients.x @ np.linalg.solve(coefficients.p, coefficients.x))
    if rms < REPORTED_FROM_RAD or chi_square < chi2_isf(chance_of(Z_ONE_TEST), len(coefficients.x)):
        return None
    most, least = int(np.argmax(deviation)), int(np.argmin(deviation))
    north = (0.5 * math.pi - yaw) % (2.0 * math.pi)
    return HeadingDeviation(
        rms, std, float(deviation[most]), float(north[most]), float(deviation[least]), float(north[least])
    )  # fmt: skip


def heading_warning(deviation: HeadingDeviation) -> Reason:
    """Return the warning; it rejects a calibration if the compass must be calibrated before the mounting."""
    degrees = math.degrees
    is_first = deviation.rms > max(FIRST, Z_ONE_TEST * deviation.std)
    first = " first" if is_first else ""
    warning = finding(
        "HEADING_DEVIATION", rms=degrees(deviation.rms), std=degrees(deviation.std), most=degrees(deviation.most),
        most_at=degrees(deviation.most_at), least=degrees(deviation.least), least_at=degrees(deviation.least_at),
        cost=1000.0 * deviation.rms, first=first,
    )  # fmt: skip
    return warning.weighed(Severity.REJECT if is_first else Severity.WARNING)
