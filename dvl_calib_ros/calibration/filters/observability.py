"""Observability of the parameters by the data so far, missing motions, predicted drift, and convergence.

Errors of yaw and scale move a vehicle off a straight leg, to the side and ahead.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from ..models import Model
from ..models.parameters import Parameters
from ..numerics.frames import Array, skew
from .filter_setup import prior

KM = 1000.0

# Largest share of the prior σ of an observable parameter: its data then hold three times the prior information.
OBSERVED_SHARE = 0.5
# Share of the motion ahead along a DVL axis from which that motion determines its scale.
SHARE_AHEAD = 0.25
# σ of a fine lever arm (m) and delay (s): 5 cm at 10 degrees per second are 9 mm/s, 10 ms at 1 m/s² 10.
FINE_STD = {"m": 0.05, "s": 0.01}
_BODY_AXES = ("roll", "pitch", "yaw")
# Requirement of roll and pitch on a reference.
MEASURES_VERTICAL = "a reference that measures the vertical velocity"
MEASURES_TURNS = "an IMU that measures the turn rate, by which the lever arm is estimated"


class Convergence(Enum):
    """Progress of a calibration: nothing is observable, something is, the drift is within `target_drift`."""

    COLLECTING = "collecting"
    COARSE = "coarse"
    FINE = "fine"


class PredictedDrift(NamedTuple):
    """Predicted drift on a straight leg, m per km, 1σ: to the side, ahead (nan without scale), and both together."""

    side: float
    ahead: float
    both: float

    @staticmethod
    def goals(parameters: Parameters) -> PredictedDrift:
        """Return the drift at `target_drift`, shared equally by both directions."""
        each = parameters.target_drift / math.sqrt(2.0)
        return PredictedDrift(each, each, parameters.target_drift)


class Observability(NamedTuple):
    """Observability of one parameter of one model.

    std: standard deviation (rad, dimensionless, m or s).
    observed: the data halved the prior σ.
    axis: the body axis (roll, pitch, yaw) of an angle's uncertainty, scale (across), or the name in words.
    missing: required motion, '' once observed.
    progress: logarithmic share of the way from the prior σ (0) to the fine threshold (1).
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
    """Return one entry per DVL error of a model, lever arm and delay, from its covariance (n, n).

    tilt_needs: Entry of `missing` for roll and pitch, if they need something other than motion; '' otherwise.

    The missing motion is found in the body frame: with a DVL at 45 degrees, φx and φy both stay uncertain after a
    straight leg, because roll is not observable.
    """
    prior_std = np.sqrt(np.diag(prior(model, parameters).p))
    in_body = body_angle_std(covariance, parameters)
    fine_std = PredictedDrift.goals(parameters).side / KM  # of an angle in rad, of a scale
    entries = []
    for index, name in enumerate(model.state_names[: model.n_errors]):
        std = math.sqrt(covariance[index, index])
        observed = bool(std <= OBSERVED_SHARE * prior_std[index])
        if index < 3:  # row i of T is the i-th DVL axis in the body
            axis = _BODY_AXES[int(np.argmax(np.abs(parameters.rotation_dvl_from_body[index]) * in_body))]
        else:
            axis = _scale_axis(model, index, parameters)
        needed = tilt_needs if tilt_needs and axis in ("roll", "pitch") else model.shown_by[axis]
        progress = _progress(std, prior_std[index], fine_std)
        entries.append(Observability(name, std, observed, axis, "" if observed else needed, progress))
    for index, name in enumerate(model.state_names[model.n_errors :], start=model.n_errors):
        if name in model.shown_by:  # published nuisance state
            std = math.sqrt(covariance[index, index])
            observed = bool(std <= OBSERVED_SHARE * prior_std[index])
            missing = "" if observed else model.shown_by[name]
            progress = _progress(std, prior_std[index], FINE_STD[model.nuisance[index - model.n_errors].unit])
            entries.append(Observability(name, std, observed, name.replace("_", " "), missing, progress))
    return tuple(entries)


def _progress(std: float, prior_std: float, fine_std: float) -> float:
    """Return `Observability.progress`."""
    if std <= fine_std:
        return 1.0
    return 0.0 if std >= prior_std else math.log(prior_std / std) / math.log(prior_std / fine_std)


def body_angle_std(covariance: Array, parameters: Parameters) -> Array:
    """Return the σ (3,) rad of the misalignment about the body axes: roll, pitch, yaw."""
    t = parameters.rotation_dvl_from_body
    return np.sqrt(np.diag(t.T @ covariance[:3, :3] @ t))


def _scale_axis(model: Model, index: int, parameters: Parameters) -> str:
    """Return whether motion ahead or across the bow determines a scale state."""
    axes = [axis for axis in range(3) if model.error_terms_from_state[3 + axis, index]]
    ahead = parameters.rotation_dvl_from_body[axes, 0] ** 2
    return "scale" if ahead.sum() > SHARE_AHEAD else "scale across"


def scale_std_ahead(model: Model, covariance: Array, parameters: Parameters) -> Array:
    """Return the σ of the scale-factor error for motion ahead, (1,); (0,) without scale.

    A velocity along n (body x in the DVL frame) is measured too long by nᵀ diag(δk) n.
    """
    if not model.scale_axes:
        return np.zeros(0)
    ahead = parameters.rotation_dvl_from_body[:, 0] ** 2 @ model.error_terms_from_state[3:]
    return np.sqrt(np.array([ahead @ covariance @ ahead]))


def predicted_drift(model: Model, covariance: Array, parameters: Parameters) -> PredictedDrift:
    """Return the drift due to a model's covariance (n, n)."""
    rows = drift_rows(model, parameters)
    side, ahead = (KM * math.sqrt(max(float(row @ covariance @ row), 0.0)) for row in rows)
    return PredictedDrift(side, ahead if model.scale_axes else math.nan, math.hypot(side, ahead))


def drift_rows(model: Model, parameters: Parameters) -> Array:
    """Return derivatives (2, n) of port and forward velocity, per m/s forward, by the states of a model."""
    t = parameters.rotation_dvl_from_body
    by_terms = t.T @ np.hstack([-skew(t[:, 0]), np.diag(t[:, 0])])
    rows: Array = by_terms[[1, 0]] @ model.error_terms_from_state
    return rows


def convergence(model: Model, covariance: Array, parameters: Parameters) -> Convergence:
    """Return the convergence of a model by its covariance (n, n) for velocities of this recording.

    Angles are about body axes, the ones a motion makes observable. The scale is that for motion ahead, because other
    axes may never be observable.
    """
    angles = body_angle_std(covariance, parameters)
    scales = scale_std_ahead(model, covariance, parameters)
    observed_angles = angles <= OBSERVED_SHARE * parameters.initial_std_misalignment
    observed_scales = scales <= OBSERVED_SHARE * parameters.initial_std_scale
    if not observed_angles.any() and not observed_scales.any():
        return Convergence.COLLECTING
    is_fine = predicted_drift(model, covariance, parameters).both <= parameters.target_drift
    return Convergence.FINE if is_fine else Convergence.COARSE
