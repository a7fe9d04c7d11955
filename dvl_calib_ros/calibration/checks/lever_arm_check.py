"""Consistency of the configured lever arm with the estimated one.

A configured lever arm (URDF, /tf_static or parameter) is a tape measurement. A significant difference means that
another input is wrong. Examples: a compass heading from north, earth-frame DVL velocities, wrong sign or unit of turn
rates, a delayed IMU, an antenna elsewhere.
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
    """Return a reason if the data contradict the configured lever arm, by the first estimate that includes it."""
    estimate = next((fit for fit in estimates if fit.used and estimates_lever_arm(MODELS[fit.model])), None)
    if estimate is None:
        return []
    # without the clock's uncertainty: a delay, which looks the same at constant speed, is one of the causes
    state = GaussianState(estimate.state, estimate.covariance - estimate.left_open)
    is_contradicted = contradicts_configured_arm(MODELS[estimate.model], state, parameters)
    if not is_contradicted.any():
        return []
    arm = estimate.lever_arm(parameters.lever_arm)
    std = estimate.std[[estimate.state_names.index(name) for name in ARM]]
    axes = ", ".join(
        f"{axis} {arm[i]:+.2f} m ± {std[i]:.2f} for {parameters.lever_arm[i]:+.2f}"
        for i, axis in enumerate("xyz")
        if is_contradicted[i]
    )
    return [finding("LEVER_ARM_CONTRADICTED", axes=axes)]
