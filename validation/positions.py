"""A run with positions whose noise lasts, and outliers, for D1: simulated by itself, and what D1 makes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.estimators.displacement_least_squares import DeadReckoning, DisplacementFit, Fixes, solve
from dvl_calib_ros.calibration.filters.filter_setup import prior
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import Array
from dvl_calib_ros.calibration.numerics.samples import Stamps


@dataclass(frozen=True)
class Truth:
    """phi: misalignment, rad. scale. arm: DVL from reference point, m. late_s: of the fixes. deviation: of the
    heading, of its sine and cosine, rad."""

    phi: tuple[float, float, float]
    scale: float = 0.0
    arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late_s: float = 0.0
    deviation: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Noise:
    """m: white, and lasting with a time of lasts_s; share of outliers of 30 m. dvl: m/s."""

    white: float = 2.0
    lasting: float = 0.0
    lasts_s: float = 60.0
    outliers: float = 0.0
    dvl: float = 0.01


class Driven(NamedTuple):
    """Stamps (N,) ns, velocities (N, 3) m/s and attitudes (N, 4) of the DVL's samples, and fixes."""

    stamps_ns: Stamps
    velocity: Array
    quaternion: Array
    fixes: Fixes


def driven(
    rng: np.random.Generator,
    seconds: float,
    dvl_hz: float = 5.0,
    fix_s: float = 1.0,
    speed: float = 1.5,
    truth: Truth | None = None,
    noise: Noise | None = None,
    depths: bool = False,
) -> Driven:
    """A lawnmower's lines."""
    truth, noise = truth or Truth((0.0, 0.0, 0.0), 0.0), noise or Noise()
    dt = 0.05
    time = np.arange(0.0, seconds + 5.0, dt)
    # lines of two minutes to and fro, and a short one across between them
    yaw_at = np.cumsum([0.0, 120.0, 15.0, 120.0, 15.0] * (1 + int(seconds / 270.0)))
    legs = np.array([0.0, 90.0, 180.0, 90.0] * (1 + int(seconds / 270.0)))
    index = np.clip(np.searchsorted(yaw_at[1::1], time, side="right"), 0, len(legs) - 1)
    wanted = np.radians(legs[index] + 25.0)
    yaw = lfilter([dt / 3.0], [1.0, dt / 3.0 - 1.0], wanted - wanted[0]) + wanted[0]
    pitch = 0.02 * np.sin(time / 7.0) + (0.15 * np.sin(time / 90.0) if depths else 0.0)
    roll = 0.03 * np.sin(time / 5.0)
    rotation = Rotation.from_quat(_quaternions(yaw, pitch, roll))
    # moves where it points, with some sway in turns
    body = np.column_stack([np.full(len(time), speed), 0.1 * np.gradient(yaw, dt), np.zeros(len(time))])
    position = np.cumsum(rotation.apply(body), axis=0) * dt
    arm = rotation.apply(truth.arm)
    at_dvl = np.gradient(position + arm, dt, axis=0)
    measured = rotation.inv().apply(at_dvl)
    phi = np.asarray(truth.phi)
    matrix = (1.0 + truth.scale) * (np.eye(3) + np.cross(np.eye(3), phi))
    every = round(1.0 / (dvl_hz * dt))
    at = np.arange(0, len(time), every)
    velocity = measured[at] @ matrix.T + rng.normal(0.0, noise.dvl, (len(at), 3))
    fix_at = np.arange(40, len(time) - 40, round(fix_s / dt))
    fixes = position[fix_at]
    fixes = fixes + rng.normal(0.0, noise.white, fixes.shape)
    if noise.lasting:
        a = math.exp(-fix_s / noise.lasts_s)
        driving = rng.normal(0.0, noise.lasting, fixes.shape)
        driving[1:] *= math.sqrt(1.0 - a * a)
        fixes = fixes + lfilter([1.0], [1.0, -a], driving, axis=0)
    bad = rng.random(len(fixes)) < noise.outliers
    fixes[bad] += rng.normal(0.0, 30.0, (int(bad.sum()), 3))
    stamps = (time * 1e9).astype(np.int64) + 1_760_000_000_000_000_000
    sine, cosine = truth.deviation
    told = rotation.as_euler("ZYX") + np.outer(sine * np.sin(yaw) + cosine * np.cos(yaw), [1.0, 0.0, 0.0])
    variance = np.full(fixes.shape, float(noise.white) ** 2)
    if not depths:
        variance[:, 2] = np.nan
    return Driven(
        stamps[at],
        velocity,
        _quaternions(*told[at].T),
        Fixes(stamps[fix_at] + round(truth.late_s * 1e9), fixes, variance),
    )


def _quaternions(yaw: Array, pitch: Array, roll: Array) -> Array:
    """(N, 4), x y z w, of angles (N,) rad: a tenth of the time of SciPy's `from_euler`, which takes any axes."""
    (cy, cp, cr), (sy, sp, sr) = (of(0.5 * np.stack([yaw, pitch, roll])) for of in (np.cos, np.sin))
    return np.column_stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


NOISES = {
    "white": Noise(),
    "lasts_30_s": Noise(2.0, 2.0, 30.0),
    "lasts_2_min": Noise(2.0, 2.0, 120.0),
    "outliers": Noise(2.0, 0.0, 60.0, 0.05),
}


def drawn(rng: np.random.Generator) -> Truth:
    """A DVL, its place, the delay of the fixes and a compass, as they may be."""
    phi = rng.normal(0.0, [0.01, 0.01, 0.03])
    return Truth(
        tuple(phi), rng.normal(0.0, 0.005), tuple(rng.normal(0.0, 1.0, 3)), abs(rng.normal(0.0, 1.0)),
        tuple(rng.normal(0.0, math.radians(0.5), 2)),
    )  # fmt: skip


def fitted(run: Driven, parameters: Parameters | None = None) -> DisplacementFit | None:
    """What D1 makes of a run; None for too little."""
    parameters = parameters or Parameters()
    reckoning = DeadReckoning(parameters.rotation_dvl_from_body)
    reckoning.add_fixes(run.fixes)
    reckoning.add_rows(run.stamps_ns, run.velocity, run.quaternion)
    return solve(reckoning.legs(), parameters, prior(MODELS["positions"], parameters))


def errors_of(fit: DisplacementFit | None, truth: Truth) -> tuple[Array, Array]:
    """Error and σ (2,) of yaw (rad) and scale."""
    assert fit is not None
    x, p = fit.errors
    return np.array([x[2] - truth.phi[2], x[3] - truth.scale]), np.sqrt(np.diag(p))[[2, 3]]
