"""Velocities derived from reference positions: correction for the averaging over `position_window`."""

from __future__ import annotations

import numpy as np

from ..models import POSITIONS
from ..models.parameters import ParameterError, Parameters
from ..numerics.frames import Array, cross
from .interpolation import GAP_S, ImuColumns, TurnRates, angular_velocity_at, attitude_at, linear_at

# Noise from which velocities derived from positions are useless, m/s.
NOISY_MPS = 0.3
# Factors of the second, fourth and sixth difference in the inverse of a mean (arcsine series).
SERIES = -1.0 / 24.0, 3.0 / 640.0, -5.0 / 7168.0


def are_positions(parameters: Parameters) -> bool:
    """Return whether the reference consists of positions."""
    return parameters.gnss_type.endswith(("/NavSatFix", "/PoseWithCovarianceStamped", "/PoseStamped"))


def check_model(parameters: Parameters) -> None:
    """Raise ParameterError if the model needs positions and the reference has velocities."""
    if parameters.model == POSITIONS.name and not are_positions(parameters):
        raise ParameterError(
            f"model: {POSITIONS.name} needs positions, but {parameters.gnss_type} holds velocities; name another "
            "model, or a topic of positions (--gnss-topic, gnss_type: NavSatFix or PoseWithCovarianceStamped)"
        )


def of_moments(times: Array, velocity: Array, imu: ImuColumns, parameters: Parameters) -> Array:
    """Correct mean velocities (N, 3) m/s over `position_window` to those at the middles (N,) s of the windows.

    The attitude gives the part of the configured lever arm exactly; the rest is deconvolved (`_deconvolved`).
    """
    window_s, arm = parameters.position_window, np.array(parameters.lever_arm)
    if not arm.any() or len(times) < 2:
        return _deconvolved(times, velocity, window_s)
    middle, start, end = (attitude_at(imu, times + half, GAP_S) for half in (0.0, -0.5 * window_s, 0.5 * window_s))
    rates = angular_velocity_at(TurnRates.of(imu), times, GAP_S)
    (rotation, oriented), (first, starts), (last, ends) = middle, start, end
    known = (starts & ends & oriented & np.isfinite(rates).all(axis=1))[:, None]
    arm_mean = np.where(known, (last - first) @ arm / window_s, 0.0)
    arm_velocity = np.where(known, np.einsum("nij,nj->ni", rotation, cross(rates, arm)), 0.0)
    return _deconvolved(times, velocity + arm_mean, window_s) - arm_velocity


def _deconvolved(times: Array, velocity: Array, window_s: float) -> Array:
    """Return velocities (N, 3) m/s whose means over windows around times (N,) s are given.

    The mean attenuates a wave of frequency f by sin(x) / x with x = π f window_s, which on a circle looks like a delay.
    The inverse is a series in differences over the window: x / sin(x) = arcsin(s) / s with s = sin(x).
    """
    if len(times) < 2:
        return velocity
    known = np.ones(len(times), dtype=bool)
    before, after = times - window_s, times + window_s
    for shifted in (before, after):
        sample = np.clip(np.searchsorted(times, shifted), 1, len(times) - 1)
        # no correction beyond an end and across an outage
        known &= (shifted >= times[0]) & (shifted <= times[-1]) & (times[sample] - times[sample - 1] <= 1.5 * window_s)
    corrected, difference = velocity.copy(), velocity
    for factor in SERIES:
        sides = linear_at(times, difference, before) + linear_at(times, difference, after)
        difference = np.where(known[:, None], sides - 2.0 * difference, 0.0)
        corrected += factor * difference
        # the next difference needs this one on both sides
        known = known & (np.interp(before, times, known) > 0.99) & (np.interp(after, times, known) > 0.99)
    return corrected
