"""Whether the heading is off by an amount that changes with the heading, or with time, as no mounting does.

Yaw is found against the IMU's heading, of which a constant error is harmless: the same IMU navigates. A compass
deviates by one and two cycles of the heading, a gyro drifts. Both turn the reference in the body, so the error to port,
as a share of the speed, follows the heading or the time; the error ahead does not. A constant error of the reference
follows the heading as well, to port and ahead alike, and is taken out with it, as far as references have one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..calibration.findings import Finding, finding
from ..calibration.frames import Array

# Stretches (s) that are averaged; one in which the heading changes by more (rad) is a turn and says nothing here.
STRETCH_S, TURNS = 10.0, math.radians(15.0)
# Fewer stretches, or a slower vehicle (m/s), say nothing.
ENOUGH, SLOW = 12, 0.1
# Standard deviation (rad) of each term before the data are seen.
LIKELY = math.radians(3.0)
# A stretch that is off by so many times the median is a manoeuvre, a gust or an outlier.
OUTLYING, ROUNDS = 3.0, 6
# Constant error that a reference may have, m/s.
OFFSET = 0.01
# F of the terms that is no chance, with the rms (rad) from which it is worth a word.
SURELY, SAID_FROM = 6.0, math.radians(0.3)
# From here on (rad) the compass is to be calibrated first (QRev's rule).
FIRST = math.radians(3.0)


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


def heading_deviation(time: Array, yaw: Array, velocity: Array, error: Array) -> HeadingDeviation | None:
    """None where it does not show.

    Parameters
    ----------
    time: (N,) s.
    yaw: (N,) rad, from east, to the left.
    velocity, error: (N, 2) m/s of the reference, and reference less DVL, ahead and to port.

    """
    blocks = _blocks(time, yaw, velocity, error)
    if len(blocks) < ENOUGH:
        return None
    at, turned, speed, ahead, port = blocks.T
    none = np.zeros(len(at))
    when = (at - at.mean()) / max(float(np.ptp(at)), 1.0)
    s, c = np.sin(turned), np.cos(turned)
    # columns: scale, east, north (constant errors of the reference), yaw; then one cycle, two cycles, time
    rows_ahead = np.stack([speed, c, s, none, *[none] * 5], axis=1)
    terms = np.stack([s, c, np.sin(2.0 * turned), np.cos(2.0 * turned), when])
    rows_port = np.stack([none, -s, c, speed, *(speed * terms)], axis=1)
    h, z = np.concatenate([rows_ahead, rows_port]), np.concatenate([ahead, port])
    scatter = np.diff(z.reshape(2, -1), axis=1).std() / math.sqrt(2.0)
    std = np.array([np.inf, OFFSET, OFFSET, np.inf, *[LIKELY] * 5]) / max(float(scatter), 1e-4)
    weight = np.ones(len(z))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        _, (x, _) = _left(root[:, None] * h, root * z, std)
        rest = np.abs(z - h @ x)
        weight = 1.0 / np.maximum(rest / max(OUTLYING * float(np.median(rest)), 1e-6), 1.0) ** 2
    kept = weight > 0.5
    h, z = h[kept], z[kept]
    without, _ = _left(h[:, :4], z, std[:4])
    left, (x, p) = _left(h, z, std)
    free = max(len(z) - 9, 1)
    noise = left / free
    if not noise > 0.0 or (without - left) / 5.0 < SURELY * noise:
        return None
    shown = terms.T @ x[4:]
    shown -= shown.mean()
    centred = terms.T - terms.T.mean(axis=0)
    rms = float(np.sqrt((shown**2).mean()))
    variance = float(np.einsum("ni,ij,nj->n", centred, noise * p[4:, 4:], centred).mean())
    if rms < SAID_FROM or rms < 3.0 * math.sqrt(variance):
        return None
    most, least = int(np.argmax(shown)), int(np.argmin(shown))
    north = (0.5 * math.pi - turned) % (2.0 * math.pi)
    by_heading, by_time = terms[:4].T @ x[4:8], when * x[8]
    return HeadingDeviation(
        rms, math.sqrt(variance), float(shown[most]), float(north[most]), float(shown[least]), float(north[least]),
        bool(by_time.std() > by_heading.std()),
    )  # fmt: skip


def heading_advice(found: HeadingDeviation | None) -> list[Finding]:
    """What to say of it."""
    if found is None:
        return []
    degrees = math.degrees
    course = "with time" if found.by_time else "with the heading"
    first = "calibrate the compass first: " if found.rms > FIRST and found.rms > found.std else ""
    return [
        finding(
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
    ]


def _blocks(time: Array, yaw: Array, velocity: Array, error: Array) -> Array:
    """Means over straight stretches (M, 5): time, yaw, speed ahead, error ahead and to port."""
    if not len(time):
        return np.zeros((0, 5))
    number = np.floor((time - time[0]) / STRETCH_S).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], number[1:] != number[:-1]]))
    means = []
    for start, end in zip(starts, [*starts[1:], len(time)], strict=True):
        part = slice(start, end)
        middle = math.atan2(np.sin(yaw[part]).mean(), np.cos(yaw[part]).mean())
        off = np.abs((yaw[part] - middle + math.pi) % (2.0 * math.pi) - math.pi)
        ahead = float(velocity[part, 0].mean())
        if off.max() > TURNS or end - start < 5 or ahead < SLOW:
            continue
        means.append([float(time[part].mean()), middle, ahead, *error[part].mean(axis=0).tolist()])
    return np.array(means).reshape(-1, 5)


def _left(h: Array, z: Array, std: Array) -> tuple[float, tuple[Array, Array]]:
    """Cost that is left; the state, and covariance over the noise's variance. std: prior, in units of the noise."""
    prior = std**-2.0
    information = h.T @ h + np.diag(prior + 1e-12)
    x = np.linalg.solve(information, h.T @ z)
    return float(((z - h @ x) ** 2).sum() + x @ (prior * x)), (x, np.linalg.inv(information))
