"""A lever arm that was told (by a transform, a URDF, a parameter) against the one that the data show.

Both are the DVL's place from the reference point, and a tape measure is good to centimetres. Where they differ by far
more than both explain, something is wrong, and the arm is the symptom: a heading that counts from north, velocities of
a DVL in the earth's frame, turn rates of the wrong sign or unit, a late IMU, an antenna elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ..verdict.reasons import Reason, finding
from .models import MODELS, Model
from .models.parameters import Parameters
from .numerics.kalman import GaussianState
from .numerics.samples import Mask

if TYPE_CHECKING:
    from .results import Estimate

ARM = ("lever_arm_x", "lever_arm_y", "lever_arm_z")
# So many σ are no chance, and so many metres no tape measure's error.
SIGMAS, MEASURED_TO = 10.0, 0.05
# Data that know an arm so many times worse than a tape measure do not improve on it.
WORSE_THAN_TOLD = 2.0


def finds_arm(model: Model) -> bool:
    """Whether its states have the lever arm."""
    return set(ARM) <= set(model.state_names)


def stands(model: Model, state: GaussianState, parameters: Parameters) -> Mask:
    """(3,) whether it is where it was told to be, by axis: contradicted, or known less well than by a tape measure."""
    if not any(parameters.lever_arm) or not finds_arm(model):
        return np.zeros(3, dtype=bool)
    std = np.sqrt(np.diag(state.p)[[model.state_names.index(name) for name in ARM]])
    return contradicted(model, state, parameters) | np.asarray(std > WORSE_THAN_TOLD * MEASURED_TO)


def contradicted(model: Model, state: GaussianState, parameters: Parameters) -> Mask:
    """(3,) whether the data show the DVL elsewhere than it was told to be, by axis of the body."""
    if not any(parameters.lever_arm) or not finds_arm(model):
        return np.zeros(3, dtype=bool)
    at = [model.state_names.index(name) for name in ARM]
    away, std = np.abs(state.x[at]), np.sqrt(np.diag(state.p)[at])
    return np.asarray(away > np.maximum(SIGMAS * std, MEASURED_TO))


def told_arm_advice(estimates: Iterable[Estimate], parameters: Parameters) -> list[Reason]:
    """Whether the lever arm that was told is another than the one that the first estimate shows that finds it."""
    estimate = next((each for each in estimates if each.used and finds_arm(MODELS[each.model])), None)
    if estimate is None:
        return []
    # a late clock, which at one speed explains as much, is one of the causes
    state = GaussianState(estimate.state, estimate.covariance - estimate.left_open)
    off = contradicted(MODELS[estimate.model], state, parameters)
    if not off.any():
        return []
    arm = estimate.lever_arm(parameters.lever_arm)
    std = estimate.std[[estimate.state_names.index(name) for name in ARM]]
    axes = ", ".join(
        f"{axis} {arm[i]:+.2f} m ± {std[i]:.2f} for {parameters.lever_arm[i]:+.2f}"
        for i, axis in enumerate("xyz")
        if off[i]
    )
    return [finding("LEVER_ARM_CONTRADICTED", axes=axes)]
