"""What the data has shown so far: per parameter, what is still missing, and how far the calibration is."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from ..models import Model
from ..models.parameters import Parameters
from ..numerics.frames import Array
from .filter_setup import prior

# A parameter counts as observed once the data has halved its prior standard deviation: it then holds three times the
# information of the prior.
OBSERVED_SHARE = 0.5
# A DVL axis with more than this share of the motion ahead has its scale shown by it.
SHARE_AHEAD = 0.25
# From here on a lever arm (m) and a delay (s) are fine: 5 cm at 10 degrees per second are 9 mm/s, 10 ms at 1 m/s² 10.
FINE_STD = {"m": 0.05, "s": 0.01}
_BODY_AXES = ("roll", "pitch", "yaw")
# What roll and pitch need of a reference; nothing is claimed of them without.
MEASURES_VERTICAL = "a reference that measures the vertical velocity"


class Convergence(Enum):
    """How far a calibration is."""

    COLLECTING = "collecting"
    COARSE = "coarse"
    FINE = "fine"


class Observability(NamedTuple):
    """One parameter of one model.

    std: standard deviation (rad, dimensionless, m or s). observed: the data has halved the prior's. axis: the body axis
    (roll, pitch, yaw) that an angle's uncertainty turns about, scale (across), or the name in words. missing: what to
    do, '' once observed. progress: share of the way from the prior's standard deviation (0) to the fine threshold (1),
    by its logarithm.
    """

    name: str
    std: float
    observed: bool
    axis: str
    missing: str
    progress: float


def observability(
    model: Model, covariance: Array, parameters: Parameters, tilt_needs: str = ""
) -> tuple[Observability, ...]:
    """One entry per error of the DVL that the model estimates, and lever arm and delay, from its covariance (n, n).

    tilt_needs: what roll and pitch lack where that is no motion.

    What the data lacks is a motion of the vehicle, so the cause is looked for in the body frame: with a DVL mounted
    at 45 degrees, a straight leg leaves φx and φy uncertain together, and both for want of roll.
    """
    prior_std = np.sqrt(np.diag(prior(model, parameters).p))
    in_body = body_angle_std(covariance, parameters)
    entries = []
    for index, name in enumerate(model.state_names[: model.n_errors]):
        std = math.sqrt(covariance[index, index])
        observed = bool(std <= OBSERVED_SHARE * prior_std[index])
        if index < 3:  # row i of T is the i-th DVL axis in the body
            axis = _BODY_AXES[int(np.argmax(np.abs(parameters.rotation_dvl_from_body[index]) * in_body))]
            fine_std = parameters.fine_std_misalignment
        else:
            axis = _scale_axis(model, index, parameters)
            fine_std = parameters.fine_std_scale
        missing = "" if observed else tilt_needs if tilt_needs and axis in _BODY_AXES[:2] else model.shown_by[axis]
        entries.append(Observability(name, std, observed, axis, missing, _progress(std, prior_std[index], fine_std)))
    for index, name in enumerate(model.state_names[model.n_errors :], start=model.n_errors):
        if name in model.shown_by:  # no mere nuisance
            std = math.sqrt(covariance[index, index])
            observed = bool(std <= OBSERVED_SHARE * prior_std[index])
            missing = "" if observed else model.shown_by[name]
            progress = _progress(std, prior_std[index], FINE_STD[model.nuisance[index - model.n_errors].unit])
            entries.append(Observability(name, std, observed, name.replace("_", " "), missing, progress))
    return tuple(entries)


def _progress(std: float, prior_std: float, fine_std: float) -> float:
    if std <= fine_std:
        return 1.0
    return 0.0 if std >= prior_std else math.log(prior_std / std) / math.log(prior_std / fine_std)


def body_angle_std(covariance: Array, parameters: Parameters) -> Array:
    """Standard deviations (3,) rad of the misalignment about the body's axes: roll, pitch, yaw."""
    t = parameters.rotation_dvl_from_body
    return np.sqrt(np.diag(t.T @ covariance[:3, :3] @ t))


def _scale_axis(model: Model, index: int, parameters: Parameters) -> str:
    """Whether a scale state is that of motion ahead or across the bow."""
    axes = [axis for axis in range(3) if model.error_terms_from_state[3 + axis, index]]
    ahead = parameters.rotation_dvl_from_body[axes, 0] ** 2
    return "scale" if ahead.sum() > SHARE_AHEAD else "scale across"


def scale_std_ahead(model: Model, covariance: Array, parameters: Parameters) -> Array:
    """Standard deviation of the scale-factor error of motion ahead: one number, or none if the model has no scale.

    A velocity along n (body x in the DVL frame) is measured too long by nᵀ diag(δk) n.
    """
    if not model.scale_axes:
        return np.zeros(0)
    ahead = parameters.rotation_dvl_from_body[:, 0] ** 2 @ model.error_terms_from_state[3:]
    return np.sqrt(np.array([ahead @ covariance @ ahead]))


def convergence(model: Model, covariance: Array, parameters: Parameters) -> Convergence:
    """How far a model is. fine: an angle is observed, every observed angle and the scale are below their thresholds.

    Angles are those about the body's axes, which are what a motion shows or does not show. The scale is that of motion
    ahead: scales of other axes may never be seen.
    """
    angles = body_angle_std(covariance, parameters)
    scales = scale_std_ahead(model, covariance, parameters)
    observed_angles = angles <= OBSERVED_SHARE * parameters.initial_std_misalignment
    observed_scales = scales <= OBSERVED_SHARE * parameters.initial_std_scale
    if not observed_angles.any() and not observed_scales.any():
        return Convergence.COLLECTING
    angles_fine = observed_angles.any() and (angles[observed_angles] < parameters.fine_std_misalignment).all()
    return Convergence.FINE if angles_fine and (scales < parameters.fine_std_scale).all() else Convergence.COARSE
