"""Covariance of errors that are constant in a recording and differ between recordings.

Heading reference errors (yaw) and the speed of sound (scale) cause no scatter within a recording. The published σ and
the comparison of recordings include them; convergence and observability do not.
"""

from __future__ import annotations

import numpy as np

from ..models import Model
from ..models.parameters import Parameters
from ..numerics.frames import Array


def day_covariance(model: Model, parameters: Parameters) -> Array:
    """Return the addition (n, n) to the covariance of a model; zero for models without a reference.

    `day_std_heading` acts about the body's vertical, `day_std_scale` on all scales alike.
    """
    found = np.zeros((model.n_state, model.n_state))
    if model.aided:
        upwards = parameters.rotation_dvl_from_body[:, 2]
        found[:3, :3] = parameters.day_std_heading**2 * np.outer(upwards, upwards)
        found[3 : model.n_errors, 3 : model.n_errors] = parameters.day_std_scale**2
    return found
