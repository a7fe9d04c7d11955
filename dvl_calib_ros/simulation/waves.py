"""Surface waves: what they add to a vehicle's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..calibration.frames import Array, rotation_from_rpy
from .trajectories import Motion, body_rates

GRAVITY = 9.81
COMPONENTS = 12
# Angular frequencies of the components over that of the peak, and spread of their directions
BAND = (0.7, 2.0)
SPREAD = np.deg2rad(20.0)


@dataclass(frozen=True)
class Waves:
    """A sea state. height: significant wave height, m. period: of the spectrum's peak, s."""

    height: float
    period: float


def add_waves(motion: Motion, waves: Waves, rng: np.random.Generator) -> Motion:
    """The motion of a vehicle small against the waves: it goes round with the water and tilts with its surface.

    Airy waves in deep water, of a Bretschneider spectrum, phases and directions by chance. With θ = k x - ω t + φ the
    surface is a cos θ, its slope -a k sin θ and the water moves at aω cos θ along and aω sin θ upwards.
    """
    steps = np.diff(motion.time, prepend=motion.time[0])
    velocity_enu = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, motion.velocity_body)
    east, north = np.cumsum(velocity_enu[:, :2] * steps[:, None], axis=0).T
    orbital = np.zeros_like(velocity_enu)
    slope = np.zeros((len(east), 2))
    for amplitude, omega, direction, phase in _components(waves, rng):
        number = omega**2 / GRAVITY
        toward = np.array([np.cos(direction), np.sin(direction)])
        theta = number * (east * toward[0] + north * toward[1]) - omega * motion.time + phase
        orbital[:, :2] += amplitude * omega * np.cos(theta)[:, None] * toward
        orbital[:, 2] += amplitude * omega * np.sin(theta)
        slope -= amplitude * number * np.sin(theta)[:, None] * toward
    return _tilted(motion, orbital, slope)


def _components(waves: Waves, rng: np.random.Generator) -> list[tuple[float, float, float, float]]:
    """Amplitude (m), angular frequency (rad/s), direction (rad, east to north) and phase (rad) of each."""
    ratio = np.linspace(*BAND, COMPONENTS)
    energy = ratio**-5 * np.exp(-1.25 * ratio**-4)
    amplitudes = np.sqrt(2.0 * energy / energy.sum()) * waves.height / 4.0
    directions = rng.uniform(0.0, 2.0 * np.pi) + rng.normal(0.0, SPREAD, COMPONENTS)
    phases = rng.uniform(0.0, 2.0 * np.pi, COMPONENTS)
    omegas = ratio * 2.0 * np.pi / waves.period
    return list(zip(amplitudes.tolist(), omegas.tolist(), directions.tolist(), phases.tolist(), strict=True))


def _tilted(motion: Motion, orbital_enu: Array, slope_enu: Array) -> Motion:
    """The motion with a velocity (N, 3) m/s added, lying on a surface of this slope (N, 2) east and north."""
    rotation = motion.rotation_enu_from_body
    ahead = np.einsum("ni,ni->n", slope_enu, rotation[:, :2, 0])
    to_port = np.einsum("ni,ni->n", slope_enu, rotation[:, :2, 1])
    roll, pitch = np.arctan(to_port), -np.arctan(ahead)
    tilt = rotation_from_rpy(np.column_stack([roll, pitch, np.zeros_like(roll)]))
    tilt_rates = body_rates(motion.time, roll, pitch, np.zeros_like(roll))
    velocity = motion.velocity_body + np.einsum("nji,nj->ni", rotation, orbital_enu)
    return Motion(
        motion.time,
        np.einsum("nji,nj->ni", tilt, velocity),
        rotation @ tilt,
        np.einsum("nji,nj->ni", tilt, motion.angular_velocity) + tilt_rates,
    )
