"""Velocities derived from reference positions: correction for the averaging over `position_window`."""

from __future__ import annotations

import numpy as np

from ..models import WITH_POSITIONS
from ..models.parameters import ParameterError, Parameters
from ..numerics.frames import Array

# Noise from which velocities derived from positions are useless, m/s.
NOISY_MPS = 0.3


def are_positions(parameters: Parameters) -> bool:
    """Return whether the reference consists of positions."""
    return parameters.gnss_type.endswith(("/NavSatFix", "/PoseWithCovarianceStamped", "/PoseStamped"))


def check_model(parameters: Parameters) -> None:
    """Raise ParameterError if the model needs positions and the reference has velocities."""
    if parameters.model == WITH_POSITIONS and not are_positions(parameters):
        raise ParameterError(
            f"model: {WITH_POSITIONS} goes by positions, and {parameters.gnss_type} holds velocities; name another "
            "model, or a topic of positions (--gnss-topic, gnss_type: NavSatFix or PoseWithCovarianceStamped)"
        )


def of_moments(times: Array, velocity: Array, window_s: float) -> Array:
    """Correct mean velocities (N, 3) m/s over windows to those at the middles (N,) s of the windows.

    The mean attenuates waves in proportion to their curvature, which on a circle looks like a delay.
    """
    if len(times) < 2:
        return velocity
    bend = -2.0 * velocity
    known = np.ones(len(times), dtype=bool)
    for asked in (times - window_s, times + window_s):
        after = np.clip(np.searchsorted(times, asked), 1, len(times) - 1)
        # no correction beyond an end and across an outage
        known &= (asked >= times[0]) & (asked <= times[-1]) & (times[after] - times[after - 1] <= 1.5 * window_s)
        bend = bend + np.stack([np.interp(asked, times, axis) for axis in velocity.T], axis=1)
    return velocity - np.where(known[:, None], bend, 0.0) / 24.0
