"""Simulated sensors: a DVL with four beams, GNSS velocity and an IMU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import Array, rotation_from_rpy

JANUS_FROM_VERTICAL = np.deg2rad(20.0)
JANUS_AZIMUTHS = np.deg2rad([45.0, 135.0, 225.0, 315.0])

# unit vectors of the beams (4, 3): velocity along each beam = BEAMS @ velocity
BEAMS: Array = np.column_stack(
    [
        np.cos(JANUS_AZIMUTHS) * np.sin(JANUS_FROM_VERTICAL),
        np.sin(JANUS_AZIMUTHS) * np.sin(JANUS_FROM_VERTICAL),
        np.full(4, np.cos(JANUS_FROM_VERTICAL)),
    ]
)
AXES_FROM_BEAMS: Array = np.linalg.pinv(BEAMS)  # least squares


@dataclass(frozen=True)
class DvlErrors:
    """Errors of a DVL.

    misalignment_rpy: (3,) rad, actual DVL in its nominal orientation, as a URDF origin.
    scale: (3,) per axis.
    beam_bias: (4,) m/s.
    beam_std: m/s of white noise on each beam.
    """

    misalignment_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: tuple[float, float, float] = (0.0, 0.0, 0.0)
    beam_bias: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    beam_std: float = 0.0


@dataclass(frozen=True)
class ImuErrors:
    """Errors of an IMU, per axis: white noise of attitude (rad) and angular velocity (rad/s), gyro bias (rad/s)."""

    attitude_std: float = 0.0
    gyro_std: float = 0.0
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)


def equivalent_error_terms(errors: DvlErrors) -> tuple[Array, Array]:
    """Return the equivalent φ (3,) rad and δk (3,) of the calibration's error model, as truth for comparison.

    A rotation is not I + [φ×]: with B = (I + scale) rotation, δk is B's diagonal minus one and φ the skew part of
    diag(1 + δk)⁻¹ B. A rotation by θ about one axis is φ = tanθ and, on the other two axes, δk = cosθ - 1. The
    neglected symmetric part is 0.2 per cent of the speed at 5 degrees about several axes.
    """
    b = np.diag(1.0 + np.asarray(errors.scale)) @ rotation_from_rpy(errors.misalignment_rpy).T
    c = b / np.diag(b)[:, None]
    skew_part = 0.5 * (c - c.T)
    return np.array([skew_part[2, 1], skew_part[0, 2], skew_part[1, 0]]), np.diag(b) - 1.0


def measure_dvl(
    velocity_body: Array,
    errors: DvlErrors,
    rotation_dvl_from_body: Array,
    rng: np.random.Generator,
    turn: Array | None = None,
) -> Array:
    """Simulate DVL velocities (N, 3) m/s in its own frame: rotated, scaled, measured by beams, solved by least squares.

    turn: (3,) or (N, 3) rad, added to the rotation vector of the misalignment.
    """
    misaligned = rotation_from_rpy(errors.misalignment_rpy).T
    if turn is None or not turn.any():
        rotated = velocity_body @ (misaligned @ rotation_dvl_from_body).T
    else:
        angles = Rotation.from_matrix(misaligned).as_rotvec() + turn
        rotated = Rotation.from_rotvec(angles).apply(velocity_body @ rotation_dvl_from_body.T)
    scaled = rotated * (1.0 + np.asarray(errors.scale))
    beams = scaled @ BEAMS.T + np.asarray(errors.beam_bias)
    beams = beams + rng.normal(0.0, errors.beam_std, beams.shape)
    return beams @ AXES_FROM_BEAMS.T


def axis_covariance(beam_std: float) -> Array:
    """Return the covariance (3, 3) (m/s)² of the axes for white noise on the beams."""
    return beam_std**2 * AXES_FROM_BEAMS @ AXES_FROM_BEAMS.T


def measure_gnss(velocity: Array, std: float, rng: np.random.Generator) -> Array:
    """Simulate GNSS velocities (N, 3) m/s with white noise per axis."""
    return velocity + rng.normal(0.0, std, velocity.shape)


def measure_imu(
    rotation_enu_from_body: Array, angular_velocity: Array, errors: ImuErrors, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Simulate an IMU's attitudes (N, 3, 3) and angular velocities (N, 3) rad/s, body frame."""
    shape = angular_velocity.shape
    tilted = rotation_from_rpy(rng.normal(0.0, errors.attitude_std, shape))
    gyro_noise = rng.normal(0.0, errors.gyro_std, shape)
    return rotation_enu_from_body @ tilted, angular_velocity + errors.gyro_bias + gyro_noise
