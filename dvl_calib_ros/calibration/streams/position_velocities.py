"""A reference that is positions: velocities of a moment, from those over the windows of `position_window`."""

from __future__ import annotations

import numpy as np

from ..models import WITH_POSITIONS
from ..models.parameter_spec import ParameterError
from ..models.parameters import Parameters
from ..numerics.frames import Array

# Velocities made of positions are of no use from this noise on, m/s.
NOISY_MPS = 0.3


def are_positions(parameters: Parameters) -> bool:
    """Whether the reference is positions."""
    return parameters.gnss_type.endswith(("/NavSatFix", "/PoseWithCovarianceStamped", "/PoseStamped"))


def check_model(parameters: Parameters) -> None:
    """Raise ParameterError where a model is named that goes by positions, and the reference is velocities."""
    if parameters.model == WITH_POSITIONS and not are_positions(parameters):
        raise ParameterError(
            f"model: {WITH_POSITIONS} goes by positions, and {parameters.gnss_type} holds velocities; name another "
            "model, or a topic of positions (--gnss-topic, gnss_type: NavSatFix or PoseWithCovarianceStamped)"
        )


def of_moments(times: Array, velocity: Array, window_s: float) -> Array:
    """Velocities (N, 3) m/s at the middles (N,) s of their windows, from those over them.

    Over a window a wave is less than in its middle, by its bend: on a circle that looks like a clock that is late.
    """
    if len(times) < 2:
        return velocity
    bend = -2.0 * velocity
    known = np.ones(len(times), dtype=bool)
    for asked in (times - window_s, times + window_s):
        after = np.clip(np.searchsorted(times, asked), 1, len(times) - 1)
        # beyond an end, and across an outage, nothing is known
        known &= (asked >= times[0]) & (asked <= times[-1]) & (times[after] - times[after - 1] <= 1.5 * window_s)
        bend = bend + np.stack([np.interp(asked, times, axis) for axis in velocity.T], axis=1)
    return velocity - np.where(known[:, None], bend, 0.0) / 24.0
