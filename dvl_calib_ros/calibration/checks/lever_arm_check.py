"""A lever arm that was told (by a transform, a URDF, a parameter) against the one that the data show.

Both are the DVL's place from the reference point, and a tape measure is good to centimetres. Where they differ by far
more than both explain, something is wrong, and the arm is the symptom: a heading that counts from north, velocities of
a DVL in the earth's frame, turn rates of the wrong sign or unit, a late IMU, an antenna elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ...verdict.reasons import Reason, finding
from ..models import MODELS
from ..models.parameters import Parameters
from ..numerics.kalman import GaussianState
from ..results.results import ARM, contradicts_configured_arm, estimates_lever_arm

if TYPE_CHECKING:
    from ..results.results import Estimate


def lever_arm_warnings(estimates: Iterable[Estimate], parameters: Parameters) -> list[Reason]:
    """Whether the lever arm that was told is another than the one that the first estimate shows that finds it."""
    estimate = next((each for each in estimates if each.used and estimates_lever_arm(MODELS[each.model])), None)
    if estimate is None:
        return []
    # a late clock, which at one speed explains as much, is one of the causes
    state = GaussianState(estimate.state, estimate.covariance - estimate.left_open)
    off = contradicts_configured_arm(MODELS[estimate.model], state, parameters)
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
