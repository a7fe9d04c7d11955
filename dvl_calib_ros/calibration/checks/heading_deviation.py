"""Check of the heading for a deviation that changes with the heading or drifts.

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
from ..numerics.tests import chi2_isf
from ..results.results import Estimate

# Its rms (rad) is worth a word from here on, where as much is found by chance so seldom where there is none.
SAID_FROM, CHANCE = math.radians(0.3), 1e-3
# From here on (rad), and so many times its σ, the compass is to be calibrated first (QRev's rule).
FIRST, SURELY = math.radians(3.0), 3.0
# ... and, of at least so much (rad), where more than this share of the samples was gated: those that it turns most, so
# it may be larger.
GATED_FIRST, GATED_FROM = math.radians(1.0), 0.1
# A drift of so much (rad, rms; 1.2° from first to last) is no yaw to accept, whatever its σ holds: nobody knows when a
# heading that drifts was right.
DRIFTS_FROM = math.radians(0.35)


class HeadingDeviation(NamedTuple):
    """What the heading is off by on the headings driven.

    rms, std: rad, of the deviation about its mean, and of its estimate. most, least: rad, at headings most_at, least_at
    (rad, from north, clockwise). by_time: whether time says more than the heading.
    """

    rms: float
    std: float
    most: float
    most_at: float
    least: float
    least_at: float
    by_time: bool


def heading_deviation(time: Array, yaw: Array, coefficients: GaussianState) -> HeadingDeviation | None:
    """None where it does not show.

    Parameters
    ----------
    time: (N,) s.
    yaw: (N,) rad, from east, to the left.
    coefficients: x (5,), P (5, 5), as `Estimate.heading_deviation`.

    """
    if not len(yaw):
        return None
    terms = np.stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw), time], axis=1)
    terms -= terms.mean(axis=0)
    shown = terms @ coefficients.x
    rms = float(np.sqrt((shown**2).mean()))
    std = math.sqrt(max(float(np.einsum("ni,ij,nj->n", terms, coefficients.p, terms).mean()), 0.0))
    found = float(coefficients.x @ np.linalg.solve(coefficients.p, coefficients.x))
    if rms < SAID_FROM or found < chi2_isf(CHANCE, len(coefficients.x)):
        return None
    most, least = int(np.argmax(shown)), int(np.argmin(shown))
    north = (0.5 * math.pi - yaw) % (2.0 * math.pi)
    by_heading, by_time = terms[:, :4] @ coefficients.x[:4], terms[:, 4] * coefficients.x[4]
    return HeadingDeviation(
        rms, std, float(shown[most]), float(north[most]), float(shown[least]), float(north[least]),
        bool(by_time.std() > by_heading.std()),
    )  # fmt: skip


def severity_of(found: HeadingDeviation, estimate: Estimate) -> Severity:
    """To a verdict: reject where the compass is to be calibrated before an estimate is worth anything."""
    is_cut = estimate.gated > GATED_FROM * (estimate.used + estimate.gated)
    if (is_cut and found.rms > GATED_FIRST) or found.rms > max(FIRST, SURELY * found.std):
        return Severity.REJECT
    is_drift = found.by_time and found.rms > max(DRIFTS_FROM, SURELY * found.std)
    return Severity.MARGINAL if is_drift or is_cut else Severity.WARNING


def heading_warnings(found: HeadingDeviation) -> Reason:
    """What to say of it."""
    degrees = math.degrees
    course = "with time" if found.by_time else "with the heading"
    first = "calibrate the compass first: " if found.rms > max(FIRST, SURELY * found.std) else ""
    return finding(
        "HEADING_DEVIATION",
        course=course,
        rms=degrees(found.rms),
        std=degrees(found.std),
        most=degrees(found.most),
        most_at=degrees(found.most_at),
        least=degrees(found.least),
        least_at=degrees(found.least_at),
        cost=1000.0 * found.rms,
        first=first,
    )
