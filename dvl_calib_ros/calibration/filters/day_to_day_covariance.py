"""What is constant on one day and another on the next.

By how much the heading reference is off goes into yaw one to one, the speed of sound into scale; no scatter within a
recording shows either. A σ is worth what happens in the next recording, so that which is published, and that by which
recordings are compared, hold both; how far a calibration is, and what its data showed, goes by the recording alone.
"""

from __future__ import annotations

import numpy as np

from ..models import Model
from ..models.parameters import Parameters
from ..numerics.frames import Array


def day_covariance(model: Model, parameters: Parameters) -> Array:
    """(n, n) to be added to a model's covariance: `day_std_heading` about the body's vertical, `day_std_scale` of every
    scale alike. Zero for models without a reference, which these do not reach.
    """
    found = np.zeros((model.n_state, model.n_state))
    if model.aided:
        upwards = parameters.rotation_dvl_from_body[:, 2]
        found[:3, :3] = parameters.day_std_heading**2 * np.outer(upwards, upwards)
        found[3 : model.n_errors, 3 : model.n_errors] = parameters.day_std_scale**2
    return found
